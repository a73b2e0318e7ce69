"""Numbers side by side in one vector register: numba types, and arithmetic on them.

    FLOATS    `LANES` float64
    INTS      `LANES` int64
    MASK      `LANES` truth values

Operators, ``min``, ``max``, ``math.floor``, ``math.sqrt`` and ``math.exp`` take these as they take
scalars, and a scalar beside them stands for all lanes; so a function of plain arithmetic, such as
`cell.cubic`, compiles for a scalar or for a register from one source. A branch does not: `pick`
chooses lane by lane, and `any_of` tells whether some lane goes there. `lane_memory` has registers
from and to arrays.

The width is that of the machine's registers. LLVM does not vectorise such loops by itself; its
vector types leave nothing to luck. Without registers of four numbers (`LANES` 1) there is nothing
to win: then, and where numba does not compile, these types are not used.
"""

from __future__ import annotations

import math
import operator
from collections.abc import Callable
from typing import Any

from llvmlite import binding, ir
from numba import types
from numba.core import cgutils, config
from numba.core.typing.templates import AbstractTemplate, infer_global, signature
from numba.extending import (
    intrinsic,
    lower_builtin,
    lower_cast,
    models,
    overload,
    register_model,
)


def _lanes() -> int:
    features = config.CPU_FEATURES or binding.get_host_cpu_features().flatten()  # type: ignore[attr-defined]
    known = features.split(",")
    if config.DISABLE_JIT:  # type: ignore[attr-defined]
        return 1
    if "+avx512f" in known and "+avx512dq" in known:
        return 8
    return 4 if "+avx2" in known and "+fma" in known else 1


LANES: int = _lanes()

I1, I32, I64 = ir.IntType(1), ir.IntType(32), ir.IntType(64)


def vector_of(scalar: ir.Type) -> ir.VectorType:
    """LLVM's type of `LANES` scalars."""
    return ir.VectorType(scalar, LANES)


class Lanes(types.Type):
    """A register of `LANES` numbers."""

    def __init__(self, name: str, scalar: ir.Type) -> None:
        self.register = vector_of(scalar)
        super().__init__(name=f"{name}{LANES}")


FLOATS = Lanes("floats", ir.DoubleType())
INTS = Lanes("ints", I64)
MASK = Lanes("mask", I1)


@register_model(Lanes)
class _LanesModel(models.PrimitiveModel):
    def __init__(self, manager: Any, lanes: Lanes) -> None:
        super().__init__(manager, lanes, lanes.register)


def splat(builder: Any, value: Any, register: ir.VectorType) -> Any:
    """A register with one value in all lanes."""
    nothing = ir.Constant(register, ir.Undefined)
    first = builder.insert_element(nothing, value, I32(0))
    return builder.shuffle_vector(first, nothing, ir.Constant(vector_of(I32), [0] * LANES))


@lower_cast(types.Float, FLOATS)
@lower_cast(types.Integer, FLOATS)
def _float_to_lanes(context: Any, builder: Any, given: Any, lanes: Lanes, value: Any) -> Any:
    value = context.cast(builder, value, given, types.float64)
    return splat(builder, value, lanes.register)


@lower_cast(types.Integer, INTS)
def _int_to_lanes(context: Any, builder: Any, given: Any, lanes: Lanes, value: Any) -> Any:
    value = context.cast(builder, value, given, types.int64)
    return splat(builder, value, lanes.register)


def _common(arguments: tuple[Any, ...]) -> Lanes | None:
    """The one type in which an operation on these works; None if there is none."""
    found = {a for a in arguments if isinstance(a, Lanes)}
    if len(found) != 1:
        return None
    (lanes,) = found
    scalars = {FLOATS: types.Number, INTS: types.Integer, MASK: ()}[lanes]
    return lanes if all(isinstance(a, (Lanes, scalars)) for a in arguments) else None  # type: ignore[arg-type]


Emit = Callable[..., Any]


def _define(operation: Any, arity: int, emit: dict[Lanes, Emit], result: Lanes | None = None):
    """Let ``operation`` work on lanes: ``emit[type](builder, *registers)`` writes the code."""

    class Typing(AbstractTemplate):
        def generic(self, arguments: tuple[Any, ...], keywords: Any) -> Any:
            lanes = _common(arguments)
            if lanes not in emit or len(arguments) != arity:
                return None
            return signature(result or lanes, *[lanes] * arity)

    infer_global(operation)(Typing)
    for lanes, write in emit.items():

        def lower(context: Any, builder: Any, sig: Any, values: Any, write: Emit = write) -> Any:
            return write(builder, *values)

        lower_builtin(operation, *[lanes] * arity)(lower)


def _of_builder(name: str, **options: Any) -> Emit:
    return lambda builder, *values: getattr(builder, name)(*values, **options)


def _comparing(sign: str) -> dict[Lanes, Emit]:
    return {
        FLOATS: lambda builder, a, b: builder.fcmp_ordered(sign, a, b),
        INTS: lambda builder, a, b: builder.icmp_signed(sign, a, b),
    }


def _extreme(sign: str) -> dict[Lanes, Emit]:
    tests = _comparing(sign)
    return {
        lanes: lambda builder, a, b, test=test: builder.select(test(builder, a, b), a, b)
        for lanes, test in tests.items()
    }


_CONTRACT = {"flags": ("contract",)}  # a*b + c in one rounding, as in scalar code
for _operation, _float, _int in [
    (operator.add, "fadd", "add"),
    (operator.sub, "fsub", "sub"),
    (operator.mul, "fmul", "mul"),
]:
    _define(_operation, 2, {FLOATS: _of_builder(_float, **_CONTRACT), INTS: _of_builder(_int)})
_define(operator.truediv, 2, {FLOATS: _of_builder("fdiv", **_CONTRACT)})
_define(operator.neg, 1, {FLOATS: _of_builder("fneg"), INTS: _of_builder("neg")})
for _operation, _sign in [
    (operator.lt, "<"),
    (operator.le, "<="),
    (operator.gt, ">"),
    (operator.ge, ">="),
    (operator.eq, "=="),
]:
    _define(_operation, 2, _comparing(_sign), result=MASK)
_define(min, 2, _extreme("<"))
_define(max, 2, _extreme(">"))
_define(operator.and_, 2, {INTS: _of_builder("and_"), MASK: _of_builder("and_")})
_define(operator.or_, 2, {INTS: _of_builder("or_"), MASK: _of_builder("or_")})
_define(operator.invert, 1, {MASK: _of_builder("not_")})
_define(operator.lshift, 2, {INTS: _of_builder("shl")})
_define(operator.rshift, 2, {INTS: _of_builder("ashr")})


def call_llvm(builder: Any, name: str, result: ir.Type, values: list[Any]) -> Any:
    """Call one of LLVM's own functions."""
    kind = ir.FunctionType(result, [value.type for value in values])
    return builder.call(cgutils.get_or_insert_function(builder.module, kind, name), values)


def _of_llvm(name: str) -> dict[Lanes, Emit]:
    name = f"llvm.{name}.v{LANES}f64"
    return {FLOATS: lambda builder, value: call_llvm(builder, name, FLOATS.register, [value])}


_define(math.floor, 1, _of_llvm("floor"))
_define(math.sqrt, 1, _of_llvm("sqrt"))


def pick(condition: Any, a: Any, b: Any) -> Any:
    """``a`` where the condition holds, else ``b``; both are computed. For scalars too."""
    return a if condition else b


@infer_global(pick)
class _PickTyping(AbstractTemplate):
    def generic(self, arguments: tuple[Any, ...], keywords: Any) -> Any:
        condition, *values = arguments
        if condition is types.boolean and set(values) == {types.float64}:
            return signature(types.float64, *arguments)
        lanes = _common(tuple(values))
        if lanes is None and all(isinstance(v, types.Float) for v in values):
            lanes = FLOATS
        return (
            None if condition is not MASK or lanes is None else signature(lanes, MASK, lanes, lanes)
        )


@lower_builtin(pick, MASK, types.Any, types.Any)
@lower_builtin(pick, types.boolean, types.float64, types.float64)
def _pick(context: Any, builder: Any, sig: Any, values: Any) -> Any:
    return builder.select(*values)


def any_of(condition: Any) -> Any:
    """Whether the condition holds in some lane; a scalar condition is itself."""
    return condition


@infer_global(any_of)
class _AnyTyping(AbstractTemplate):
    def generic(self, arguments: tuple[Any, ...], keywords: Any) -> Any:
        known = arguments in ((MASK,), (types.boolean,))
        return signature(types.boolean, *arguments) if known else None


@lower_builtin(any_of, types.boolean)
def _any_scalar(context: Any, builder: Any, sig: Any, values: Any) -> Any:
    return values[0]


@lower_builtin(any_of, MASK)
def _any_lane(context: Any, builder: Any, sig: Any, values: Any) -> Any:
    bits = ir.IntType(LANES)
    return builder.icmp_unsigned("!=", builder.bitcast(values[0], bits), bits(0))


LOG2_E, LN2_HIGH, LN2_LOW = 1.4426950408889634, 0.6931471803691238, 1.9082149292705877e-10


@overload(math.exp, jit_options={"forceinline": True})
def _exp(x):
    """exp(x), x <= 0, within 2 units of the last place; 0 below -708.

    x = k ln 2 + r with |r| <= ln 2 / 2; exp(r) by its series to r^13, then times 2^k.
    """
    if x is not FLOATS:
        return None

    def implementation(x):
        x = max(x, -708.5)
        k = math.floor(x * LOG2_E + 0.5)
        r = (x - k * LN2_HIGH) - k * LN2_LOW
        p = 1.0 / 6227020800.0
        p = p * r + 1.0 / 479001600.0
        p = p * r + 1.0 / 39916800.0
        p = p * r + 1.0 / 3628800.0
        p = p * r + 1.0 / 362880.0
        p = p * r + 1.0 / 40320.0
        p = p * r + 1.0 / 5040.0
        p = p * r + 1.0 / 720.0
        p = p * r + 1.0 / 120.0
        p = p * r + 1.0 / 24.0
        p = p * r + 1.0 / 6.0
        p = p * r + 0.5
        p = p * r + 1.0
        p = p * r + 1.0
        return pick(x < -708.0, 0.0, p * power_of_two(to_ints(k)))

    return implementation


@intrinsic
def power_of_two(typing_context, exponent):
    """2^k for ints k of -1022 to 1023."""

    def write(context, builder, sig, values):
        bias = splat(builder, I64(1023), INTS.register)
        shift = splat(builder, I64(52), INTS.register)
        return builder.bitcast(builder.shl(builder.add(values[0], bias), shift), FLOATS.register)

    return signature(FLOATS, INTS), write


@intrinsic
def floats(typing_context, x):
    """x in all lanes."""

    def write(context, builder, sig, values):
        return splat(builder, values[0], FLOATS.register)

    return signature(FLOATS, types.float64), write


@intrinsic
def ints(typing_context, x):
    """x in all lanes."""

    def write(context, builder, sig, values):
        return splat(builder, values[0], INTS.register)

    return signature(INTS, types.int64), write


@intrinsic
def numbers(typing_context):
    """0, 1, 2 ...: each lane's own number."""

    def write(context, builder, sig, values):
        return ir.Constant(INTS.register, list(range(LANES)))

    return signature(INTS), write


@intrinsic
def to_ints(typing_context, x):
    """Floats of less than 2^31 to ints, towards zero (by way of 32 bits: that is one instruction
    on every machine)."""

    def write(context, builder, sig, values):
        return builder.sext(builder.fptosi(values[0], vector_of(I32)), INTS.register)

    return signature(INTS, FLOATS), write


@intrinsic
def to_floats(typing_context, x):
    """Ints of less than 2^31 to floats."""

    def write(context, builder, sig, values):
        return builder.sitofp(builder.trunc(values[0], vector_of(I32)), FLOATS.register)

    return signature(FLOATS, INTS), write


@intrinsic
def count(typing_context, mask):
    """In how many lanes the mask holds."""

    def write(context, builder, sig, values):
        return builder.zext(builder.ctpop(builder.bitcast(values[0], ir.IntType(LANES))), I64)

    return signature(types.int64, MASK), write
