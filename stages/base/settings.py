"""Settings and their bounds, stated once, in the metadata of each field.

Keys of the metadata:
    help: with the unit.
    min, max: bounds of a number, inclusive.
    choices: the allowed values; of a list the allowed items, and at least one is required.
    may_be_empty: True if a list with `choices` may be empty.
    pattern: regular expression that the whole text must match.
    wanted: a sentence that says what `pattern` requires.
    option: the option's name if it is not the field's.
    together: of a list, the metavars of the values that one use of the option takes.
    needs: another field, without which only the default has a meaning.
    affects_output: False if every value gives the same bytes.
    midway: True if an interrupted stage may be resumed with another value.
    panel: the heading (one of `PANELS`) under which `splat process --help` lists the option; a
        setting without one is an option of its stage's own command only.
"""

from __future__ import annotations

import math
import re
import types
from collections.abc import Mapping
from dataclasses import MISSING, dataclass, fields, replace
from dataclasses import field as dataclass_field
from functools import cache
from pathlib import Path
from typing import Any, Union, get_args, get_origin, get_type_hints

from stages.base.errors import SplatError, UsageError

PANELS = (
    *("Input", "Quality and time", "Size", "Output"),
    *("Known cameras", "Units", "Light and masks", "Advanced"),
)


# A value that was taken back: the field gets its default. It is a path, because versions of typer
# before 0.29 make one of whatever else is given for a path; only this very object counts.
UNSET = Path()


@dataclass(frozen=True)
class Setting:
    """One setting and its bounds.

    flag: "--max-side". kind: type of the value, or of a list's items if `many`. optional: whether
    it may be None. default: None if there is none. low, high: bounds, None if there is none.
    """

    name: str
    flag: str
    kind: type
    default: Any = None
    many: bool = False
    optional: bool = False
    low: float | None = None
    high: float | None = None
    choices: tuple[str, ...] = ()
    pattern: str = ""
    wanted: str = ""
    help: str = ""
    together: str = ""
    needs: str = ""
    panel: str = ""
    may_be_empty: bool = False
    affects_output: bool = True
    midway: bool = False

    def check(self, value: Any) -> None:
        """Check a value. Raises SplatError "option-value" if it is out of bounds."""
        if value is None and self.optional:
            return
        items = value if self.many and isinstance(value, (tuple, list)) else (value,)
        for item in items:
            if not self._allows(item):
                raise self._refused(item)
        if self.choices and not items and not self.may_be_empty:
            raise self._refused("with nothing")

    def parse(self, text: str) -> Any:
        """One value from its text; `UNSET` for an empty text where there may be no value. Raises
        SplatError "option-value"."""
        if not text and self.optional:
            return UNSET
        try:
            value = self.kind(text)
        except ValueError:
            raise self._refused(text) from None
        if not self._allows(value):
            raise self._refused(text)
        return value

    def _allows(self, value: Any) -> bool:
        if self.kind in (int, float):
            kinds = (int, float) if self.kind is float else (int,)
            if not isinstance(value, kinds) or isinstance(value, bool) or not math.isfinite(value):
                return False
            return (self.low is None or value >= self.low) and (
                self.high is None or value <= self.high
            )
        if not isinstance(value, self.kind) or (self.choices and value not in self.choices):
            return False
        return not self.pattern or re.fullmatch(self.pattern, str(value)) is not None

    def _refused(self, value: Any) -> SplatError:
        return UsageError(
            "option-value",
            given=f"{self.flag} {value if str(value) else chr(34) * 2} cannot be used.",
            wanted=self.wanted or self._wanted(),
            hint="Leave it out to get the default.",
        )

    def _wanted(self) -> str:
        if self.choices:
            return f"One of {', '.join(self.choices)}."
        if self.kind not in (int, float):
            return "Yes or no." if self.kind is bool else "A text."
        what = "A whole number" if self.kind is int else "A number"
        if self.low is not None and self.high is not None:
            return f"{what} from {self.low:,} to {self.high:,}."
        return f"{what} of at least {self.low:,}." if self.low is not None else f"{what}."


def setting(
    default: Any, help: str, min: float | None = None, max: float | None = None, **metadata: Any
) -> Any:
    """A field of a settings dataclass. metadata: as listed in this module's docstring."""
    bounds = {"low": min, "high": max}
    return dataclass_field(default=default, metadata={"help": help, **bounds, **metadata})


_type_hints = cache(get_type_hints)  # evaluating them again for every use slows down the help


def settings_of(settings_type: type) -> list[Setting]:
    """Every field of a settings dataclass, in order."""
    hints = _type_hints(settings_type)
    settings = []
    for field in fields(settings_type):
        hint, optional = hints[field.name], False
        if get_origin(hint) in (Union, types.UnionType):
            hint = next(arg for arg in get_args(hint) if arg is not type(None))
            optional = True
        many = get_origin(hint) in (tuple, list)
        more = dict(field.metadata)
        option = more.pop("option", field.name.removesuffix("s") if many else field.name)
        settings.append(
            Setting(
                name=field.name,
                flag="--" + option.replace("_", "-"),
                kind=get_args(hint)[0] if many else hint,
                default=None if field.default is MISSING else field.default,
                many=many,
                optional=optional,
                **more,
            )
        )
    return settings


def check_settings(settings: Any) -> None:
    """Check every field of a settings dataclass. Raises SplatError "option-value", and
    "option-alone" for a setting whose `needs` is not given. A settings dataclass may have a method
    `check` of its own, for what fields say together."""
    every = {setting.name: setting for setting in settings_of(type(settings))}
    for name, setting in every.items():
        setting.check(getattr(settings, name))
        if not setting.needs or getattr(settings, name) == setting.default:
            continue
        other = every[setting.needs]
        if getattr(settings, other.name) == other.default:
            raise UsageError(
                "option-alone",
                given=f"{setting.flag} means nothing without {other.flag}.",
                wanted="Both, or neither.",
                hint=f"Add {other.flag}, or leave {setting.flag} out.",
            )
    if hasattr(settings, "check"):
        settings.check()


def changed(settings: Any, typed: Mapping[str, Any]) -> Any:
    """`settings` with the typed values of its fields, checked. What is taken back takes back what
    means nothing without it. Raises as `check_settings`."""
    defaults = {field.name: field.default for field in fields(settings)}
    gone = {name for name, value in typed.items() if value is UNSET}
    dependent = (one.name for one in settings_of(type(settings)) if one.needs in gone)
    gone |= set(dependent) - typed.keys()
    values = {name: typed[name] for name in typed.keys() & defaults.keys()}
    values |= {name: defaults[name] for name in gone & defaults.keys()}
    new = replace(settings, **values)
    check_settings(new)
    return new
