"""The conditions of `--keep`: `opacity > 0.1 and scale < 0.5`.

A condition consists of numbers, the names in `VARIABLES`, + - * /, comparisons, and, or, not and
parentheses. Python's parser builds the tree; it is checked and evaluated here, never by Python.
"""

from __future__ import annotations

import ast
import functools
import itertools
from collections.abc import Callable, Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

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
# NumPy's functions, so that scalars divide by 0 like arrays
_ARITHMETIC: dict[type[ast.AST], Any] = {
    ast.Add: np.add,
    ast.Sub: np.subtract,
    ast.Mult: np.multiply,
    ast.Div: np.divide,
    ast.UAdd: np.positive,
    ast.USub: np.negative,
}
_COMPARISONS: dict[type[ast.AST], Any] = {
    ast.Lt: np.less,
    ast.LtE: np.less_equal,
    ast.Gt: np.greater,
    ast.GtE: np.greater_equal,
    ast.Eq: np.equal,
    ast.NotEq: np.not_equal,
}


class _RefusedError(ValueError):
    """Why a text is no condition."""


def parse_expression(text: str) -> Callable[[Splats], NDArray[np.bool_]]:
    """The condition of `text`: for N splats [N] whether it is true; false where a comparison meets
    NaN. Raises SplatError "edit-keep" for what is no condition."""
    try:
        if len(text) > _LONGEST:
            raise _RefusedError(f"it is longer than {_LONGEST} characters")
        kind, value = _built(ast.parse(text.strip(), mode="eval").body)
        if kind is not bool:
            raise _RefusedError("it is a number, and not true or false")
    except _RefusedError as refused:
        raise _wrong(text, str(refused)) from refused
    except SyntaxError as error:
        raise _wrong(text, f"it cannot be read ({error.msg})") from error
    except (ValueError, MemoryError, RecursionError) as error:
        raise _wrong(text, "it cannot be read") from error

    def condition(splats: Splats) -> NDArray[np.bool_]:
        with np.errstate(all="ignore"):
            return np.full(len(splats), value(splats), bool)

    return condition


def _built(node: ast.expr, depth: int = 0) -> tuple[type, Callable[[Splats], Any]]:
    """(bool or float, the function that computes `node` for N splats: [N], or one value for all).
    Raises _RefusedError."""
    if depth > _DEEPEST:
        raise _RefusedError(f"it is nested deeper than {_DEEPEST}")
    match node:
        case ast.Constant(value=bool() as truth):
            return bool, lambda splats: truth
        case ast.Constant(value=int() | float() as number):
            if abs(number) > 1e300:
                raise _RefusedError("it holds a number that is too large")
            return float, lambda splats: float(number)
        case ast.Name(id=name):
            if name not in VARIABLES:
                raise _RefusedError(f"there is no variable {name!r}")
            return float, lambda splats: VARIABLES[name](splats).astype(np.float64)
    kind, wanted, apply, parts = _operation(node)
    terms = []
    for part in parts:
        found, term = _built(part, depth + 1)
        if found is not wanted:
            what = "true or false" if wanted is bool else "a number"
            raise _RefusedError(f"{ast.unparse(part)!r} stands where {what} is wanted")
        terms.append(term)
    return kind, lambda splats: apply(*(term(splats) for term in terms))


def _operation(node: ast.expr) -> tuple[type, type, Callable[..., Any], list[ast.expr]]:
    """(the type of the result, the type of each operand, the function, the operands). Raises
    _RefusedError."""
    match node:
        case ast.BoolOp(op=sign, values=parts):
            both = np.logical_and if isinstance(sign, ast.And) else np.logical_or
            return bool, bool, lambda *values: functools.reduce(both, values), parts
        case ast.UnaryOp(op=ast.Not(), operand=part):
            return bool, bool, np.logical_not, [part]
        case ast.UnaryOp(op=sign, operand=part) if type(sign) in _ARITHMETIC:
            return float, float, _ARITHMETIC[type(sign)], [part]
        case ast.BinOp(left=left, op=sign, right=right) if type(sign) in _ARITHMETIC:
            return float, float, _ARITHMETIC[type(sign)], [left, right]
        case ast.Compare(left=left, ops=signs, comparators=others) if all(
            type(sign) in _COMPARISONS for sign in signs
        ):
            compare = [_COMPARISONS[type(sign)] for sign in signs]

            def compared(*values: Any) -> Any:
                pairs = zip(compare, itertools.pairwise(values), strict=True)
                return functools.reduce(np.logical_and, [holds(*pair) for holds, pair in pairs])

            return bool, float, compared, [left, *others]
    raise _RefusedError(f"{ast.unparse(node)[:60]!r} is not understood")


def _wrong(text: str, why: str) -> SplatError:
    return UsageError(
        "edit-keep",
        given=f"--keep {text[:100]!r}: {why}.",
        wanted=f"A condition on {', '.join(VARIABLES)}, with numbers, + - * /, < <= > >= == !=, "
        "and, or, not.",
        hint="For example: --keep 'opacity > 0.1 and scale < 0.5'",
    )
