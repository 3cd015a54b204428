"""When a fit counts as diverged, and what is kept then: by construction."""

from __future__ import annotations

import math

import pytest
import torch
from painted import painted_avatar

from hwp_bench.base.errors import DidNotConverge
from wildghand.gaussians.fit_loop import repeatable
from wildghand.plain.loop import FEWEST, MAX_RISE, WINDOW, Watchers
from wildghand.plain.model import PlainModel


@pytest.fixture(scope="module")
def model() -> PlainModel:
    return painted_avatar(("right",)).model


class Fitted:
    """A model as the watchers see a fit, and the steps that it says it has skipped."""

    def __init__(self, model: PlainModel, skipped: int = 0) -> None:
        self.finite, self.snapshot = model.finite, model.snapshot
        self.number = skipped

    def skipped(self) -> int:
        return self.number


def watch_window(
    guard: Watchers, model: PlainModel, start: int, loss: float, skipped: int = 0
) -> list[bool]:
    fitted = Fitted(model, skipped)
    return [guard.watch(start + i, loss, fitted) for i in range(WINDOW)]


def test_falling_loss_is_fine_and_the_last_window_is_kept(model: PlainModel) -> None:
    guard = Watchers()
    assert all(watch_window(guard, model, 0, 1.0) + watch_window(guard, model, WINDOW, 0.5))
    assert guard.step == 2 * WINDOW - 1


def test_a_loss_that_rises_far_is_divergence_and_the_best_state_is_kept(model: PlainModel) -> None:
    guard = Watchers()
    watch_window(guard, model, 0, 1.0)
    kept = model.light.clone()
    changed = model.with_parameters({**model.parameters(), "light": model.light + 1.0})
    assert not all(watch_window(guard, changed, WINDOW, 1.01 * MAX_RISE))
    assert guard.step == WINDOW - 1
    assert torch.equal(guard.best().light, kept)


def test_the_kept_state_is_a_copy(model: PlainModel) -> None:
    guard = Watchers()
    live = model.snapshot()
    watch_window(guard, live, 0, 1.0)
    live.light.add_(5.0)
    assert torch.equal(guard.best().light, model.light)


@pytest.mark.parametrize("loss", [math.nan, math.inf])
def test_a_loss_that_is_no_number_is_divergence(model: PlainModel, loss: float) -> None:
    assert not Watchers().watch(0, loss, model)


def test_a_parameter_that_is_no_number_is_divergence(model: PlainModel) -> None:
    guard = Watchers()
    watch_window(guard, model, 0, 1.0)
    broken = model.snapshot()
    broken.gaussians.offsets[3, 1] = math.nan
    assert not all(watch_window(guard, broken, WINDOW, 0.9))
    assert torch.isfinite(guard.best().gaussians.offsets).all()


def test_a_model_that_is_broken_since_the_last_window_is_not_sound(model: PlainModel) -> None:
    guard = Watchers()
    watch_window(guard, model, 0, 1.0)
    guard.watch(WINDOW, 0.9, Fitted(model))
    assert guard.sound(Fitted(model))
    broken = model.snapshot()
    broken.gaussians.offsets[3, 1] = math.nan
    assert not guard.sound(Fitted(broken))


def test_a_window_of_skipped_steps_alone_is_divergence(model: PlainModel) -> None:
    guard = Watchers()
    assert all(watch_window(guard, model, 0, 1.0, skipped=WINDOW - 1))
    assert all(watch_window(guard, model, WINDOW, 1.0, skipped=2 * WINDOW - 2))
    assert not all(watch_window(guard, model, 2 * WINDOW, 1.0, skipped=3 * WINDOW - 2))
    assert guard.step == WINDOW - 1
    again = Watchers()
    again.load_state_dict(guard.state_dict())
    assert all(watch_window(again, model, 3 * WINDOW, 1.0, skipped=3 * WINDOW - 2))


def test_a_short_fit_that_skipped_every_step_is_not_sound(model: PlainModel) -> None:
    guard = Watchers()
    assert guard.sound(Fitted(model))
    for step in range(3):
        guard.watch(step, 1.0, Fitted(model))
    assert guard.sound(Fitted(model, 2))
    assert not guard.sound(Fitted(model, 3))


@pytest.mark.parametrize(
    ("steps", "loss", "skipped", "sound"),
    [
        (FEWEST, 1.01 * MAX_RISE, 0, False),
        (FEWEST, 0.99 * MAX_RISE, 0, True),
        (FEWEST - 1, 1.01 * MAX_RISE, 0, True),
        (2, 1.01 * MAX_RISE, 1, False),
        (2, 0.99 * MAX_RISE, 2, True),
    ],
)
def test_a_loss_that_rose_far_since_the_last_window_is_not_sound(
    model: PlainModel, steps: int, loss: float, skipped: int, sound: bool
) -> None:
    guard = Watchers()
    watch_window(guard, model, 0, 1.0, skipped=3)
    for step in range(steps):
        guard.watch(WINDOW + step, loss, Fitted(model, 3))
    assert guard.sound(Fitted(model, 3 + skipped)) == sound


def test_without_any_good_state_there_is_only_the_error() -> None:
    with pytest.raises(DidNotConverge, match="first 50 steps"):
        Watchers().best()


def test_gradients_of_large_reads_repeat_on_several_threads() -> None:
    # Oracle: one thread. Many readers of few rows, so that threads meet at every row.
    generator = torch.Generator().manual_seed(0)
    values = torch.randn(64, 32, generator=generator)
    index = torch.randint(64, (200_000,), generator=generator)
    weights = torch.randn(200_000, 32, generator=generator)

    def gradient() -> torch.Tensor:
        table = values.clone().requires_grad_()
        with repeatable(table.device):
            (table[index] * weights).sum().backward()
        assert table.grad is not None
        return table.grad

    threads = torch.get_num_threads()
    try:
        torch.set_num_threads(1)
        expected = gradient()
        torch.set_num_threads(4)
        assert all(torch.equal(gradient(), expected) for _ in range(5))
    finally:
        torch.set_num_threads(threads)
    assert not torch.are_deterministic_algorithms_enabled()
