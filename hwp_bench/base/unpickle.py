"""Read pickles from outside without running what they ask for.

Hand models and the official HWP release come as pickles, and a pickle can name any function and
have it called. Here it can name numpy arrays and builtin containers; what the caller lists as
stand-ins becomes an inert object that only keeps its state; everything else is refused by name.
Not even numpy's own types are given out: array and element type are rebuilt by the functions
below, because a crafted `numpy.dtype` state can make numpy take bytes for pointers. What these
files do not need is not read at all: sets, and keys of tables that are not texts or numbers, whose
hashes can be chosen to be equal.
"""

from __future__ import annotations

import itertools
import math
import os
import pickle
import struct
from collections.abc import Callable, Collection, Iterator
from pathlib import Path
from typing import Any

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

# The hash of larger integers repeats.
_LARGEST_INTEGER = 2**63
# Axes of an array.
_MOST_AXES = 32
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


def load_pickle(
    path: str | os.PathLike[str],
    *,
    stand_ins: Collection[str] = (),
    max_bytes: int = MAX_PICKLE_BYTES,
    max_steps: int = MAX_STEPS,
) -> Any:
    """Read one object from a pickle file, whatever the file asks for.

    Python 2 pickles are read too, their strings as Latin-1.
    """
    path = Path(path)
    check_is_file(path)
    size = path.stat().st_size
    if size > max_bytes:
        raise BadInput(f"holds {size} bytes, more than the {max_bytes} that are read", where=path)
    try:
        with path.open("rb") as stream:
            loaded = _Unpickler(_Exact(stream, size), path, stand_ins, max_steps).load()
        _check_expanded(loaded, MAX_EXPANDED + size)
        return loaded
    except HwpError:
        raise
    # A damaged pickle can raise any exception.
    except Exception as error:
        text = shown(" ".join(str(error).split()))[:200]
        reason = text or f"a step of it fails with {type(error).__name__}"
        raise BadInput(f"is not a readable pickle ({reason})", where=path) from error


class _Exact:
    """A file that refuses to be read beyond its end, before room is made for what is not there."""

    def __init__(self, stream: Any, size: int) -> None:
        self._stream = stream
        self._size = size
        self.readline = stream.readline

    def read(self, count: int) -> bytes:
        left = self._size - self._stream.tell()
        if count > max(left, 1):
            raise ValueError(f"it claims {count:,} bytes where {left:,} are left")
        return bytes(self._stream.read(count))


class _Memo(dict[int, Any]):
    """Objects by the numbers that a pickler gives them, one after the other."""

    def __setitem__(self, number: int, value: Any) -> None:
        if number > len(self) + 1:
            raise ValueError(f"memo number {number} after {len(self)} objects")
        super().__setitem__(number, value)


#: Python's own reader, whose every step can be changed.
_Reader: Any = pickle._Unpickler
#: The steps that are taken: those of files of plain data.
_NAMES = (
    "PROTO FRAME STOP MARK POP POP_MARK DUP MEMOIZE PUT BINPUT LONG_BINPUT GET BINGET LONG_BINGET "
    "NONE NEWTRUE NEWFALSE INT BININT BININT1 BININT2 LONG LONG1 LONG4 FLOAT BINFLOAT STRING "
    "BINSTRING SHORT_BINSTRING UNICODE BINUNICODE SHORT_BINUNICODE BINUNICODE8 BINBYTES "
    "SHORT_BINBYTES BINBYTES8 BYTEARRAY8 EMPTY_TUPLE TUPLE TUPLE1 TUPLE2 TUPLE3 EMPTY_LIST LIST "
    "APPEND APPENDS EMPTY_DICT DICT SETITEM SETITEMS GLOBAL STACK_GLOBAL REDUCE NEWOBJ BUILD "
    "PERSID BINPERSID"
)
_STEPS = frozenset(getattr(pickle, name)[0] for name in _NAMES.split())


class _Unpickler(_Reader):
    def __init__(
        self, stream: _Exact, path: Path, stand_ins: Collection[str], max_steps: int
    ) -> None:
        super().__init__(stream, encoding="latin1")
        self.memo = _Memo()
        self.dispatch = self
        self._left = self._most = max_steps
        self._path = path
        self._stand_ins = frozenset(stand_ins)
        self._classes: dict[str, type[StandIn]] = {}

    def __getitem__(self, code: int) -> Callable[[Any], None]:
        """Return the function of the next step, if its arguments are sound."""
        self._left -= 1
        if self._left < 0:
            raise ValueError(f"more than {self._most:,} steps")
        if code not in _STEPS:
            raise ValueError(f"step {bytes([code])!r} is not one of plain data")
        if any(isinstance(one, int) and abs(one) > _LARGEST_INTEGER for one in self.stack[-1:]):
            raise ValueError("an absurdly large integer")
        if code in (pickle.SETITEM[0], pickle.SETITEMS[0], pickle.DICT[0]):
            keys = self.stack[-2:-1] if code == pickle.SETITEM[0] else self.stack[::2]
            if any(not isinstance(key, str | bytes | int | float | None) for key in keys):
                raise ValueError("a key of a table is neither a text nor a number")
        if code == pickle.BUILD[0] and not isinstance(self.stack[-2], StandIn | _Dtype | _Array):
            raise TypeError("a state of something that has none")
        taken: dict[int, Callable[[Any], None]] = _Reader.dispatch
        return _Unpickler.byte_array if code == pickle.BYTEARRAY8[0] else taken[code]

    def byte_array(self) -> None:
        """Take a step that makes an array of bytes, whose room is made when they are there."""
        (count,) = struct.unpack("<Q", self.read(8))
        self.append(bytearray(self.read(count)))

    def find_class(self, module: str, name: str) -> Any:
        full = f"{module}.{name}"
        if full in _ADMITTED:
            return _ADMITTED[full]
        parents = module.split(".")
        packages = {".".join(parents[: i + 1]) + ".*" for i in range(len(parents))}
        if full in self._stand_ins or not packages.isdisjoint(self._stand_ins):
            if full not in self._classes:
                self._classes[full] = type("StandIn", (StandIn,), {"origin": full})
            return self._classes[full]
        raise UnsafePickle(
            "this pickle asks for something that is not plain data",
            where=self._path,
            field=full,
            remedy="Do not open this file with ordinary tools: it may run code.",
        )

    def persistent_load(self, pid: Any) -> Any:
        raise UnsafePickle(
            "this pickle refers to objects outside itself", where=self._path, field="persistent id"
        )


# What has parts.
_HOLDERS = (dict, list, tuple, StandIn)


def _check_expanded(loaded: Any, most: int) -> None:
    """Refuse what numpy would copy into far more memory than the pickle takes."""
    # Size and depth of each container; None while its parts are looked at.
    known: dict[int, tuple[int, int] | None] = {}

    def measure(item: Any, level: int) -> tuple[int, int]:
        if id(item) in known:
            if (found := known[id(item)]) is None:
                raise ValueError("a container contains itself")
            return found
        known[id(item)] = None
        size, depth = 1, 1
        for part in _parts_of(item) if level <= MAX_DEPTH else ():
            if isinstance(part, _HOLDERS):
                inner = measure(part, level + 1)
                size, depth = size + inner[0], max(depth, 1 + inner[1])
            else:
                size += _leaf(part)
        if size > most:
            raise ValueError(f"it comes to more than {most:,} numbers and characters")
        if max(level, depth) > MAX_DEPTH:
            raise ValueError("it is nested too deeply")
        known[id(item)] = size, depth
        return size, depth

    if isinstance(loaded, _HOLDERS):
        measure(loaded, 1)


def _parts_of(item: Any) -> Iterator[Any]:
    """The parts of a container or an inert object."""
    if isinstance(item, StandIn):
        return iter(vars(item).values())
    return itertools.chain(item.keys(), item.values()) if isinstance(item, dict) else iter(item)


def _leaf(item: Any) -> int:
    if isinstance(item, np.ndarray):
        return item.size * max(1, item.itemsize // 8)
    return len(item) if isinstance(item, str | bytes | bytearray) else 1


class _Dtype:
    """An element type as a pickle describes it, checked before numpy sees it."""

    def __init__(self, name: Any, align: Any = False, copy: Any = False) -> None:
        # A text first: of what is shared many times, a text would fill the memory.
        dtype = np.dtype(name if isinstance(name, str) else "O")
        # An element of no bytes would make an array of any shape out of nothing.
        if dtype.kind not in _KINDS or dtype.itemsize == 0:
            raise ValueError(f"array elements of type {dtype} are not plain numbers or text")
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
        shape = _plain_shape(shape)
        expected = plain.itemsize * math.prod(shape)
        if expected != len(data):
            raise ValueError(f"an array of shape {shape} holds {len(data)} bytes, not {expected}")
        whole = (1, shape, plain, bool(fortran), data)
        super().__setstate__(whole)  # type: ignore[arg-type]


def _bytes_of(raw: Any = b"") -> bytes:
    # Nothing but bytes: an integer would make that many zeros.
    if not isinstance(raw, (bytes, bytearray)):
        raise TypeError(f"{type(raw).__name__} where bytes are expected")
    return bytes(raw)


def _plain_shape(shape: Any) -> tuple[int, ...]:
    sound = isinstance(shape, tuple | list) and len(shape) <= _MOST_AXES
    if not sound or any(not isinstance(length, int) or length < 0 for length in shape):
        raise ValueError("an array's shape is not made of integers")
    return tuple(shape)


def _plain_dtype(holder: Any) -> np.dtype[Any]:
    if not isinstance(holder, _Dtype):
        raise TypeError("an array without an element type")
    return holder.dtype


def _ndarray(*arguments: Any) -> Any:
    raise TypeError("this class is only named in pickles, never called")


def _object(*arguments: Any) -> Any:
    raise TypeError("this class is only named in pickles, never called")


def _reconstruct(subtype: Any, shape: Any, typecode: Any) -> np.ndarray:
    if subtype is not _ndarray:
        raise TypeError("an array of a foreign class")
    return np.ndarray.__new__(_Array, (0,), np.int8)


def _scalar(dtype: Any, raw: Any = b"") -> Any:
    data = raw.encode("latin1") if isinstance(raw, str) else _bytes_of(raw)
    (value,) = np.frombuffer(data, dtype=_plain_dtype(dtype))
    return value


def _from_buffer(buffer: Any, dtype: Any, shape: Any, order: Any) -> np.ndarray:
    flat = np.frombuffer(bytearray(_bytes_of(buffer)), dtype=_plain_dtype(dtype))
    return flat.reshape(_plain_shape(shape), order="F" if order == "F" else "C").view(_Array)


def _encode(text: Any, codec: Any = "latin1") -> bytes:
    if not isinstance(text, str) or codec not in ("latin1", "latin-1", "iso-8859-1"):
        raise TypeError("only Latin-1 text becomes bytes")
    return text.encode("latin1")


def _bytearray(raw: Any = b"", codec: Any = "latin1") -> bytearray:
    return bytearray(_encode(raw, codec) if isinstance(raw, str) else _bytes_of(raw))


def _object_reconstructor(made: Any, base: Any, state: Any) -> Any:
    if not (isinstance(made, type) and issubclass(made, StandIn) and base is _object):
        raise TypeError("an object of a class that is not admitted")
    return made()


def _admitted() -> dict[str, Any]:
    """Stateless functions for the names that a pickle may contain."""
    names: dict[str, Any] = {
        "numpy.ndarray": _ndarray,
        "numpy.dtype": _Dtype,
        "_codecs.encode": _encode,
    }
    for core in ("numpy.core", "numpy._core"):  # the name changed in numpy 2
        names[f"{core}.multiarray._reconstruct"] = _reconstruct
        names[f"{core}.multiarray.scalar"] = _scalar
        names[f"{core}.numeric._frombuffer"] = _from_buffer
    for builtins in ("builtins", "__builtin__"):  # Python 3 and 2
        names[f"{builtins}.bytes"] = _bytes_of
        names[f"{builtins}.bytearray"] = _bytearray
        names[f"{builtins}.object"] = _object
    for copyreg in ("copyreg", "copy_reg"):
        names[f"{copyreg}._reconstructor"] = _object_reconstructor
    return names


_ADMITTED = _admitted()
