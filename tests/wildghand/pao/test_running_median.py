"""The running median. Oracles: numbers by hand, numpy's median."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from wildghand.pao.pao import LEAST, RATE, running_median


def test_it_starts_at_the_first_and_follows() -> None:
    counted = torch.ones(2, 3, dtype=torch.bool)
    first = running_median(None, torch.full((2, 3), 0.1), counted)
    assert first == pytest.approx(0.1)
    second = running_median(first, torch.full((2, 3), 0.2), counted)
    assert second == pytest.approx(0.1 + RATE * 0.1)


def test_what_does_not_count_changes_nothing() -> None:
    nothing = torch.zeros(2, 3, dtype=torch.bool)
    assert running_median(0.3, torch.ones(2, 3), nothing) == 0.3
    assert running_median(None, torch.ones(2, 3), nothing) == LEAST
    everything = ~nothing
    for value in (float("inf"), float("nan")):
        assert running_median(0.3, torch.full((2, 3), value), everything) == 0.3
    assert running_median(None, torch.zeros(2, 3), everything) == LEAST


@settings(max_examples=30, deadline=None)
@given(st.integers(1, 40), st.integers(0, 5))
def test_the_newest_is_numpys_lower_median(count: int, seed: int) -> None:
    random = np.random.default_rng(seed)
    errors = random.uniform(0.01, 1.0, count)
    counted = random.uniform(size=count) < 0.7
    counted[0] = True
    found = running_median(None, torch.from_numpy(errors), torch.from_numpy(counted))
    expected = np.quantile(errors[counted], 0.5, method="lower")
    assert float(found) == pytest.approx(expected, rel=1e-12)


def test_the_same_where_nobody_waits() -> None:
    """The code of other devices, run on the CPU through its own function."""
    from wildghand.pao.pao import _on_device

    random = np.random.default_rng(1)
    errors = torch.from_numpy(random.uniform(0.0, 1.0, (3, 7)))
    errors[0, 0] = torch.inf
    counted = torch.from_numpy(random.uniform(size=(3, 7)) < 0.5)
    for previous in (None, 0.4):
        expected = running_median(previous, errors, counted)
        found = _on_device(previous, errors, counted & errors.isfinite())
        assert float(found) == pytest.approx(float(expected), rel=1e-12)
    assert float(_on_device(None, errors, torch.zeros_like(counted))) == LEAST
    # Segment Anything may find no region in a frame.
    none = torch.zeros(1, 0)
    for previous in (None, 0.3, torch.tensor(0.3, dtype=torch.float64)):
        expected = running_median(previous, none, none.bool())
        assert float(_on_device(previous, none, none.bool())) == pytest.approx(float(expected))
