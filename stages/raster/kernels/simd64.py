"""Eight float64 at a time: what runs over splats, one splat a lane.

Same idea as `simd` (which runs over pixels in float32): values of type `f64x8`, masks of type
`mask8`; scalars mix freely with vectors in arithmetic and comparison functions. Splats lie in
memory row by row, so lanes are collected by row number with `gather8` and put back with `scatter8`.
All functions here can be called from `numba.njit` code only.
"""

from __future__ import annotations

import math
import operator
from typing import Any

from llvmlite import ir
from numba.core import types
from numba.extending import intrinsic, models, overload, register_model

from stages.raster.kernels.simd import call_llvm

LANES = 8
_F64 = ir.DoubleType()
_I32, _I64 = ir.IntType(32), ir.IntType(64)
_VECTOR = ir.VectorType(_F64, LANES)
_INTEGERS = ir.VectorType(_I64, LANES)
_MASK = ir.VectorType(ir.IntType(1), LANES)


class _Lanes8(types.Type):
    def __init__(self, name: str) -> None:
        super().__init__(name=name)


f64x8 = _Lanes8("f64x8")
mask8 = _Lanes8("mask8")


@register_model(_Lanes8)
class _Lanes8Model(models.PrimitiveModel):
    def __init__(self, dmm: Any, fe_type: Any) -> None:
        super().__init__(dmm, fe_type, _MASK if fe_type is mask8 else _VECTOR)


def _constant(value: float) -> ir.Constant:
    return ir.Constant(_VECTOR, [ir.Constant(_F64, value)] * LANES)


def _lane(index: int) -> ir.Constant:
    return ir.Constant(_I32, index)


def _broadcast(builder: Any, scalar: Any) -> Any:
    undefined = ir.Constant(_VECTOR, ir.Undefined)
    one = builder.insert_element(undefined, scalar, _lane(0))
    zeros = ir.Constant(ir.VectorType(_I32, LANES), [_lane(0)] * LANES)
    return builder.shuffle_vector(one, undefined, zeros)


def _as_vector(context: Any, builder: Any, value: Any, from_type: Any) -> Any:
    if from_type is f64x8:
        return value
    return _broadcast(builder, context.cast(builder, value, from_type, types.float64))


def _function(result: Any, arity: int, emit: Any) -> Any:
    """An intrinsic of `arity` vectors or scalars; scalars are spread over the lanes."""

    def generator(typing_args: tuple[Any, ...]) -> Any:
        def codegen(context: Any, builder: Any, sig: Any, args: Any) -> Any:
            pairs = zip(args, sig.args, strict=True)
            return emit(builder, *(_as_vector(context, builder, a, t) for a, t in pairs))

        return result(*typing_args), codegen

    if arity == 1:

        @intrinsic
        def one(typingctx: Any, a: Any) -> Any:
            return generator((a,))

        return one
    if arity == 2:

        @intrinsic
        def two(typingctx: Any, a: Any, b: Any) -> Any:
            return generator((a, b))

        return two

    @intrinsic
    def three(typingctx: Any, a: Any, b: Any, c: Any) -> Any:
        return generator((a, b, c))

    return three


# --- memory --------------------------------------------------------------------------------------


def _address(context: Any, builder: Any, array_type: Any, array: Any, index: Any) -> Any:
    struct = context.make_array(array_type)(context, builder, array)
    return builder.gep(struct.data, [index])


@intrinsic
def dload(typingctx: Any, array: Any, index: Any) -> Any:
    """array[index : index + 8] of a C-contiguous float64 or float32 array; not bounds-checked."""

    def codegen(context: Any, builder: Any, sig: Any, args: Any) -> Any:
        address = _address(context, builder, sig.args[0], args[0], args[1])
        if sig.args[0].dtype == types.float64:
            return builder.load(builder.bitcast(address, _VECTOR.as_pointer()), align=8)
        narrow = ir.VectorType(ir.FloatType(), LANES)
        value = builder.load(builder.bitcast(address, narrow.as_pointer()), align=4)
        return builder.fpext(value, _VECTOR)

    return f64x8(array, types.intp), codegen


@intrinsic
def dstore(typingctx: Any, array: Any, index: Any, value: Any) -> Any:
    """array[index : index + 8] = value of a C-contiguous float64 array; not bounds-checked."""

    def codegen(context: Any, builder: Any, sig: Any, args: Any) -> Any:
        address = _address(context, builder, sig.args[0], args[0], args[1])
        builder.store(args[2], builder.bitcast(address, _VECTOR.as_pointer()), align=8)
        return context.get_dummy_value()

    return types.void(array, types.intp, f64x8), codegen


# Not plain kernels: those would be compiled anew for each number that stands in a call.
@intrinsic
def at(typingctx: Any, work: Any, k: Any) -> Any:
    """Entry k of a float64 array of eights: work[8 k : 8 k + 8]; not bounds-checked."""

    def codegen(context: Any, builder: Any, sig: Any, args: Any) -> Any:
        start = builder.mul(args[1], ir.Constant(args[1].type, LANES))
        address = _address(context, builder, sig.args[0], args[0], start)
        return builder.load(builder.bitcast(address, _VECTOR.as_pointer()), align=8)

    return f64x8(work, types.intp), codegen


@intrinsic
def put(typingctx: Any, work: Any, k: Any, value: Any) -> Any:
    """The way back of `at`."""

    def codegen(context: Any, builder: Any, sig: Any, args: Any) -> Any:
        start = builder.mul(args[1], ir.Constant(args[1].type, LANES))
        address = _address(context, builder, sig.args[0], args[0], start)
        builder.store(args[2], builder.bitcast(address, _VECTOR.as_pointer()), align=8)
        return context.get_dummy_value()

    return types.void(work, types.intp, f64x8), codegen


@intrinsic
def istore(typingctx: Any, array: Any, index: Any, value: Any) -> Any:
    """array[index : index + 8] = value, rounded to zero, of an int64 array; not bounds-checked."""

    def codegen(context: Any, builder: Any, sig: Any, args: Any) -> Any:
        address = _address(context, builder, sig.args[0], args[0], args[1])
        whole = builder.fptosi(args[2], _INTEGERS)
        builder.store(whole, builder.bitcast(address, _INTEGERS.as_pointer()), align=8)
        return context.get_dummy_value()

    return types.void(array, types.intp, f64x8), codegen


@intrinsic
def gather8(typingctx: Any, array: Any, rows: Any, stride: Any, column: Any) -> Any:
    """Lane k: element `rows[k] * stride + column` of a C-contiguous float array, as float64."""

    def codegen(context: Any, builder: Any, sig: Any, args: Any) -> Any:
        value = ir.Constant(_VECTOR, ir.Undefined)
        for k in range(LANES):
            at = _element(context, builder, sig, args, k)
            loaded = builder.load(at)
            if sig.args[0].dtype != types.float64:
                loaded = builder.fpext(loaded, _F64)
            value = builder.insert_element(value, loaded, _lane(k))
        return value

    return f64x8(array, rows, types.intp, types.intp), codegen


@intrinsic
def scatter8(typingctx: Any, array: Any, rows: Any, stride: Any, column: Any, value: Any) -> Any:
    """The way back of `gather8`; rounds to the array's type."""

    def codegen(context: Any, builder: Any, sig: Any, args: Any) -> Any:
        for k in range(LANES):
            at = _element(context, builder, sig, args, k)
            lane = builder.extract_element(args[4], _lane(k))
            if sig.args[0].dtype != types.float64:
                lane = builder.fptrunc(lane, ir.FloatType())
            builder.store(lane, at)
        return context.get_dummy_value()

    return types.void(array, rows, types.intp, types.intp, f64x8), codegen


def _element(context: Any, builder: Any, sig: Any, args: Any, lane: int) -> Any:
    row_at = _address(context, builder, sig.args[1], args[1], ir.Constant(_I64, lane))
    row = builder.load(row_at)
    if sig.args[1].dtype != types.int64:
        row = builder.sext(row, _I64)
    index = builder.add(builder.mul(row, args[2]), args[3])
    return _address(context, builder, sig.args[0], args[0], index)


# --- arithmetic ----------------------------------------------------------------------------------


def _vector(*typed: Any) -> Any:
    return f64x8(*typed)


def _mask(*typed: Any) -> Any:
    return mask8(*typed)


# Numba compares signatures with annotations and all, so the overloads carry none.
def _mixed(a, b):
    either = a is f64x8 or b is f64x8
    return either and all(t is f64x8 or isinstance(t, types.Float | types.Integer) for t in (a, b))


_add2 = _function(_vector, 2, lambda b, x, y: b.fadd(x, y))
_sub2 = _function(_vector, 2, lambda b, x, y: b.fsub(x, y))
_mul2 = _function(_vector, 2, lambda b, x, y: b.fmul(x, y))
_div2 = _function(_vector, 2, lambda b, x, y: b.fdiv(x, y))


@overload(operator.add)
def _add(a, b):
    return (lambda a, b: _add2(a, b)) if _mixed(a, b) else None


@overload(operator.sub)
def _sub(a, b):
    return (lambda a, b: _sub2(a, b)) if _mixed(a, b) else None


@overload(operator.mul)
def _mul(a, b):
    return (lambda a, b: _mul2(a, b)) if _mixed(a, b) else None


@overload(operator.truediv)
def _truediv(a, b):
    return (lambda a, b: _div2(a, b)) if _mixed(a, b) else None


@overload(operator.neg)
def _neg(a):
    return (lambda a: _sub2(-0.0, a)) if a is f64x8 else None


spread8 = _function(_vector, 1, lambda b, x: x)
dsqrt = _function(_vector, 1, lambda b, x: call_llvm(b, "llvm.sqrt.v8f64", _VECTOR, [x]))
dabs = _function(_vector, 1, lambda b, x: call_llvm(b, "llvm.fabs.v8f64", _VECTOR, [x]))
dfloor = _function(_vector, 1, lambda b, x: call_llvm(b, "llvm.floor.v8f64", _VECTOR, [x]))
dceil = _function(_vector, 1, lambda b, x: call_llvm(b, "llvm.ceil.v8f64", _VECTOR, [x]))
# the second where a lane holds NaN
dmin = _function(_vector, 2, lambda b, x, y: b.select(b.fcmp_ordered("<", x, y), x, y))
dmax = _function(_vector, 2, lambda b, x, y: b.select(b.fcmp_ordered(">", x, y), x, y))
# False where a lane holds NaN
dge = _function(_mask, 2, lambda b, x, y: b.fcmp_ordered(">=", x, y))
dgt = _function(_mask, 2, lambda b, x, y: b.fcmp_ordered(">", x, y))
deq = _function(_mask, 2, lambda b, x, y: b.fcmp_ordered("==", x, y))


@intrinsic
def dselect(typingctx: Any, mask: Any, a: Any, b: Any) -> Any:
    """a where the mask is set, else b; either may be a scalar."""

    def codegen(context: Any, builder: Any, sig: Any, args: Any) -> Any:
        chosen = (_as_vector(context, builder, args[k], sig.args[k]) for k in (1, 2))
        return builder.select(args[0], *chosen)

    return f64x8(mask, a, b), codegen


@intrinsic
def dand(typingctx: Any, a: Any, b: Any) -> Any:
    def codegen(context: Any, builder: Any, sig: Any, args: Any) -> Any:
        return builder.and_(*args)

    return mask8(a, b), codegen


@intrinsic
def bits8(typingctx: Any, mask: Any) -> Any:
    """The mask as an integer, lane k in bit k."""

    def codegen(context: Any, builder: Any, sig: Any, args: Any) -> Any:
        return builder.zext(builder.bitcast(args[0], ir.IntType(LANES)), _I64)

    return types.int64(mask), codegen


# --- exp and log ---------------------------------------------------------------------------------

_LOG2E = 1.0 / math.log(2.0)
_LN2_HIGH = 0.693145751953125  # exact in 20 bits: multiples up to 2^11 are exact
_LN2_LOW = 1.4286068203094172e-06
# Taylor to degree 13 on [-ln(2)/2, ln(2)/2]: remainder 2e-17.
_EXP = [1.0 / math.factorial(k) for k in range(14)]


def _exp(builder: Any, x: Any) -> Any:
    x = builder.select(builder.fcmp_ordered("<", x, _constant(708.0)), x, _constant(708.0))
    x = builder.select(builder.fcmp_ordered(">", x, _constant(-708.0)), x, _constant(-708.0))
    magic = _constant(6755399441055744.0)  # 1.5 x 2^52: adding it rounds to the nearest integer
    fma = "llvm.fma.v8f64"
    shifted = call_llvm(builder, fma, _VECTOR, [x, _constant(_LOG2E), magic])
    whole = builder.fsub(shifted, magic)
    rest = call_llvm(builder, fma, _VECTOR, [whole, _constant(-_LN2_HIGH), x])
    rest = call_llvm(builder, fma, _VECTOR, [whole, _constant(-_LN2_LOW), rest])
    value = _constant(_EXP[-1])
    for coefficient in _EXP[-2::-1]:
        value = call_llvm(builder, fma, _VECTOR, [value, rest, _constant(coefficient)])
    shift = ir.Constant(_INTEGERS, [ir.Constant(_I64, 52)] * LANES)
    exponent = builder.shl(builder.bitcast(shifted, _INTEGERS), shift)
    return builder.bitcast(builder.add(builder.bitcast(value, _INTEGERS), exponent), _VECTOR)


def _log(builder: Any, x: Any) -> Any:
    """log of a positive, normal x: x = m 2^e with m in [sqrt(1/2), sqrt(2)), and a series in
    ((m - 1)/(m + 1))^2."""
    bits = builder.bitcast(x, _INTEGERS)

    def integers(value: int) -> ir.Constant:
        return ir.Constant(_INTEGERS, [ir.Constant(_I64, value)] * LANES)

    root_half = integers(0x3FE6A09E667F3BCD)  # the bits of sqrt(1/2)
    exponent = builder.ashr(builder.sub(bits, root_half), integers(52))
    m = builder.bitcast(builder.sub(bits, builder.shl(exponent, integers(52))), _VECTOR)
    e = builder.sitofp(exponent, _VECTOR)
    one = _constant(1.0)
    s = builder.fdiv(builder.fsub(m, one), builder.fadd(m, one))
    s2 = builder.fmul(s, s)
    value = _constant(2.0 / 21)
    for k in range(19, 0, -2):
        args = [value, s2, _constant(2.0 / k)]
        value = call_llvm(builder, "llvm.fma.v8f64", _VECTOR, args)
    value = builder.fmul(value, s)
    args = [e, _constant(math.log(2.0)), value]
    return call_llvm(builder, "llvm.fma.v8f64", _VECTOR, args)


dexp = _function(_vector, 1, _exp)  # clipped to exp(+-708); NaN gives exp(708)
dlog = _function(_vector, 1, _log)
