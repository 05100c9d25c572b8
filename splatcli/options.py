"""Command-line options, made from the stages' settings.

A setting's type, help, bounds and panel are stated once, in its stage, which also says what is
wrong with a value. An option that is not given is None here, so that a stage's command changes only
what was typed.
"""

from __future__ import annotations

import inspect
from collections.abc import Callable, Iterable, Mapping
from pathlib import Path
from typing import Annotated, Any, get_args

import typer

from stages.base.settings import PANELS, UNSET, Setting, settings_of

_METAVARS = {int: "N", float: "X", bool: None, Path: "PATH"}


def parameters(
    settings_type: type,
    shown: Callable[[Setting], str | bool] | None = None,
    *,
    only_in_process: bool = False,
) -> list[inspect.Parameter]:
    """One keyword parameter for each field of a stage's settings, as typer reads them.

    Args:
        shown: gives the default that the help shows; by default the field's own.
        only_in_process: leave out the settings that have no panel.
    """
    chosen = [s for s in settings_of(settings_type) if s.panel or not only_in_process]
    return [_parameter(setting, (shown or shown_default)(setting)) for setting in chosen]


def _parameter(setting: Setting, shown: str | bool) -> inspect.Parameter:
    if setting.kind is bool:
        flags = f"{setting.flag}/--no-{setting.flag[2:]}"
        return keyword(setting.name, bool | None, option(setting, shown, flags=flags))
    if setting.together:
        values: Any = tuple[(setting.kind,) * len(setting.together.split())]  # type: ignore[misc]
        made = option(setting, shown, metavar=setting.together)
        return keyword(setting.name, values | None, made)
    one = list[setting.kind] if setting.many else setting.kind  # type: ignore[name-defined]
    return keyword(setting.name, one | None, option(setting, shown))


def option(
    setting: Setting, shown: str | bool = True, *, flags: str = "", metavar: str | None = None
) -> Any:
    """A typer option that accepts what the setting allows; the setting explains a refusal.

    Args:
        shown: the default for the help; True for the parameter's own, False for none.
        flags: "--fill/--no-fill"; by default the setting's flag.
        metavar: of an option with several values; by default the name of the type.
    """
    parsed = not (flags or metavar)
    return typer.Option(
        flags or setting.flag,
        parser=setting.parse if parsed else None,
        help=_help(setting),
        show_default=shown,
        metavar=metavar or _METAVARS.get(setting.kind, "NAME" if setting.choices else "TEXT"),
        rich_help_panel=setting.panel or "Advanced",
        autocompletion=lambda incomplete: [
            choice for choice in setting.choices if choice.startswith(incomplete)
        ],
    )


def number(
    flag: str, kind: type, low: float, high: float, help: str, shown: str | bool = True
) -> Any:
    """A typer option for a number that is no stage's setting."""
    setting = Setting(flag[2:], flag, kind, low=low, high=high, help=help, panel="Options")
    return option(setting, shown)


def _help(setting: Setting) -> str:
    """The setting's help, with the choices if it does not name them itself."""
    if all(word in setting.help for word in setting.choices):
        return setting.help
    return f"{setting.help.rstrip('.')}: {', '.join(setting.choices)}."


def keyword(name: str, accepted: Any, option: Any, default: Any = None) -> inspect.Parameter:
    """A keyword parameter in the form that typer reads."""
    return inspect.Parameter(
        name,
        inspect.Parameter.KEYWORD_ONLY,
        default=default,
        annotation=Annotated[accepted, option],
    )


def shown_default(setting: Setting) -> str | bool:
    """A setting's default for the help; False for none."""
    value = setting.default
    if value is None or value in ("", ()):
        return False
    if isinstance(value, (tuple, list)):
        return " ".join(map(str, value))
    if isinstance(value, bool):
        return "yes" if value else "no"
    return f"{value:g}" if isinstance(value, float) else str(value)


def given_only(given: Mapping[str, Any]) -> dict[str, Any]:
    """What was typed: None and empty lists left out, lists as tuples, paths absolute."""
    typed = {name: value for name, value in given.items() if value is not None and value != []}
    paths = {n: v for n, v in typed.items() if isinstance(v, Path) and v is not UNSET}
    typed |= {name: path.absolute() for name, path in paths.items()}
    return {n: tuple(value) if isinstance(value, list) else value for n, value in typed.items()}


def with_parameters(
    command: Callable[..., Any], added: Iterable[inspect.Parameter]
) -> Callable[..., Any]:
    """`command`, which takes **given, after the added parameters were put into its signature, as
    typer sees it; options in the order of their panels."""
    signature = inspect.signature(command, eval_str=True)
    own = [p for p in signature.parameters.values() if p.kind is not inspect.Parameter.VAR_KEYWORD]
    # Typer shows panels in the order of their first options.
    every = sorted([*added, *own], key=lambda p: (p.kind, _panel_number(p)))

    command.__annotations__ = {p.name: p.annotation for p in every}
    command.__signature__ = signature.replace(  # type: ignore[attr-defined]
        parameters=every, return_annotation=None
    )
    return command


def _panel_number(parameter: inspect.Parameter) -> int:
    panels = [getattr(part, "rich_help_panel", None) for part in get_args(parameter.annotation)]
    return next((PANELS.index(panel) for panel in panels if panel in PANELS), -1)
