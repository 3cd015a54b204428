"""The download. Oracle: a hub in memory, and hashlib."""

from __future__ import annotations

import hashlib
import json
import sys
import types
from pathlib import Path
from typing import Any

import pytest

from hwp_bench.base.errors import BadInput, HwpError, MissingDependency, UsageError
from hwp_bench.cli.main import main
from hwp_bench.importers.official.download import (
    RECORD,
    HuggingFaceHub,
    RemoteFile,
    download_release,
)

FILES = {
    "capture0_subsample3_single/output.pkl": b"pickle",
    "capture0_subsample3_single/00000.png": b"image",
    "capture1_subsample2_single/output.pkl": b"other",
    "README.md": b"words",
}


def sha(data: bytes) -> str:
    return hashlib.sha256(data).hexdigest()


class MemoryHub:
    """A hub of one commit that can stop in the middle."""

    def __init__(
        self, files: dict[str, bytes], commit: str = "c0ffee", stop_after: int = 99
    ) -> None:
        self.content, self.commit, self.left = dict(files), commit, stop_after
        self.fetched: list[str] = []

    def files(self, revision: str | None) -> tuple[str, list[RemoteFile]]:
        assert revision in (None, "main", self.commit)
        listed = [RemoteFile(name, len(data), None) for name, data in self.content.items()]
        return self.commit, listed

    def fetch(self, name: str, commit: str, folder: Path) -> Path:
        if self.left == 0:
            raise ConnectionError("the line went dead\nwith details")
        self.left -= 1
        self.fetched.append(name)
        target = folder / name
        target.parent.mkdir(parents=True, exist_ok=True)
        target.write_bytes(self.content[name])
        return target


@pytest.fixture
def pins(tmp_path: Path) -> Path:
    return tmp_path / "pins.json"


def test_everything_is_fetched_recorded_and_pinned(tmp_path: Path, pins: Path) -> None:
    made = download_release(tmp_path / "out", MemoryHub(FILES), pins=pins)
    assert made.files == {name: sha(data) for name, data in FILES.items()}
    for name, data in FILES.items():
        assert (tmp_path / "out" / name).read_bytes() == data
    assert json.loads((tmp_path / "out" / RECORD).read_text())["commit"] == "c0ffee"
    assert json.loads(pins.read_text())["files"] == made.files


def test_an_interrupted_download_goes_on(tmp_path: Path, pins: Path) -> None:
    out = tmp_path / "out"
    with pytest.raises(HwpError, match=r"the line went dead\)"):
        download_release(out, MemoryHub(FILES, stop_after=2), pins=pins)
    hub = MemoryHub(FILES)
    made = download_release(out, hub, pins=pins)
    assert made.kept == 2
    assert hub.fetched == list(FILES)[2:]
    again = MemoryHub(FILES)
    assert download_release(out, again, pins=pins).kept == 4
    assert again.fetched == []


def test_changed_bytes_are_refused_here_and_there(tmp_path: Path, pins: Path) -> None:
    download_release(tmp_path / "one", MemoryHub(FILES), pins=pins)
    changed = {**FILES, "README.md": b"evil!"}
    with pytest.raises(BadInput, match="pinned on first use"):
        download_release(tmp_path / "two", MemoryHub(changed), pins=pins)
    (tmp_path / "one" / "README.md").write_bytes(b"mine")
    with pytest.raises(BadInput, match="pinned on first use"):
        download_release(tmp_path / "one", MemoryHub(FILES), pins=pins)
    # Never replaced.
    assert (tmp_path / "one" / "README.md").read_bytes() == b"mine"


def test_what_the_hub_states_must_hold(tmp_path: Path, pins: Path) -> None:
    hub = MemoryHub({"a.pkl": b"x"})
    hub.files = lambda revision: ("c0ffee", [RemoteFile("a.pkl", 1, sha(b"y"))])  # type: ignore[method-assign]
    with pytest.raises(BadInput, match="stated by the hub"):
        download_release(tmp_path / "out", hub, pins=pins)
    assert not pins.exists()


@pytest.mark.parametrize("change", [{"files": {"README.md": 1}}, {"files": None}, {"schema": "?"}])
def test_damaged_pins_and_records_are_named(
    tmp_path: Path, pins: Path, change: dict[str, Any]
) -> None:
    download_release(tmp_path / "out", MemoryHub(FILES), pins=pins)
    for file, folder in (pins, "new"), (tmp_path / "out" / RECORD, "out"):
        content = file.read_text()
        file.write_text(json.dumps({**json.loads(content), **change}))
        with pytest.raises(BadInput, match=f"{file.name}: is not the record of a download"):
            download_release(tmp_path / folder, MemoryHub(FILES), pins=pins)
        file.write_text(content)
    assert not (tmp_path / "new").exists()


def test_a_folder_of_the_user_is_not_touched(tmp_path: Path, pins: Path) -> None:
    (tmp_path / "out").mkdir()
    (tmp_path / "out" / "thesis.tex").write_text("x")
    with pytest.raises(UsageError, match="exists already"):
        download_release(tmp_path / "out", MemoryHub(FILES), pins=pins)
    assert [path.name for path in (tmp_path / "out").iterdir()] == ["thesis.tex"]
    download_release(tmp_path / "other", MemoryHub(FILES), pins=pins)
    with pytest.raises(UsageError, match="already"):
        download_release(tmp_path / "other", MemoryHub(FILES), revision="v2", pins=pins)


def test_names_that_leave_the_folder_are_refused(tmp_path: Path, pins: Path) -> None:
    for name in ("../evil", "/etc/evil"):
        hub = MemoryHub({"good": b"1", name: b"2"})
        with pytest.raises(BadInput, match="leads out"):
            download_release(tmp_path / "out", hub, pins=pins)
        assert hub.fetched == []
        assert not (tmp_path / "out").exists()


def test_single_captures_can_be_chosen(tmp_path: Path, pins: Path) -> None:
    made = download_release(tmp_path / "out", MemoryHub(FILES), captures=["capture0_"], pins=pins)
    assert set(made.files) == set(list(FILES)[:2])
    with pytest.raises(UsageError, match="--capture"):
        download_release(tmp_path / "two", MemoryHub(FILES), captures=["capture9_"], pins=pins)


def fake_package(monkeypatch: pytest.MonkeyPatch) -> list[dict[str, Any]]:
    """A `huggingface_hub` that serves `FILES`."""
    calls: list[dict[str, Any]] = []
    module = types.ModuleType("huggingface_hub")

    class HfApi:
        def dataset_info(self, repo: str, *, revision: str | None, files_metadata: bool) -> Any:
            assert files_metadata
            rows = [
                types.SimpleNamespace(
                    rfilename=name, size=len(data), lfs={"sha256": sha(data), "size": len(data)}
                )
                for name, data in FILES.items()
            ]
            return types.SimpleNamespace(sha="c0ffee", siblings=rows)

    def hf_hub_download(repo: str, name: str, **options: Any) -> str:
        calls.append({"repo": repo, "name": name, **options})
        target = Path(options["local_dir"]) / name
        target.parent.mkdir(parents=True, exist_ok=True)
        target.write_bytes(FILES[name])
        return str(target)

    module.HfApi, module.hf_hub_download = HfApi, hf_hub_download  # type: ignore[attr-defined]
    monkeypatch.setitem(sys.modules, "huggingface_hub", module)
    return calls


def test_the_command_uses_the_hubs_own_client(tmp_path: Path, monkeypatch, capsys) -> None:
    calls = fake_package(monkeypatch)
    monkeypatch.setenv("HWP_CACHE", str(tmp_path / "cache"))
    out = tmp_path / "WildGHand"
    assert main(["data", "get", "hwp", "-o", str(out)]) == 0
    printed = capsys.readouterr().out
    assert f"{out}, 4 files, 0 of them existed before" in printed
    assert {(call["revision"], call["repo_type"]) for call in calls} == {("c0ffee", "dataset")}
    assert list((tmp_path / "cache" / "pins").iterdir())
    assert main(["data", "get", "hwp", "-o", str(out), "--json"]) == 0
    assert json.loads(capsys.readouterr().out)["kept"] == 4


@pytest.mark.parametrize(
    "words",
    [("real-1", "--out", "x"), ("real-1", "--capture", "capture0_"), ("real-1", "--revision", "v1"),
     ("hwp", "--from", "x")],
)  # fmt: skip
def test_options_of_the_other_data_set_are_refused(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys, words: tuple[str, ...]
) -> None:
    calls = fake_package(monkeypatch)
    monkeypatch.chdir(tmp_path)
    assert main(["data", "get", *words]) == 2
    assert f"{words[1]}: is not for {words[0]}" in capsys.readouterr().err
    assert not calls
    assert not list(tmp_path.iterdir())


def test_without_the_package_the_message_says_so(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "huggingface_hub", None)
    with pytest.raises(MissingDependency, match="pip install"):
        HuggingFaceHub()
