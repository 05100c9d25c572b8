"""Decides which stages run, and why."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from stages.base.errors import SplatError
from stages.base.stage import Stage
from stages.run.digests import FileRecords, combined_digest, damage, record_files
from stages.run.manifest import Manifest
from stages.run.request import Request, request_for, why_again
from stages.run.workspace import Layout

PHOTOS = "photos"  # the input of a stage that reads no other
MASKS = "masks"
_NAMED_AT_MOST = 3


@dataclass(frozen=True)
class Step:
    """One line of a plan.

    reason: why the stage runs; "" if it does not. manifest: of the finished run, if there is one.
    interrupted: whether there is unfinished work. failed: whether its last attempt failed.
    """

    stage: Stage
    number: int
    will_run: bool
    reason: str
    manifest: Manifest | None = None
    interrupted: bool = False
    failed: bool = False


class Planner:
    """Goes through the stages in order and keeps the digest of each output that is known.

    photos: the photographs, or None if the run folder does not record them.
    """

    def __init__(self, layout: Layout, photos: Path | None) -> None:
        self.layout = layout
        self.photos = photos
        self._digests: dict[str, str] = {}
        self._pending: dict[str, bool] = {}  # name -> has finished before
        self._photo_records: FileRecords | None = None

    def plan(self, wanted: Mapping[str, Any]) -> list[Step]:
        """One step for each stage. wanted: settings by stage name. Raises SplatError, OSError."""
        steps = []
        for stage in self.layout.stages:
            step = self.assess(stage, wanted[stage.name])
            if step.will_run:
                self._pending[stage.name] = step.manifest is not None
            elif step.manifest is not None:
                self.learn(stage, step.manifest)
            steps.append(step)
        return steps

    def learn(self, stage: Stage, manifest: Manifest) -> None:
        """Keep the digest of the stage's final output."""
        self._digests[stage.name] = manifest.output_digest

    def assess(self, stage: Stage, settings: Any) -> Step:
        """Whether `stage` has to run, given the outputs of the stages before it."""
        space = self.layout.workspace(stage)
        number = self.layout.number(stage)
        manifest = Manifest.read(space.final)
        interrupted = space.partial.exists()
        waiting = [
            f"{name} {'runs again' if self._pending[name] else 'has to run'} first"
            for name in stage.reads
            if name in self._pending
        ]
        failure = space.failure()
        if manifest is None:
            first = "was interrupted" if interrupted else "has not run yet"
            return Step(stage, number, True, failure or first, None, interrupted, bool(failure))
        reasons = why_again(
            self._request_if_known(stage, settings, manifest, bool(waiting)),
            manifest,
            stage.settings_type,
        )
        broken = damage(space.final, manifest.outputs)[:_NAMED_AT_MOST]
        reasons += waiting + [f"its output {change}" for change in broken]
        runs = bool(reasons)
        if runs and failure:
            reasons.append(f"failed at the last attempt: {failure}")
        why = ", ".join(reasons)
        return Step(stage, number, runs, why, manifest, interrupted, runs and bool(failure))

    def request(self, stage: Stage, settings: Any) -> Request:
        """The request for `stage`. Raises SplatError (photographs-missing), OSError."""
        if stage.reads:
            inputs = {name: self._digests[name] for name in stage.reads}
            files = self._files_of(stage, settings)
            inputs |= {name: combined_digest(records) for name, records in files.items()}
            return request_for(stage, settings, inputs, files)
        if self._photo_records is None:
            done = Manifest.read(self.layout.workspace(stage).final)
            known = done.input_files.get(PHOTOS) if done else None
            self._photo_records = record_files(self.existing_photos(), known, users=True)
        files = {PHOTOS: self._photo_records, **self._masks(stage, settings)}
        inputs = {name: combined_digest(records) for name, records in files.items()}
        return request_for(stage, settings, inputs, files)

    def _masks(self, stage: Stage, settings: Any) -> dict[str, FileRecords]:
        """The records of masks in a folder of their own, if there is one."""
        from stages.photos.masks import mask_folder

        folder = mask_folder(self.existing_photos(), getattr(settings, MASKS, None))
        if folder is None:
            return {}
        done = Manifest.read(self.layout.workspace(stage).final)
        known = done.input_files.get(MASKS) if done else None
        if known is not None and not folder.exists():
            return {MASKS: known}
        return {MASKS: record_files(folder, known, users=True)}

    def _files_of(self, stage: Stage, settings: Any) -> dict[str, FileRecords]:
        """Records of the user's own files that settings name, by setting. Files that were removed
        after the stage finished count as unchanged, as photographs do. Raises SplatError,
        OSError."""
        from stages.cameras.table import files_of

        found = {}
        done = Manifest.read(self.layout.workspace(stage).final)
        for name, value in vars(settings).items():
            if not isinstance(value, Path):
                continue
            known = done.input_files.get(name) if done else None
            if known is not None and not value.exists():
                found[name] = known
                continue
            files = files_of(value)
            records = (record_files(path, known, users=True) for path in files)
            found[name] = {key: record for part in records for key, record in part.items()}
        return found

    def existing_photos(self) -> Path:
        """Where the photographs are. Raises SplatError (photographs-missing)."""
        if self.photos is None or not self.photos.exists():
            raise SplatError(
                "photographs-missing",
                given=f"The photographs are not at {self.photos}."
                if self.photos
                else "The run folder does not say where its photographs are.",
                wanted="The folder of photographs that the run is made from.",
                hint="Put it back, or name its new place: splat process PHOTOS --out RUN",
            )
        return self.photos

    def _request_if_known(
        self, stage: Stage, settings: Any, done: Manifest, waiting: bool
    ) -> Request:
        """The request with the inputs of the finished run where the present ones are unknown.
        Outputs of stages that have to run first are a reason of their own, and photographs that
        were moved away after ingest are none."""
        gone = not stage.reads and (self.photos is None or not self.photos.exists())
        if waiting or gone:
            return request_for(stage, settings, done.inputs, done.input_files)
        return self.request(stage, settings)
