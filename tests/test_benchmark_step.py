"""Shares of a profiled step. Oracle: a computation whose two components are known by their work."""

from __future__ import annotations

import time
from typing import Any

import pytest
import torch
from torch.profiler import record_function

from benchmarks.step_shares import by_component, shares_of
from benchmarks.step_spans import COMPONENT, marked, profiled

#: The backward pass of the quick component.
QUICK = ("backward", "quick")


class Slow(torch.autograd.Function):
    """An operation of one's own that takes a millisecond forward and five backward."""

    @staticmethod
    def forward(ctx: Any, values: torch.Tensor) -> torch.Tensor:
        time.sleep(0.001)
        return values.clone()

    @staticmethod
    def backward(ctx: Any, gradient: torch.Tensor) -> torch.Tensor:
        time.sleep(0.005)
        return gradient.clone()


def test_backward_work_belongs_to_the_component_that_ran_forward() -> None:
    weight = torch.ones(4, requires_grad=True)
    with marked(), profiled() as profiler:
        began = time.perf_counter()
        with record_function(COMPONENT + "slow"):
            with torch.no_grad():
                weight * 3.0  # it makes no node, and has the number of the next one
            values = Slow.apply(weight * 2.0)
        with record_function(COMPONENT + "quick"):
            loss = (values * values).sum()
        loss.backward()
        seconds = time.perf_counter() - began
    shares = shares_of(profiler, seconds)
    table = by_component(shares)
    assert sum(sum(parts.values()) for parts in table.values()) == pytest.approx(1.0)
    assert table["slow"]["backward"] >= 0.005 / seconds
    assert table["slow"]["forward"] >= 0.001 / seconds
    assert shares["backward", "slow", "SlowBackward"] >= 0.005 / seconds
    quick = {operation for step_pass, where, operation in shares if (step_pass, where) == QUICK}
    assert {"MulBackward0", "SumBackward0"} <= quick
    assert "SlowBackward" not in quick
    assert table["quick"]["backward"] > 0.0


def test_an_optimizer_is_found_by_the_span_that_torch_opens() -> None:
    weight = torch.ones(4, requires_grad=True)
    optimizer = torch.optim.Adam([weight])
    with marked(), profiled() as profiler:
        began = time.perf_counter()
        weight.sum().backward()
        optimizer.step()
        seconds = time.perf_counter() - began
    assert by_component(shares_of(profiler, seconds))["optimizer"]["update"] > 0.0


def test_marks_go_away() -> None:
    before = torch.autograd.backward
    with marked():
        assert torch.autograd.backward is not before
    assert torch.autograd.backward is before
