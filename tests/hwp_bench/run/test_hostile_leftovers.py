"""Hostile leftovers: what a method leaves in its output, or submits, that is not what it should be.

Nothing that they try would do harm if it succeeded. Oracle: the files themselves, and the messages.
"""

from __future__ import annotations

import json
import sys
import time
from pathlib import Path

import numpy as np
import pytest
from hostile import folder_of, hostile_method
from small_methods import SUBMISSION, write_manifest

from hwp_bench.base.errors import MethodFailed
from hwp_bench.evaluation.scoring import read_prediction
from hwp_bench.methods.contract import RunSettings
from hwp_bench.methods.manifest import read_manifest
from hwp_bench.run.runner import rehearse_method, run_method
from hwp_bench.run.sandbox import supervise
from hwp_bench.run.sandbox.confinement import Confinement

MODES = ("required", "none")
pytestmark = pytest.mark.skipif(sys.platform != "linux", reason="process control is Linux's")


@pytest.mark.parametrize("mode", MODES)
def test_links_and_pipes_in_the_output_are_not_followed(attack, tmp_path: Path, mode: str) -> None:
    frame = folder_of(tmp_path / "capture") / "000018.png"
    frame.write_bytes(b"a test frame")
    script = f"""
output = pathlib.Path(sys.argv[2])
(output / "predictions").mkdir()
(output / "predictions/000018.png").symlink_to({str(frame)!r})
(output / "checkpoints").symlink_to({str(frame.parent)!r})
(output / "run.json").symlink_to("/dev/zero")
os.mkfifo(output / "progress.json")
time.sleep(0.5)
"""
    record, _ = attack(script, mode)
    assert record.facts.fit_seconds is None
    left = sorted(path.name for path in (tmp_path / "output").rglob("*"))
    assert [name for name in left if name != "home"] == ["log.txt", "predictions"]
    assert frame.read_bytes() == b"a test frame"


def test_a_log_that_became_a_link_is_not_passed_on(attack, tmp_path: Path) -> None:
    secret = folder_of(tmp_path / "home") / "secret"
    secret.write_text("s3cret")
    script = f"""
log = pathlib.Path(sys.argv[2]) / "log.txt"
log.unlink()
log.symlink_to({str(secret)!r})
"""
    with pytest.raises(FileNotFoundError):  # by the test's own look at the log
        attack(script, "none")
    assert secret.read_text() == "s3cret"


@pytest.mark.parametrize("mode", MODES)
def test_a_log_that_is_opened_late_leads_nowhere(
    attack, tmp_path: Path, mode: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A busy machine lets the method run before the log's reader: it may not choose the file."""
    secret = folder_of(tmp_path / "home") / "secret"
    secret.write_text("s3cret")
    honest = supervise._drain

    def late(*arguments) -> None:
        time.sleep(1.0)
        honest(*arguments)

    monkeypatch.setattr(supervise, "_drain", late)
    script = f"""
log = pathlib.Path(sys.argv[2]) / "log.txt"
log.unlink(missing_ok=True)
log.symlink_to({str(secret)!r})
print("overwritten")
"""
    with pytest.raises(FileNotFoundError):  # by the test's own look at the log
        attack(script, mode)
    assert secret.read_text() == "s3cret"


@pytest.mark.parametrize("mode", MODES)
@pytest.mark.parametrize("left", ["link", "pipe"])
def test_a_rehearsal_reads_nothing_that_was_put_in_its_place(
    tmp_path: Path, mode: str, left: str, capsys: pytest.CaptureFixture[str]
) -> None:
    secret = folder_of(tmp_path / "home") / "secret"
    secret.write_text("s3cret\n" * 3)
    put = f"os.symlink({str(secret)!r}, name)" if left == "link" else "os.mkfifo(name)"
    method = folder_of(tmp_path / "method")
    (method / "odd.py").write_text(
        f"""
import os
for name in ("log.txt", "failure.json"):
    if os.path.lexists(name):
        os.unlink(name)
    {put}
os._exit(1)
"""
    )
    write_manifest(method, "odd", 'python = "odd:Method"')
    with pytest.raises(MethodFailed, match="cannot be made: exit status 1"):
        rehearse_method(read_manifest(method), RunSettings(), confinement=Confinement(mode))
    assert "s3cret" not in capsys.readouterr().err


@pytest.mark.parametrize("which", ["frame", "folder"])
def test_a_submission_of_links_is_refused(tmp_path: Path, which: str) -> None:
    from hwp_bench.base.errors import BadInput
    from hwp_bench.base.images import write_image

    sealed = folder_of(tmp_path / "sealed")
    write_image(sealed / "000018.png", np.full((8, 8, 3), 9, np.uint8))
    method = folder_of(tmp_path / "entry")
    write_manifest(method, "links", SUBMISSION)
    folder = method / "predictions" / "tiny"
    folder.parent.mkdir()
    if which == "folder":
        folder.symlink_to(sealed)
        with pytest.raises(BadInput, match="leads out of the folder"):
            run_method(read_manifest(method), "tiny", tmp_path, tmp_path / "output")
    else:
        folder.mkdir()
        (folder / "000018.png").symlink_to(sealed / "000018.png")
        record = run_method(read_manifest(method), "tiny", tmp_path, tmp_path / "output")
        assert read_prediction(record.predictions, 18, (8, 8)).failure == "000018.png: is a link"


@pytest.mark.parametrize("form", ["zip", "tar"])
def test_an_archive_is_no_method(tmp_path: Path, form: str) -> None:
    import shutil

    from hwp_bench.base.errors import BadMethod
    from hwp_bench.methods.manifest import find_method

    method = hostile_method(tmp_path / "method", "")
    archive = shutil.make_archive(str(tmp_path / "archive"), form, method)
    with pytest.raises(BadMethod, match="is not a method directory"):
        read_manifest(find_method(archive))


@pytest.mark.parametrize(
    "forged",
    [
        {"checkpoint_frames": [7] * 100_000},
        {"checkpoints": [{"step": 1, "seconds": 1.0, "peak_memory": 1}] * 5_000},
        {"checkpoint_frames": [-1]},
        {"fit_seconds": -1.0},
        {"peak_memory": 9223372036854775807},
        {"device": "x" * 1_000_000},
    ],
    ids=["frames", "checkpoints", "negative frame", "negative", "memory", "device"],
)
def test_a_forged_run_costs_nothing(attack, forged: dict) -> None:
    script = f"pathlib.Path(sys.argv[2], 'run.json').write_text({json.dumps(json.dumps(forged))})\n"
    with pytest.raises(MethodFailed, match=r"run\.json that cannot be read") as caught:
        attack(script, "none")
    assert len(str(caught.value)) < 1_000


def test_nothing_that_a_method_leaves_stops_the_next_run(attack, tmp_path: Path) -> None:
    script = """
here = os.open(sys.argv[2], os.O_RDONLY)
for _ in range(3000):
    os.mkdir("d", dir_fd=here)
    inner = os.open("d", os.O_RDONLY, dir_fd=here)
    os.close(here)
    here = inner
closed = pathlib.Path(sys.argv[2], "predictions")
closed.mkdir()
(closed / "000000.png").touch()
closed.chmod(0)
print(json.dumps({"done": True}))
"""
    for _ in range(2):
        record, said = attack(script, "none")
        assert said["done"]
        assert [path.name for path in record.predictions.iterdir()] == ["000000.png"]
