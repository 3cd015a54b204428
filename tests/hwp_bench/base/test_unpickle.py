"""The restricted unpickler: reads what it must, runs nothing, names what it refuses."""

from __future__ import annotations

import contextlib
import itertools
import pickle
import struct
import subprocess
import sys
from collections import OrderedDict
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from hwp_bench.base.errors import BadInput, HwpError, UnsafePickle
from hwp_bench.base.unpickle import StandIn, load_pickle


@pytest.fixture
def file(tmp_path: Path) -> Path:
    return tmp_path / "object.pkl"


class Calls:
    """Pickles as a call of `function` with `arguments`."""

    def __init__(self, function: Any, *arguments: Any) -> None:
        self.call = (function, arguments)

    def __reduce__(self) -> Any:
        return self.call


@pytest.mark.parametrize("protocol", range(pickle.HIGHEST_PROTOCOL + 1))
def test_arrays_and_containers_come_back(file: Path, protocol: int) -> None:
    random = np.random.default_rng(0)
    value = {
        "floats": random.normal(size=(3, 4)),
        "fortran": np.asfortranarray(random.normal(size=(3, 4)).astype(np.float32)),
        "big endian": np.arange(5, dtype=">i4"),
        "bytes": np.zeros((2, 2, 1), dtype=np.uint8),
        "bools": np.array([True, False]),
        "text": np.array(["hand", "öre"]),
        "empty": np.zeros((0, 3)),
        "zero-dimensional": np.array(3.5),
        "scalar": np.float32(1.5),
        "plain": [1, 2.5, None, True, "name", b"raw", (1, 2)],
        "buffer": bytearray(b"xyz"),
    }
    file.write_bytes(pickle.dumps(value, protocol=protocol))
    read = load_pickle(file)
    assert list(read) == list(value)
    for key, expected in value.items():
        if isinstance(expected, np.ndarray):
            plain = np.asarray(read[key])
            assert type(plain) is np.ndarray
            assert plain.dtype.newbyteorder("=") == expected.dtype.newbyteorder("=")
            np.testing.assert_array_equal(plain, expected)
        else:
            assert read[key] == expected
    assert isinstance(read["scalar"], np.float32)


def test_python_2_pickles_are_read(file: Path) -> None:
    # What Python 2's cPickle wrote for {'a': numpy.arange(3.), 'path': 'x.jpg'}, protocol 2.
    raw = (
        b"\x80\x02}q\x01(U\x01aq\x02cnumpy.core.multiarray\n_reconstruct\nq\x03cnumpy\nndarray\n"
        b"q\x04K\x00\x85U\x01b\x87Rq\x05(K\x01K\x03\x85cnumpy\ndtype\nq\x06U\x02f8K\x00K\x01\x87R"
        b"q\x07(K\x03U\x01<NNNJ\xff\xff\xff\xffJ\xff\xff\xff\xffK\x00tb\x89U\x18"
        + np.arange(3.0).tobytes()
        + b"tbU\x04pathq\x08U\x05x.jpgq\x09u."
    )
    file.write_bytes(raw)
    read = load_pickle(file)
    np.testing.assert_array_equal(read["a"], np.arange(3.0))
    assert read["path"] == "x.jpg"


def exploit(function: Any, *arguments: Any) -> bytes:
    return pickle.dumps({"frames": [1, {"deep": (Calls(function, *arguments),)}]})


def test_foreign_calls_are_refused_by_name_and_not_made(file: Path, tmp_path: Path) -> None:
    import builtins
    import os
    import subprocess

    trace = tmp_path / "trace"
    for name, raw in {
        "posix.system": exploit(os.system, f"touch {trace}"),
        "builtins.eval": exploit(builtins.eval, f"open({str(trace)!r}, 'w')"),
        "builtins.exec": exploit(builtins.exec, f"open({str(trace)!r}, 'w')"),
        "subprocess.Popen": exploit(subprocess.Popen, ["touch", str(trace)]),
        "builtins.getattr": exploit(builtins.getattr, {}, "__class__"),
        "builtins.__import__": exploit(builtins.__import__, "os"),
        "io.open": exploit(builtins.open, str(trace), "w"),
        "numpy.fromfile": exploit(np.fromfile, "/etc/hostname"),
        "numpy.load": exploit(np.load, "x.npy", None, True),
        "functools.partial": b"cfunctools\npartial\n.",
        "builtins.bytearray.fromhex": b"\x80\x04\x8c\x08builtins\x8c\x11bytearray.fromhex\x93.",
        "numpy._core.multiarray._reconstruct.__globals__": (
            b"\x80\x04\x8c\x16numpy._core.multiarray\x8c\x18_reconstruct.__globals__\x93."
        ),
        "hwp_bench.base.unpickle.load_pickle": b"chwp_bench.base.unpickle\nload_pickle\n.",
    }.items():
        file.write_bytes(raw)
        with pytest.raises(UnsafePickle) as caught:
            load_pickle(file)
        assert caught.value.field == name
        assert str(file) in str(caught.value)
    assert not trace.exists()


def test_persistent_references_are_refused(file: Path) -> None:
    file.write_bytes(b"Pwhatever\n.")
    with pytest.raises(UnsafePickle):
        load_pickle(file)


def test_object_arrays_are_refused(file: Path) -> None:
    file.write_bytes(pickle.dumps(np.array([{}, None], dtype=object)))
    with pytest.raises(BadInput, match="not plain numbers"):
        load_pickle(file)


def array_pickle(dtype: bytes, state: bytes, shape: bytes, raw: bytes) -> bytes:
    """An array pickle with chosen type name, type state, shape and bytes (protocol 2)."""
    return (
        b"\x80\x02cnumpy.core.multiarray\n_reconstruct\ncnumpy\nndarray\nK\x00\x85U\x01b\x87R"
        b"(K\x01" + shape + b"cnumpy\ndtype\nU" + bytes([len(dtype)]) + dtype + b"K\x00K\x01\x87R"
        b"(" + state + b"tb\x89T" + struct.pack("<I", len(raw)) + raw + b"tb."
    )


PLAIN_STATE = b"K\x03U\x01<NNNJ\xff\xff\xff\xffJ\xff\xff\xff\xffK\x00"


def test_the_crafted_pickles_below_are_well_formed(file: Path) -> None:
    file.write_bytes(array_pickle(b"f8", PLAIN_STATE, b"K\x02\x85", bytes(16)))
    np.testing.assert_array_equal(load_pickle(file), np.zeros(2))


@pytest.mark.parametrize(
    "raw",
    [
        # Bytes taken for object pointers: an object type, plain or hidden in a structure.
        array_pickle(b"O8", PLAIN_STATE, b"K\x02\x85", bytes(16)),
        array_pickle(b"O", PLAIN_STATE, b"K\x02\x85", bytes(16)),
        array_pickle(b"V8", PLAIN_STATE, b"K\x02\x85", bytes(16)),
        array_pickle(b"f8,O", PLAIN_STATE, b"K\x01\x85", bytes(16)),
        # Structure, subtype or element size slipped in through the type's state.
        array_pickle(
            b"f8", b"K\x03U\x01<NU\x01f\x85}J\xff\xff\xff\xffK\x01K\x3f", b"K\x02\x85", b""
        ),
        array_pickle(b"f8", b"K\x03U\x01<NNNM\xff\x7fK\x01K\x3f", b"K\x02\x85", bytes(16)),
        array_pickle(b"f8", b"K\x03U\x01?NNNJ\xff\xff\xff\xffK\x01K\x00", b"K\x02\x85", bytes(16)),
        # Shapes that promise more or less than there is.
        array_pickle(b"f8", PLAIN_STATE, b"K\x03\x85", bytes(16)),
        array_pickle(b"f8", PLAIN_STATE, b"J\xff\xff\xff\xff\x85", bytes(8)),
        array_pickle(b"f8", PLAIN_STATE, b"J\xff\xff\xff\x7fJ\xff\xff\xff\x7f\x86", bytes(8)),
        array_pickle(b"S0", PLAIN_STATE, b"J\xff\xff\xff\x7f\x85", b""),
        # Memory asked for out of nothing.
        b"c__builtin__\nbytearray\nJ\xff\xff\xff\x7f\x85R.",
        b"\x80\x02N" + b"r\xff\xff\xff\xff" + b".",
        b"cnumpy\nndarray\n(J\xff\xff\xff\x7f\x85tR.",
        b"\x80\x02cnumpy\nndarray\nJ\xff\xff\xff\x7f\x85\x85\x81.",
        # Admitted functions misused.
        b"c_codecs\nencode\nX\x01\x00\x00\x00aX\x03\x00\x00\x00bz2\x86R.",
        b"ccopy_reg\n_reconstructor\n(c__builtin__\nset\nc__builtin__\nobject\nNtR.",
        b"cnumpy.core.multiarray\nscalar\nNN\x86R.",
        b"cnumpy.core.multiarray\n_reconstruct\n(c__builtin__\nset\nK\x00\x85U\x01btR.",
        # Attributes of admitted functions set from a pickle.
        b"\x80\x02c_codecs\nencode\nN}U\x09_functionNs\x86b.",
        b"\x80\x02cnumpy\ndtype\n}U\x09__init__Nsb.",
    ],
)
def test_crafted_pickles_are_refused(file: Path, raw: bytes) -> None:
    file.write_bytes(raw)
    with pytest.raises(BadInput):
        load_pickle(file)
    # Nothing stuck to the reader: an honest file is still read.
    file.write_bytes(pickle.dumps([np.arange(3), bytearray(b"x"), b"y"], protocol=2))
    np.testing.assert_array_equal(load_pickle(file)[0], np.arange(3))


def test_stand_ins_keep_state_and_run_nothing(file: Path) -> None:
    raw = b"\x80\x02cchumpy.ch\nCh\n)\x81}U\x01xK\x05sbcfoo\nBar\nK\x01K\x02\x86R\x86."
    file.write_bytes(raw)
    inner, called = load_pickle(file, stand_ins=("chumpy.*", "foo.Bar"))
    assert isinstance(inner, StandIn)
    assert (inner.origin, inner.state) == ("chumpy.ch.Ch", {"x": 5})
    assert (called.origin, called.arguments) == ("foo.Bar", (1, 2))
    with pytest.raises(UnsafePickle) as caught:
        load_pickle(file, stand_ins=("chumpy.*",))
    assert caught.value.field == "foo.Bar"
    with pytest.raises(UnsafePickle):
        load_pickle(file, stand_ins=("chump.*", "foo.Bar"))


def test_old_style_objects_become_stand_ins(file: Path) -> None:
    file.write_bytes(
        b"ccopy_reg\n_reconstructor\n(cchumpy.ch\nCh\nc__builtin__\nobject\nNtR(dS'x'\nI7\nsb."
    )
    assert load_pickle(file, stand_ins=("chumpy.*",)).state == {"x": 7}


def test_absent_and_oversized_files_are_named(file: Path) -> None:
    with pytest.raises(BadInput, match="does not exist"):
        load_pickle(file)
    file.write_bytes(pickle.dumps(bytes(1000)))
    with pytest.raises(BadInput, match="more than the 500"):
        load_pickle(file, max_bytes=500)


HONEST = pickle.dumps(
    [{"img_path": "a.jpg", "pose": np.arange(48.0)[None], "n": i} for i in range(3)], protocol=2
)


@settings(max_examples=150, deadline=None)
@given(position=st.integers(0, len(HONEST) - 1), value=st.integers(0, 255), cut=st.booleans())
def test_damage_is_a_named_error_or_plain_data(
    tmp_path_factory: pytest.TempPathFactory, position: int, value: int, cut: bool
) -> None:
    file = tmp_path_factory.getbasetemp() / "damaged.pkl"
    damaged = HONEST[:position] + (b"" if cut else bytes([value]) + HONEST[position + 1 :])
    file.write_bytes(damaged)
    with contextlib.suppress(HwpError):  # any other exception fails the test
        load_pickle(file)


def _shared(item: Any, times: int) -> Any:
    for _ in range(times):
        item = [item] * 10
    return item


def _deep(depth: int) -> Any:
    item: Any = 0.0
    for _ in range(depth):
        item = [item]
    return item


def _circle() -> Any:
    item: list[Any] = [1.0]
    item.append({"self": item})
    return item


@pytest.mark.parametrize(
    ("value", "problem"),
    [
        (_shared(0.0, 12), "more than"),
        ({"v_template": _shared(0.0, 9)}, "more than"),
        (_shared("x" * 1000, 6), "more than"),
        (_shared(np.zeros(1000), 6), "more than"),
        ({"a": ((_shared(b"y" * 1000, 6),),)}, "more than"),
        (_deep(100), "nested too deeply"),
        (_circle(), "contains itself"),
        ({i * (2**61 - 1): 0 for i in range(100)}, "absurdly large integer"),
        ({complex(-1000003 * i, i): 0 for i in range(2000)}, "not plain data"),
        (np.ones(3, complex), "not plain numbers"),
        (set(itertools.product((-1, -2), repeat=11)), "not (one of )?plain data"),
        (dict.fromkeys(itertools.product((-1, -2), repeat=11)), "neither a text nor a number"),
        (OrderedDict.fromkeys(itertools.product((-1, -2), repeat=11)), "not plain data"),
        ([frozenset([i]) for i in range(2000)], "not (one of )?plain data"),
        (1 << 20_000, "absurdly large integer"),
    ],
    ids=[
        "lists", "a table of lists", "texts", "arrays", "tuples", "deep", "circle", "integer keys",
        "complex keys", "complex array", "set of equal hashes", "keys of equal hashes",
        "ordered keys of equal hashes", "frozen sets", "integer",
    ],
)  # fmt: skip
@pytest.mark.parametrize("protocol", [2, 4], ids=["protocol 2", "protocol 4"])
def test_small_pickles_of_large_things_are_refused(
    file: Path, value: Any, problem: str, protocol: int
) -> None:
    file.write_bytes(pickle.dumps(value, protocol=protocol))
    with pytest.raises(BadInput, match=problem):
        load_pickle(file)


def test_what_is_shared_a_little_is_read(file: Path) -> None:
    value = {"a": _shared(1.5, 3), "b": [np.arange(4.0)] * 5}
    file.write_bytes(pickle.dumps(value))
    read = load_pickle(file)
    assert read["a"] == value["a"]
    assert [list(item) for item in read["b"]] == [[0.0, 1.0, 2.0, 3.0]] * 5


def test_steps_are_bounded(file: Path) -> None:
    file.write_bytes(pickle.dumps([0.5 * i for i in range(1000)]))
    assert len(load_pickle(file, max_steps=2000)) == 1000
    with pytest.raises(BadInput, match="more than 500 steps"):
        load_pickle(file, max_steps=500)


NEST = 100_000
# The size of each is some 50 kB to 1 MB; what they make is nested 100,000 deep, or 2^60 large.
KILLING = {
    "tuples of one": b"})" + b"\x85" * NEST + b"K\x01s",
    "tuples of two": b"})" + b"K\x01\x86" * NEST + b"K\x01s",
    "tuples of three": b"})" + b"K\x01K\x02\x87" * NEST + b"K\x01s",
    "tuples of marks": b"}" + b"(" * NEST + b"t" * NEST + b"K\x01s",
    "lists": b"]" * NEST + b"a" * (NEST - 1),
    "tables": b"}" + b"K\x01}" * NEST + b"s" * NEST,
    "frozen sets": b"}" + b"(" * NEST + b"\x91" * NEST + b"K\x01s",
    "calls": b"}" + b"cchumpy\nX\n" * NEST + b")" + b"R\x85" * NEST + b"K\x01s",
    "states": b"cchumpy\nX\n)\x81" * NEST + b"}" + b"b" * NEST,
    "in a set": b"cbuiltins\nset\n])" + b"\x85" * NEST + b"a\x85R",
    "in an ordered table": b"ccollections\nOrderedDict\n]()" + b"\x85" * NEST + b"K\x01ta\x85R",
    "doubled": b"})" + b"2\x86" * 60 + b"K\x01s",
    "doubled by memo": b"})" + b"".join(b"\x94h%c\x86" % i for i in range(60)) + b"K\x01s",
    "doubled in a set": b"()" + b"2\x86" * 60 + b"\x91",
    "one large key often": b"})" + b"".join(b"\x94h%c\x86" % i for i in range(20)) + b"\x94"
    + b"0(" + b"h\x14N" * 20_000 + b"u",
    "a frame of 2^62 bytes": b"\x95" + struct.pack("<Q", 2**62) + b"N",
    "text of 2^62 bytes": b"\x8e" + struct.pack("<Q", 2**62) + b"N",
    "bytes of 2^40 bytes": b"\x96" + struct.pack("<Q", 2**40) + b"N",
    "parts of an array": pickle.dumps(np.zeros((1, 1)), protocol=4)[2:-1] + b"K\x00K\x05s",
}  # fmt: skip
READ_ALL = """
import sys
from pathlib import Path
from hwp_bench.base.errors import BadInput
from hwp_bench.base.unpickle import load_pickle
for file in sorted(Path(sys.argv[1]).iterdir()):
    print(file.name, flush=True)
    try:
        load_pickle(file, stand_ins=("chumpy.*",))
    except BadInput as error:
        said = error.problem
        named = error.field in ("builtins.set", "collections.OrderedDict")
        assert named or (said.endswith(")") and not said.endswith("()")), said
    else:
        raise SystemExit(f"{file.name} was read")
"""


def test_pickles_that_would_kill_the_process_are_refused_with_a_reason(tmp_path: Path) -> None:
    # In a process of its own: the stack of C overflows, which no test could catch.
    folder = tmp_path / "pickles"
    folder.mkdir()
    for name, body in KILLING.items():
        (folder / name).write_bytes(b"\x80\x05" + body + b".")
    done = subprocess.run(
        [sys.executable, "-c", READ_ALL, str(folder)], capture_output=True, text=True, timeout=300
    )
    assert (done.returncode, done.stderr) == (0, ""), (done.stdout.splitlines()[-1:], done.stderr)
    assert len(done.stdout.splitlines()) == len(KILLING)


@pytest.mark.parametrize("raw", [b"", b".", b"0.", b"g99\n.", b"(2.", b"N}b.", b"\x82\x01."])
def test_no_reason_is_empty(file: Path, raw: bytes) -> None:
    file.write_bytes(raw)
    with pytest.raises(BadInput, match=r"is not a readable pickle \(.+\)") as caught:
        load_pickle(file)
    assert "\n" not in caught.value.problem
