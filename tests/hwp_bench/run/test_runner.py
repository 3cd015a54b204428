"""Methods run apart: crashes, hangs, floods of output end as one error."""

from __future__ import annotations

import json
import sys
import time
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from small_methods import SCRIPT, write_manifest

from hwp_bench.base.errors import MethodFailed
from hwp_bench.evaluation.scoring import read_prediction
from hwp_bench.methods.contract import Budget
from hwp_bench.methods.manifest import MethodManifest, read_manifest
from hwp_bench.run import worker
from hwp_bench.run.runner import DEFAULT_TIME_LIMIT, run_method
from hwp_bench.run.sandbox.supervise import MAX_LOG_BYTES
from hwp_bench.run.worker import ReportClock, checkpoint_times, cpu_seconds

PYTHON = """
import numpy as np

class Avatar:
    def __init__(self, colour): self.colour = colour
    def render(self, hands, camera):
        rgba = np.ones((camera.height, camera.width, 4), np.float32)
        rgba[..., :3] = self.colour
        return rgba

class Method:
    def __init__(self, settings, seed): self.settings = settings
    def fit(self, training, budget, report):
        total = np.zeros(3)
        for step, frame in enumerate(training.train):
            total += training.frame(frame)[training.mask(frame) > 127].mean(0) / 255
            report(step, Avatar(total / (step + 1)))
            report.progress(step + 1, len(training.train))
        BODY
        return Avatar(total / len(training.train))
"""


def python_method(folder: Path, body: str = "pass") -> MethodManifest:
    """A method that paints the mean colour of the hand; `body` runs at the end of its fit."""
    folder.mkdir(parents=True, exist_ok=True)
    (folder / "mean_colour.py").write_text(PYTHON.replace("BODY", body))
    write_manifest(folder, "mean", 'python = "mean_colour:Method"')
    return read_manifest(folder)


def command_method(folder: Path, script: str) -> MethodManifest:
    """A method that is a Python script outside the contract's classes."""
    folder.mkdir(parents=True, exist_ok=True)
    (folder / "run.py").write_text(script)
    write_manifest(folder, "command", SCRIPT)
    return read_manifest(folder)


def _run(
    manifest: MethodManifest, request: Path, tmp_path: Path, limit: float = DEFAULT_TIME_LIMIT
):
    return run_method(manifest, "tiny", request, tmp_path / "output", time_limit=limit)


def test_a_python_method_fits_and_renders(request_folder: Path, tmp_path: Path) -> None:
    record = _run(python_method(tmp_path / "m"), request_folder, tmp_path)
    colours = [read_prediction(record.predictions, f, (32, 32)).pixels[0, 0] for f in (18, 19)]
    np.testing.assert_array_equal(colours[0], colours[1])
    assert 100 < colours[0][0] < 200
    facts = record.facts
    assert facts.fit_seconds > 0
    assert facts.render_seconds > 0
    assert facts.peak_memory > 10**7
    # The last of the 16 steps that it reports, of which few are checkpoints.
    assert facts.steps == 15
    assert facts.device == "cpu"
    assert facts.checkpoints[-1].seconds == facts.fit_seconds
    assert facts.checkpoint_frames == [16, 17]


def test_a_method_that_uses_a_gpu_need_not_say_so(request_folder: Path, tmp_path: Path) -> None:
    # In the place of a GPU, what torch says once it has begun to use one.
    body = (
        "import sys; sys.modules['torch.cuda'] = type("
        "'', (), {'is_initialized': lambda: True, 'synchronize': lambda: None})"
    )
    record = _run(python_method(tmp_path / "m", body), request_folder, tmp_path)
    assert record.facts.device == "cuda"


def test_the_clock_waits_for_what_a_gpu_was_told(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    # Two seconds of work are queued when the checkpoint is taken; drawing would wait for them.
    now, queued = [100.0], [2.0]

    def wait() -> None:
        now[0] += queued.pop() if queued else 0.0

    gpu = SimpleNamespace(is_initialized=lambda: True, synchronize=wait)
    monkeypatch.setitem(sys.modules, "torch.cuda", gpu)
    monkeypatch.setattr(worker, "time", SimpleNamespace(perf_counter=lambda: now[0]))
    clock = ReportClock(Budget(), lambda index, avatar: wait(), tmp_path / "progress.json")
    clock.take(1, None)  # type: ignore[arg-type]
    assert (clock.elapsed, clock.paused) == (2.0, 0.0)


def test_steps_after_the_returned_state_were_taken_too(
    request_folder: Path, tmp_path: Path
) -> None:
    body = "back = Avatar(total / len(training.train)); back.steps = 3; return back"
    facts = _run(python_method(tmp_path / "m", body), request_folder, tmp_path).facts
    assert facts.checkpoints[-1].step == 3
    assert facts.steps == 15


def test_three_channels_are_as_good_as_four(request_folder: Path, tmp_path: Path) -> None:
    # Oracle: the same method with a coverage channel.
    pictures = []
    for name, body in (("four", "pass"), ("three", "Avatar.render = rgb")):
        manifest = python_method(tmp_path / name, body)
        with open(tmp_path / name / "mean_colour.py", "a") as stream:
            stream.write(
                "def rgb(self, hands, camera):\n"
                "    return np.broadcast_to(self.colour, (camera.height, camera.width, 3))\n"
            )
        record = run_method(manifest, "tiny", request_folder, tmp_path / f"{name}-output")
        pictures.append(read_prediction(record.predictions, 18, (32, 32)).pixels)
    np.testing.assert_array_equal(*pictures)


def test_a_command_fits_and_renders(request_folder: Path, tmp_path: Path) -> None:
    script = """
import json, pathlib, shutil, sys
request, output = map(pathlib.Path, sys.argv[1:])
split = json.loads((request / "request.json").read_text())["split"]
(output / "predictions").mkdir()
for frame in range(*split["test"]):
    shutil.copy(request / "frames/000000.png", output / f"predictions/{frame:06d}.png")
"""
    record = _run(command_method(tmp_path / "m", script), request_folder, tmp_path)
    assert read_prediction(record.predictions, 19, (32, 32)).failure is None
    assert record.facts.fit_seconds is None
    assert record.wall_seconds > 0


@pytest.mark.parametrize(
    ("body", "problem"),
    [
        ("import os; os._exit(3)", "exit status 3"),
        ("import os; os.kill(os.getpid(), 9)", "killed by SIGKILL"),
        ("return None", "AttributeError"),
        ("Avatar.render = lambda *a: np.zeros((5, 5, 4))", r"shape \(5, 5, 4\)"),
        ("return Avatar(np.nan)", "NaN or infinity"),
        ("import sys; sys.exit(0)", "ended before"),
        ("import sys; sys.exit('a reason')", "a reason"),
        ("raise type('Own', (BaseException,), {})('a reason')", "Own: a reason"),
        ("raise ValueError('a reason \\ud800')", r"ValueError: a reason \?"),
        ("Avatar.render = lambda *a: np.zeros((32, 32, 3), complex)", "complex128, not real"),
    ],
)
def test_crashes_are_named(request_folder: Path, tmp_path: Path, body: str, problem: str) -> None:
    manifest = python_method(tmp_path / "m", body)
    with pytest.raises(MethodFailed, match=problem):
        _run(manifest, request_folder, tmp_path)


def test_a_frame_that_cannot_be_rendered_costs_only_itself(
    request_folder: Path, tmp_path: Path
) -> None:
    body = """
        last, colour = training.hand_poses(19), total / len(training.train)
        def render(self, hands, camera):
            same = all(np.array_equal(hands[side].pose, last[side].pose) for side in last)
            return np.full((camera.height, camera.width, 3), np.nan if same else 0.5)
        Avatar.render = render"""
    record = _run(python_method(tmp_path / "m", body.lstrip()), request_folder, tmp_path)
    found = [read_prediction(record.predictions, frame, (32, 32)) for frame in (18, 19)]
    assert (found[0].pixels == 128).all()
    assert found[1].pixels is None
    assert "frame 19: render returned NaN" in (tmp_path / "output" / "log.txt").read_text()


def test_a_method_that_hangs_is_stopped(request_folder: Path, tmp_path: Path) -> None:
    method = command_method(tmp_path / "m", "import time; time.sleep(600)")
    with pytest.raises(MethodFailed, match=r"ran out of time on tiny after 1\.5 s"):
        _run(method, request_folder, tmp_path, limit=1.5)


def test_megabytes_of_output_keep_both_ends(request_folder: Path, tmp_path: Path) -> None:
    # Oracle: the bytes that were printed, cut by hand.
    script = "print('start', 'x' * 5_000_000, 'the reason')\nraise SystemExit(4)"
    with pytest.raises(MethodFailed, match="exit status 4"):
        _run(command_method(tmp_path / "m", script), request_folder, tmp_path)
    log = (tmp_path / "output" / "log.txt").read_bytes()
    printed = b"start " + b"x" * 5_000_000 + b" the reason\n"
    half = MAX_LOG_BYTES // 2
    gap = f"\n[{len(printed) - 2 * half} bytes in the middle were not kept]\n".encode()
    assert log == printed[:half] + gap + printed[-half:]


def test_output_that_fits_is_kept_as_it_is(request_folder: Path, tmp_path: Path) -> None:
    script = f"import sys\nsys.stdout.write('y' * {MAX_LOG_BYTES})\nraise SystemExit(4)"
    with pytest.raises(MethodFailed):
        _run(command_method(tmp_path / "m", script), request_folder, tmp_path)
    assert (tmp_path / "output" / "log.txt").read_bytes() == b"y" * MAX_LOG_BYTES


def test_the_schedule_is_dense_at_the_start_then_every_tenth() -> None:
    assert checkpoint_times(Budget(seconds=10.0)) == [1, 2, 3, 4, 5, 6, 7, 8, 9]
    assert checkpoint_times(Budget())[:5] == [1, 2, 4, 8, 16]
    assert checkpoint_times(Budget(seconds=0.5)) == pytest.approx([0.05 * k for k in range(1, 10)])


def test_the_clock_stands_still_while_a_checkpoint_is_taken(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    now, taken = [100.0], []
    monkeypatch.setattr("hwp_bench.run.worker.time", SimpleNamespace(perf_counter=lambda: now[0]))

    def record(index: int, avatar: object) -> None:
        now[0] += 0.25
        taken.append(index)

    clock = ReportClock(Budget(), record, tmp_path / "p.json")
    now[0] += 0.5
    clock.take(5, None)  # type: ignore[arg-type]
    assert clock.elapsed == 0.5
    assert clock.paused == 0.25
    assert taken == [0]
    assert clock.checkpoints[0].step == 5
    assert clock.checkpoints[0].seconds == 0.5
    clock(6, None)  # type: ignore[arg-type]
    assert taken == [0]


def test_cpu_seconds_are_of_the_fit_and_leave_checkpoints_out(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    spent = [7.0]
    monkeypatch.setattr("hwp_bench.run.worker.cpu_seconds", lambda: spent[0])

    def record(index: int, avatar: object) -> None:
        spent[0] += 0.25

    clock = ReportClock(Budget(), record, tmp_path / "p.json")
    spent[0] += 3.0
    clock.take(5, None)  # type: ignore[arg-type]
    spent[0] += 1.0
    assert clock.cpu_seconds == 4.0
    monkeypatch.undo()
    # What the system counts grows by about what a busy loop takes, in this thread or another.
    before, began = cpu_seconds(), time.thread_time()
    while time.thread_time() - began < 0.05:
        pass
    assert cpu_seconds() - before >= 0.04


def test_a_budget_in_steps_is_checkpointed_every_tenth(tmp_path: Path) -> None:
    clock = ReportClock(Budget(steps=40), lambda index, avatar: None, tmp_path / "p.json")
    # The first offer is the unfitted avatar: it is always recorded.
    for step in range(41):
        clock(step, None)  # type: ignore[arg-type]
    assert [checkpoint.step for checkpoint in clock.checkpoints] == list(range(0, 40, 4))


def test_steps_may_be_integers_of_numpy(tmp_path: Path) -> None:
    # Oracle: the records and the file that Python's own integers make.
    clock = ReportClock(Budget(), lambda index, avatar: None, tmp_path / "p.json")
    for step in (np.int64(0), np.int32(3)):
        clock(step, None)  # type: ignore[arg-type]
    clock.take(np.uint8(4), None)  # type: ignore[arg-type]
    assert [type(checkpoint.step) for checkpoint in clock.checkpoints] == [int, int]
    assert json.dumps([checkpoint.step for checkpoint in clock.checkpoints]) == "[0, 4]"
    assert clock.last == 4
