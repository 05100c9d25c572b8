"""Vectors of 8 int32 lanes: what `binning` asks of the spans of eight rows of blocks.

The functions can be called from compiled code only. Arrays are flat, of int32, not bounds-checked.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from llvmlite import ir
from numba.core import types
from numba.extending import intrinsic

from stages.raster.kernels.vectors import I32, I64, address_of, call_llvm, lane_constants

LANES = 8
_VECTOR = ir.VectorType(I32, LANES)


def _constants(values: Sequence[int]) -> Any:
    return ir.Constant(_VECTOR, [ir.Constant(I32, value) for value in values])


def _load(context: Any, builder: Any, sig: Any, args: Any, offset: int = 0) -> Any:
    """The lanes args[0][args[1] + offset :]."""
    index = builder.add(args[1], ir.Constant(I64, offset))
    address = address_of(context, builder, sig.args[0], args[0], index)
    return builder.load(builder.bitcast(address, _VECTOR.as_pointer()), align=4)


def _reduced(builder: Any, name: str, vector: Any) -> Any:
    return call_llvm(builder, f"llvm.vector.reduce.{name}.v{LANES}i32", I32, [vector])


def _reduction(name: str) -> Any:
    """An intrinsic (array, index): what LLVM's reduction `name` makes of the lanes, as int64."""

    def typed(typingctx: Any, array: Any, index: Any) -> Any:
        def codegen(context: Any, builder: Any, sig: Any, args: Any) -> Any:
            lanes = _load(context, builder, sig, args)
            return builder.sext(_reduced(builder, name, lanes), I64)

        return types.int64(array, types.intp), codegen

    return intrinsic(typed)


least8, most8 = _reduction("smin"), _reduction("smax")


@intrinsic
def span_bits(typingctx: Any, spans: Any, index: Any, base: Any) -> Any:
    """Bits 4 q to 4 q + 3: which of the columns base to base + 3 lie in span q, that is from
    spans[index + q] to spans[index + 8 + q], both included; q from 0 to 7."""

    def codegen(context: Any, builder: Any, sig: Any, args: Any) -> Any:
        undefined = ir.Constant(_VECTOR, ir.Undefined)
        first = builder.trunc(args[2], I32)
        first = builder.insert_element(undefined, first, ir.Constant(I32, 0))
        first = builder.shuffle_vector(first, undefined, lane_constants([0] * LANES))
        zero, one, four = (_constants([value] * LANES) for value in (0, 1, 4))

        def larger(x: Any, y: Any) -> Any:
            return builder.select(builder.icmp_signed(">", x, y), x, y)

        def smaller(x: Any, y: Any) -> Any:
            return builder.select(builder.icmp_signed("<", x, y), x, y)

        low = builder.sub(_load(context, builder, sig, args), first)
        end = builder.add(builder.sub(_load(context, builder, sig, args, LANES), first), one)
        low = smaller(larger(low, zero), four)
        end = larger(smaller(end, four), low)
        bits = builder.sub(builder.shl(one, end), builder.shl(one, low))
        placed = builder.shl(bits, _constants(range(0, 4 * LANES, 4)))
        return builder.zext(_reduced(builder, "or", placed), I64)

    return types.int64(spans, types.intp, types.int64), codegen
