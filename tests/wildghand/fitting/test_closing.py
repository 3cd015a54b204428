"""The end of a fit: light and weight masks. Oracles: a clock of known cost, the fit left alone."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
import torch
from painted import TrainingMaker

from hwp_bench.methods.contract import TrainingCapture
from wildghand.fitting import fit as fitting
from wildghand.fitting import light as closing
from wildghand.fitting.components import make_fit
from wildghand.fitting.fit import Fit
from wildghand.model.settings import read_settings


def begun(training: TrainingCapture, **changes: Any) -> Fit:
    quick = {"gaussians": 300, "network.identity_resolution": 24, "network.plane_resolution": 12}
    return make_fit(training, read_settings({**quick, **changes}), 0, torch.device("cpu"))


@pytest.fixture
def fit(make_training: TrainingMaker) -> Fit:
    return begun(make_training("right"))


def test_the_light_gets_the_seconds_that_it_takes(
    fit: Fit, monkeypatch: pytest.MonkeyPatch
) -> None:
    now = 100.0

    def slow(fit: Fit, frames: int, count: int) -> int:
        nonlocal now
        now += 0.5 + 0.1 * frames
        return count

    monkeypatch.setattr(closing, "light_samples", slow)
    monkeypatch.setattr(closing, "fit_light", lambda samples: None)
    monkeypatch.setattr(closing.time, "perf_counter", lambda: now)
    whole = 0.5 + 0.1 * len(fit.data.frames)
    assert fit.seconds_for_steps(60.0) == pytest.approx(60.0 - whole)
    # A short budget is not spent on the light alone.
    assert fit.seconds_for_steps(2.0) == 1.0


def test_looking_ahead_changes_nothing_of_the_fit(fit: Fit) -> None:
    before = {name: value.clone() for name, value in fit.model.state_dict().items()}
    random = torch.get_rng_state()
    assert 0.0 < fit.seconds_for_steps(1000.0) < 1000.0
    after = fit.model.state_dict()
    assert after.keys() == before.keys()
    assert all(torch.equal(after[name], before[name]) for name in before)
    assert torch.equal(random, torch.get_rng_state())


def test_without_light_all_seconds_are_for_steps(make_training: TrainingMaker) -> None:
    fit = begun(make_training("right"), **{"light.enabled": False, "visibility.enabled": False})
    assert fit.seconds_for_steps(7.0) == 7.0


def test_weight_masks_are_made_when_they_are_asked_for(
    fit: Fit, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(fitting, "MAX_MASKS", 3)
    calls: list[int] = []
    draw = fit.draw
    monkeypatch.setattr(fit, "draw", lambda batch: calls.append(int(batch.rows[0])) or draw(batch))
    avatar = fit.avatar(0, final=True)
    assert not calls
    frames = fit.data.frames.indices.tolist()
    assert sorted(avatar.weight_masks) == [frames[row] for row in sorted(calls)]
    assert (calls[0], calls[-1], len(calls)) == (0, len(frames) - 1, 3)
    mask = avatar.weight_masks[frames[0]]
    assert mask.dtype == np.uint8
    assert mask.shape == fit.data.frames.images.shape[1:3]
    assert len(calls) == 3
    assert not fit.avatar(0).weight_masks
