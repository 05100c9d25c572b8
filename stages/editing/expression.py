"""The conditions of `--keep`: `opacity > 0.1 and scale < 0.5`.

A condition consists of numbers, the names in `VARIABLES`, + - * /, comparisons, and, or, not and
parentheses. Python's parser builds the tree; it is checked and evaluated here, never by Python.
"""

from __future__ import annotations

import ast
import functools
import operator
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from stages.base.blocks import reported_blocks
from stages.base.errors import SplatError, UsageError
from stages.scene import Splats, dc_to_rgb

Column = Callable[[Splats], NDArray[np.floating]]
VARIABLES: Mapping[str, Column] = {
    "x": lambda splats: splats.means[:, 0],
    "y": lambda splats: splats.means[:, 1],
    "z": lambda splats: splats.means[:, 2],
    "opacity": lambda splats: splats.opacities,
    "scale": lambda splats: np.exp(splats.log_scales.max(axis=1)),
    "thickness": lambda splats: np.exp(splats.log_scales.min(axis=1)),
    "red": lambda splats: dc_to_rgb(splats.sh[:, 0, 0]),
    "green": lambda splats: dc_to_rgb(splats.sh[:, 0, 1]),
    "blue": lambda splats: dc_to_rgb(splats.sh[:, 0, 2]),
    "degree": lambda splats: splats.sh_degrees.astype(np.float64),
}
_LONGEST, _DEEPEST = 1000, 40
_ARITHMETIC: dict[type[ast.AST], Any] = {
    ast.Add: operator.add,
    ast.Sub: operator.sub,
    ast.Mult: operator.mul,
    ast.Div: operator.truediv,
    ast.UAdd: operator.pos,
    ast.USub: operator.neg,
}
_COMPARISONS: dict[type[ast.AST], Any] = {
    ast.Lt: operator.lt,
    ast.LtE: operator.le,
    ast.Gt: operator.gt,
    ast.GtE: operator.ge,
    ast.Eq: operator.eq,
    ast.NotEq: operator.ne,
}


class _RefusedError(ValueError):
    """Why a text is no condition."""


@dataclass(frozen=True)
class Expression:
    """A checked condition."""

    tree: ast.expr

    def evaluate(self, splats: Splats) -> NDArray[np.bool_]:
        """[N] whether the condition is true; false where a comparison meets NaN."""
        found = np.empty(len(splats), bool)
        for rows in reported_blocks(len(splats)):
            with np.errstate(all="ignore"):
                found[rows] = _value(self.tree, splats.take(rows))
        return found


def parse_expression(text: str) -> Expression:
    """Check `text`. Raises SplatError "edit-keep" for what is no condition."""
    try:
        if len(text) > _LONGEST:
            raise _RefusedError(f"it is longer than {_LONGEST} characters")
        tree = ast.parse(text.strip(), mode="eval").body
        if _checked(tree) is not bool:
            raise _RefusedError("it is a number, and not true or false")
    except _RefusedError as refused:
        raise _wrong(text, str(refused)) from refused
    except SyntaxError as error:
        raise _wrong(text, f"it cannot be read ({error.msg})") from error
    except (ValueError, MemoryError, RecursionError) as error:
        raise _wrong(text, "it cannot be read") from error
    return Expression(tree)


def _checked(node: ast.expr, depth: int = 0) -> type:
    """The type of `node`, bool or float. Raises _RefusedError."""
    if depth > _DEEPEST:
        raise _RefusedError(f"it is nested deeper than {_DEEPEST}")

    def each(parts: list[ast.expr], wanted: type) -> None:
        for part in parts:
            if _checked(part, depth + 1) is not wanted:
                kind = "true or false" if wanted is bool else "a number"
                raise _RefusedError(f"{ast.unparse(part)!r} stands where {kind} is wanted")

    match node:
        case ast.BoolOp(values=values):
            each(values, bool)
            return bool
        case ast.UnaryOp(op=ast.Not(), operand=operand):
            each([operand], bool)
            return bool
        case ast.Compare(left=left, ops=signs, comparators=others):
            if all(type(sign) in _COMPARISONS for sign in signs):
                each([left, *others], float)
                return bool
        case ast.BinOp(left=left, op=sign, right=right) if type(sign) in _ARITHMETIC:
            each([left, right], float)
            return float
        case ast.UnaryOp(op=sign, operand=operand) if type(sign) in _ARITHMETIC:
            each([operand], float)
            return float
        case ast.Constant(value=bool()):
            return bool
        case ast.Constant(value=int() | float() as value):
            if abs(value) > 1e300:
                raise _RefusedError("it holds a number that is too large")
            return float
        case ast.Name(id=name):
            if name in VARIABLES:
                return float
            raise _RefusedError(f"there is no variable {name!r}")
    raise _RefusedError(f"{ast.unparse(node)[:60]!r} is not understood")


def _value(node: Any, splats: Splats) -> Any:
    """The value of a checked tree: [N], or one value for all splats."""
    match node:
        case ast.Constant(value=bool() as truth):
            return truth
        case ast.Constant(value=int() | float() as number):
            return float(number)
        case ast.Name(id=name):
            return VARIABLES[name](splats).astype(np.float64)
        case ast.BoolOp(op=sign, values=values):
            together = np.logical_and if isinstance(sign, ast.And) else np.logical_or
            return functools.reduce(together, [_value(part, splats) for part in values])
        case ast.UnaryOp(op=ast.Not(), operand=operand):
            return np.logical_not(_value(operand, splats))
        case ast.UnaryOp(op=sign, operand=operand):
            return _ARITHMETIC[type(sign)](_value(operand, splats))
        case ast.BinOp(left=left, op=sign, right=right):
            # as NumPy values, so that scalars divide by 0 like arrays
            both = np.float64(1) * _value(left, splats), np.float64(1) * _value(right, splats)
            return _ARITHMETIC[type(sign)](*both)
        case ast.Compare(left=left, ops=signs, comparators=others):
            terms = [_value(term, splats) for term in (left, *others)]
            found = True
            for comparison, a, b in zip(signs, terms[:-1], terms[1:], strict=True):
                found = np.logical_and(found, _COMPARISONS[type(comparison)](a, b))
            return found
    raise AssertionError(ast.dump(node))


def _wrong(text: str, why: str) -> SplatError:
    return UsageError(
        "edit-keep",
        given=f"--keep {text[:100]!r}: {why}.",
        wanted=f"A condition on {', '.join(VARIABLES)}, with numbers, + - * /, < <= > >= == !=, "
        "and, or, not.",
        hint="For example: --keep 'opacity > 0.1 and scale < 0.5'",
    )
