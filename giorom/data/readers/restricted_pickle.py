"""Read arrays out of pickles without running anything a pickle asks for.

A pickle is a program for a small stack machine. This module runs the part of that machine that data
files need and nothing else: containers, numbers, short text, and the handful of
constructors by which NumPy arrays and PyTorch tensors are stored. A global is never looked up:
its name becomes a token, and only known tokens applied to arguments of the expected form have
a meaning. Whatever else a file asks for is refused with the name of what it wanted.

Array bytes are not loaded; a ``LazyArray`` notes where they lie. Stack, memo, containers and
the number of steps have limits, so that neither time nor memory is the file's choice.

Accepted globals: ``numpy.ndarray``, ``numpy.dtype``, ``numpy.core.multiarray._reconstruct``,
``_codecs.encode``, ``collections.OrderedDict``, ``torch._utils._rebuild_tensor_v2`` and the names
of PyTorch's storages; of NumPy also ``scalar`` (a number) and ``_frombuffer`` (an array in
pickle protocol 5); ``numpy._core`` stands for ``numpy.core``, and ``__builtin__.bytes`` without
arguments for the bytes of an empty array in protocol 2.
"""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

from giorom.data.metadata import DataError
from giorom.data.readers.byte_source import ByteSource
from giorom.data.readers.lazy_array import TensorStorage
from giorom.data.readers.pickle_constructors import (
    CONSTRUCTORS,
    Global,
    Refused,
    build,
    storage_of,
)
from giorom.data.readers.pickle_opcodes import BINGET, LONG_BINGET, STOP, steps

__all__ = ["Loaded", "first_texts", "load_pickle"]

MOST_OBJECTS = 8_000_000
MOST_STACK = 1_000_000
"""Limits of the machine; the largest published file needs a fifth of them."""


class _Mark:
    """What MARK leaves on the stack."""


_MARK = _Mark()


@dataclass(frozen=True, slots=True)
class Loaded:
    """What a pickle holds."""

    value: Any
    end: int
    """First byte after it."""

    storages: tuple[TensorStorage, ...]
    """The tensor storages it refers to, whose places are not known yet."""


def load_pickle(source: ByteSource, *, start: int = 0, has_storages: bool = False) -> Loaded:
    """Interpret a pickle.

    Args:
        source: Where it lies.
        start: Its first byte.
        has_storages: Whether references to tensor storages have a meaning here.

    Returns:
        Its value: dicts with text keys, lists, tuples, numbers, text, ``LazyArray``.

    Raises:
        DataError: If it asks for anything that is not in the list above, is damaged, or exceeds the
            limits. Nothing has been run.
    """
    wanted = _wanted_memo(source, start)
    machine = _Machine(source, wanted, has_storages=has_storages)
    for position, code, argument, end in steps(source, start):
        try:
            if code == STOP:
                return Loaded(machine.result(), end, tuple(machine.storages))
            machine.run(code, argument)
        except Refused as error:
            raise DataError(
                f"{source.name}: the pickle at byte {position} is refused: {error}. "
                f"Nothing was run."
            ) from None
    raise DataError(f"{source.name}: the pickle has no end. It is cut off.")


def first_texts(source: ByteSource, *, start: int = 0, most: int = 200) -> list[str]:
    """Short texts among the first opcodes of a pickle, to tell what it is.

    Args:
        source: Where it lies.
        start: Its first byte.
        most: How many opcodes to look at.

    Returns:
        The texts; empty if it is no pickle.
    """
    texts: list[str] = []
    try:
        for count, (_, code, argument, _) in enumerate(steps(source, start)):
            if count == 0 and code != 0x80:
                return []
            if isinstance(argument, str):
                texts.append(argument)
            if count >= most:
                break
    except DataError:
        pass
    return texts


def _wanted_memo(source: ByteSource, start: int) -> set[int]:
    """The memo entries that are used again; the others need not be kept."""
    wanted: set[int] = set()
    for _, code, argument, _ in steps(source, start):
        if code in (BINGET, LONG_BINGET):
            wanted.add(argument)
            if len(wanted) > MOST_STACK:
                raise DataError(f"{source.name}: the pickle shares too many objects to be data.")
    return wanted


class _Machine:
    """The stack machine."""

    def __init__(self, source: ByteSource, wanted: set[int], *, has_storages: bool) -> None:
        self.source, self.wanted, self.has_storages = source, wanted, has_storages
        self.stack: list[Any] = []
        self.marks: list[int] = []
        self.memo: dict[int, Any] = {}
        self.storages: list[TensorStorage] = []
        self.memoized = self.objects = 0

    def run(self, code: int, argument: Any) -> None:
        """Do one step."""
        _ACTIONS[code](self, argument)
        if len(self.stack) > MOST_STACK or self.objects > MOST_OBJECTS:
            raise Refused(f"it holds more than {MOST_OBJECTS} objects or nests too deeply")

    def result(self) -> Any:
        """The value that is left."""
        if len(self.stack) != 1 or self.marks:
            raise Refused("it does not end with one value")
        return self.stack[0]

    def push(self, value: Any) -> None:
        """Put a new value on the stack."""
        self.objects += 1
        self.stack.append(value)

    def pop(self) -> Any:
        """Take the topmost value."""
        if not self.stack or self.stack[-1] is _MARK:
            raise Refused("it takes a value from an empty stack")
        return self.stack.pop()

    def pop_to_mark(self) -> list[Any]:
        """Take everything above the last mark."""
        if not self.marks:
            raise Refused("it lacks a mark")
        place = self.marks.pop()
        values = self.stack[place + 1 :]
        del self.stack[place:]
        return values

    def top(self, kind: type) -> Any:
        """The topmost value, which must be of a kind."""
        if not self.stack or type(self.stack[-1]) is not kind:
            raise Refused(f"it needs a {kind.__name__} where there is none")
        return self.stack[-1]


def _mark(machine: _Machine, _: Any) -> None:
    machine.marks.append(len(machine.stack))
    machine.push(_MARK)


def _pop_mark(machine: _Machine, _: Any) -> None:
    machine.pop_to_mark()


def _nothing(machine: _Machine, _: Any) -> None:
    """PROTO and FRAME carry no value."""


def _push(machine: _Machine, argument: Any) -> None:
    machine.push(argument)


def _constant(value: Any) -> Callable[[_Machine, Any], None]:
    return lambda machine, _: machine.push(value)


def _empty_list(machine: _Machine, _: Any) -> None:
    machine.push([])


def _empty_dict(machine: _Machine, _: Any) -> None:
    machine.push({})


def _tuple_of(count: int) -> Callable[[_Machine, Any], None]:
    def act(machine: _Machine, _: Any) -> None:
        values = [machine.pop() for _ in range(count)]
        machine.push(tuple(reversed(values)))

    return act


def _tuple_to_mark(machine: _Machine, _: Any) -> None:
    machine.push(tuple(machine.pop_to_mark()))


def _list_to_mark(machine: _Machine, _: Any) -> None:
    machine.push(machine.pop_to_mark())


def _append(machine: _Machine, _: Any) -> None:
    value = machine.pop()
    machine.top(list).append(value)


def _appends(machine: _Machine, _: Any) -> None:
    values = machine.pop_to_mark()
    machine.top(list).extend(values)


def _set_item(machine: _Machine, _: Any) -> None:
    value, key = machine.pop(), machine.pop()
    _set_pairs(machine.top(dict), [key, value])


def _set_items(machine: _Machine, _: Any) -> None:
    pairs = machine.pop_to_mark()
    _set_pairs(machine.top(dict), pairs)


def _set_pairs(target: dict[str, Any], pairs: list[Any]) -> None:
    """Enter keys and values; keys are text, so that none can be made to collide."""
    if len(pairs) % 2:
        raise Refused("it enters a key without a value")
    for key, value in zip(pairs[::2], pairs[1::2], strict=True):
        if type(key) is not str:
            raise Refused(f"it uses a {type(key).__name__} as a key; keys are short texts here")
        target[key] = value


def _dict_to_mark(machine: _Machine, _: Any) -> None:
    target: dict[str, Any] = {}
    _set_pairs(target, machine.pop_to_mark())
    machine.push(target)


def _put(machine: _Machine, index: int) -> None:
    if machine.memoized:
        raise Refused("it mixes two ways of numbering its objects")
    _remember(machine, index)


def _memoize(machine: _Machine, _: Any) -> None:
    _remember(machine, machine.memoized)
    machine.memoized += 1


def _remember(machine: _Machine, index: int) -> None:
    if not machine.stack or machine.stack[-1] is _MARK:
        raise Refused("it names an object that is not there")
    if index in machine.wanted:
        machine.memo[index] = machine.stack[-1]


def _get(machine: _Machine, index: int) -> None:
    if index not in machine.memo:
        raise Refused("it refers to an object that is not there")
    machine.push(machine.memo[index])


def _global(machine: _Machine, names: tuple[str, str]) -> None:
    machine.push(Global.known(*names))


def _stack_global(machine: _Machine, _: Any) -> None:
    name, module = machine.pop(), machine.pop()
    if type(name) is not str or type(module) is not str:
        raise Refused("it names a global by something that is no text")
    machine.push(Global.known(module, name))


def _reduce(machine: _Machine, _: Any) -> None:
    arguments, function = machine.pop(), machine.pop()
    if type(function) is not Global or type(arguments) is not tuple:
        raise Refused("it calls something that is no known constructor")
    constructor = CONSTRUCTORS.get(function.name)
    if constructor is None:
        raise Refused(f"it calls {function.name}, which is not called in any data file")
    machine.push(constructor(arguments))


def _build(machine: _Machine, _: Any) -> None:
    state, target = machine.pop(), machine.pop()
    build(target, state)
    machine.push(target)


def _persistent_id(machine: _Machine, _: Any) -> None:
    if not machine.has_storages:
        raise Refused("it refers to something outside the file (a persistent id)")
    storage = storage_of(machine.pop())
    machine.storages.append(storage)
    machine.push(storage)


_ACTIONS: dict[int, Callable[[_Machine, Any], None]] = {
    0x80: _nothing,
    0x95: _nothing,
    ord("("): _mark,
    ord("0"): lambda machine, _: machine.pop(),
    ord("1"): _pop_mark,
    ord("N"): _constant(None),
    0x88: _constant(True),
    0x89: _constant(False),
    ord("J"): _push,
    ord("K"): _push,
    ord("M"): _push,
    0x8A: _push,
    ord("G"): _push,
    ord("X"): _push,
    0x8C: _push,
    0x8D: _push,
    ord("B"): _push,
    ord("C"): _push,
    0x8E: _push,
    0x96: _push,
    ord("]"): _empty_list,
    ord("a"): _append,
    ord("e"): _appends,
    ord("l"): _list_to_mark,
    ord(")"): _constant(()),
    ord("t"): _tuple_to_mark,
    0x85: _tuple_of(1),
    0x86: _tuple_of(2),
    0x87: _tuple_of(3),
    ord("}"): _empty_dict,
    ord("d"): _dict_to_mark,
    ord("s"): _set_item,
    ord("u"): _set_items,
    BINGET: _get,
    LONG_BINGET: _get,
    ord("q"): _put,
    ord("r"): _put,
    0x94: _memoize,
    ord("c"): _global,
    0x93: _stack_global,
    ord("R"): _reduce,
    ord("b"): _build,
    ord("Q"): _persistent_id,
}
"""What each opcode does."""
