"""Eight numbers at once in compiled code: a vector of the processor as a type of numba.

Numba relies on LLVM to find such vectors in loops. LLVM does not find them in loops that are short, that branch,
or that read at places named by a list. Lanes have single or double precision; +, -, * and / work on lanes and
numbers, and round as for single numbers. Lanes exist in compiled code only: Python never sees one.
"""

from __future__ import annotations

import operator
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from llvmlite import ir
from numba import errors, types
from numba.extending import intrinsic, models, overload, register_model

from coupole.kernels.kept_code import digest_of

LANES = 8
_HALF, _INT = ir.HalfType(), ir.IntType(32)
_NUMBERS = {types.float32: ir.FloatType(), types.float64: ir.DoubleType()}


class _Lanes(types.Type):
    """The name of the type contains a digest of this module. numba chooses kept code by the types of arguments,
    even for a kernel whose module does not import this one.
    """

    def __init__(self, number: Any) -> None:
        super().__init__(f"Lanes({number}, {digest_of(Path(__file__).resolve())[:8]})")
        self.number = number


_KINDS = {number: _Lanes(number) for number in _NUMBERS}


def _vector(number: Any) -> Any:
    return ir.VectorType(_NUMBERS[number], LANES)


@register_model(_Lanes)
class _LanesModel(models.PrimitiveModel):
    def __init__(self, manager: Any, kind: Any) -> None:
        super().__init__(manager, kind, _vector(kind.number))  # type: ignore[no-untyped-call]


def _kind(*argument_types: Any) -> Any:
    """Return the type of the result for these types: the type of the lanes among them."""
    kinds = {kind for kind in argument_types if isinstance(kind, _Lanes)}
    if len(kinds) != 1:
        raise errors.TypingError(f"expected lanes of one precision, got {', '.join(map(str, argument_types))}")
    return kinds.pop()


def _compiled_function(kind_of: Any) -> Any:
    """Return a function of compiled code alone; it receives the types of its arguments."""
    return intrinsic(kind_of)


def _broadcast(context: Any, builder: Any, number: Any, kind: Any, value: Any) -> Any:
    """Return a number in all lanes; lanes are returned unchanged."""
    if isinstance(kind, _Lanes):
        return value
    no_vector = ir.Constant(_vector(number), ir.Undefined)
    first = builder.insert_element(no_vector, context.cast(builder, value, kind, number), _INT(0))
    return builder.shuffle_vector(first, no_vector, ir.Constant(ir.VectorType(_INT, LANES), [0] * LANES))


def _made_of(build: Any) -> Any:
    """Return a function of lanes and numbers; `build` makes its code for their vectors."""

    def generate(context, builder, signature, values):  # type: ignore[no-untyped-def]
        number, typed_values = signature.return_type.number, zip(signature.args, values, strict=True)
        return build(builder, *(_broadcast(context, builder, number, kind, value) for kind, value in typed_values))

    return generate


def _operate(name: str) -> Any:
    def kind_of(_context, first, second):  # type: ignore[no-untyped-def]
        return _kind(first, second)(first, second), _made_of(lambda builder, a, b: getattr(builder, name)(a, b))

    return _compiled_function(kind_of)


def _give_operator(function: Any, lane_operator: Any) -> None:
    @overload(function)
    def choose(first, second):  # type: ignore[no-untyped-def]
        if isinstance(first, _Lanes) or isinstance(second, _Lanes):
            return lambda first, second: lane_operator(first, second)  # noqa: PLW0108  numba wants a function of Python
        return None


for _function, _in_place, _name in (
    (operator.add, operator.iadd, "fadd"),
    (operator.sub, operator.isub, "fsub"),
    (operator.mul, operator.imul, "fmul"),
    (operator.truediv, operator.itruediv, "fdiv"),
):
    _lane_operator = _operate(_name)
    _give_operator(_function, _lane_operator)
    _give_operator(_in_place, _lane_operator)


@_compiled_function
def lanes(_context, number):  # type: ignore[no-untyped-def]
    """Return lanes that all have the value `number`, in its precision."""
    kind = _KINDS[types.float32 if number == types.float32 else types.float64]
    return kind(number), _made_of(lambda builder, value: value)


@_compiled_function
def larger(_context, left, right):  # type: ignore[no-untyped-def]
    """Return the larger number, lane by lane; `right` where one is NaN."""

    def build(builder, a, b):  # type: ignore[no-untyped-def]
        return builder.select(builder.fcmp_ordered(">", a, b), a, b)

    return _kind(left, right)(left, right), _made_of(build)


@_compiled_function
def if_less(_context, left, right, then, otherwise):  # type: ignore[no-untyped-def]
    """Return `then` where `left` is less than `right`; elsewhere, and where one is NaN, `otherwise`."""

    def build(builder, a, b, c, d):  # type: ignore[no-untyped-def]
        return builder.select(builder.fcmp_ordered("<", a, b), c, d)

    kind = _kind(left, right, then, otherwise)
    return kind(left, right, then, otherwise), _made_of(build)


def _math(name: str) -> Any:
    def kind_of(_context, number):  # type: ignore[no-untyped-def]
        def build(builder, value):  # type: ignore[no-untyped-def]
            kind = ir.FunctionType(value.type, [value.type])
            whole = f"llvm.{name}.v{LANES}f{number.number.bitwidth}"
            declaration = builder.module.globals.get(whole)
            return builder.call(declaration or ir.Function(builder.module, kind, whole), [value])

        return number(number), _made_of(build)

    return _compiled_function(kind_of)


root, absolute = _math("sqrt"), _math("fabs")


def _address(context: Any, builder: Any, kind: Any, array: Any, *places: Any) -> Any:
    """Return the address of an element of an array with any strides."""
    array_struct = context.make_array(kind)(context, builder, array)
    address = builder.ptrtoint(array_struct.data, ir.IntType(64))
    for number, place in enumerate(places):
        stride = builder.extract_value(array_struct.strides, number)
        address = builder.add(address, builder.mul(stride, place))
    return address


@_compiled_function
def load_row(_context, array, row):  # type: ignore[no-untyped-def]
    """Return the first eight numbers of a row of an array [n, 8 or more] in C order; integers become single
    precision."""
    if array.layout != "C":
        raise errors.TypingError(f"expected an array in C order, got the order {array.layout}")
    vector_kind = _KINDS.get(array.dtype, _KINDS[types.float32])

    def generate(context, builder, signature, values):  # type: ignore[no-untyped-def]
        kind = signature.args[0].dtype
        vector_type = ir.VectorType(context.get_value_type(kind), LANES)
        address = _address(context, builder, signature.args[0], *values)
        vector = builder.load(builder.inttoptr(address, vector_type.as_pointer()))
        vector.align = kind.bitwidth // 8
        return builder.uitofp(vector, _vector(types.float32)) if isinstance(kind, types.Integer) else vector

    return vector_kind(array, types.intp), generate


@_compiled_function
def store(_context, numbers, array, row):  # type: ignore[no-untyped-def]
    """Store lanes as the first eight numbers of a row of an array [n, 8 or more]. The array is in C order and has
    the lanes' precision."""
    if array.layout != "C" or array.dtype != numbers.number:
        raise errors.TypingError(f"expected an array of {numbers.number} in C order, got {array}")

    def generate(context, builder, signature, values):  # type: ignore[no-untyped-def]
        address = _address(context, builder, signature.args[1], *values[1:])
        instruction = builder.store(values[0], builder.inttoptr(address, values[0].type.as_pointer()))
        instruction.align = numbers.number.bitwidth // 8
        return context.get_dummy_value()

    return types.void(numbers, array, types.intp), generate


@_compiled_function
def total(_context, numbers):  # type: ignore[no-untyped-def]
    """Return the sum of the lanes, computed by halves."""

    def generate(_context, builder, _signature, values):  # type: ignore[no-untyped-def]
        vector, count = values[0], LANES
        while count > 1:
            count //= 2
            low, high = (
                ir.Constant(ir.VectorType(_INT, count), [at + n for n in range(count)]) for at in (0, count)
            )
            no_vector = ir.Constant(vector.type, ir.Undefined)
            halves = (builder.shuffle_vector(vector, no_vector, half) for half in (low, high))
            vector = builder.fadd(*halves)
        return builder.extract_element(vector, _INT(0))

    return numbers.number(numbers), generate


@_compiled_function
def gather_lanes(_context, arrays, rows, place):  # type: ignore[no-untyped-def]
    """Return, in single precision, the numbers at one place of eight `rows` [8] of `arrays` [m, n]. The arrays
    have unsigned integers or floats."""

    def generate(context, builder, signature, values):  # type: ignore[no-untyped-def]
        frames, row_number, place = values
        of_arrays, of_rows = signature.args[:2]
        element_type = context.get_value_type(of_arrays.dtype)
        vector = ir.Constant(ir.VectorType(element_type, LANES), ir.Undefined)
        for lane in range(LANES):
            where = _address(context, builder, of_rows, row_number, ir.IntType(64)(lane))
            row = builder.load(builder.inttoptr(where, ir.IntType(64).as_pointer()))
            address = _address(context, builder, of_arrays, frames, row, place)
            number = builder.load(builder.inttoptr(address, element_type.as_pointer()))
            vector = builder.insert_element(vector, number, _INT(lane))
        if isinstance(of_arrays.dtype, types.Integer):
            return builder.uitofp(vector, _vector(types.float32))
        single = of_arrays.dtype == types.float32
        return vector if single else builder.fptrunc(vector, _vector(types.float32))

    return _KINDS[types.float32](arrays, rows, types.intp), generate


def _shuffle(builder: Any, first_vector: Any, second_vector: Any, places: list[int]) -> Any:
    """Return a vector of chosen numbers of two vectors; the numbers of the second vector are counted after those
    of the first."""
    return builder.shuffle_vector(
        first_vector, second_vector, ir.Constant(ir.VectorType(_INT, len(places)), places)
    )


def _vectors_at(builder: Any, address: Any, kind: Any, count: int) -> Iterator[Any]:
    """Yield pointers to `count` consecutive vectors of one kind, aligned like their elements."""
    size = kind.count * 4
    for number in range(count):
        yield builder.inttoptr(builder.add(address, ir.IntType(64)(number * size)), kind.as_pointer())


@_compiled_function
def four_gathered(_context, arrays, rows, first):  # type: ignore[no-untyped-def]
    """Return four lanes: the numbers at the places `first` to `first` + 3 in eight `rows` [8] of `arrays` [m, n]
    in C order and single precision. The four numbers of a row are read together and transposed in two steps, which
    is faster than number by number."""
    _refuse_but_singles(arrays)
    four = ir.VectorType(ir.FloatType(), 4)

    def generate(context, builder, signature, values):  # type: ignore[no-untyped-def]
        of_arrays, of_rows = signature.args[:2]
        fours = []
        for lane in range(LANES):
            where = _address(context, builder, of_rows, values[1], ir.IntType(64)(lane))
            row = builder.load(builder.inttoptr(where, ir.IntType(64).as_pointer()))
            address = _address(context, builder, of_arrays, values[0], row, values[2])
            fours.append(builder.load(next(_vectors_at(builder, address, four, 1)), align=4))
        rows = [_shuffle(builder, fours[n], fours[n + 4], list(range(8))) for n in range(4)]
        low, high = [0, 8, 1, 9, 4, 12, 5, 13], [2, 10, 3, 11, 6, 14, 7, 15]
        pairs = [_shuffle(builder, rows[n], rows[n + 2], half) for half in (low, high) for n in (0, 1)]
        vectors = [_shuffle(builder, pairs[n], pairs[n + 1], half) for n in (0, 2) for half in (low, high)]
        return context.make_tuple(builder, signature.return_type, vectors)

    return _several(4)(arrays, rows, types.intp), generate


@_compiled_function
def in_turns(_context, array, row):  # type: ignore[no-untyped-def]
    """Return three lanes from a row of 24 numbers in which the lanes' numbers alternate. The array [n, 24] is in C
    order and single precision."""
    _refuse_but_singles(array)

    def generate(context, builder, signature, values):  # type: ignore[no-untyped-def]
        address = _address(context, builder, signature.args[0], *values)
        places = _vectors_at(builder, address, _vector(types.float32), 3)
        first, second, third = (builder.load(place, align=4) for place in places)
        vectors = []
        for lane in range(3):
            sources = [3 * n + lane for n in range(LANES)]
            early = _shuffle(builder, first, second, [min(n, 15) for n in sources])
            late = [k if n < 16 else n - 8 for k, n in enumerate(sources)]
            vectors.append(_shuffle(builder, early, third, late))
        return context.make_tuple(builder, signature.return_type, vectors)

    return _several(3)(array, types.intp), generate


@_compiled_function
def add_in_turns(_context, first, two, three, array, row):  # type: ignore[no-untyped-def]
    """Add three lanes to a row of 24 in which their numbers alternate, in an array as for `in_turns`."""
    _refuse_but_singles(array)

    def generate(context, builder, signature, values):  # type: ignore[no-untyped-def]
        address = _address(context, builder, signature.args[3], *values[3:])
        for number, place in enumerate(_vectors_at(builder, address, _vector(types.float32), 3)):
            sources = [divmod(8 * number + n, 3) for n in range(LANES)]
            early = _shuffle(builder, values[0], values[1], [lane + 8 * (of % 2) for lane, of in sources])
            late = [8 + lane if of == 2 else n for n, (lane, of) in enumerate(sources)]
            total_vector = builder.fadd(builder.load(place, align=4), _shuffle(builder, early, values[2], late))
            builder.store(total_vector, place, align=4)
        return context.get_dummy_value()

    return types.void(first, two, three, array, types.intp), generate


def _several(count: int) -> Any:
    return types.UniTuple(_KINDS[types.float32], count)  # type: ignore[no-untyped-call]


def _refuse_but_singles(array: Any) -> None:
    if array.layout != "C" or array.dtype != types.float32:
        raise errors.TypingError(f"expected an array of float32 in C order, got {array}")


@_compiled_function
def store_halves(_context, numbers, bits):  # type: ignore[no-untyped-def]
    """Store eight numbers in `bits` [8] of uint16 as float16, each rounded to the nearest."""

    def generate(context, builder, signature, values):  # type: ignore[no-untyped-def]
        halves = builder.fptrunc(values[0], ir.VectorType(_HALF, LANES))
        address = _address(context, builder, signature.args[1], values[1])
        store = builder.store(halves, builder.inttoptr(address, halves.type.as_pointer()))
        store.align = 2
        return context.get_dummy_value()

    return types.void(numbers, bits), generate
