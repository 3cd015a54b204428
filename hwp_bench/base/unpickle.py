"""Read pickles from outside without running what they ask for.

Hand models and the official HWP release come as pickles, and a pickle can name any function and
have it called. Here it can name numpy arrays and builtin containers; what the caller lists as
stand-ins becomes an inert object that only keeps its state; everything else is refused by name.
Not even numpy's own types are given out: array and element type are rebuilt by the functions
below, because a crafted `numpy.dtype` state can make numpy take bytes for pointers.
"""

from __future__ import annotations

import itertools
import os
import pickle
import pickletools
from collections import OrderedDict
from collections.abc import Callable, Collection, Iterator, Sequence
from functools import partial
from pathlib import Path
from typing import Any, cast

import numpy as np

from hwp_bench.base.errors import BadInput, HwpError, UnsafePickle, shown
from hwp_bench.base.files import check_is_file

#: Largest pickle that is read, in bytes; MANO has 4 MB, a released HWP capture some 100 MB.
MAX_PICKLE_BYTES = 1024 * 1024 * 1024

#: Most steps of a pickle: each can make an object of some 200 bytes.
MAX_STEPS = 10_000_000
#: Most numbers and characters that containers and arrays come to when whatever they share is
#: counted as often as it is there, on top of the file's size.
MAX_EXPANDED = 10_000_000
#: Deepest nesting of containers and objects.
MAX_DEPTH = 64

# Most keys of tables and sets that are tuples or frozen sets: equal hashes can be chosen for them
# (-1 and -2 have the same), and a table of n equal hashes takes n^2 steps.
_MOST_ODD_KEYS = 1000
# Deepest nesting while the steps are taken, where objects count twice or more: hashing a key calls
# itself once a level without a bound of its own, until the stack of the process is full.
_DEEPEST_STEPS = 4 * MAX_DEPTH
# The hash of larger integers repeats.
_LARGEST_INTEGER = 2**63
_BYTE_ORDERS = "<>|="
_KINDS = "biufSU"


class StandIn:
    """The name and the state of an object whose class is not admitted."""

    #: The class that the pickle names, "module.name".
    origin: str = ""
    #: Positional arguments of the constructor.
    arguments: tuple[Any, ...] = ()
    #: The state: mostly the object's attributes as a dict.
    state: Any = None

    def __new__(cls, *arguments: Any) -> StandIn:
        """Keep the arguments; no code of the named class exists here."""
        made = super().__new__(cls)
        made.arguments = arguments
        return made

    def __init__(self, *arguments: Any) -> None:
        pass

    def __setstate__(self, state: Any) -> None:
        self.state = state


# What has parts.
_HOLDERS = (dict, list, tuple, set, frozenset, StandIn)


def load_pickle(
    path: str | os.PathLike[str],
    *,
    stand_ins: Collection[str] = (),
    max_bytes: int = MAX_PICKLE_BYTES,
    max_steps: int = MAX_STEPS,
) -> Any:
    """Read one object from a pickle file, whatever the file asks for.

    Python 2 pickles are read too, their strings as Latin-1.

    Args:
        path: the file.
        stand_ins: names that become `StandIn` objects: "module.name" for one class, "package.*"
            for every class of a package.
        max_bytes: larger files are refused.
        max_steps: pickles of more steps are refused.

    Returns:
        Builtin containers, numbers, strings, stand-ins and numpy arrays of plain numbers. The
        arrays are of a subclass; `numpy.asarray` makes them plain.

    Raises:
        UnsafePickle: the file names anything else; the error's field is that name.
        BadInput: the file is missing, too large, truncated or damaged, or would be far larger in
            memory: by what it shares, by keys of equal hashes, or by its depth.
    """
    path = Path(path)
    check_is_file(path)
    size = path.stat().st_size
    if size > max_bytes:
        raise BadInput(f"holds {size} bytes, more than the {max_bytes} that are read", where=path)
    try:
        with path.open("rb") as stream:
            _check_steps(_Exact(stream, size), max_steps, MAX_EXPANDED + size)
            stream.seek(0)
            loaded = _Unpickler(stream, path, stand_ins).load()
            _check_expanded(loaded, MAX_EXPANDED + size)
            return loaded
    except HwpError:
        raise
    # A damaged pickle can raise any exception.
    except Exception as error:
        raise BadInput(f"is not a readable pickle ({_reason(error)})", where=path) from error


def _reason(error: Exception) -> str:
    """Say in one line why a pickle cannot be read, whatever the error says."""
    if isinstance(error, KeyError):
        return f"it refers to object {error}, which is not there"
    text = shown(" ".join(str(error).split()))[:200]
    return text or f"a step of it fails with {type(error).__name__}"


class _Exact:
    """A file that refuses to be read beyond its end, before room is made for what is not there."""

    def __init__(self, stream: Any, size: int) -> None:
        self._stream = stream
        self.size = size
        self.readline = stream.readline
        self.tell = stream.tell

    def read(self, count: int) -> bytes:
        """Read some bytes; none at the end of the file."""
        left = self.size - self._stream.tell()
        if count > max(left, 1):
            raise ValueError(f"it claims {count:,} bytes where {left:,} are left")
        return bytes(self._stream.read(count))


def _check_steps(stream: _Exact, most: int, most_size: int) -> None:
    """Refuse steps that no pickler writes, before any is taken.

    Args:
        stream: the pickle.
        most: largest number of steps.
        most_size: largest size of what is hashed, and of any object that is made.
    """
    shape = _Shape(most_size)
    for count, (opcode, argument, _) in enumerate(pickletools.genops(cast("Any", stream))):
        if count >= most:
            raise ValueError(f"more than {most:,} steps")
        # The reader makes room for the largest memo number.
        if opcode.name in ("PUT", "BINPUT", "LONG_BINPUT") and (argument or 0) > count + 1:
            raise ValueError(f"memo number {argument} after {count} steps")
        if isinstance(argument, int) and abs(argument) > _LARGEST_INTEGER:
            raise ValueError("an absurdly large integer")
        if opcode.name == "FRAME" and (argument or 0) > stream.size:
            raise ValueError(f"it claims {argument:,} bytes of {stream.size:,}")
        shape.take(opcode, argument)


class _Made:
    """An object that a step will make: its depth and its size."""

    __slots__ = ("depth", "hashed", "size")

    def __init__(self, depth: int = 0, size: int = 1, *, hashed: bool = False) -> None:
        self.depth = depth
        self.size = size
        #: Whether it is a tuple or frozen set, whose hash looks at every part.
        self.hashed = hashed


#: What begins a group of parts on the stack.
_MARK = _Made()


class _Shape:
    """Follows the steps of a pickle without taking them: how deep and large all becomes.

    What is shared counts each time. A list or table that grows after it was put into another one
    is followed no further: it has no hash, and `_check_expanded` measures it afterwards.
    """

    def __init__(self, most: int) -> None:
        self._most = most
        self._stack: list[_Made] = []
        self._memo: dict[int, _Made] = {}
        self._hashed = 0
        self._odd_keys = 0

    def take(self, opcode: pickletools.OpcodeInfo, argument: Any) -> None:
        """Follow one step.

        Raises:
            ValueError: it takes what is not there, or makes something too deep or too large.
        """
        name = opcode.name
        if name in _TUPLES:
            self._make(self._some(_TUPLES[name]), hashed=True)
        elif name in ("TUPLE", "FROZENSET"):
            parts = self._group()
            if name == "FROZENSET":
                self._hash(parts)
                self._odd_keys += 1
            self._make(parts, hashed=True)
        elif name in ("LIST", "DICT", "OBJ", "INST"):
            parts = self._group()
            if name == "DICT":
                self._hash(parts[::2])
            self._make(parts)
        elif name in _ADDED:
            many, first, step = _ADDED[name]
            parts = self._group() if many else self._some(step)
            self._hash(parts[first::step] if first is not None else [])
            self._grow(parts)
        elif name in ("REDUCE", "NEWOBJ", "NEWOBJ_EX"):
            parts = self._some(3 if name == "NEWOBJ_EX" else 2)
            # The function may make a set or table of them, and counts the odd keys itself.
            self._hash(parts, odd=False)
            self._make(parts)
        elif name == "BUILD":
            self._grow(self._some(1))
        elif name in ("PUT", "BINPUT", "LONG_BINPUT"):
            self._memo[argument] = self._top()
        elif name == "MEMOIZE":
            self._memo[len(self._memo)] = self._top()
        elif name in ("GET", "BINGET", "LONG_BINGET"):
            if argument not in self._memo:
                raise ValueError(f"it refers to object {argument}, which is not there")
            self._stack.append(self._memo[argument])
        elif name == "MARK":
            self._stack.append(_MARK)
        elif name == "POP_MARK":
            self._group()
        elif name == "DUP":
            self._stack.append(self._top())
        else:
            # Steps that only take something away or make something without parts.
            self._some(len(opcode.stack_before))
            self._stack += [_Made() for _ in opcode.stack_after]

    def _top(self) -> _Made:
        if not self._stack or self._stack[-1] is _MARK:
            raise ValueError("a step takes more than is there")
        return self._stack[-1]

    def _some(self, count: int) -> list[_Made]:
        if len(self._stack) < count:
            raise ValueError("a step takes more than is there")
        found = self._stack[len(self._stack) - count :]
        del self._stack[len(self._stack) - count :]
        return found

    def _group(self) -> list[_Made]:
        """Take the parts since the last mark, and the mark."""
        found: list[_Made] = []
        while self._stack:
            part = self._stack.pop()
            if part is _MARK:
                return found[::-1]
            found.append(part)
        raise ValueError("a step takes more than is there")

    def _make(self, parts: Sequence[_Made], *, hashed: bool = False) -> None:
        made = _Made(1, hashed=hashed)
        self._stack.append(made)
        self._grow(parts)

    def _grow(self, parts: Sequence[_Made]) -> None:
        holder = self._top()
        holder.depth = max([holder.depth, *(1 + part.depth for part in parts)])
        holder.size += sum(part.size for part in parts)
        if holder.depth > _DEEPEST_STEPS:
            raise ValueError("it is nested too deeply")
        if holder.size > self._most:
            raise ValueError(f"it comes to more than {self._most:,} numbers and characters")

    def _hash(self, keys: Sequence[_Made], *, odd: bool = True) -> None:
        for key in keys:
            self._hashed += key.size
            self._odd_keys += odd and key.hashed
        if self._hashed > _HASHED * self._most:
            raise ValueError(f"its keys come to more than {_HASHED * self._most:,} values")
        if self._odd_keys > _MOST_ODD_KEYS:
            raise ValueError(f"more than {_MOST_ODD_KEYS:,} tuples and frozen sets as keys")


#: Steps that make a tuple of the last values of the stack, with how many.
_TUPLES = {"EMPTY_TUPLE": 0, "TUPLE1": 1, "TUPLE2": 2, "TUPLE3": 3}
#: Steps that add to what is there: whether by a group, which of the parts is the first key (None:
#: none is), and of how many parts each addition is.
_ADDED: dict[str, tuple[bool, int | None, int]] = {
    "APPEND": (False, None, 1),
    "APPENDS": (True, None, 1),
    "SETITEM": (False, 0, 2),
    "SETITEMS": (True, 0, 2),
    "ADDITEMS": (True, 0, 1),
}
# Times of the largest size that all keys together may come to.
_HASHED = 4


def _check_expanded(loaded: Any, most: int) -> None:
    """Refuse what numpy would copy into far more memory than the pickle takes.

    Args:
        loaded: the object.
        most: largest sum of numbers and characters; what is shared counts each time.

    Raises:
        ValueError: it is larger, contains itself, or is nested too deeply.
    """
    # Size and depth of each container, from the inside out; None while its parts are looked at,
    # so that a part without one contains the container that it is in.
    known: dict[int, tuple[int, int] | None] = {}
    stack: list[Any] = [loaded] if isinstance(loaded, _HOLDERS) else []
    while stack:
        item = stack[-1]
        if known.get(id(item)) is not None:
            stack.pop()
            continue
        inner = [part for part in _parts_of(item) if isinstance(part, _HOLDERS)]
        if id(item) not in known:
            known[id(item)] = None
            if any(known.get(id(part), ()) is None for part in inner):
                raise ValueError("a container contains itself")
            stack += [part for part in inner if id(part) not in known]
            continue
        facts = [fact for part in inner if (fact := known[id(part)]) is not None]
        leaves = sum(_leaf(part) for part in _parts_of(item) if not isinstance(part, _HOLDERS))
        size = 1 + leaves + sum(fact[0] for fact in facts)
        depth = 1 + max((fact[1] for fact in facts), default=0)
        if size > most:
            raise ValueError(f"it comes to more than {most:,} numbers and characters")
        if depth > MAX_DEPTH:
            raise ValueError("it is nested too deeply")
        known[id(item)] = (size, depth)
        stack.pop()


def _parts_of(item: Any) -> Iterator[Any]:
    """The parts of a container or an inert object."""
    if isinstance(item, StandIn):
        return iter(vars(item).values())
    return itertools.chain(item.keys(), item.values()) if isinstance(item, dict) else iter(item)


def _leaf(item: Any) -> int:
    if isinstance(item, np.ndarray):
        return item.size * max(1, item.itemsize // 8)
    return len(item) if isinstance(item, str | bytes | bytearray) else 1


class _Unpickler(pickle.Unpickler):
    def __init__(self, stream: Any, path: Path, stand_ins: Collection[str]) -> None:
        super().__init__(stream, encoding="latin1")
        self._path = path
        self._stand_ins = frozenset(stand_ins)
        self._classes: dict[str, type[StandIn]] = {}
        self._counted = 0

    def find_class(self, module: str, name: str) -> Any:
        full = f"{module}.{name}"
        if full in _ADMITTED:
            return _ADMITTED[full]
        if full in _HASHING:
            return _Function(partial(self._make_of_keys, _HASHING[full]))
        if self._is_stand_in(module, full):
            if full not in self._classes:
                self._classes[full] = type("StandIn", (StandIn,), {"origin": full})
            return self._classes[full]
        raise UnsafePickle(
            "this pickle asks for something that is not plain data",
            where=self._path,
            field=full,
            remedy="Do not open this file with ordinary tools: it may run code.",
        )

    def _make_of_keys(self, kind: type, *arguments: Any) -> Any:
        """Make a set or table, whose keys `_MOST_ODD_KEYS` bounds."""
        if any(not isinstance(parts, list | tuple | set | frozenset | dict) for parts in arguments):
            raise TypeError(f"a {kind.__name__} of something that is not a list")
        for item in itertools.chain(*arguments):
            key = item[:1] if kind is OrderedDict and isinstance(item, list | tuple) else [item]
            self._counted += any(isinstance(part, tuple | frozenset) for part in key)
        self._counted += kind is frozenset
        if self._counted > _MOST_ODD_KEYS:
            raise ValueError(f"more than {_MOST_ODD_KEYS:,} tuples and frozen sets as keys")
        return kind(*arguments)

    def persistent_load(self, pid: Any) -> Any:
        raise UnsafePickle(
            "this pickle refers to objects outside itself", where=self._path, field="persistent id"
        )

    def _is_stand_in(self, module: str, full: str) -> bool:
        parents = module.split(".")
        packages = {".".join(parents[: i + 1]) + ".*" for i in range(len(parents))}
        return full in self._stand_ins or not packages.isdisjoint(self._stand_ins)


class _Function:
    """A function that a pickle may call but not change (a pickle can set attributes)."""

    __slots__ = ("_function",)
    _function: Callable[..., Any]

    def __init__(self, function: Callable[..., Any]) -> None:
        object.__setattr__(self, "_function", function)

    def __call__(self, *arguments: Any) -> Any:
        return self._function(*arguments)

    def __setattr__(self, name: str, value: Any) -> None:
        raise TypeError("a pickle may not change what it calls")

    def __setstate__(self, state: Any) -> None:
        raise TypeError("a pickle may not change what it calls")


class _Dtype:
    """An element type as a pickle describes it, checked before numpy sees it."""

    def __init__(self, name: Any, align: Any = False, copy: Any = False) -> None:
        dtype = np.dtype(str(name))
        # An element of no bytes would make an array of any shape out of nothing.
        if dtype.kind not in _KINDS or dtype.itemsize == 0:
            raise ValueError(f"array elements of type {name!r} are not plain numbers or text")
        self.dtype = dtype

    def __setstate__(self, state: tuple[Any, ...]) -> None:
        # (version, byte order, subtype, names, fields, element size, alignment, flags[, metadata])
        order, structure, size = state[1], state[2:5], state[5]
        if order not in tuple(_BYTE_ORDERS) or any(part is not None for part in structure):
            raise ValueError("an array's element type is structured")
        if size not in (-1, self.dtype.itemsize):
            raise ValueError("an array's element size contradicts its type")
        self.dtype = self.dtype.newbyteorder(order)


class _Array(np.ndarray):
    """An array that takes its content only from bytes of the right length."""

    def __setitem__(self, key: Any, value: Any) -> None:
        # Indices that are arrays can come to far more elements than the pickle has.
        raise TypeError("a pickle may not change parts of an array")

    def __setstate__(self, state: Any) -> None:
        _, shape, dtype, fortran, raw = state
        plain = _plain_dtype(dtype)
        data = raw.encode("latin1") if isinstance(raw, str) else _bytes_of(raw)
        expected = plain.itemsize
        for length in shape:
            if not isinstance(length, int) or length < 0:
                raise ValueError("an array's shape is not made of integers")
            expected *= length
        if expected != len(data):
            raise ValueError(f"an array of shape {shape} holds {len(data)} bytes, not {expected}")
        whole = (1, tuple(shape), plain, bool(fortran), data)
        super().__setstate__(whole)  # type: ignore[arg-type]


def _bytes_of(raw: Any) -> bytes:
    # Nothing but bytes: an integer would make that many zeros.
    if not isinstance(raw, (bytes, bytearray)):
        raise TypeError(f"{type(raw).__name__} where bytes are expected")
    return bytes(raw)


def _plain_dtype(holder: Any) -> np.dtype[Any]:
    if not isinstance(holder, _Dtype):
        raise TypeError("an array without an element type")
    return holder.dtype


def _refuse_call(*arguments: Any) -> Any:
    raise TypeError("this class is only named in pickles, never called")


def _reconstruct(subtype: Any, shape: Any, typecode: Any) -> np.ndarray:
    if subtype is not _NDARRAY:
        raise TypeError("an array of a foreign class")
    return np.ndarray.__new__(_Array, (0,), np.int8)


def _scalar(dtype: Any, raw: Any = b"") -> Any:
    data = raw.encode("latin1") if isinstance(raw, str) else _bytes_of(raw)
    (value,) = np.frombuffer(data, dtype=_plain_dtype(dtype))
    return value


def _from_buffer(buffer: Any, dtype: Any, shape: Any, order: Any) -> np.ndarray:
    flat = np.frombuffer(bytearray(_bytes_of(buffer)), dtype=_plain_dtype(dtype))
    return flat.reshape(shape, order="F" if order == "F" else "C").view(_Array)


def _encode(text: Any, codec: Any = "latin1") -> bytes:
    if not isinstance(text, str) or codec not in ("latin1", "latin-1", "iso-8859-1"):
        raise TypeError("only Latin-1 text becomes bytes")
    return text.encode("latin1")


def _bytes(raw: Any = b"") -> bytes:
    return _bytes_of(raw)


def _bytearray(raw: Any = b"", codec: Any = "latin1") -> bytearray:
    return bytearray(_encode(raw, codec) if isinstance(raw, str) else _bytes_of(raw))


def _object_reconstructor(made: Any, base: Any, state: Any) -> Any:
    if not (isinstance(made, type) and issubclass(made, StandIn) and base is _OBJECT):
        raise TypeError("an object of a class that is not admitted")
    return made()


_NDARRAY = _Function(_refuse_call)
_OBJECT = _Function(_refuse_call)


def _admitted() -> dict[str, Any]:
    names: dict[str, Any] = {
        "numpy.ndarray": _NDARRAY,
        "numpy.dtype": _Dtype,
        "_codecs.encode": _Function(_encode),
    }
    for core in ("numpy.core", "numpy._core"):  # the name changed in numpy 2
        names[f"{core}.multiarray._reconstruct"] = _Function(_reconstruct)
        names[f"{core}.multiarray.scalar"] = _Function(_scalar)
        names[f"{core}.numeric._frombuffer"] = _Function(_from_buffer)
    for builtins in ("builtins", "__builtin__"):  # Python 3 and 2
        names[f"{builtins}.bytes"] = _Function(_bytes)
        names[f"{builtins}.bytearray"] = _Function(_bytearray)
        names[f"{builtins}.object"] = _OBJECT
    for copyreg in ("copyreg", "copy_reg"):
        names[f"{copyreg}._reconstructor"] = _Function(_object_reconstructor)
    return names


_ADMITTED = _admitted()
# What takes the hash of what it is made of.
_HASHING: dict[str, type] = {
    "collections.OrderedDict": OrderedDict,
    **{f"{module}.set": set for module in ("builtins", "__builtin__")},
    **{f"{module}.frozenset": frozenset for module in ("builtins", "__builtin__")},
}
