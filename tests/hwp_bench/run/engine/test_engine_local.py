"""Jobs in turn and side by side. Oracles: files that the jobs write, counts of their deaths."""

from __future__ import annotations

import signal
from pathlib import Path

import psutil
import pytest
from engine_jobs import Told, Write, write_job

from hwp_bench.base.errors import BadInput, HwpError, UsageError
from hwp_bench.run.engine import Engine, LocalEngine, Needs, processes
from hwp_bench.run.engine.processes import ParallelEngine, divide_gpus


def texts(folder: Path) -> dict[str, str]:
    return {path.parent.name: path.read_text() for path in sorted(folder.glob("*/out.txt"))}


def test_in_turn_jobs_run_in_order_and_stop_at_the_first_failure(tmp_path: Path) -> None:
    jobs = [
        write_job(tmp_path, Write(name, fault))
        for name, fault in (("c", ""), ("a", ""), ("b", "refuse"), ("d", ""))
    ]
    began, done = [], []

    def on_start(index: int, count: int, text: str):
        began.append((index, count, text))
        return lambda steps, total: began.append((steps, total))

    with pytest.raises(BadInput, match=r"a\.png: x: is wrong\. Mend it\."):
        LocalEngine().run(jobs, done.append, on_start)
    assert began == [(0, 4, "c"), (1, 2), (1, 4, "a"), (1, 2), (2, 4, "b"), (1, 2)]
    assert done == [0, 1]
    assert set(texts(tmp_path)) == {"c", "a"}


@pytest.mark.parametrize("engine", [LocalEngine(), ParallelEngine(2)])
def test_both_engines_leave_the_same_files(
    engine: Engine, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("NUMBA_NUM_THREADS", "1")
    source = tmp_path / "source"
    source.mkdir()
    (source / "a.txt").write_text("!")
    jobs = [write_job(tmp_path / "out", Write(f"job{n}"), source) for n in range(3)]
    done: list[int] = []
    with engine:
        engine.run(jobs, done.append)
    assert sorted(done) == [0, 1, 2]
    assert texts(tmp_path / "out") == {f"job{n}": f"job{n}! 1" for n in range(3)}


def test_side_by_side_a_failure_waits_for_the_others(tmp_path: Path) -> None:
    faults = ["", "refuse", "break", ""]
    jobs = [write_job(tmp_path, Write(f"job{n}", fault)) for n, fault in enumerate(faults)]
    view, done = Told(), []
    with pytest.raises(HwpError, match="the first of 2 failures in 4 jobs"):
        ParallelEngine(2, view).run(jobs, done.append)
    assert sorted(done) == [0, 3]
    assert set(texts(tmp_path)) == {"job0", "job3"}
    assert view.ends["job1"] == "a.png: x: is wrong. Mend it."
    assert view.ends["job2"] == "a job broke: ZeroDivisionError: by nobody"
    assert view.ends["job0"] is None


def test_finished_jobs_do_not_run_and_threads_follow_the_needs(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.delenv("NUMBA_NUM_THREADS", raising=False)
    jobs = [write_job(tmp_path, Write(name), cpus=3) for name in ("old", "new")]
    jobs[0].output.mkdir()
    (jobs[0].output / "out.txt").write_text("kept")
    done: list[int] = []
    ParallelEngine(2).run(jobs, done.append)
    assert sorted(done) == [0, 1]
    assert texts(tmp_path) == {"old": "kept", "new": "new 3"}


@pytest.mark.parametrize(
    ("by", "reason"), [(signal.SIGKILL, "SIGKILL"), (signal.SIGTERM, "interrupted")]
)
def test_a_job_whose_process_is_killed_starts_again_but_not_for_ever(
    tmp_path: Path, by: int, reason: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    graves = tmp_path / "graves"
    graves.mkdir()
    view = Told()
    jobs = [write_job(tmp_path / "out", Write("job", deaths=2, by=by, graves=graves))]
    ParallelEngine(
        1,
        view,
    ).run(jobs, lambda index: None)
    assert len(list(graves.iterdir())) == 2
    assert len(view.starts) == 3
    assert sum("again, its worker was lost" in text for text in view.said) == 2
    jobs = [write_job(tmp_path / "out", Write("other", deaths=9, by=by, graves=graves))]
    monkeypatch.setattr(processes, "RETRIES", 1)
    with pytest.raises(HwpError, match=rf"'other' was lost 2 times \({reason}\)"):
        ParallelEngine(1).run(jobs, lambda index: None)
    assert set(texts(tmp_path / "out")) == {"job"}


def test_a_stop_ends_the_jobs_and_leaves_what_was_finished(tmp_path: Path) -> None:
    jobs = [write_job(tmp_path, Write("quick")), write_job(tmp_path, Write("slow", seconds=600))]

    def stop(index: int) -> None:
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        ParallelEngine(2).run(jobs, stop)
    assert set(texts(tmp_path)) == {"quick"}
    left = [child.cmdline() for child in psutil.Process().children(recursive=True)]
    assert not [
        words for words in left if any("hwp_bench.run.engine.processes" in word for word in words)
    ]


def test_gpus_are_divided_or_refused() -> None:
    cards = ["4", "5", "6", "7"]
    visible = [
        share.get("CUDA_VISIBLE_DEVICES") for share in divide_gpus(4, Needs(gpus=0.5), cards)
    ]
    assert visible == ["4", "4", "5", "5"]
    visible = [share.get("CUDA_VISIBLE_DEVICES") for share in divide_gpus(2, Needs(gpus=2), cards)]
    assert visible == ["4,5", "6,7"]
    assert divide_gpus(3, Needs(), []) == [{}, {}, {}]
    with pytest.raises(UsageError, match="5 jobs of 1 GPUs at once need 5 GPUs, and there are 4"):
        divide_gpus(5, Needs(gpus=1), cards)
