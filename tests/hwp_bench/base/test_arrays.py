"""Array files from others. Oracle: what was written; and that only one kind of error comes."""

from __future__ import annotations

import io
import warnings
import zipfile
from pathlib import Path

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from hwp_bench.base.arrays import evenly, read_npz, take, write_npz
from hwp_bench.base.errors import BadInput

ARRAYS = {"a": np.arange(12.0).reshape(3, 4), "b": np.array([True, False])}


def _whole(**arrays: np.ndarray) -> bytes:
    buffer = io.BytesIO()
    np.savez_compressed(buffer, **arrays)
    return buffer.getvalue()


def _archive(path: Path, name: str, content: bytes) -> Path:
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as archive:
        archive.writestr(name, content)
    return path


def _header(text: str) -> bytes:
    line = text.encode().ljust(117) + b"\n"
    return b"\x93NUMPY\x01\x00" + len(line).to_bytes(2, "little") + line


def test_what_is_written_is_read(tmp_path: Path) -> None:
    read = read_npz(write_npz(tmp_path / "file.npz", ARRAYS))
    assert read.keys() == ARRAYS.keys()
    for name, array in ARRAYS.items():
        np.testing.assert_array_equal(read[name], array)
        assert read[name].dtype == array.dtype


def test_a_bomb_is_refused_before_it_is_unpacked(tmp_path: Path) -> None:
    path = tmp_path / "bomb.npz"
    path.write_bytes(_whole(a=np.zeros(4_000_000)))
    assert path.stat().st_size < 100_000
    with pytest.raises(BadInput, match="unpacks to 32000"):
        read_npz(path, max_bytes=10_000_000)


@pytest.mark.parametrize(
    ("content", "problem"),
    [
        (
            _header("{'descr': '<f8', 'fortran_order': False, 'shape': (1000000, 1000000)}"),
            "claims 8000000000000 bytes",
        ),
        (_header("{'descr': '|O', 'fortran_order': False, 'shape': ()}"), "Object arrays|claims"),
        (
            _header("{'descr': '<U0', 'fortran_order': False, 'shape': (2147483647, 2147483647)}"),
            "elements of no bytes",
        ),
        (_header("[" * 90), "not a readable array file"),
        (b"plain text", "not a readable array file"),
        (b"", "not a readable array file"),
        (b"\x93NUMPY\x09\x00" + b"\0" * 200, "version"),
    ],
)
def test_headers_that_lie_are_refused(tmp_path: Path, content: bytes, problem: str) -> None:
    with pytest.raises(BadInput, match=problem):
        read_npz(_archive(tmp_path / "file.npz", "a.npy", content))


@pytest.mark.parametrize("names", [["a.npy", "a.npy"], [f"{i}.npy" for i in range(10_001)]])
def test_arrays_are_there_once_and_not_too_many(tmp_path: Path, names: list[str]) -> None:
    file = tmp_path / "file.npz"
    with warnings.catch_warnings(), zipfile.ZipFile(file, "w") as archive:
        warnings.simplefilter("ignore")
        for name in names:
            archive.writestr(name, b"")
    with pytest.raises(BadInput, match="more than 10,000 arrays, or one twice"):
        read_npz(file)


def test_objects_are_refused_and_not_unpickled(tmp_path: Path) -> None:
    marker = tmp_path / "executed"

    class Exploit:
        def __reduce__(self) -> tuple:
            return Path.touch, (marker,)

    path = tmp_path / "file.npz"
    np.savez(path, a=np.array([Exploit()], dtype=object))
    with pytest.raises(BadInput, match="Object arrays"):
        read_npz(path)
    assert not marker.exists()


def test_names_that_climb_are_only_names(tmp_path: Path) -> None:
    buffer = io.BytesIO()
    np.save(buffer, np.zeros(2))
    (tmp_path / "inner").mkdir()
    path = _archive(tmp_path / "inner" / "file.npz", "../../up.npy", buffer.getvalue())
    assert list(read_npz(path)) == ["../../up"]
    assert [item.name for item in tmp_path.rglob("*")] == ["inner", "file.npz"]


@settings(
    max_examples=150, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture]
)
@given(st.data())
def test_any_damage_is_one_kind_of_error(tmp_path: Path, data: st.DataObject) -> None:
    raw = bytearray(_whole(**ARRAYS))
    for _ in range(data.draw(st.integers(1, 4))):
        raw[data.draw(st.integers(0, len(raw) - 1))] = data.draw(st.integers(0, 255))
    path = tmp_path / "file.npz"
    path.write_bytes(raw[: data.draw(st.integers(0, len(raw)))])
    message = ""
    try:
        for name, array in read_npz(path).items():
            take({name: array}, name, array.shape, where=path, dtype=bool)
    except BadInput as error:
        message = str(error)
    assert "\n" not in message


@given(count=st.integers(0, 3000), most=st.integers(0, 500))
def test_both_ends_and_gaps_that_differ_by_one(count: int, most: int) -> None:
    found = evenly(count, most)
    assert len(found) == min(count, most)
    assert found.dtype == np.int64
    if len(found) > 1:
        assert (found[0], found[-1]) == (0, count - 1)
        gaps = np.diff(found)
        # A rounded place is half a step off at most, so two neighbours are one.
        assert gaps.min() >= 1
        assert abs(gaps - (count - 1) / (len(found) - 1)).max() <= 1.0


def test_one_is_the_first_and_few_are_all() -> None:
    assert evenly(7, 1).tolist() == [0]
    assert evenly(4, 9).tolist() == [0, 1, 2, 3]
    assert evenly(9, 3).tolist() == [0, 4, 8]


def test_a_directory_of_very_many_entries_is_refused_unread(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    count, file = 300_000, tmp_path / "many.npz"
    end = b"PK\5\6" + bytes(4) + b"\xff\xff" * 2 + (46 * count).to_bytes(4, "little") + bytes(6)
    file.write_bytes((b"PK\1\2" + bytes(42)) * count + end)
    monkeypatch.setattr(zipfile, "ZipInfo", lambda *_: pytest.fail("an entry was read"))
    with pytest.raises(BadInput, match="more than 10,000 arrays"):
        read_npz(file)
