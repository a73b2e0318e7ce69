"""Registers from and to arrays: any element for each lane, or neighbours.

Arrays are in C order, and an index counts their elements in that order. What an array holds in
fewer bits is widened on the way in and narrowed on the way out.
"""

from __future__ import annotations

from typing import Any

from llvmlite import ir
from numba import types
from numba.core.typing.templates import signature
from numba.extending import intrinsic

from volcli.kernels.lanes import (
    FLOATS,
    I32,
    I64,
    INTS,
    LANES,
    MASK,
    Lanes,
    call_llvm,
    splat,
    vector_of,
)


def _stored(context: Any, array: Any) -> ir.Type:
    return context.get_data_type(array.dtype)


def _bytes(array: Any) -> int:
    return int(array.dtype.bitwidth) // 8


def _is_narrow(array: Any) -> bool:
    return isinstance(array.dtype, types.Integer) and _bytes(array) < 8


def _data(context: Any, builder: Any, array: Any, value: Any) -> Any:
    return context.make_array(array)(context, builder, value).data


def _lanes_of(array: Any) -> Lanes:
    return FLOATS if isinstance(array.dtype, types.Float) else INTS


def _widen(builder: Any, array: Any, value: Any) -> Any:
    """What an array holds, as a register of FLOATS or INTS."""
    if array.dtype == types.float32:
        return builder.fpext(value, FLOATS.register)
    if _is_narrow(array):
        return builder.sext(value, INTS.register)
    return value


def _narrow(builder: Any, array: Any, value: Any) -> Any:
    if _is_narrow(array):
        return builder.trunc(value, vector_of(ir.IntType(array.dtype.bitwidth)))
    return value


def _pointers(context: Any, builder: Any, array: Any, value: Any, index: Any, to: ir.Type) -> Any:
    """For each lane the address of an element, counted in C order."""
    base = builder.ptrtoint(_data(context, builder, array, value), I64)
    size = splat(builder, I64(_bytes(array)), INTS.register)
    address = builder.add(splat(builder, base, INTS.register), builder.mul(index, size))
    return builder.inttoptr(address, vector_of(to.as_pointer()))


def _masked_gather(builder: Any, pointers: Any, mask: Any, scalar: ir.Type, align: int) -> Any:
    register = vector_of(scalar)
    name = f"llvm.masked.gather.v{LANES}{scalar.intrinsic_name}.v{LANES}p0"
    return call_llvm(
        builder, name, register, [pointers, I32(align), mask, ir.Constant(register, None)]
    )


@intrinsic
def load(typing_context, array, first):
    """``array[first : first + LANES]``, float64, or int32 or int64."""

    def write(context, builder, sig, values):
        pointer = builder.gep(_data(context, builder, array, values[0]), [values[1]])
        pointer = builder.bitcast(pointer, vector_of(_stored(context, array)).as_pointer())
        return _widen(builder, array, builder.load(pointer, align=_bytes(array)))

    return signature(_lanes_of(array), array, types.int64), write


@intrinsic
def store(typing_context, array, first, value):
    """``array[first : first + LANES] = value``."""

    def write(context, builder, sig, values):
        pointer = builder.gep(_data(context, builder, array, values[0]), [values[1]])
        stored = _narrow(builder, array, values[2])
        pointer = builder.bitcast(pointer, stored.type.as_pointer())
        builder.store(stored, pointer, align=_bytes(array))
        return context.get_dummy_value()

    return signature(types.none, array, types.int64, _lanes_of(array)), write


@intrinsic
def gather(typing_context, array, index, mask):
    """``array.ravel()[index]`` where the mask holds, else 0; the array is in C order."""

    def write(context, builder, sig, values):
        stored = _stored(context, array)
        pointers = _pointers(context, builder, array, values[0], values[1], stored)
        value = _masked_gather(builder, pointers, values[2], stored, _bytes(array))
        return _widen(builder, array, value)

    return signature(_lanes_of(array), array, INTS, MASK), write


@intrinsic
def gather_square(typing_context, array, index, row, mask):
    """Elements ``index``, ``index + 1``, ``index + row``, ``index + row + 1`` of float32.

    A gather of 64 bits a lane brings two of them; taking both registers apart together needs fewer
    instructions than one at a time.
    """

    def write(context, builder, sig, values):
        array_value, index_value, row_value, mask_value = values
        second = builder.add(index_value, splat(builder, row_value, INTS.register))
        twice = ir.VectorType(ir.FloatType(), 2 * LANES)
        pairs = []
        for at in (index_value, second):
            pointers = _pointers(context, builder, array, array_value, at, I64)
            both = _masked_gather(builder, pointers, mask_value, I64, _bytes(array))
            pairs.append(builder.bitcast(both, twice))
        result = []
        for half in (0, 1):  # of each pair the first, then the second
            order = ir.Constant(ir.VectorType(I32, 2 * LANES), list(range(half, 4 * LANES, 2)))
            result.append(builder.shuffle_vector(*pairs, order))
        return context.make_tuple(
            builder,
            sig.return_type,
            [
                builder.fpext(
                    builder.shuffle_vector(
                        half,
                        ir.Constant(twice, ir.Undefined),
                        ir.Constant(vector_of(I32), list(range(first, first + LANES))),
                    ),
                    FLOATS.register,
                )
                for first in (0, LANES)
                for half in result
            ],
        )

    return signature(types.UniTuple(FLOATS, 4), array, INTS, types.int64, MASK), write


@intrinsic
def scatter(typing_context, array, index, value, mask):
    """``array.ravel()[index] = value`` where the mask holds; the array is in C order."""

    def write(context, builder, sig, values):
        stored = _stored(context, array)
        pointers = _pointers(context, builder, array, values[0], values[1], stored)
        name = f"llvm.masked.scatter.v{LANES}{stored.intrinsic_name}.v{LANES}p0"
        value = _narrow(builder, array, values[2])
        call_llvm(builder, name, ir.VoidType(), [value, pointers, I32(_bytes(array)), values[3]])
        return context.get_dummy_value()

    return signature(types.none, array, INTS, _lanes_of(array), MASK), write


@intrinsic
def append(typing_context, array, first, value, mask):
    """Write the lanes of ``value`` where the mask holds, one after another, to ``array[first:]``.

    Up to ``LANES`` elements are written whatever the mask: the array must have room for them.
    """

    def write(context, builder, sig, values):
        pointer = builder.gep(_data(context, builder, array, values[0]), [values[1]])
        register = values[2].type
        kind = f"v{LANES}{register.element.intrinsic_name}"
        together = call_llvm(
            builder,
            f"llvm.experimental.vector.compress.{kind}",
            register,
            [values[2], values[3], ir.Constant(register, ir.Undefined)],
        )
        stored = _narrow(builder, array, together)
        pointer = builder.bitcast(pointer, stored.type.as_pointer())
        builder.store(stored, pointer, align=_bytes(array))
        return context.get_dummy_value()

    return signature(types.none, array, types.int64, _lanes_of(array), MASK), write
