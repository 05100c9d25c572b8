"""Command-line options, made from the stages' settings.

A field's type, help and bounds are stated once, in its stage. An option that is not given is None
here, so that a stage's command changes only what was typed.
"""

from __future__ import annotations

import enum
import inspect
import sys
import types
from collections.abc import Callable, Collection, Iterable, Mapping
from dataclasses import MISSING, Field, fields, replace
from pathlib import Path
from typing import Annotated, Any, Literal, Union, get_args, get_origin, get_type_hints

import typer

from stages.base.errors import Family, SplatError

_METAVARS = {int: "N", float: "X", bool: None, str: "TEXT", Path: "PATH"}


def parameters(settings_type: type, names: Iterable[str] | None = None) -> list[inspect.Parameter]:
    """One keyword parameter a settings field (those in `names`), as typer reads them."""
    hints = get_type_hints(settings_type)
    wanted = {field.name: field for field in fields(settings_type)}
    chosen = wanted if names is None else {n: wanted[n] for n in names if n in wanted}
    return [_parameter(field, hints[name]) for name, field in chosen.items()]


def flag_of(field: Field[Any], hint: Any) -> str:
    """ "--max-side"; a repeatable option is named in the singular: formats -> --format."""
    name = field.metadata.get("option") or field.name
    if _is_many(hint) and name.endswith("s") and "option" not in field.metadata:
        name = name[:-1]
    return "--" + str(name).replace("_", "-")


def _parameter(field: Field[Any], hint: Any) -> inspect.Parameter:
    kind = _element_type(field, hint)
    flag = flag_of(field, hint)
    bounds: dict[str, Any] = {}
    if kind in (int, float):
        bounds = {"min": field.metadata.get("min", 0), "max": field.metadata.get("max")}
    if kind is bool:
        flag = f"{flag}/--no-{flag[2:]}"
    option = typer.Option(
        flag,
        help=_help(field, kind),
        show_default=_shown_default(field),
        metavar=_METAVARS.get(kind, "NAME"),
        **bounds,
    )
    accepted = Union[list[kind], None] if _is_many(hint) else Union[kind, None]  # type: ignore[valid-type]  # noqa: UP007
    return keyword(field.name, accepted, option)


def _help(field: Field[Any], kind: Any) -> str:
    """The field's help, with the choices if it does not name them itself."""
    text = str(field.metadata.get("help", ""))
    members: Iterable[enum.Enum] = kind if isinstance(kind, enum.EnumMeta) else ()
    words = [str(member.value) for member in members]
    if all(word in text for word in words):
        return text
    return f"{text.rstrip('.')}: {', '.join(words)}."


def keyword(name: str, accepted: Any, option: Any, default: Any = None) -> inspect.Parameter:
    """A keyword parameter in the form that typer reads."""
    return inspect.Parameter(
        name,
        inspect.Parameter.KEYWORD_ONLY,
        default=default,
        annotation=Annotated[accepted, option],
    )


def choice(name: str, values: Iterable[str]) -> type[enum.Enum]:
    """A type that accepts only these words."""
    return enum.Enum(name, {value: value for value in values})  # type: ignore[return-value]


def one_of(words: Collection[str]) -> Callable[[str | None], str | None]:
    """A check, as typer calls it, that an option is one of `words` or was not given."""

    def checked(value: str | None) -> str | None:
        if value is not None and value not in words:
            raise typer.BadParameter(f"{value!r} is not one of {', '.join(words)}.")
        return value

    return checked


def _is_many(hint: Any) -> bool:
    return get_origin(hint) in (tuple, list)


def _element_type(field: Field[Any], hint: Any) -> Any:
    """The type of one value: int, float, bool, str, Path, or an enumeration of choices."""
    if get_origin(hint) in (Union, types.UnionType):
        hint = next(arg for arg in get_args(hint) if arg is not type(None))
    if _is_many(hint):
        hint = get_args(hint)[0]
    choices = field.metadata.get("choices")
    if choices is None and get_origin(hint) is Literal:
        choices = get_args(hint)
    if choices is not None:
        return choice(field.name, map(str, choices))
    return hint if hint in (int, float, bool, str, Path) else str


def _shown_default(field: Field[Any]) -> str | bool:
    value = field.default
    if value is MISSING and field.default_factory is not MISSING:
        value = field.default_factory()
    if value is None or value is MISSING or value == "":
        return False
    if isinstance(value, (tuple, list)):
        return " ".join(map(str, value))
    return {True: "yes", False: "no"}[value] if isinstance(value, bool) else str(value)


def given_only(given: Mapping[str, Any]) -> dict[str, Any]:
    """What was typed: None and empty lists left out, choices as words, lists as tuples."""
    typed = {}
    for name, value in given.items():
        if value is None or value == []:
            continue
        typed[name] = tuple(map(_word, value)) if isinstance(value, list) else _word(value)
    return typed


def _word(value: Any) -> Any:
    return value.value if isinstance(value, enum.Enum) else value


def changed(settings: Any, typed: Mapping[str, Any]) -> Any:
    """`settings` with the typed fields that it has, checked.

    A stage's file may have `check(settings)`, which raises SplatError: better now than after the
    stages before it have run. Raises SplatError (option-value, or what `check` raises).
    """
    names = {field.name for field in fields(settings)}
    check = getattr(sys.modules[type(settings).__module__], "check", None)
    try:
        new = replace(settings, **{k: v for k, v in typed.items() if k in names})
        if check is not None:
            check(new)
        return new
    except (ValueError, TypeError) as error:
        raise SplatError(
            "option-value",
            given=f"An option has a value that cannot be used: {error}.",
            wanted="A value that the setting allows.",
            hint="Add --help to the command to see what each option takes.",
            family=Family.USAGE,
        ) from error


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
