"""Kill -9 at random moments, start again, compare with the run that was left in peace.

Run from the repository: `python -m benchmarks.faults [--kills 200] [--only evaluate fit]`.
Four commands on the smallest of inputs: `sim render`, `evaluate` and `ablate` with a method of a
third party that needs nothing but numpy, and `wildghand fit` (which saves its state every 0.2 s
here, so that even a small fit is resumed). Only the command's own process is killed; what it
started must end by itself, and must not disturb the next start, which follows at once. Several
kills in a row may hit one output before it is finished and compared. Exit status 1 where a result
differs.
"""

from __future__ import annotations

import argparse
import hashlib
import json
import os
import random
import shutil
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import IO, Any

from benchmarks.patience import finish

#: Kills in a row before a run is left to finish.
IN_A_ROW = 5

_ROOT = Path(__file__).resolve().parents[1]
# What two runs of the same work may differ in: times, memory, and checkpoints, which come by time.
_LOOSE = {"started", "curve", "peak_memory", "environment", "seconds", "isolation"}
_METHOD = """
import time
import numpy as np
class Method:
    steps = 4
    def __init__(self, settings, seed):
        self.level = settings["level"] + 0.01 * seed
    def fit(self, training, budget, report):
        time.sleep(0.3)
        return self
    def render(self, hands, camera):
        return np.full((camera.height, camera.width, 4), self.level)
"""
_MANIFEST = """
schema = "hwp-method/1"
training = "none"
name = "gray"
[entry]
python = "gray_method:Method"
[presets.default]
level = 0.5
[switches.bright]
settings_off = { level = 0.2 }
"""
_FIT = (
    "import sys, wildghand.fitting.session as session; session.SAVE_EVERY = 0.2; "
    "from wildghand.cli.main import main; sys.exit(main())"
)


@dataclass(frozen=True)
class Target:
    """One command that is killed."""

    #: Name in the table.
    name: str
    #: Words after `python`, for an output place.
    words: Callable[[Path], Sequence[str]]
    #: Digest of everything that must be the same, of a finished output.
    digest: Callable[[Path], str]
    #: Whether the command refuses an output that is there: then that must be whole.
    refuses: bool


@dataclass(frozen=True)
class Tally:
    """What the kills of one command came to."""

    #: Name of the command.
    name: str
    #: Seconds of the run that was left in peace.
    seconds: float
    #: Kills that hit a running process.
    kills: int
    #: Outputs that were finished afterwards.
    finished: int
    #: What went wrong, a line each.
    faults: tuple[str, ...]


def make_targets(work: Path, seeds: int = 2) -> list[Target]:
    """Make the inputs in a folder and return the commands; one capture is rendered for it.

    Args:
        work: the folder.
        seeds: of the ablation, each of which is two evaluations.
    """
    method = work / "gray"
    method.mkdir(parents=True)
    (method / "gray_method.py").write_text(_METHOD)
    (method / "method.toml").write_text(_MANIFEST)
    capture = work / "capture0"
    bench = ["-m", "hwp_bench.cli.main"]
    render = [*bench, "sim", "render", "capture0", "--frame-count", "10", "--size", "48"]
    render += ["--workers", "1"]
    # Scores of a free-view clip would only take time.
    status, said = _finish([*render, "--no-free-view", "-o", str(capture)])
    if status:
        raise SystemExit(f"the capture could not be rendered: {said}")
    scored = [str(method), "--capture", str(capture)]
    # Bending and shadows come before the first step, and are a third of a run's time.
    changes = ("gaussians=400", "device=cpu", "subject.enabled=false", "shadows.enabled=false")
    small = ["--steps", "40", *(word for change in changes for word in ("--set", change))]
    return [
        Target("sim render", lambda out: [*render, "-o", str(out)], capture_digest, True),
        Target(
            "evaluate", lambda out: [*bench, "evaluate", *scored, "-o", str(out)], results_digest,
            False,
        ),
        Target(
            "ablate",
            lambda out: [
                *bench, "ablate", *scored, "--without", "bright", "--seeds", str(seeds),
                "-o", str(out),
            ],
            results_digest,
            False,
        ),
        Target(
            "wildghand fit",
            lambda out: ["-c", _FIT, "fit", str(capture), "-o", str(out), *small],
            avatar_digest,
            True,
        ),
    ]  # fmt: skip


def capture_digest(out: Path) -> str:
    """Digests of a capture and its clip, whose files are compared with what they should be."""
    from hwp_bench.capture import open_capture
    from hwp_bench.capture.check import check_capture

    wrong = [finding for finding in check_capture(out).findings if finding.level == "error"]
    if wrong:
        return f"damaged: {wrong[0].problem}"
    capture = open_capture(out)
    clip = capture.free_view
    return f"{capture.digest} {clip.digest if clip else 'without a free view'}"


def results_digest(out: Path) -> str:
    """Digest of every result file and kept prediction below a folder, times left out."""
    total = hashlib.sha256()
    for path in sorted(out.rglob("results.json")):
        content = json.loads(path.read_text())
        del content["digest"]  # of everything, times too
        text = json.dumps(_firm(content), sort_keys=True)
        total.update(f"{path.relative_to(out)}{text}".encode())
    for path in sorted(out.rglob("predictions/*.png")):
        total.update(str(path.relative_to(out)).encode() + path.read_bytes())
    return total.hexdigest()


def avatar_digest(out: Path) -> str:
    """Digest of an avatar's tensors and description, times left out."""
    text = json.dumps(_firm(json.loads((out / "avatar.json").read_text())), sort_keys=True)
    tensors = (out / "model.safetensors").read_bytes()
    return hashlib.sha256(text.encode() + tensors).hexdigest()


def _firm(value: Any) -> Any:
    if isinstance(value, dict):
        return {
            name: _firm(item)
            for name, item in value.items()
            if name not in _LOOSE and not name.endswith("_seconds")
        }
    return [_firm(item) for item in value] if isinstance(value, list) else value


def _start(words: Sequence[str], log: IO[bytes]) -> subprocess.Popen[bytes]:
    known = os.environ.get("PYTHONPATH")
    environment = {
        **os.environ,
        "PYTHONPATH": str(_ROOT) if not known else os.pathsep.join([str(_ROOT), known]),
    }
    # A file and no pipe: orphans of a killed run would keep a pipe open.
    return subprocess.Popen([sys.executable, *words], env=environment, stdout=log, stderr=log)


def _finish(words: Sequence[str]) -> tuple[int, str]:
    """Run a command to its end; returns its exit status and the line that says why."""
    with tempfile.TemporaryFile() as log:
        status = finish(_start(words, log))
        log.seek(0)
        lines = log.read().decode(errors="replace").strip().splitlines()
    reasons = [line for line in lines if "failed:" in line or "error:" in line]
    return status, (reasons or lines or [""])[-1]


def torture(target: Target, kills: int, work: Path, chance: random.Random) -> Tally:
    """Kill one command so many times, and compare every output that is finished afterwards."""
    begun = time.perf_counter()
    status, said = _finish(target.words(work / "peace"))
    seconds = time.perf_counter() - begun
    if status:
        return Tally(target.name, seconds, 0, 0, (f"fails unharmed: {said}",))
    expected = target.digest(work / "peace")
    done, finished = 0, 0
    faults: list[str] = []
    while done < kills:
        out = work / f"out-{done}"
        for _ in range(min(IN_A_ROW, kills - done)):
            done += _kill(target.words(out), chance.uniform(0.0, seconds))
            if target.refuses and out.exists():
                break
        if not (target.refuses and out.exists()):
            status, said = _finish(target.words(out))
            if status:
                faults.append(f"after kill {done}: status {status}: {said}")
                continue
        finished += 1
        if target.digest(out) != expected:
            faults.append(f"after kill {done}: another result")
        shutil.rmtree(out, ignore_errors=True)
    return Tally(target.name, seconds, done, finished, tuple(faults))


def _kill(words: Sequence[str], moment: float) -> int:
    """Start a command and kill it after so many seconds; returns 1 where it still ran."""
    with tempfile.TemporaryFile() as log:
        process = _start(words, log)
        try:
            process.wait(moment)
        except subprocess.TimeoutExpired:
            process.kill()
            process.wait()
            return 1
    return 0


def main(arguments: Sequence[str] | None = None) -> int:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else None)
    parser.add_argument("--kills", type=int, default=200, help="random moments in total")
    parser.add_argument("--seed", type=int, default=0, help="of the moments")
    parser.add_argument("--only", nargs="+", help="some of: sim render, evaluate, ablate, ...")
    args = parser.parse_args(arguments)
    print("| command | left in peace [s] | kills | finished after | other results or errors |")
    print("| --- | ---: | ---: | ---: | --- |", flush=True)
    faulty = 0
    with tempfile.TemporaryDirectory(prefix="hwp-faults-") as name:
        targets = make_targets(Path(name))
        chosen = [
            t for t in targets if not args.only or {t.name, t.name.split()[-1]} & {*args.only}
        ]
        for index, target in enumerate(chosen):
            share = args.kills // len(chosen) + (index < args.kills % len(chosen))
            work = Path(name) / target.name.replace(" ", "-")
            tally = torture(target, share, work, random.Random(f"{args.seed} {target.name}"))
            faulty += len(tally.faults)
            faults = "; ".join(tally.faults) or "none"
            print(
                f"| `{tally.name}` | {tally.seconds:.1f} | {tally.kills} | {tally.finished} "
                f"| {faults} |",
                flush=True,
            )
    return 1 if faulty else 0


if __name__ == "__main__":
    sys.exit(main())
