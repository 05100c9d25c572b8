"""Vectors of 8 float64 lanes and masks of 8 bits, for what runs over splats, one splat a lane.

Values have the type `f64x8`; see `vectors`. Scalars mix freely with vectors. Splats lie in memory
row by row, so lanes are collected by row number with `gather8` and written with `scatter8`. The
functions can be called from compiled code only.
"""

from __future__ import annotations

import math
import operator
from typing import Any

from llvmlite import ir
from numba.core import types
from numba.extending import intrinsic, overload

from stages.raster.kernels.vectors import I32, I64, Lanes, address_of

LANES = 8
_F64 = Lanes("f64", LANES)
f64x8 = _F64.vector

dmin, dmax = _F64.minimum, _F64.maximum
dge, dgt, deq = _F64.greater_equal, _F64.greater, _F64.equal
dand, dselect, bits8 = _F64.both, _F64.select, _F64.bits
dsqrt, dabs = _F64.sqrt, _F64.abs
dfloor = _F64.function(f64x8, 1, lambda b, x: _F64.call(b, "floor", x))
dceil = _F64.function(f64x8, 1, lambda b, x: _F64.call(b, "ceil", x))
spread8 = _F64.function(f64x8, 1, lambda b, x: x)
_subtract = _F64.function(f64x8, 2, lambda b, x, y: b.fsub(x, y))


@overload(operator.neg)
def _neg(a):
    return (lambda a: _subtract(-0.0, a)) if a is f64x8 else None


# --- memory --------------------------------------------------------------------------------------


dload, dstore = _F64.loader(), _F64.storer()
# entry k of a float64 array of eights: work[8 k : 8 k + 8]
at, put = _F64.loader(LANES), _F64.storer(LANES)


@intrinsic
def gather8(typingctx: Any, array: Any, rows: Any, stride: Any, column: Any) -> Any:
    """Lane k: element `rows[k] * stride + column` of a C-contiguous float array, as float64."""

    def codegen(context: Any, builder: Any, sig: Any, args: Any) -> Any:
        value = ir.Constant(_F64.llvm, ir.Undefined)
        for k in range(LANES):
            at = _element(context, builder, sig, args, k)
            loaded = builder.load(at)
            if sig.args[0].dtype != types.float64:
                loaded = builder.fpext(loaded, ir.DoubleType())
            value = builder.insert_element(value, loaded, ir.Constant(I32, k))
        return value

    return f64x8(array, rows, types.intp, types.intp), codegen


@intrinsic
def scatter8(typingctx: Any, array: Any, rows: Any, stride: Any, column: Any, value: Any) -> Any:
    """The inverse of `gather8`; rounds to the array's type."""

    def codegen(context: Any, builder: Any, sig: Any, args: Any) -> Any:
        for k in range(LANES):
            at = _element(context, builder, sig, args, k)
            lane = builder.extract_element(args[4], ir.Constant(I32, k))
            if sig.args[0].dtype != types.float64:
                lane = builder.fptrunc(lane, ir.FloatType())
            builder.store(lane, at)
        return context.get_dummy_value()

    return types.void(array, rows, types.intp, types.intp, f64x8), codegen


def _element(context: Any, builder: Any, sig: Any, args: Any, lane: int) -> Any:
    row_at = address_of(context, builder, sig.args[1], args[1], ir.Constant(I64, lane))
    row = builder.load(row_at)
    if sig.args[1].dtype != types.int64:
        row = builder.sext(row, I64)
    index = builder.add(builder.mul(row, args[2]), args[3])
    return address_of(context, builder, sig.args[0], args[0], index)


# --- exp and log ---------------------------------------------------------------------------------

_LOG2E = 1.0 / math.log(2.0)
_LN2_HIGH = 0.693145751953125  # exact in 20 bits: multiples up to 2^11 are exact
_LN2_LOW = 1.4286068203094172e-06
# Taylor to degree 13 on [-ln(2)/2, ln(2)/2]: remainder 2e-17.
_EXP = [1.0 / math.factorial(k) for k in range(14)]


def _exp(builder: Any, x: Any) -> Any:
    x = builder.select(builder.fcmp_ordered("<", x, _F64.constant(708.0)), x, _F64.constant(708.0))
    x = builder.select(
        builder.fcmp_ordered(">", x, _F64.constant(-708.0)), x, _F64.constant(-708.0)
    )
    magic = _F64.constant(6755399441055744.0)  # 1.5 x 2^52: adding it rounds to the nearest integer
    shifted = _F64.call(builder, "fma", x, _F64.constant(_LOG2E), magic)
    whole = builder.fsub(shifted, magic)
    rest = _F64.call(builder, "fma", whole, _F64.constant(-_LN2_HIGH), x)
    rest = _F64.call(builder, "fma", whole, _F64.constant(-_LN2_LOW), rest)
    value = _F64.constant(_EXP[-1])
    for coefficient in _EXP[-2::-1]:
        value = _F64.call(builder, "fma", value, rest, _F64.constant(coefficient))
    bits = builder.bitcast(shifted, _F64.integers)
    exponent = builder.shl(bits, _F64.integer_constant(52))
    bits = builder.add(builder.bitcast(value, _F64.integers), exponent)
    return builder.bitcast(bits, _F64.llvm)


def _log(builder: Any, x: Any) -> Any:
    """log of a positive, normal x: x = m 2^e with m in [sqrt(1/2), sqrt(2)), and a series in
    ((m - 1)/(m + 1))^2."""
    bits = builder.bitcast(x, _F64.integers)
    root_half = _F64.integer_constant(0x3FE6A09E667F3BCD)  # the bits of sqrt(1/2)
    exponent = builder.ashr(builder.sub(bits, root_half), _F64.integer_constant(52))
    m = builder.bitcast(
        builder.sub(bits, builder.shl(exponent, _F64.integer_constant(52))), _F64.llvm
    )
    e = builder.sitofp(exponent, _F64.llvm)
    one = _F64.constant(1.0)
    s = builder.fdiv(builder.fsub(m, one), builder.fadd(m, one))
    s2 = builder.fmul(s, s)
    value = _F64.constant(2.0 / 21)
    for k in range(19, 0, -2):
        value = _F64.call(builder, "fma", value, s2, _F64.constant(2.0 / k))
    value = builder.fmul(value, s)
    return _F64.call(builder, "fma", e, _F64.constant(math.log(2.0)), value)


dexp = _F64.function(f64x8, 1, _exp)  # clamped to exp(+-708); NaN gives exp(708)
dlog = _F64.function(f64x8, 1, _log)
