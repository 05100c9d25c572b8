"""Vector values in Numba kernels: the LLVM code that `simd` and `simd64` share.

LLVM's loop vectoriser does not see through a rasteriser's inner loop (arrays that may alias,
masks, an exponential), so kernels use explicit vector types. LLVM lowers them to the registers of
the processor: for 16 float32 one AVX-512 register, two of AVX2, four of SSE or NEON.
"""

from __future__ import annotations

import operator
from typing import Any

from llvmlite import ir
from numba.core import cgutils, types
from numba.extending import intrinsic, models, overload, register_model

I32, I64 = ir.IntType(32), ir.IntType(64)
_ELEMENTS = {"f32": ir.FloatType(), "f64": ir.DoubleType(), "bit": ir.IntType(1)}
_SCALARS = {"f32": types.float32, "f64": types.float64}


class VectorType(types.Type):
    """Numba type of `lanes` values of a kind: "f32", "f64", or "bit" for a mask."""

    def __init__(self, kind: str, lanes: int) -> None:
        self.kind, self.lanes = kind, lanes
        super().__init__(name=f"{kind}x{lanes}")

    @property
    def llvm(self) -> Any:
        return ir.VectorType(_ELEMENTS[self.kind], self.lanes)


@register_model(VectorType)
class _VectorModel(models.PrimitiveModel):
    def __init__(self, dmm: Any, fe_type: Any) -> None:
        super().__init__(dmm, fe_type, fe_type.llvm)


def call_llvm(builder: Any, name: str, result: Any, args: list[Any]) -> Any:
    """Call the LLVM intrinsic `name`."""
    function_type = ir.FunctionType(result, [a.type for a in args])
    function = cgutils.get_or_insert_function(builder.module, function_type, name)
    return builder.call(function, args)


def address_of(context: Any, builder: Any, array_type: Any, array: Any, index: Any) -> Any:
    """Address of array[index] of a flat array; not bounds-checked."""
    struct = context.make_array(array_type)(context, builder, array)
    return builder.gep(struct.data, [index])


def lane_constants(lanes: Any) -> Any:
    """The vector of lane numbers that a shuffle takes."""
    numbers = [ir.Constant(I32, lane) for lane in lanes]
    return ir.Constant(ir.VectorType(I32, len(numbers)), numbers)


class Lanes:
    """One vector type, its mask type, and the functions that every vector type has.

    Functions are Numba intrinsics, to be called from compiled code only.

    Attributes:
        minimum, maximum: by lane; the second argument where a lane holds NaN.
        greater_equal, greater, equal: masks; False where a lane holds NaN.
        both: "and" of two masks.
        select: (mask, a, b) -> a where the mask is set, else b.
        bits: mask -> int64, lane k in bit k.
        sqrt, abs: by lane.
    """

    def __init__(self, kind: str, lanes: int) -> None:
        self.lanes = lanes
        self.vector, self.mask = VectorType(kind, lanes), VectorType("bit", lanes)
        self.llvm = self.vector.llvm
        self.integers = ir.VectorType(I32 if kind == "f32" else I64, lanes)
        self._scalar = _SCALARS[kind]
        self._suffix = f"v{lanes}{kind}"
        # A float64 constant next to a float32 vector would be rounded without notice.
        self._mixing = (types.Float, types.Integer) if kind == "f64" else ()
        vector, mask = self.vector, self.mask
        self.minimum = self.function(
            vector, 2, lambda b, x, y: b.select(b.fcmp_ordered("<", x, y), x, y)
        )
        self.maximum = self.function(
            vector, 2, lambda b, x, y: b.select(b.fcmp_ordered(">", x, y), x, y)
        )
        self.greater_equal = self.function(mask, 2, lambda b, x, y: b.fcmp_ordered(">=", x, y))
        self.greater = self.function(mask, 2, lambda b, x, y: b.fcmp_ordered(">", x, y))
        self.equal = self.function(mask, 2, lambda b, x, y: b.fcmp_ordered("==", x, y))
        self.both = self.function(mask, 2, lambda b, x, y: b.and_(x, y))
        self.select = self.function(vector, 3, lambda b, m, x, y: b.select(m, x, y))
        self.bits = self.function(
            types.int64, 1, lambda b, m: b.zext(b.bitcast(m, ir.IntType(lanes)), I64)
        )
        self.sqrt = self.function(vector, 1, lambda b, x: self.call(b, "sqrt", x))
        self.abs = self.function(vector, 1, lambda b, x: self.call(b, "fabs", x))
        for operation, instruction in (
            (operator.add, "fadd"),
            (operator.sub, "fsub"),
            (operator.mul, "fmul"),
            (operator.truediv, "fdiv"),
        ):
            self._overload(operation, instruction)

    def call(self, builder: Any, name: str, *args: Any) -> Any:
        """Call LLVM's intrinsic `name` ("fma") for this vector type."""
        return call_llvm(builder, f"llvm.{name}.{self._suffix}", self.llvm, list(args))

    def constant(self, value: float) -> Any:
        return ir.Constant(self.llvm, [ir.Constant(self.llvm.element, value)] * self.lanes)

    def integer_constant(self, value: int) -> Any:
        return ir.Constant(self.integers, [ir.Constant(self.integers.element, value)] * self.lanes)

    def broadcast(self, builder: Any, scalar: Any) -> Any:
        """The same value in all lanes."""
        undefined = ir.Constant(self.llvm, ir.Undefined)
        one = builder.insert_element(undefined, scalar, ir.Constant(I32, 0))
        return builder.shuffle_vector(one, undefined, lane_constants([0] * self.lanes))

    def loader(self, step: int = 1) -> Any:
        """An intrinsic (array, index): the lanes array[step x index : step x index + lanes].

        The array is flat or C-contiguous, of floats (not wider than the lanes) or of bytes; not
        bounds-checked. An intrinsic, because a kernel would be compiled again for each constant
        index.
        """

        def typed(typingctx: Any, array: Any, index: Any) -> Any:
            def codegen(context: Any, builder: Any, sig: Any, args: Any) -> Any:
                address, stored = self._place(context, builder, sig, args, step)
                value = builder.load(address, align=stored.bitwidth // 8)
                if stored == self._scalar:
                    return value
                convert = builder.fpext if isinstance(stored, types.Float) else builder.uitofp
                return convert(value, self.llvm)

            return self.vector(array, types.intp), codegen

        return intrinsic(typed)

    def storer(self, step: int = 1) -> Any:
        """An intrinsic (array, index, value), the inverse of `loader`: into an array of the lanes'
        type, or rounded to zero into one of integers."""

        def typed(typingctx: Any, array: Any, index: Any, value: Any) -> Any:
            def codegen(context: Any, builder: Any, sig: Any, args: Any) -> Any:
                address, stored = self._place(context, builder, sig, args, step)
                value = args[2]
                if isinstance(stored, types.Integer):
                    value = builder.fptosi(value, address.type.pointee)
                builder.store(value, address, align=stored.bitwidth // 8)
                return context.get_dummy_value()

            return types.void(array, types.intp, self.vector), codegen

        return intrinsic(typed)

    def _place(self, context: Any, builder: Any, sig: Any, args: Any, step: int) -> Any:
        """(address of a vector of elements of the array args[0], at step x args[1]; their type)."""
        stored = sig.args[0].dtype
        index = builder.mul(args[1], ir.Constant(args[1].type, step))
        address = address_of(context, builder, sig.args[0], args[0], index)
        elements = ir.VectorType(context.get_data_type(stored), self.lanes)
        return builder.bitcast(address, elements.as_pointer()), stored

    def function(self, result: Any, arity: int, emit: Any) -> Any:
        """An intrinsic of `arity` vectors, masks or scalars. Scalars are broadcast.

        emit(builder, *vectors) writes its instructions.
        """

        def typed(*arguments: Any) -> Any:
            def codegen(context: Any, builder: Any, sig: Any, args: Any) -> Any:
                pairs = zip(args, sig.args, strict=True)
                return emit(builder, *(self._as_vector(context, builder, a, t) for a, t in pairs))

            return result(*arguments), codegen

        if arity == 1:
            return intrinsic(lambda typingctx, a: typed(a))
        if arity == 2:
            return intrinsic(lambda typingctx, a, b: typed(a, b))
        return intrinsic(lambda typingctx, a, b, c: typed(a, b, c))

    def _as_vector(self, context: Any, builder: Any, value: Any, from_type: Any) -> Any:
        if isinstance(from_type, VectorType):
            return value
        return self.broadcast(builder, context.cast(builder, value, from_type, self._scalar))

    def _overload(self, operation: Any, instruction: str) -> None:
        apply = self.function(self.vector, 2, lambda b, x, y: getattr(b, instruction)(x, y))

        # Numba compares signatures with annotations, so the overloads have none.
        def types_of(a, b):
            fits = all(t is self.vector or isinstance(t, self._mixing) for t in (a, b))
            if fits and (a is self.vector or b is self.vector):
                return lambda a, b: apply(a, b)
            return None

        overload(operation)(types_of)
