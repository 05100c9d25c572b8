"""Runs the stages in order, and skips those that are finished and unchanged."""

from __future__ import annotations

import time
from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path
from threading import Event
from typing import Any

from stages.base.errors import Family, Interrupted, RunFolderError, SplatError, UsageError
from stages.base.interrupt import stop_event
from stages.base.settings import check_settings
from stages.base.stage import Stage
from stages.base.text import quoted
from stages.run import runfolder
from stages.run.attempt import attempt
from stages.run.digests import damage
from stages.run.failures import as_splat_error, unusable
from stages.run.listener import Listener
from stages.run.lock import holder
from stages.run.manifest import Manifest
from stages.run.planning import PHOTOS, Planner, Step
from stages.run.runfile import RunFile
from stages.run.stages import STAGES
from stages.run.time_limit import within_limit
from stages.run.workspace import Layout

__all__ = ["Pipeline", "Step"]

_PICTURES = (".jpg", ".png")  # no stage's `load` opens these


class Pipeline:
    """The stages over one run folder.

    run_folder: made by `run` if it does not exist. photos: the photographs; by default those that
    the run folder records. stages: all seven by default.
    """

    def __init__(
        self, run_folder: Path, photos: Path | None = None, stages: Sequence[Stage] | None = None
    ) -> None:
        every = tuple(stages) if stages else STAGES
        self.run_folder = Path(run_folder)
        self.photos = Path(photos).absolute() if photos is not None else None
        self.layout = Layout(self.run_folder, every)

    def with_run(self, name: str, run: Callable[..., Any]) -> Pipeline:
        """This pipeline with another function for a stage. It must give the same output."""
        stages = (replace(s, run=run) if s.name == name else s for s in self.layout.stages)
        self.layout = replace(self.layout, stages=tuple(stages))
        return self

    def stage_folder(self, name: str) -> Path:
        """Folder of the finished output of a stage; it need not exist yet."""
        return self.layout.workspace(self.layout.stage(name)).final

    def manifest(self, name: str) -> Manifest | None:
        """The manifest of a finished stage, or None. Raises SplatError as `Manifest.read` does."""
        return Manifest.read(self.stage_folder(name))

    def load(self, name: str) -> Any:
        """The output of a finished stage. What `Stage.load` reads is compared with the digests of
        the manifest. Raises SplatError (stage-not-finished, run-folder-damaged)."""
        if self.manifest(name) is None:
            raise self._not_finished(name, f"{name} has not finished")
        self.check_outputs((name,), pictures=False)
        return self.layout.stage(name).load(self.stage_folder(name))

    def recorded_settings(self, otherwise: Mapping[str, Any] | None = None) -> dict[str, Any]:
        """Settings by stage name, as last requested; of a stage that has none recorded those in
        `otherwise`, by default the stage's own defaults."""
        recorded = RunFile.read(self.run_folder) or RunFile()
        return recorded.settings_of(self.layout.stages, otherwise)

    def recorded_photos(self) -> Path | None:
        """The photographs that the run folder records."""
        recorded = RunFile.read(self.run_folder)
        return recorded.photographs if recorded else None

    def with_exported(self, formats: Collection[str]) -> tuple[str, ...]:
        """The formats that the run has exported, which stay, and then the given ones."""
        exported = self.manifest("export")
        earlier = exported.settings.get("formats", ()) if exported else ()
        return tuple(dict.fromkeys((*earlier, *formats)))

    def busy(self) -> int | None:
        """Id of the process that holds the run folder's lock now, or None."""
        return holder(self.run_folder)

    def status(self) -> list[Step]:
        """The plan for the settings last requested. Raises SplatError (run-folder-missing)."""
        if not runfolder.is_run_folder(self.run_folder):
            raise runfolder.missing(self.run_folder)
        return self.plan()

    def check_outputs(self, names: Collection[str] | None = None, pictures: bool = True) -> None:
        """Read all files of finished stages. Raises SplatError (run-folder-damaged) if one is not
        as it was written: a fault of the disk may change neither size nor time.

        names: of the stages; None for all. pictures: whether pictures are read as well.
        """
        damaged = {}
        for stage in self.layout.stages:
            manifest = self.manifest(stage.name) if names is None or stage.name in names else None
            folder = self.stage_folder(stage.name)
            outputs = manifest.outputs if manifest else {}
            chosen = {
                file: record
                for file, record in outputs.items()
                if pictures or not file.lower().endswith(_PICTURES)
            }
            if changes := damage(folder, chosen, read_all=True):
                damaged[folder] = changes
        if damaged:
            what = (f"{folder.name}/{change}" for folder in damaged for change in damaged[folder])
            folders = " and ".join(quoted(folder) for folder in damaged)
            raise RunFolderError(
                "run-folder-damaged",
                given=f"In {self.run_folder}, {', '.join(what)}.",
                wanted="The files as the stages wrote them.",
                hint=f"Check the disk. Delete {folders}; then `splat process "
                f"{quoted(self.run_folder)}` makes this again, and what depends on it if "
                "it differs.",
            )

    def plan(self, settings: Mapping[str, Any] | None = None) -> list[Step]:
        """What `run` would do, one step for each stage. Changes nothing.

        settings: dataclasses by stage name; the recorded ones if left out. Raises SplatError.
        """
        wanted = {**self.recorded_settings(), **(settings or {})}
        photos = self.photos or self.recorded_photos()
        try:
            return Planner(self.layout, photos, wanted).plan()
        except OSError as error:
            raise unusable(error, self.run_folder) from error

    def run(
        self,
        settings: Mapping[str, Any] | None = None,
        until: str | None = None,
        may_run: Collection[str] | None = None,
        listener: Listener | None = None,
        stop: Event | None = None,
    ) -> list[Manifest]:
        """Run what has to run, up to and including the stage `until`.

        Args:
            settings: dataclasses by stage name; recorded for later runs, except changes for a
                stage that refuses them or its inputs, and for later ones. The recorded ones are
                used where left out.
            until: name of the last stage; None for all, which share a limit of time.
            may_run: names of the stages that may run; it is an error if another one has to.
            listener: receives the events of the run.
            stop: set by the caller to stop the run at the next safe boundary; without it SIGINT
                and SIGTERM do that.

        Returns the manifests in order. Raises SplatError; Interrupted after a stop. Finished
        stages are kept then, and the stage's own checkpoint stays in its working folder.
        """
        for given in (settings or {}).values():
            check_settings(given)  # before a folder is made
        listener = listener or Listener()
        first = self.layout.workspace(self.layout.stages[0]).final
        try:
            with (
                runfolder.opened(self.run_folder, self.photos),
                stop_event(stop, listener.stopping) as stopped,
            ):
                for stage in self.layout.stages:
                    self.layout.workspace(stage).recover()
                before = runfolder.recorded_for(self.run_folder, self.photos, first)
                run_file = before.updated(settings or {})
                wanted = run_file.settings_of(self.layout.stages)
                for recorded in wanted.values():
                    check_settings(recorded)
                planner = Planner(self.layout, run_file.photographs, wanted)
                self._check_allowed(planner, until, may_run)
                run_file.write(self.run_folder)
                forget = partial(self._forget, before, run_file)
                return self._run_all(planner, until, stopped, listener, forget)
        except OSError as error:
            raise unusable(error, self.run_folder) from error
        finally:
            listener.ended()

    def _forget(self, before: RunFile, changed: RunFile, refusing: Stage) -> None:
        """If the command changed the settings of a stage that refused, record the settings of this
        stage and of later ones as they were `before`."""
        if before.settings_of([refusing]) != changed.settings_of([refusing]):
            later = self.layout.stages[self.layout.number(refusing) - 1 :]
            names = {stage.name for stage in later}
            changed.with_settings_from(before, names).write(self.run_folder)

    def _run_all(
        self,
        planner: Planner,
        until: str | None,
        stop: Event,
        listener: Listener,
        forget: Callable[[Stage], None],
    ) -> list[Manifest]:
        """forget: is called with a stage that refused its options or inputs, see `_forget`.
        Otherwise a later command without the refused options would fail as well."""
        manifests, began = [], time.monotonic() if until is None else None
        for stage in self.layout.up_to(until):
            try:
                step = planner.assess(stage)
                if step.will_run or step.manifest is None:
                    if stop.is_set():
                        raise Interrupted(stage.name)
                    manifest = self._run_one(planner, step, stop, listener, began)
                    listener.finished(stage, step.number, manifest)
                else:
                    manifest = step.manifest
                    listener.skipped(stage, step.number, manifest)
            except (SplatError, OSError) as error:
                explained = as_splat_error(error, stage.name, self.run_folder)
                if explained and explained.family in (Family.USAGE, Family.INPUT):
                    forget(stage)
                raise
            planner.learn(stage, manifest)
            manifests.append(manifest)
        return manifests

    def _run_one(
        self, planner: Planner, step: Step, stop: Event, listener: Listener, began: float | None
    ) -> Manifest:
        stage, settings = step.stage, planner.wanted[step.stage.name]
        space = self.layout.workspace(stage)
        request = planner.request(stage)
        self.check_outputs(stage.reads)  # the manifest will record the digests of what was read
        resumed = space.begin(request)
        listener.started(stage, step.number, step.reason, resumed)
        inputs = {
            name: self.layout.stage(name).load(self.stage_folder(name)) for name in stage.reads
        } or {PHOTOS: planner.existing_photos()}
        if began is not None:
            settings = within_limit(stage.name, settings, time.monotonic() - began)
        return attempt(request, settings, inputs, space, stop, listener)

    def _check_allowed(
        self, planner: Planner, until: str | None, may_run: Collection[str] | None
    ) -> None:
        """Raises SplatError (stage-not-finished) for the first stage that has to run and may not.
        It uses a planner of its own, because that of the run learns the real outputs."""
        if may_run is None:
            return
        reached = self.layout.up_to(until)
        for step in Planner(self.layout, planner.photos, planner.wanted).plan():
            if step.stage in reached and step.will_run and step.stage.name not in may_run:
                again = "" if step.manifest is None else "would run again: "
                what = f"{step.stage.name} {again}{step.reason}"
                raise self._not_finished(step.stage.name, what)

    def _not_finished(self, name: str, what: str) -> SplatError:
        folder = quoted(self.run_folder)
        return UsageError(
            "stage-not-finished",
            given=f"In {self.run_folder}, {what}.",
            wanted="Every earlier stage finished and unchanged.",
            hint=f"Run `splat {name} {folder}` first, or `splat process {folder}` for everything "
            "that is missing.",
        )
