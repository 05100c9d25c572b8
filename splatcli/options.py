"""Command-line options, made from the stages' settings.

A setting's type, help and bounds are stated once, in its stage, which also says what is wrong with
a value. An option that is not given is None here, so that a stage's command changes only what was
typed.
"""

from __future__ import annotations

import inspect
from collections.abc import Callable, Iterable, Mapping
from dataclasses import fields, replace
from pathlib import Path
from typing import Annotated, Any

import typer

from stages.base.settings import Setting, check_settings, settings_of

_METAVARS = {int: "N", float: "X", bool: None, Path: "PATH"}


def parameters(
    settings_type: type,
    names: Iterable[str] | None = None,
    shown: Callable[[Setting], str | bool] | None = None,
) -> list[inspect.Parameter]:
    """One keyword parameter a settings field (those in `names`), as typer reads them.

    shown: the default to show in the help; by default the field's own.
    """
    every = {setting.name: setting for setting in settings_of(settings_type)}
    chosen = every.values() if names is None else [every[name] for name in names if name in every]
    return [_parameter(setting, (shown or shown_default)(setting)) for setting in chosen]


def _parameter(setting: Setting, shown: str | bool) -> inspect.Parameter:
    if setting.kind is bool:
        flags, accepted = f"{setting.flag}/--no-{setting.flag[2:]}", bool | None
        return keyword(
            setting.name, accepted, typer.Option(flags, help=setting.help, show_default=shown)
        )
    if setting.together:
        words: Any = tuple[(setting.kind,) * len(setting.together.split())]  # type: ignore[misc]
        typed = typer.Option(
            setting.flag, help=setting.help, show_default=shown, metavar=setting.together
        )
        return keyword(setting.name, words | None, typed)
    one = list[setting.kind] if setting.many else setting.kind  # type: ignore[name-defined]
    return keyword(setting.name, one | None, option(setting, shown))


def option(setting: Setting, shown: str | bool = True) -> Any:
    """A typer option that takes what the setting allows, and says so itself when it does not."""
    return typer.Option(
        setting.flag,
        parser=setting.parse,
        help=_help(setting),
        show_default=shown,
        metavar=_METAVARS.get(setting.kind, "NAME" if setting.choices else "TEXT"),
    )


def number(
    flag: str, kind: type, low: float, high: float, help: str, shown: str | bool = True
) -> Any:
    """A typer option for a number that is no stage's setting."""
    return option(Setting(flag[2:], flag, kind, low=low, high=high, help=help), shown)


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
    if value is None or value == "":
        return False
    if isinstance(value, (tuple, list)):
        return " ".join(map(str, value))
    return {True: "yes", False: "no"}[value] if isinstance(value, bool) else str(value)


def given_only(given: Mapping[str, Any]) -> dict[str, Any]:
    """What was typed: None and empty lists left out, lists as tuples."""
    typed = {name: value for name, value in given.items() if value is not None and value != []}
    typed |= {n: value.absolute() for n, value in typed.items() if isinstance(value, Path)}
    return {n: tuple(value) if isinstance(value, list) else value for n, value in typed.items()}


def changed(settings: Any, typed: Mapping[str, Any]) -> Any:
    """`settings` with the typed fields that it has, checked. Raises SplatError (option-value)."""
    names = {field.name for field in fields(settings)}
    new = replace(settings, **{name: value for name, value in typed.items() if name in names})
    check_settings(new)
    return new


def with_parameters(
    command: Callable[..., Any], added: Iterable[inspect.Parameter]
) -> Callable[..., Any]:
    """`command`, which takes **given, with the added parameters in the signature typer sees."""
    signature = inspect.signature(command, eval_str=True)
    own = [p for p in signature.parameters.values() if p.kind is not inspect.Parameter.VAR_KEYWORD]
    every = [*own, *added]
    annotations = {p.name: p.annotation for p in every}

    def call(**values: Any) -> Any:
        return command(**values)

    call.__name__ = command.__name__
    call.__doc__ = command.__doc__
    call.__annotations__ = annotations
    call.__signature__ = signature.replace(  # type: ignore[attr-defined]
        parameters=sorted(every, key=lambda p: p.kind), return_annotation=None
    )
    return call
