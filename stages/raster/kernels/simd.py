"""Sixteen float32 at a time, spelled out.

LLVM's loop vectoriser does not see through a rasteriser's inner loop (arrays that may alias,
masks, an exponential), so the kernels say what they mean: values of type `f32x16` and masks of 16
bits, which LLVM lowers to whatever the processor has (one AVX-512 register, two of AVX2, four of
SSE or NEON). All functions here can be called from `numba.njit` code only.
"""

from __future__ import annotations

import operator
from typing import Any

import numba
from llvmlite import ir
from numba.core import cgutils, types
from numba.extending import intrinsic, models, overload, register_model

LANES = 16
_F32 = ir.FloatType()
_I32 = ir.IntType(32)
_VECTOR = ir.VectorType(_F32, LANES)
_INTEGERS = ir.VectorType(_I32, LANES)
_MASK = ir.VectorType(ir.IntType(1), LANES)


class _VectorType(types.Type):
    def __init__(self, name: str) -> None:
        super().__init__(name=name)


f32x16 = _VectorType("f32x16")
mask16 = _VectorType("mask16")


@register_model(_VectorType)
class _VectorModel(models.PrimitiveModel):
    def __init__(self, dmm: Any, fe_type: Any) -> None:
        super().__init__(dmm, fe_type, _MASK if fe_type is mask16 else _VECTOR)


def _constant(value: float) -> ir.Constant:
    return ir.Constant(_VECTOR, [ir.Constant(_F32, value)] * LANES)


def _broadcast(builder: Any, scalar: Any) -> Any:
    undefined = ir.Constant(_VECTOR, ir.Undefined)
    one = builder.insert_element(undefined, scalar, ir.Constant(_I32, 0))
    zeros = ir.Constant(ir.VectorType(_I32, LANES), [ir.Constant(_I32, 0)] * LANES)
    return builder.shuffle_vector(one, undefined, zeros)


def call_llvm(builder: Any, name: str, result: Any, args: list[Any]) -> Any:
    function_type = ir.FunctionType(result, [a.type for a in args])
    function = cgutils.get_or_insert_function(builder.module, function_type, name)
    return builder.call(function, args)


def _pointer(context: Any, builder: Any, array_type: Any, array: Any, index: Any) -> Any:
    struct = context.make_array(array_type)(context, builder, array)
    address = builder.gep(struct.data, [index])
    return builder.bitcast(address, _VECTOR.as_pointer())


def _unary(typing_result: Any, emit: Any) -> Any:
    @intrinsic
    def op(typingctx: Any, a: Any) -> Any:
        def codegen(context: Any, builder: Any, sig: Any, args: Any) -> Any:
            return emit(builder, *args)

        return typing_result(a), codegen

    return op


def _binary(result: Any, emit: Any) -> Any:
    @intrinsic
    def op(typingctx: Any, a: Any, b: Any) -> Any:
        def codegen(context: Any, builder: Any, sig: Any, args: Any) -> Any:
            return emit(builder, *args)

        return result(a, b), codegen

    return op


@intrinsic
def vload(typingctx: Any, array: Any, index: Any) -> Any:
    """array[index : index + 16] of a C-contiguous 1-D float32 array; not bounds-checked."""

    def codegen(context: Any, builder: Any, sig: Any, args: Any) -> Any:
        address = _pointer(context, builder, sig.args[0], args[0], args[1])
        return builder.load(address, align=4)

    return f32x16(array, types.intp), codegen


@intrinsic
def vload_levels(typingctx: Any, array: Any, index: Any) -> Any:
    """16 elements of a flat array of float32 or of bytes, as float32."""

    def codegen(context: Any, builder: Any, sig: Any, args: Any) -> Any:
        if sig.args[0].dtype == types.float32:
            return builder.load(_pointer(context, builder, sig.args[0], args[0], args[1]), align=4)
        struct = context.make_array(sig.args[0])(context, builder, args[0])
        bytes_ = ir.VectorType(ir.IntType(8), LANES)
        address = builder.bitcast(builder.gep(struct.data, [args[1]]), bytes_.as_pointer())
        return builder.uitofp(builder.load(address, align=1), _VECTOR)

    return f32x16(array, types.intp), codegen


@intrinsic
def vstore(typingctx: Any, array: Any, index: Any, value: Any) -> Any:
    """array[index : index + 16] = value; not bounds-checked."""

    def codegen(context: Any, builder: Any, sig: Any, args: Any) -> Any:
        address = _pointer(context, builder, sig.args[0], args[0], args[1])
        builder.store(args[2], address, align=4)
        return context.get_dummy_value()

    return types.void(array, types.intp, f32x16), codegen


_QUARTER = ir.VectorType(_F32, 4)


def _row_of_four(context: Any, builder: Any, array_type: Any, args: Any, row: int) -> Any:
    """Address of array[index + row * stride]."""
    step = builder.mul(args[2], ir.Constant(ir.IntType(64), row))
    struct = context.make_array(array_type)(context, builder, args[0])
    address = builder.gep(struct.data, [builder.add(args[1], step)])
    return builder.bitcast(address, _QUARTER.as_pointer())


@intrinsic
def vload4x4(typingctx: Any, array: Any, index: Any, stride: Any) -> Any:
    """Four lanes from each of index, index + stride, + 2 stride, + 3 stride; not bounds-checked."""

    def codegen(context: Any, builder: Any, sig: Any, args: Any) -> Any:
        rows = [
            builder.load(_row_of_four(context, builder, sig.args[0], args, row), align=4)
            for row in range(4)
        ]
        eight = ir.VectorType(_I32, 8)
        pair = ir.Constant(eight, [ir.Constant(_I32, k) for k in range(8)])
        halves = [builder.shuffle_vector(a, b, pair) for a, b in (rows[:2], rows[2:])]
        whole = ir.Constant(_INTEGERS, [ir.Constant(_I32, k) for k in range(LANES)])
        return builder.shuffle_vector(*halves, whole)

    return f32x16(array, types.intp, types.intp), codegen


@intrinsic
def vstore4x4(typingctx: Any, array: Any, index: Any, stride: Any, value: Any) -> Any:
    """The way back of `vload4x4`."""

    def codegen(context: Any, builder: Any, sig: Any, args: Any) -> Any:
        four = ir.VectorType(_I32, 4)
        for row in range(4):
            lanes = ir.Constant(four, [ir.Constant(_I32, 4 * row + k) for k in range(4)])
            part = builder.shuffle_vector(args[3], args[3], lanes)
            address = _row_of_four(context, builder, sig.args[0], args, row)
            builder.store(part, address, align=4)
        return context.get_dummy_value()

    return types.void(array, types.intp, types.intp, f32x16), codegen


@intrinsic
def prefetch(typingctx: Any, array: Any, index: Any) -> Any:
    """Ask for the cache line of the flat array[index], which will be read soon."""

    def codegen(context: Any, builder: Any, sig: Any, args: Any) -> Any:
        struct = context.make_array(sig.args[0])(context, builder, args[0])
        byte = ir.IntType(8).as_pointer()
        address = builder.bitcast(builder.gep(struct.data, [args[1]]), byte)
        flags = [ir.Constant(_I32, k) for k in (0, 3, 1)]  # read, keep, data
        call_llvm(builder, "llvm.prefetch.p0", ir.VoidType(), [address, *flags])
        return context.get_dummy_value()

    return types.void(array, types.intp), codegen


@intrinsic
def splat16(typingctx: Any, scalar: Any) -> Any:
    """The same float32 in all lanes."""

    def codegen(context: Any, builder: Any, sig: Any, args: Any) -> Any:
        return _broadcast(builder, args[0])

    return f32x16(types.float32), codegen


@intrinsic
def vfma(typingctx: Any, a: Any, b: Any, c: Any) -> Any:
    """a * b + c, rounded once."""

    def codegen(context: Any, builder: Any, sig: Any, args: Any) -> Any:
        return call_llvm(builder, "llvm.fma.v16f32", _VECTOR, list(args))

    return f32x16(a, b, c), codegen


@intrinsic
def vfnma(typingctx: Any, a: Any, b: Any, c: Any) -> Any:
    """c - a * b, rounded once."""

    def codegen(context: Any, builder: Any, sig: Any, args: Any) -> Any:
        negated = builder.fneg(args[0])
        return call_llvm(builder, "llvm.fma.v16f32", _VECTOR, [negated, args[1], args[2]])

    return f32x16(a, b, c), codegen


@intrinsic
def vselect(typingctx: Any, mask: Any, a: Any, b: Any) -> Any:
    """a where the mask is set, else b."""

    def codegen(context: Any, builder: Any, sig: Any, args: Any) -> Any:
        return builder.select(*args)

    return f32x16(mask, a, b), codegen


def _any(builder: Any, mask: Any) -> Any:
    bits = builder.bitcast(mask, ir.IntType(LANES))
    return builder.icmp_unsigned("!=", bits, ir.Constant(ir.IntType(LANES), 0))


def _bits(builder: Any, mask: Any) -> Any:
    return builder.zext(builder.bitcast(mask, ir.IntType(LANES)), ir.IntType(64))


def _lowest_bit(builder: Any, bits: Any) -> Any:
    return builder.cttz(bits, ir.Constant(ir.IntType(1), 1))


def _sum(builder: Any, vector: Any) -> Any:
    """A tree of fixed shape, so that every processor adds in the same order."""
    width = LANES
    undefined = ir.Constant(_VECTOR, ir.Undefined)
    while width > 1:
        width //= 2
        lanes = [ir.Constant(_I32, (i + width) % LANES) for i in range(LANES)]
        shuffled = builder.shuffle_vector(vector, undefined, ir.Constant(_INTEGERS, lanes))
        vector = builder.fadd(vector, shuffled)
    return builder.extract_element(vector, ir.Constant(_I32, 0))


def _fold(builder: Any, a: Any, b: Any, group: int) -> Any:
    """Halve groups of `group` lanes: the sums of a's groups, then those of b's."""
    half = group // 2
    starts = range(0, 2 * LANES, group)
    low = [ir.Constant(_I32, g + k) for g in starts for k in range(half)]
    high = [ir.Constant(_I32, g + half + k) for g in starts for k in range(half)]
    lows = builder.shuffle_vector(a, b, ir.Constant(_INTEGERS, low))
    highs = builder.shuffle_vector(a, b, ir.Constant(_INTEGERS, high))
    return builder.fadd(lows, highs)


@intrinsic
def store_sums8(
    typingctx: Any,
    array: Any,
    index: Any,
    a: Any,
    b: Any,
    c: Any,
    d: Any,
    e: Any,
    f: Any,
    g: Any,
    h: Any,
) -> Any:
    """array[index : index + 8] = the sums over the lanes of eight vectors, by one tree."""

    def codegen(context: Any, builder: Any, sig: Any, args: Any) -> Any:
        vectors = list(args[2:])
        group = LANES
        while len(vectors) > 1:
            pairs = zip(vectors[::2], vectors[1::2], strict=True)
            vectors = [_fold(builder, x, y, group) for x, y in pairs]
            group //= 2
        sums = _fold(builder, vectors[0], vectors[0], group)
        eight = ir.VectorType(_I32, 8)
        first = ir.Constant(eight, [ir.Constant(_I32, k) for k in range(8)])
        half = builder.shuffle_vector(sums, sums, first)
        address = _pointer(context, builder, sig.args[0], args[0], args[1])
        builder.store(half, builder.bitcast(address, half.type.as_pointer()), align=4)
        return context.get_dummy_value()

    return types.void(array, types.intp, *([f32x16] * 8)), codegen


# exp2 on [-1/2, 1/2]: minimax polynomial of degree 5 by Remez' exchange, relative error 7.5e-8.
_EXP2 = (
    1.0000000716546849,
    0.6931469670647613,
    0.24022119723840105,
    0.05550713273496898,
    0.009675541334449414,
    0.0013276471992851953,
)


def _exp2(builder: Any, x: Any) -> Any:
    """2^x for x in [-126, 126]: the whole part goes into the exponent bits."""
    magic = _constant(12582912.0)  # 1.5 x 2^23: adding it rounds to the nearest integer
    shifted = builder.fadd(x, magic)
    whole = builder.fsub(shifted, magic)
    rest = builder.fsub(x, whole)
    value = _constant(_EXP2[-1])
    for coefficient in _EXP2[-2::-1]:
        value = call_llvm(
            builder, "llvm.fma.v16f32", _VECTOR, [value, rest, _constant(coefficient)]
        )
    bits = builder.bitcast(shifted, _INTEGERS)
    exponent = builder.shl(bits, ir.Constant(_INTEGERS, [ir.Constant(_I32, 23)] * LANES))
    return builder.bitcast(builder.add(builder.bitcast(value, _INTEGERS), exponent), _VECTOR)


def _min(builder: Any, a: Any, b: Any) -> Any:
    return builder.select(builder.fcmp_ordered("<", a, b), a, b)


def _max(builder: Any, a: Any, b: Any) -> Any:
    return builder.select(builder.fcmp_ordered(">", a, b), a, b)


def _vector1(a: Any) -> Any:
    return f32x16(a)


def _vector2(a: Any, b: Any) -> Any:
    return f32x16(a, b)


def _mask2(a: Any, b: Any) -> Any:
    return mask16(a, b)


vmin = _binary(_vector2, _min)  # the second where a lane holds NaN
vmax = _binary(_vector2, _max)
vexp2 = _unary(_vector1, _exp2)
vabs = _unary(_vector1, lambda b, x: call_llvm(b, "llvm.fabs.v16f32", _VECTOR, [x]))
vsqrt = _unary(_vector1, lambda b, x: call_llvm(b, "llvm.sqrt.v16f32", _VECTOR, [x]))
vsum = _unary(lambda a: types.float32(a), _sum)
bits16 = _unary(lambda a: types.int64(a), _bits)  # lane k in bit k
lowest_bit = _unary(lambda a: types.int64(types.int64), _lowest_bit)  # of a number that is not 0
vany = _unary(lambda a: types.boolean(a), _any)
vge = _binary(_mask2, lambda b, x, y: b.fcmp_ordered(">=", x, y))  # False where a lane holds NaN
vgt = _binary(_mask2, lambda b, x, y: b.fcmp_ordered(">", x, y))
vand = _binary(_mask2, lambda b, x, y: b.and_(x, y))
vnot = _unary(lambda a: mask16(a), lambda b, x: b.not_(x))
_vadd = _binary(_vector2, lambda b, x, y: b.fadd(x, y))
_vsub = _binary(_vector2, lambda b, x, y: b.fsub(x, y))
_vmul = _binary(_vector2, lambda b, x, y: b.fmul(x, y))
_vdiv = _binary(_vector2, lambda b, x, y: b.fdiv(x, y))


# Numba compares signatures with annotations and all, so the overloads carry none.
def _both_vectors(a, b):
    return a is f32x16 and b is f32x16


@overload(operator.add)
def _add(a, b):
    return (lambda a, b: _vadd(a, b)) if _both_vectors(a, b) else None


@overload(operator.sub)
def _sub(a, b):
    return (lambda a, b: _vsub(a, b)) if _both_vectors(a, b) else None


@overload(operator.mul)
def _mul(a, b):
    return (lambda a, b: _vmul(a, b)) if _both_vectors(a, b) else None


@overload(operator.truediv)
def _truediv(a, b):
    return (lambda a, b: _vdiv(a, b)) if _both_vectors(a, b) else None


@intrinsic
def take_ticket(typingctx: Any, counter: Any) -> Any:
    """counter[0]++ as one atomic operation; the value before. Threads share work with it.

    Only the order in which work is taken depends on it, never a result.
    """

    def codegen(context: Any, builder: Any, sig: Any, args: Any) -> Any:
        struct = context.make_array(sig.args[0])(context, builder, args[0])
        one = ir.Constant(ir.IntType(64), 1)
        return builder.atomic_rmw("add", struct.data, one, "monotonic")

    return types.int64(counter), codegen


kernel = numba.njit(
    nogil=True,
    cache=True,
    fastmath=False,
    error_model="numpy",
    boundscheck=False,
    no_cfunc_wrapper=True,  # a fourteenth of the time to compile, for what nobody calls
)
"""Decorator of every kernel: runs without the GIL, compiled once and kept on disk."""
