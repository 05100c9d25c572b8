"""The settings of a run: presets, options, and what a run folder recorded."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from inspect import Parameter
from pathlib import Path
from typing import Any

import typer

from splatcli import console, options
from stages.base.errors import UsageError
from stages.base.settings import UNSET, Setting, changed, settings_of
from stages.base.text import quoted
from stages.raster.backends import backend_of
from stages.run.pipeline import Pipeline
from stages.run.runfolder import is_run_folder
from stages.run.stages import STAGE_NAMES, STAGE_OF, options_of
from stages.seed.settings import SPLATS_OF_A_STAGE
from stages.train.settings import PRESETS, TrainSettings

DEFAULT_PRESET = "standard"

# Options that describe one capture: a batch gives the same options to all of its runs.
_OF_ONE_CAPTURE = (
    *("masks", "depth", "cameras", "split", "refine_cameras"),
    *("scale", "metres", "splats", "densify", "blocks", "view"),
)


def process_parameters() -> list[Parameter]:
    """The options of `splat process`: the settings with a panel. One that several stages have is
    listed once and given to all of them."""
    parameters: dict[str, Parameter] = {}
    for name in STAGE_NAMES:
        kind = STAGE_OF[name].settings_type
        for parameter in options.parameters(kind, _shown, only_in_process=True):
            parameters.setdefault(parameter.name, parameter)
    shown = f"{DEFAULT_PRESET}; as before where a run goes on"
    return [_preset_parameter(shown), *parameters.values(), _view_parameter()]


def batch_parameters() -> list[Parameter]:
    """The options of `process` that can apply to many captures."""
    return [p for p in process_parameters() if p.name not in _OF_ONE_CAPTURE]


def stage_parameters(name: str) -> list[Parameter]:
    """All settings of one stage; for training also the preset and --view."""
    kind = STAGE_OF[name].settings_type
    if name == "ingest":
        return options.parameters(kind)
    own = options.parameters(kind, shown=_shown_or_recorded)
    if name != "train":
        return own
    return [_preset_parameter(f"as before, else {DEFAULT_PRESET}"), *own, _view_parameter()]


def _preset_parameter(shown: str) -> Parameter:
    setting = Setting(
        "preset",
        "--preset",
        str,
        choices=tuple(PRESETS),
        help="How much training: preview (minutes), standard, or best (the full recipe).",
        panel="Quality and time",
    )
    return options.keyword("preset", str | None, options.option(setting, shown))


def _view_parameter() -> Parameter:
    option = typer.Option(
        "--view",
        help="Show the scene in the browser while it is trained.",
        rich_help_panel="Output",
    )
    return options.keyword("view", bool, option, default=False)


def _by_preset(setting: Setting) -> bool:
    """Whether it is a training setting whose value differs between presets."""
    values = {getattr(preset, setting.name, setting.default) for preset in PRESETS.values()}
    return len(values) > 1 and setting in settings_of(type(PRESETS[DEFAULT_PRESET]))


def _shown(setting: Setting) -> str | bool:
    """The default for the help."""
    return "by preset" if _by_preset(setting) else options.shown_default(setting)


def _shown_or_recorded(setting: Setting) -> str | bool:
    """The default for the help of a command that takes recorded settings first."""
    shown = _shown(setting)
    return f"as before, else {shown}" if shown else "as before"


def defaults() -> dict[str, Any]:
    """Settings by stage name, with the default preset."""
    fresh = {name: STAGE_OF[name].settings_type() for name in STAGE_NAMES}
    return {**fresh, "train": PRESETS[DEFAULT_PRESET]}


def recorded(pipeline: Pipeline) -> dict[str, Any]:
    """Settings by stage name that the run folder records; of a stage without, and of a new run
    folder, the defaults. Raises SplatError."""
    if not is_run_folder(pipeline.run_folder):
        return defaults()
    return pipeline.recorded_settings(defaults())


def requested(pipeline: Pipeline, given: Mapping[str, Any], preset: str | None) -> dict[str, Any]:
    """Settings by stage name of a whole run: the recorded ones, changed by a preset, then by the
    given options. A run folder as splats stands for those that it trained. Raises SplatError, also
    for known cameras and given splats that no run could use."""
    from splatcli.input_files import check_files  # loads NumPy, which `--help` does without

    given = dict(given)
    if "formats" in given:
        given["formats"] = pipeline.with_exported(given["formats"])
    splats = given.get("splats", UNSET)
    if splats is not UNSET and is_run_folder(splats):
        given["splats"] = _trained_splats(splats, pipeline.run_folder)
    settings = combined(recorded(pipeline), given, preset)
    if given.keys() & {"cameras", "splats"}:
        check_files(settings)
    return settings


def combined(
    base: Mapping[str, Any], given: Mapping[str, Any], preset: str | None
) -> dict[str, Any]:
    """`base` (settings by stage name) changed by a preset, then by the given options. A single
    stage takes all options that it has; of several stages each takes what `SHARED_OPTIONS` gives
    it.

    Raises SplatError for a value that is not allowed, and for a backend that is not available
    here.
    """
    chosen = dict(base)
    if preset is not None and "train" in chosen:
        chosen["train"] = _with_preset(chosen["train"], preset)
    if given.get("splats") not in (None, UNSET) and "steps" not in given:
        given = {**given, "steps": 0}
    if "train" in chosen:
        given = TrainSettings.completed(given)
    new = {
        name: changed(settings, given if len(chosen) == 1 else options_of(name, given))
        for name, settings in chosen.items()
    }
    if "backend" in given:  # an error now, not after an hour of other work
        with_backend = [settings for settings in new.values() if hasattr(settings, "backend")]
        for name in {settings.backend for settings in with_backend}:
            backend_of(name).require()
    return new


def _trained_splats(run: Path, run_folder: Path) -> Path:
    """The splats of the finished training of `run`, for `run_folder` to start from. Raises
    SplatError."""
    if run.resolve() == run_folder.resolve():
        raise UsageError(
            "option-out",
            given=f"{run} would start from its own splats, and training replaces them.",
            wanted="A folder of its own for the run that goes on from them.",
            hint=f"splat process {quoted(run)} --out NEW --splats {quoted(run)} --steps 3000",
        )
    earlier = Pipeline(run)
    earlier.load("train")  # raises if it has not finished, or is damaged
    return earlier.stage_folder("train") / SPLATS_OF_A_STAGE


def _with_preset(train: TrainSettings, preset: str) -> TrainSettings:
    """`train` with the amount of training of a preset, without a time limit; all else stays."""
    names = {one.name for one in settings_of(TrainSettings) if _by_preset(one)}
    if train.splats is not None:
        names.discard("steps")  # a preset's would not train given splats
    return replace(train, seconds=0.0, **{name: getattr(PRESETS[preset], name) for name in names})


def of_new_run(given: Mapping[str, Any]) -> dict[str, Any]:
    """Settings by stage name of a new run with the given options, "preset" included. Raises
    SplatError."""
    return with_options(defaults(), given)


def with_options(base: Mapping[str, Any], given: Mapping[str, Any]) -> dict[str, Any]:
    """`base` (settings by stage name) changed by the given options, "preset" included. Raises
    SplatError."""
    others = {name: value for name, value in given.items() if name != "preset"}
    return combined(base, others, given.get("preset"))


def training_summary(settings: TrainSettings, given: Mapping[str, Any], preset: str | None) -> str:
    """One sentence with the training settings of a resumed run, and where each comes from."""
    by_origin: dict[str, list[str]] = {}
    recorded = f"preset {preset}" if preset else "as recorded in the run"
    for setting in settings_of(type(settings)):
        name, value = setting.name, getattr(settings, setting.name)
        if name in given or (value and _shown(setting) == "by preset"):  # 0: others decide
            origin = "as given" if name in given else recorded
            text = f"{console.label(name)} {console.figure(name, value)}"
            by_origin.setdefault(origin, []).append(text)
    parts = [f"{', '.join(texts)} ({origin})" for origin, texts in by_origin.items()]
    return f"Training: {'; '.join(parts)}."
