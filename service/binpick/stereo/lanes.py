"""Sixteen numbers at a time: LLVM's vectors as values of compiled functions, whatever instructions the machine has for them.

Loops over disparities written with them do what they say; left to itself the compiler finds vectors in some loops and
misses them in others that differ by a sign.
"""

from collections.abc import Callable
from typing import Any

from llvmlite import ir
from numba.core import cgutils, types
from numba.extending import intrinsic, models, register_model
from numba.np.arrayobj import make_array

LANES = 16


class Lanes(types.Type):
    """Sixteen integers of so many bits: bytes are unsigned, words signed."""

    def __init__(self, bits: int) -> None:
        self.bits = bits
        super().__init__(name=f"Lanes{bits}")


@register_model(Lanes)
class LanesModel(models.PrimitiveModel):  # type: ignore[misc]
    """How LLVM holds them."""

    def __init__(self, manager: Any, lanes: Lanes) -> None:
        super().__init__(manager, lanes, _vector(lanes))


BYTES, WORDS = Lanes(8), Lanes(16)
OF = {types.uint8: BYTES, types.int16: WORDS}


def _vector(lanes: Lanes) -> Any:
    return ir.VectorType(ir.IntType(lanes.bits), LANES)


def _constant(bits: int, numbers: list[int]) -> Any:
    return ir.Constant(ir.VectorType(ir.IntType(bits), LANES), [ir.IntType(bits)(number) for number in numbers])


def _place(context: Any, builder: Any, array: Any, value: Any, index: Any) -> Any:
    begin = make_array(array)(context, builder, value).data
    return builder.bitcast(builder.gep(begin, [index]), _vector(OF[array.dtype]).as_pointer())


def _verb(code: Callable[..., Any]) -> Any:
    """A function of compiled code, of which Python's types know nothing."""
    return intrinsic(code)


@_verb
def load(_typing: Any, array: Any, index: Any) -> Any:
    """load(array, index): sixteen of a flat array, from this index on. Nothing checks the end."""
    lanes = OF[array.dtype]

    def code(context: Any, builder: Any, _signature: Any, args: Any) -> Any:
        return builder.load(_place(context, builder, array, *args), align=lanes.bits // 8)

    return lanes(array, index), code


@_verb
def store(_typing: Any, array: Any, index: Any, value: Any) -> Any:
    """store(array, index, lanes)."""
    lanes = OF[array.dtype]

    def code(context: Any, builder: Any, _signature: Any, args: Any) -> Any:
        builder.store(args[2], _place(context, builder, array, *args[:2]), align=lanes.bits // 8)
        return context.get_dummy_value()

    return types.void(array, index, value), code


@_verb
def all_of(_typing: Any, number: Any) -> Any:
    """all_of(number): sixteen times the same."""
    lanes = OF[number]

    def code(_context: Any, builder: Any, _signature: Any, args: Any) -> Any:
        nothing = ir.Constant(_vector(lanes), ir.Undefined)
        first = builder.insert_element(nothing, args[0], ir.IntType(32)(0))
        return builder.shuffle_vector(first, nothing, _constant(32, [0] * LANES))

    return lanes(number), code


@_verb
def counted(_typing: Any) -> Any:
    """counted(): 0 to 15, words."""
    return WORDS(), lambda *_: _constant(16, list(range(LANES)))


@_verb
def widened(_typing: Any, lanes: Any) -> Any:
    """widened(bytes): the same as words."""
    return WORDS(lanes), lambda _context, builder, _signature, args: builder.zext(args[0], _vector(WORDS))


@_verb
def quarter(_typing: Any, lanes: Any) -> Any:
    """quarter(bytes): a fourth of each, downwards."""
    return lanes(lanes), lambda _context, builder, _signature, args: builder.lshr(args[0], _constant(lanes.bits, [2] * LANES))


@_verb
def lowest(_typing: Any, lanes: Any) -> Any:
    """lowest(words): the least of the sixteen, a number."""

    def code(_context: Any, builder: Any, _signature: Any, args: Any) -> Any:
        kind = ir.FunctionType(ir.IntType(16), [_vector(WORDS)])
        return builder.call(cgutils.get_or_insert_function(
            builder.module, kind, f"llvm.vector.reduce.smin.v{LANES}i16"), args)

    return types.int16(lanes), code


def _of_two(named: str, text: str, operate: Callable[[Any, Lanes, Any, Any], Any]) -> Any:
    def typed(_typing: Any, a: Any, b: Any) -> Any:
        return a(a, b), lambda _context, builder, _signature, args: operate(builder, a, *args)

    typed.__name__, typed.__doc__ = named, text
    return _verb(typed)


def _call(of_bytes: str, of_words: str) -> Callable[[Any, Lanes, Any, Any], Any]:
    def operate(builder: Any, lanes: Lanes, a: Any, b: Any) -> Any:
        vector, name = _vector(lanes), of_bytes if lanes.bits == 8 else of_words
        kind = ir.FunctionType(vector, [vector, vector])
        return builder.call(cgutils.get_or_insert_function(
            builder.module, kind, f"llvm.{name}.v{LANES}i{lanes.bits}"), [a, b])

    return operate


def _joined(first: int) -> Callable[[Any, Lanes, Any, Any], Any]:
    return lambda builder, _lanes, a, b: builder.shuffle_vector(a, b, _constant(32, list(range(first, first + LANES))))


plus = _of_two("plus", "plus(a, b), ending at what fits.", _call("uadd.sat", "sadd.sat"))
minus = _of_two("minus", "minus(a, b), ending at what fits: bytes at 0.", _call("usub.sat", "ssub.sat"))
least = _of_two("least", "least(a, b) of each pair.", _call("umin", "smin"))
most = _of_two("most", "most(a, b) of each pair.", _call("umax", "smax"))
lower = _of_two("lower", "lower(a, b): what lies one place before each of b; a is what comes before b.", _joined(LANES - 1))
upper = _of_two("upper", "upper(a, b): what lies one place after each of a; b is what comes after a.", _joined(1))


def _choice(named: str, text: str, operator: str, unsigned: bool) -> Any:
    def typed(_typing: Any, a: Any, b: Any, x: Any, y: Any) -> Any:
        def code(_context: Any, builder: Any, _signature: Any, args: Any) -> Any:
            compare = builder.icmp_unsigned if unsigned else builder.icmp_signed
            return builder.select(compare(operator, args[0], args[1]), args[2], args[3])

        return x(a, b, x, y), code

    typed.__name__, typed.__doc__ = named, text
    return _verb(typed)


where_less = _choice("where_less", "where_less(a, b, x, y): x where a < b, else y; words.", "<", unsigned=False)
where_equal = _choice("where_equal", "where_equal(a, b, x, y): x where a == b, else y.", "==", unsigned=True)
where_within = _choice("where_within", "where_within(a, n, x, y): x where 0 <= a < n, else y.", "<", unsigned=True)
