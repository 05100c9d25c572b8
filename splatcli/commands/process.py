"""`splat process` and the commands of single stages."""

from __future__ import annotations

from collections.abc import Callable, Collection, Mapping
from pathlib import Path
from typing import Any

from splatcli import console, log, options, progress, run_result, run_settings
from splatcli.arguments import Cluster, Out, Photos, Run
from splatcli.folders import DEFAULT, find_run_folder, run_folder_for
from stages.base.errors import UsageError
from stages.base.settings import changed
from stages.base.text import quoted
from stages.run import runfolder
from stages.run.branch import branch
from stages.run.listener import Listener, Listeners
from stages.run.pipeline import Pipeline
from stages.run.stages import STAGE_NAMES
from stages.viewer.live_training import LiveTraining
from stages.viewer.server import open_in_browser

_CLUSTER_UNUSED = "cluster-unused"


def process(
    photos: Photos = None,
    *,
    out: Out = None,
    cluster: Cluster = None,
    **given: Any,
) -> None:
    """Photographs in, assets out: all seven stages.

    Finished work is kept: after an interruption the same command goes on where it stopped.
    """
    # It loads training, which `--help` does not need.
    from splatcli.distribution import check_blocks, distributed

    run_folder, photos = _run_folder_and_photos(photos, out)
    pipeline = distributed(Pipeline(run_folder, photos), cluster)
    given = options.given_only(given)
    view, preset = given.pop("view", False), given.pop("preset", None)
    is_known = runfolder.is_run_folder(run_folder)
    settings = run_settings.requested(pipeline, given, preset)
    check_blocks(settings["train"], cluster if pipeline.manifest("train") is None else None)
    if is_known and console.mode.has_notes:
        console.note(run_settings.training_summary(settings["train"], given, preset))
    if cluster is not None and settings["train"].blocks == "1":
        console.warn(
            "Warning: --cluster has no effect: the run trains in one block, on this machine. "
            f"--blocks auto trains large captures in several. ({_CLUSTER_UNUSED})"
        )
    _run(pipeline, settings, view=view)


def stage_command(name: str) -> Callable[..., None]:
    """The command that runs the stage `name`."""

    def ingest(photos: Photos = None, *, out: Out = None, **given: Any) -> None:
        pipeline = Pipeline(*_run_folder_and_photos(photos, out))
        _run_stage("ingest", pipeline, given)

    def later(run: Run = None, **given: Any) -> None:
        _run_stage(name, Pipeline(find_run_folder(run)), given)

    return ingest if name == "ingest" else later


def _run_folder_and_photos(photos: Path | None, out: Path | None) -> tuple[Path, Path | None]:
    """(run folder, photographs or None) of a command's arguments.

    Photographs start or continue the run folder `out`, or `run_folder_for` them; a run folder in
    their place, or nothing, continues with the recorded settings. A run folder and another `out`
    start or continue a second run that begins as the first. Raises SplatError, OSError.
    """
    if photos is None:
        return find_run_folder(out), None
    if runfolder.is_run_folder(photos):
        if out is None or out.resolve() == photos.resolve():
            return photos, None
        if not runfolder.is_run_folder(out):
            branch(photos, out)
        elif Pipeline(out).recorded_photos() != Pipeline(photos).recorded_photos():
            raise UsageError(
                "option-out",
                given=f"{photos} and {out} are runs of different photographs.",
                wanted=f"A new folder, for a run that begins as {photos}, or one made so.",
                hint="Name another folder with --out.",
            )
        return out, None
    folder = out or run_folder_for(photos)
    runfolder.check_photos(folder, photos)  # before anything is said of the run
    if out is None and folder != DEFAULT and console.mode.has_notes:
        console.note(f"Run folder: {folder}, since {DEFAULT} holds a run of other photographs.")
    return folder, photos


def _run_stage(name: str, pipeline: Pipeline, given: Mapping[str, Any]) -> None:
    """One stage, with the recorded settings and the given options. Stages after training take
    little time: where some are missing before this one, they run too."""
    from splatcli.distribution import distributed  # loads training, which `--help` does not need

    is_known = runfolder.is_run_folder(pipeline.run_folder)
    base = run_settings.recorded(pipeline)
    given = options.given_only(given)
    if "splats" in given:
        raise UsageError(
            "option-alone",
            given=f"--splats concerns seeding and training, and splat {name} runs one of them.",
            wanted="The command of the whole run.",
            hint=f"splat process {quoted(pipeline.run_folder)} --splats FILE",
        )
    preset, view = given.pop("preset", None), given.pop("view", False)
    if "formats" in given:
        given["formats"] = pipeline.with_exported(given["formats"])
    settings = run_settings.combined({name: base[name]}, given, preset)
    if name == "export":  # `quantise` may have to fine-tune for the formats
        changes: dict[str, Any] = {
            key: given[key] for key in ("formats", "drawing") if key in given
        }
        if "formats" in changes:
            changes["formats"] = (*base["quantise"].formats, *given["formats"])
        settings["quantise"] = changed(base["quantise"], changes)
    if not is_known:
        settings = {**base, **settings}
    if name == "train" and console.mode.has_notes:
        console.note(run_settings.training_summary(settings["train"], given, preset))
    after_training = STAGE_NAMES[STAGE_NAMES.index("train") + 1 :]
    _run(
        distributed(pipeline),
        settings,
        until=name,
        may_run=after_training if name in after_training else (name,),
        view=view,
    )


def _run(
    pipeline: Pipeline,
    settings: Mapping[str, Any],
    *,
    until: str | None = None,
    may_run: Collection[str] | None = None,
    view: bool = False,
) -> None:
    """Run the pipeline and print the result. view: show the training on a page, too."""
    log.write_settings(settings)
    listeners: list[Listener] = [log.LogListener(), progress.listener_for(console.mode)]
    if view:
        listeners.insert(0, _live_training(pipeline))
    pipeline.run(settings, until=until, may_run=may_run, listener=Listeners(*listeners))
    run_result.show(pipeline, until)


def _live_training(pipeline: Pipeline) -> Listener:
    def announce(address: str) -> None:
        if console.mode.as_json:
            console.emit("view", address=address)
        else:
            console.note(f"Watch the training at {address}", "bold")
        open_in_browser(address)

    return LiveTraining(pipeline, announce, console.warn)
