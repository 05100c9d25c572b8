"""From what was typed to a run of the pipeline: settings, presets, which stages may run."""

from __future__ import annotations

from collections.abc import Collection, Mapping
from contextlib import AbstractContextManager
from inspect import Parameter
from pathlib import Path
from typing import Any

import typer

from splatcli import console, options, progress, summary
from splatcli import live_view as watching
from splatcli.folders import DEFAULT, find_run_folder
from stages import STAGE_NAMES, load_stage
from stages.base.errors import Family, SplatError
from stages.base.settings import Setting, settings_of
from stages.distributed import blocks, cluster, sfm_chunks
from stages.distributed.tasks import Executor
from stages.raster.backends import backend_of, backend_of_settings
from stages.run import runfolder
from stages.run.listeners import Listeners
from stages.run.pipeline import Listener, Pipeline
from stages.run.precompile import PrecompileListener

DEFAULT_PRESET = "standard"
# What speaks of one capture and no other: a batch gives the same options to all of its runs.
_OF_ONE_CAPTURE = ("masks", "cameras", "split", "refine_cameras", "scale", "blocks", "view")


def preset_parameter(shown: str) -> Parameter:
    """`--preset`, with the names that training defines. shown: the default."""
    setting = Setting(
        "preset",
        "--preset",
        str,
        choices=tuple(presets()),
        help="How much training: preview (minutes), standard, or best (the full recipe).",
        panel="Quality and time",
    )
    return options.keyword("preset", str | None, options.option(setting, shown))


def view_parameter() -> Parameter:
    """`--view`, of the commands that train."""
    option = typer.Option(
        "--view",
        help="Show the scene in the browser while it is trained.",
        rich_help_panel="Output",
    )
    return options.keyword("view", bool, option, default=False)


def presets() -> Mapping[str, Any]:
    """Training settings by preset name."""
    from stages.train import PRESETS

    found: Mapping[str, Any] = PRESETS
    return found


def process_parameters() -> list[Parameter]:
    """The few options of `process`; one that several stages share is given to all of them."""
    found: dict[str, Parameter] = {}
    for name in STAGE_NAMES:
        kind = load_stage(name).settings_type
        for parameter in options.parameters(kind, _shown, only_in_process=True):
            found.setdefault(parameter.name, parameter)
    shown = f"{DEFAULT_PRESET}; as before where a run goes on"
    return [preset_parameter(shown), *found.values(), view_parameter()]


def batch_parameters() -> list[Parameter]:
    """Those of `process` that can be asked of many captures at once."""
    return [p for p in process_parameters() if p.name not in _OF_ONE_CAPTURE]


def stage_parameters(name: str) -> list[Parameter]:
    """All settings of one stage; training has presets too, and can be watched."""
    kind = load_stage(name).settings_type
    if name == "ingest":
        return options.parameters(kind)
    if name != "train":
        return options.parameters(kind, shown=_kept)
    own = options.parameters(kind, shown=_kept)
    return [preset_parameter(f"as before, else {DEFAULT_PRESET}"), *own, view_parameter()]


def _shown(setting: Setting) -> str | bool:
    """The default for the help: that of the preset, where presets differ in it."""
    values = {getattr(preset, setting.name, setting.default) for preset in presets().values()}
    return options.shown_default(setting) if len(values) == 1 else "by preset"


def _kept(setting: Setting) -> str | bool:
    """As `_shown`, where what the run was asked before comes first."""
    shown = _shown(setting)
    return f"as before, else {shown}" if shown else "as before"


def settings_for(
    base: Mapping[str, Any], typed: Mapping[str, Any], preset: str | None
) -> dict[str, Any]:
    """`base` (settings by stage name) with a preset and what was typed. Raises SplatError."""
    chosen = dict(base)
    if preset is not None and "train" in chosen:
        chosen["train"] = presets()[preset]
    found = {name: options.changed(settings, typed) for name, settings in chosen.items()}
    if typed.keys() & {"backend", "device"}:  # said now, not after an hour of other work
        for asked in {
            backend_of_settings(each) for each in found.values() if hasattr(each, "backend")
        }:
            backend_of(asked).require()
    return found


def training_in_words(settings: Any, typed: Mapping[str, Any], preset: str | None) -> str:
    """What training is asked of a run that goes on, and which of it was not asked just now."""
    origins: dict[str, list[str]] = {}
    before = f"preset {preset}" if preset else "as this run was asked before"
    for setting in settings_of(type(settings)):
        name = setting.name
        if name in typed or _shown(setting) == "by preset":
            origin = "as typed" if name in typed else before
            words = f"{console.label(name)} {console.figure(name, getattr(settings, name))}"
            origins.setdefault(origin, []).append(words)
    told = "; ".join(f"{', '.join(words)} ({origin})" for origin, words in origins.items())
    return f"Training: {told}."


def defaults() -> dict[str, Any]:
    """Settings by stage name, with the default preset."""
    fresh = {name: load_stage(name).settings_type() for name in STAGE_NAMES}
    return {**fresh, "train": presets()[DEFAULT_PRESET]}


def fresh_settings(typed: Mapping[str, Any]) -> dict[str, Any]:
    """What a new run is asked: settings by stage name, by what was typed, the preset included.
    Raises SplatError."""
    others = {name: value for name, value in typed.items() if name != "preset"}
    return settings_for(defaults(), others, typed.get("preset"))


def target_of(photos: Path | None, out: Path | None) -> tuple[Path, Path | None]:
    """(run folder, photographs or None) that a command is about.

    Photographs start or continue the run folder `out`, or `run/`; a run folder in their place, or
    nothing, continues what it was asked before. Raises SplatError.
    """
    if photos is None:
        return find_run_folder(out), None
    if runfolder.is_run_folder(photos):
        if out is not None and out.absolute() != photos.absolute():
            raise SplatError(
                "option-out",
                given=f"{photos} is itself a run folder, and --out names {out}.",
                wanted="Photographs to start from, or one run folder to continue.",
                hint=f"Leave --out away to continue {photos}.",
                family=Family.USAGE,
            )
        return photos, None
    return out or DEFAULT, photos


def run(
    pipeline: Pipeline,
    settings: Mapping[str, Any],
    *,
    until: str | None = None,
    may_run: Collection[str] | None = None,
    quiet: bool = False,
    as_json: bool = False,
    view: bool = False,
) -> None:
    """Run the pipeline and show what came of it. view: on a page too, while it trains."""
    listener = progress.listener_for(quiet, as_json)
    if until is None:
        listener = Listeners(PrecompileListener(settings["train"].backend), listener)
    if view:
        listener = Listeners(watching.LiveTraining(pipeline, as_json), listener)
    pipeline.run(settings, until=until, may_run=may_run, listener=listener)
    summary.show(pipeline, until, quiet=quiet, as_json=as_json)


def run_all(
    photos: Path | None,
    out: Path | None,
    address: str | None,
    given: Mapping[str, Any],
    quiet: bool,
    as_json: bool,
) -> None:
    """`splat process`. Without photographs, what was asked before counts too. address: of the
    cluster that trains blocks."""
    run_folder, photos = target_of(photos, out)
    pipeline = in_blocks(Pipeline(run_folder, photos), address)
    base = defaults() if photos is not None else pipeline.recorded_settings()
    typed = options.given_only(given)
    view = typed.pop("view", False)
    preset = typed.pop("preset", None)
    settings = settings_for(base, typed, preset)
    if "cameras" in typed:
        _check_cameras(typed["cameras"])
    if photos is None and not (quiet or as_json):
        console.note(training_in_words(settings["train"], typed, preset))
    run(pipeline, settings, quiet=quiet, as_json=as_json, view=view)


def _check_cameras(path: Path) -> None:
    """Raises SplatError for cameras that cannot be read: before all photographs are."""
    from stages.cameras.table import read_cameras

    read_cameras(path)


def run_stage(
    name: str,
    pipeline: Pipeline,
    given: Mapping[str, Any],
    quiet: bool,
    as_json: bool,
) -> None:
    """One stage, with the settings recorded before and what was typed.

    The stages after training are cheap: those that are missing in between run too.
    """
    known = runfolder.is_run_folder(pipeline.run_folder)
    base = pipeline.recorded_settings() if known else defaults()
    typed = options.given_only(given)
    preset, view = typed.pop("preset", None), typed.pop("view", False)
    if "formats" in typed:
        typed["formats"] = _with_exported(pipeline, typed["formats"])
    settings = settings_for({name: base[name]}, typed, preset)
    if name == "export" and "formats" in typed:  # which quantise may have to fine-tune to first
        formats = (*base["quantise"].formats, *typed["formats"])
        settings["quantise"] = options.changed(base["quantise"], {"formats": formats})
    if not known:
        settings = {**base, **settings}
    if name == "train" and not (quiet or as_json):
        console.note(training_in_words(settings["train"], typed, preset))
    pipeline = in_blocks(pipeline, None)
    may_run = _may_run(name)
    run(pipeline, settings, until=name, may_run=may_run, quiet=quiet, as_json=as_json, view=view)


def in_blocks(pipeline: Pipeline, address: str | None) -> Pipeline:
    """The pipeline; if it has blocks, the cluster at `address` trains them, or this process. A
    cluster does shares of structure from motion, too."""

    def opened(folder: Path, listener: Listener) -> AbstractContextManager[Executor]:
        seen = filter(None, [pipeline.run_folder, pipeline.photos or pipeline.recorded_photos()])
        return cluster.open_executor(address, folder, seen, listener)

    shared = pipeline if address is None else sfm_chunks.with_shares(pipeline, opened)
    return blocks.in_blocks(shared, opened)


def _with_exported(pipeline: Pipeline, formats: Collection[str]) -> tuple[str, ...]:
    """The formats asked for, after those that lie there already: asking for one more loses none."""
    manifest = pipeline.manifest("export")
    earlier = manifest.settings.get("formats", ()) if manifest is not None else ()
    return tuple(dict.fromkeys((*earlier, *formats)))


def _may_run(name: str) -> Collection[str]:
    after_training = STAGE_NAMES[STAGE_NAMES.index("train") + 1 :]
    return after_training if name in after_training else (name,)
