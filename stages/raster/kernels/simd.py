"""Vectors of 16 float32 lanes and masks of 16 bits, for what runs over pixels.

Values have the type `f32x16`; see `vectors`. The functions can be called from compiled code only.
"""

from __future__ import annotations

from typing import Any

import numba
from llvmlite import ir
from numba.core import types
from numba.extending import intrinsic

from stages.raster.kernels.vectors import (
    I32,
    I64,
    Lanes,
    address_of,
    call_llvm,
    lane_constants,
)

LANES = 16
_F32 = Lanes("f32", LANES)
f32x16 = _F32.vector

vmin, vmax = _F32.minimum, _F32.maximum
vge, vgt, vand, vselect = _F32.greater_equal, _F32.greater, _F32.both, _F32.select
vabs, vsqrt = _F32.abs, _F32.sqrt
bits16 = _F32.bits
vnot = _F32.function(_F32.mask, 1, lambda b, x: b.not_(x))
splat16 = _F32.function(f32x16, 1, lambda b, x: x)  # the same float32 in all lanes
# a * b + c and c - a * b, rounded once
vfma = _F32.function(f32x16, 3, lambda b, x, y, z: _F32.call(b, "fma", x, y, z))
vfnma = _F32.function(f32x16, 3, lambda b, x, y, z: _F32.call(b, "fma", b.fneg(x), y, z))

# --- memory --------------------------------------------------------------------------------------


vload, vstore = _F32.loader(), _F32.storer()


def _row_of_four(context: Any, builder: Any, array_type: Any, args: Any, row: int) -> Any:
    """Address of the four elements from array[index + row * stride] on."""
    step = builder.mul(args[2], ir.Constant(I64, row))
    address = address_of(context, builder, array_type, args[0], builder.add(args[1], step))
    return builder.bitcast(address, ir.VectorType(ir.FloatType(), 4).as_pointer())


@intrinsic
def vload4x4(typingctx: Any, array: Any, index: Any, stride: Any) -> Any:
    """Four lanes from each of index, index + stride, + 2 stride, + 3 stride; not bounds-checked."""

    def codegen(context: Any, builder: Any, sig: Any, args: Any) -> Any:
        rows = [
            builder.load(_row_of_four(context, builder, sig.args[0], args, row), align=4)
            for row in range(4)
        ]
        halves = [
            builder.shuffle_vector(a, b, lane_constants(range(8))) for a, b in (rows[:2], rows[2:])
        ]
        return builder.shuffle_vector(*halves, lane_constants(range(LANES)))

    return f32x16(array, types.intp, types.intp), codegen


@intrinsic
def vstore4x4(typingctx: Any, array: Any, index: Any, stride: Any, value: Any) -> Any:
    """The inverse of `vload4x4`."""

    def codegen(context: Any, builder: Any, sig: Any, args: Any) -> Any:
        for row in range(4):
            lanes = lane_constants(range(4 * row, 4 * row + 4))
            part = builder.shuffle_vector(args[3], args[3], lanes)
            address = _row_of_four(context, builder, sig.args[0], args, row)
            builder.store(part, address, align=4)
        return context.get_dummy_value()

    return types.void(array, types.intp, types.intp, f32x16), codegen


@intrinsic
def prefetch(typingctx: Any, array: Any, index: Any) -> Any:
    """Prefetch the cache line of array[index], which is read soon."""

    def codegen(context: Any, builder: Any, sig: Any, args: Any) -> Any:
        address = address_of(context, builder, sig.args[0], args[0], args[1])
        address = builder.bitcast(address, ir.IntType(8).as_pointer())
        flags = [ir.Constant(I32, k) for k in (0, 3, 1)]  # read, keep, data
        call_llvm(builder, "llvm.prefetch.p0", ir.VoidType(), [address, *flags])
        return context.get_dummy_value()

    return types.void(array, types.intp), codegen


# --- masks and sums ------------------------------------------------------------------------------


def _any(builder: Any, mask: Any) -> Any:
    return call_llvm(builder, f"llvm.vector.reduce.or.v{LANES}i1", ir.IntType(1), [mask])


def _sum(builder: Any, vector: Any) -> Any:
    """A tree of fixed shape, so that every processor adds in the same order."""
    width = LANES
    undefined = ir.Constant(_F32.llvm, ir.Undefined)
    while width > 1:
        width //= 2
        lanes = lane_constants([(i + width) % LANES for i in range(LANES)])
        vector = builder.fadd(vector, builder.shuffle_vector(vector, undefined, lanes))
    return builder.extract_element(vector, ir.Constant(I32, 0))


def _fold(builder: Any, a: Any, b: Any, group: int) -> Any:
    """Halve groups of `group` lanes: the sums of a's groups, then those of b's."""
    half = group // 2
    starts = range(0, 2 * LANES, group)
    low = lane_constants([g + k for g in starts for k in range(half)])
    high = lane_constants([g + half + k for g in starts for k in range(half)])
    return builder.fadd(builder.shuffle_vector(a, b, low), builder.shuffle_vector(a, b, high))


vany = _F32.function(types.boolean, 1, _any)
vsum = _F32.function(types.float32, 1, _sum)


@intrinsic
def lowest_bit(typingctx: Any, bits: Any) -> Any:
    """The number of the lowest bit that is set in an integer that is not 0."""

    def codegen(context: Any, builder: Any, sig: Any, args: Any) -> Any:
        return builder.cttz(args[0], ir.Constant(ir.IntType(1), 1))

    return types.int64(types.int64), codegen


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
        half = builder.shuffle_vector(sums, sums, lane_constants(range(8)))
        address = address_of(context, builder, sig.args[0], args[0], args[1])
        builder.store(half, builder.bitcast(address, half.type.as_pointer()), align=4)
        return context.get_dummy_value()

    return types.void(array, types.intp, *([f32x16] * 8)), codegen


# --- exp2 ----------------------------------------------------------------------------------------

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
    """2^x for x in [-126, 126]: the integer part is added to the exponent bits."""
    magic = _F32.constant(12582912.0)  # 1.5 x 2^23: adding it rounds to the nearest integer
    shifted = builder.fadd(x, magic)
    whole = builder.fsub(shifted, magic)
    rest = builder.fsub(x, whole)
    value = _F32.constant(_EXP2[-1])
    for coefficient in _EXP2[-2::-1]:
        value = _F32.call(builder, "fma", value, rest, _F32.constant(coefficient))
    bits = builder.bitcast(shifted, _F32.integers)
    exponent = builder.shl(bits, _F32.integer_constant(23))
    bits = builder.add(builder.bitcast(value, _F32.integers), exponent)
    return builder.bitcast(bits, _F32.llvm)


vexp2 = _F32.function(f32x16, 1, _exp2)


# --- kernels -------------------------------------------------------------------------------------


@intrinsic
def take_ticket(typingctx: Any, counter: Any) -> Any:
    """Increment counter[0] atomically and return the value before. Threads share work with it.

    Only the order of the work depends on it, never a result.
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
    no_cfunc_wrapper=True,  # saves a fourteenth of the compile time
)
"""Decorator of every kernel: releases the GIL; the compiled code is cached on disk."""
