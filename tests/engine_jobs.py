"""Jobs and methods for the engine's tests: importable from a process of their own."""

from __future__ import annotations

import os
import signal
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path

from hwp_bench.base.console import JobsView
from hwp_bench.base.errors import BadInput
from hwp_bench.run.engine import Folder, Job, Needs
from hwp_bench.run.engine.job import OnProgress


@dataclass(frozen=True)
class Write:
    """Writes a file; fails, dies or waits first where it is told to."""

    text: str
    #: `refuse`, `break`, or nothing.
    fault: str = ""
    #: Times that its process is killed before it gets through; counted in files there.
    deaths: int = 0
    #: Signal that it is killed by.
    by: int = signal.SIGKILL
    #: Where deaths are counted.
    graves: Path | None = None
    #: Seconds that it waits.
    seconds: float = 0.0

    def __call__(self, inputs: Mapping[str, Path], output: Path, on_progress: OnProgress) -> None:
        on_progress(1, 2)
        if self.fault == "refuse":
            raise BadInput("is wrong", where="a.png", field="x", remedy="Mend it.")
        if self.fault == "break":
            raise ZeroDivisionError("by nobody")
        if self.graves is not None and len(list(self.graves.iterdir())) < self.deaths:
            (self.graves / str(os.getpid())).touch()
            os.kill(os.getpid(), self.by)
            time.sleep(60)
        time.sleep(self.seconds)
        output.mkdir(parents=True, exist_ok=True)
        found = "".join((inputs[name] / "a.txt").read_text() for name in sorted(inputs))
        threads = os.environ.get("NUMBA_NUM_THREADS")
        (output / "out.txt").write_text(f"{self.text}{found} {threads}")


def write_job(folder: Path, work: Write, *inputs: Path, cpus: float = 1.0) -> Job:
    """A job whose result is `folder/TEXT/out.txt`."""
    output = folder / work.text
    folders = {str(number): path for number, path in enumerate(inputs)}
    return Job(
        text=work.text,
        here=lambda on_progress: work(folders, output, on_progress),
        work=work,
        output=output,
        finished=(output / "out.txt").is_file,
        inputs={name: Folder(path) for name, path in folders.items()},
        needs=Needs(cpus),
    )


def hold(holding: Path, release: Path) -> None:
    """Takes a processor of a node until `release` is there; `holding` tells that it has it."""
    holding.touch()
    while not release.exists():
        time.sleep(0.1)


class Told(JobsView):
    """A view that keeps what it is told."""

    def __init__(self) -> None:
        super().__init__(quiet=True)
        self.starts: list[tuple[int, str]] = []
        self.ends: dict[str, str | None] = {}
        self.said: list[str] = []
        self.on_steps: Callable[[int, str], None] = lambda index, place: None

    def start(self, index: int, text: str, place: str) -> None:
        self.starts.append((index, place))
        super().start(index, text, place)

    def steps(self, index: int, done: int, total: int) -> None:
        self.on_steps(index, dict(self.starts).get(index, ""))

    def end(self, index: int, text: str, problem: str | None = None) -> None:
        self.ends[text] = problem
        super().end(index, text, problem)

    def say(self, text: str) -> None:
        self.said.append(text)


_METHOD = """
import time
import numpy as np

STUCK = ""

class Gray:
    steps = 3
    def __init__(self, settings, seed):
        self.settings, self.seed = settings, seed
    def fit(self, training, budget, report):
        report.progress(1, 2)
        time.sleep(600 if STUCK and STUCK in __file__ else self.settings["seconds"])
        pixels = [training.frame(frame)[training.mask(frame) > 127] for frame in training.train]
        noise = np.random.default_rng(self.seed).normal(0, 0.02, 3)
        self.colour = np.concatenate(pixels).mean(axis=0) / 255 + noise
        if self.settings["flat"]:
            self.colour = np.full(3, self.colour.mean())
        return self
    def render(self, hands, camera):
        rgba = np.ones((camera.height, camera.width, 4))
        rgba[..., :3] = self.colour
        return rgba
"""

_MANIFEST = """
schema = "hwp-method/1"
training = "none"
name = "gray"
[entry]
python = "gray_method:Gray"
[presets.default]
flat = false
seconds = {seconds}
[switches.colour]
title = "Colour"
settings_off = {{flat = true}}
"""


def write_gray_method(folder: Path, seconds: float, stuck: str = "") -> Path:
    """A method of NumPy alone that waits, then paints the mean colour of the hand.

    Where its own file lies at a place with `stuck` in it, it waits until it is killed.
    """
    folder.mkdir()
    (folder / "gray_method.py").write_text(_METHOD.replace('STUCK = ""', f"STUCK = {stuck!r}"))
    (folder / "method.toml").write_text(_MANIFEST.format(seconds=seconds))
    return folder
