"""Kernels are made ready before a fit, and its clock leaves that out.

Oracles: which versions numba holds before and after a fit, and a clock that jumps while kernels are
made ready.
"""

from __future__ import annotations

import json
import os
import subprocess
import sys
import time
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import pytest
import torch
from painted import SilentReport
from tiny_fits import BARE, QUICK

from hwp_bench.capture import Capture
from hwp_bench.methods.contract import Budget, TrainingCapture
from hwp_bench.methods.request import open_request
from hwp_bench.run import worker
from hwp_bench.run.worker import RUN, read_facts
from wildghand.fitting import session
from wildghand.fitting.components import make_fit
from wildghand.fitting.fit import Fit
from wildghand.fitting.method import WildGHandMethod, ready_fit
from wildghand.gaussians.fit_loop import Loss
from wildghand.model.settings import read_settings

#: Settings that call other kernels, or the same ones in another way.
VARIANTS: tuple[dict[str, Any], ...] = (
    {},
    {"mode": "paper", "schedule.epochs": 0},
    {"pao.variant": "binary"},
    {"mode": "released", "schedule.epochs": 0},
    {"schedule.batch": 4},
    {"dpd.enabled": False},
    {"heads": False},
    {"prepass.enabled": False},
)
_PROGRAM = """
import json, sys
from test_ready import made_within_fits
print(json.dumps(made_within_fits(sys.argv[1:])))
"""


def made_within_fits(requests: list[str]) -> list[str]:
    """Versions that fits made or loaded after their start: all variants, then two on both hands."""
    found: list[str] = []
    for request, variants in zip(requests, (VARIANTS, VARIANTS[:2]), strict=True):
        training = open_request(Path(request))
        for changes in variants:
            method = WildGHandMethod({**QUICK, **changes}, 0)
            before = versions()
            avatar = method.fit(training, Budget(steps=2), SilentReport())
            avatar.render(training.hand_poses(0), training.camera(0))
            found += [name for name, count in versions().items() if count > before.get(name, 0)]
    return found


def versions() -> dict[str, int]:
    """How many versions of each compiled function of the toolkit this process holds."""
    found = {}
    for name, module in list(sys.modules.items()):
        if name.split(".")[0] in ("wildghand", "hwp_bench"):
            for attribute, value in list(vars(module).items()):
                dispatcher = getattr(value, "dispatcher", value)
                if hasattr(dispatcher, "nopython_signatures"):
                    found[f"{name}.{attribute}"] = len(dispatcher.nopython_signatures)
    return found


def test_a_step_compiles_nothing(make_training: Callable[..., TrainingCapture]) -> None:
    device = ready_fit("cpu")
    settings = read_settings({"gaussians": 600, "device": "cpu"})
    fit = make_fit(make_training(), settings, 0, device)
    before = versions()
    assert sum(before.values()) > 20
    for _ in range(2 * settings.schedule.texture_every):
        fit.step(torch.tensor([0]), 0.9)
    after = {name: count for name, count in versions().items() if count}
    assert after == {name: count for name, count in before.items() if count}


@pytest.mark.slow
def test_no_setting_compiles_on_the_clock(make_training: Callable[..., TrainingCapture]) -> None:
    requests = [str(make_training(hands).root) for hands in ("right", "both")]
    done = subprocess.run(
        [sys.executable, "-c", _PROGRAM, *requests],
        env={**os.environ, "PYTHONPATH": os.pathsep.join(map(str, sys.path))},
        cwd=Path(__file__).parent,
        stdout=subprocess.PIPE,
        check=True,
    )
    assert json.loads(done.stdout) == []


class Jump:
    """A clock that jumps when it is told to."""

    def __init__(self) -> None:
        self.ahead = 0.0

    def perf_counter(self) -> float:
        """Seconds."""
        return time.perf_counter() + self.ahead


def test_a_slow_compiler_is_not_in_the_seconds_of_wildghand_fit(
    make_painted: Callable[..., Capture],
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    jump = Jump()

    def slow(name: str) -> torch.device:
        jump.ahead += 1e6
        return ready_fit(name)

    monkeypatch.setattr(session, "time", jump)
    monkeypatch.setattr(session, "ready_fit", slow)
    avatar = session.fit_capture(make_painted().root, settings=BARE, budget=Budget(steps=2))
    assert 0.0 < avatar.record.seconds < 1e5
    (line,) = [
        line for line in capsys.readouterr().err.splitlines() if line.startswith("Kernels ready")
    ]
    assert float(line.partition(" s,")[0].rpartition(" ")[2]) >= 1e6


def test_preparation_counts_once_in_the_seconds_of_wildghand_fit(
    make_painted: Callable[..., Capture], monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    jump = Jump()

    def slow(*given: Any) -> Fit:
        jump.ahead += 1e6
        return make_fit(*given)

    def stop(fit: Fit, step: int, loss: Loss) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr(session, "time", jump)
    monkeypatch.setattr(session, "make_fit", slow)
    monkeypatch.setattr(session, "SAVE_EVERY", 0.0)
    source, out = make_painted().root, tmp_path / "avatar"
    given: dict[str, Any] = {"settings": BARE, "budget": Budget(seconds=1e6 + 1e5, steps=2)}
    with pytest.raises(KeyboardInterrupt):
        session.fit_capture(source, out, watch=stop, **given)
    record = session.fit_capture(source, out, **given).record
    assert record.steps == 2
    assert 1e6 < record.seconds < 1e6 + 1e5


def test_a_slow_compiler_is_not_in_the_seconds_of_an_evaluation(
    make_training: Callable[..., TrainingCapture], monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    jump = Jump()

    def slow(settings: Mapping[str, Any], seed: int) -> WildGHandMethod:
        method = WildGHandMethod({**BARE, "schedule.steps": 2}, seed)
        jump.ahead += 1e6
        return method

    monkeypatch.setattr(worker, "time", jump)
    worker.run(make_training(), slow, tmp_path / "out", worker.render_checked)
    facts = read_facts(tmp_path / "out" / RUN)
    assert facts.steps == 2
    assert facts.fit_seconds is not None
    assert 0.0 < facts.fit_seconds < 1e5
    assert facts.ready_seconds is not None
    assert facts.ready_seconds >= 1e6


def test_getting_ready_and_a_step_leave_torchs_compiler_out() -> None:
    # It takes two seconds to import; a step of torch's own optimizers would.
    program = """
import sys
import torch
from wildghand.fitting.method import ready_fit
from wildghand.gaussians.adam import ClippedAdam
from wildghand.gaussians.fit_loop import repeatable
with repeatable(ready_fit("cpu")):
    value = torch.ones(3, requires_grad=True)
    value.sum().backward()
    ClippedAdam([{"params": [value], "lr": 0.1}]).take_step(torch.ones(()))
assert float(value.sum()) < 3.0
print([name for name in ("torch._dynamo", "torch._inductor") if name in sys.modules])
"""
    made = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True)
    assert made.stdout.strip() == "[]", made.stderr
