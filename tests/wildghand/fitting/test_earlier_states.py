"""States that a fit may go back to.

Oracles: the numbers of steps written out, an average that ends where a state was kept, and a search
over errors that are given.
"""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from odd_fits import part
from painted import SilentReport, TrainingMaker
from tiny_fits import UNJUDGED

from hwp_bench.capture.splits import Split
from hwp_bench.methods.contract import Budget, TrainingCapture
from wildghand.avatar.files import load_avatar, save_avatar
from wildghand.fitting.choice import AveragedSteps, StateChoice
from wildghand.fitting.components import make_fit
from wildghand.fitting.fit import Fit
from wildghand.model.settings import read_settings
from wildghand.plain.choice import Averaging, KeptStates
from wildghand.plain.loop import run_fit

CPU = torch.device("cpu")
#: Of two frames: a state is kept after 5, 10 and 20 steps.
FIT: dict[str, Any] = {**UNJUDGED, "schedule.steps": 20}


def counted(steps: int, first: int, share: float = 1.0) -> tuple[torch.Tensor, KeptStates]:
    """A fit whose tensor is the number of its step."""
    tensor = torch.zeros(3, dtype=torch.float64)
    average = Averaging([tensor], share)
    states = KeptStates(average, first)
    for step in range(1, steps + 1):
        tensor.fill_(step)
        average.take()
        states.take()
    average.put()
    return tensor, states


def place_of(tensor: torch.Tensor) -> float:
    """Steps behind a state of `counted`: the mean of 1 to t is (t + 1) / 2."""
    return 2.0 * float(tensor[0]) - 1.0


@given(steps=st.integers(0, 300), first=st.integers(1, 50))
def test_states_double_up_to_half_of_the_steps(steps: int, first: int) -> None:
    expected = [first * 2**k for k in range(10) if first * 2**k <= steps / 2]
    assert counted(steps, first)[1].candidates == expected[::-1]


@pytest.mark.parametrize("share", [0.0, 0.1, 1.0])
def test_a_state_is_the_mean_of_the_steps_until_then(share: float) -> None:
    tensor, states = counted(40, 5, share)
    states.go_back(lambda: abs(float(tensor[0]) - float(counted(10, 99, share)[0][0])))
    assert torch.equal(tensor, counted(10, 99, share)[0])


@given(errors=st.lists(st.floats(0.0, 1.0), min_size=4, max_size=4))
def test_it_goes_back_as_long_as_errors_fall(errors: list[float]) -> None:
    """Steps 40, 20, 10 and 5 have the four errors."""
    places = [40, 20, 10, 5]
    tensor, states = counted(40, 5)
    asked = []

    def error() -> float:
        asked.append(round(place_of(tensor)))
        return errors[places.index(asked[-1])]

    states.go_back(error)
    last = next((k for k in range(3) if errors[k + 1] >= errors[k]), 3)
    assert (states.chosen or 40) == places[last] == round(place_of(tensor))
    # One error beyond the best is looked at, and none after that.
    assert asked == places[: min(last + 2, 4)]


def test_an_error_that_is_not_finite_is_never_gone_back_to() -> None:
    tensor, states = counted(40, 5)
    states.go_back(lambda: 1.0 if place_of(tensor) == 40 else math.nan)
    assert states.chosen is None
    assert place_of(tensor) == 40


def test_a_short_fit_asks_for_nothing() -> None:
    tensor, states = counted(9, 5)
    states.go_back(lambda: pytest.fail("nothing is to be chosen"))
    assert states.chosen is None
    assert place_of(tensor) == 9
    states.forget()
    assert states.candidates == []


def test_a_saved_state_goes_on_as_if_never_stopped(tmp_path: Path) -> None:
    tensor, states = counted(23, 5)
    torch.save(states.state_dict(), tmp_path / "state.pt")
    average = Averaging([tensor], 1.0)
    again = KeptStates(average, 5)
    again.load_state_dict(torch.load(tmp_path / "state.pt", weights_only=True))
    assert again.candidates == states.candidates == [10, 5]
    for _ in range(17):
        again.take()
    assert again.candidates == [20, 10, 5]
    again.go_back(lambda: abs(place_of(tensor) - 10))
    assert place_of(tensor) == 10


@pytest.fixture
def training(make_training: TrainingMaker) -> TrainingCapture:
    """Two frames are fitted, six are for validation."""
    made = make_training()
    first, last = made.split.test[[0, -1]].tolist()
    made.split = Split(made.id, last + 1, (0, 2), (first - 6, first), (first, last + 1))
    made._train = made.split.train
    return made


def fitted(
    training: TrainingCapture,
    monkeypatch: pytest.MonkeyPatch,
    wanted: int,
    budget: Budget | None = None,
    **changes: Any,
) -> tuple[Fit, Any, dict[int, list[torch.Tensor]]]:
    """A fit in which a state draws the validation frames best, its avatar, and its means."""
    fit = make_fit(training, read_settings({**FIT, **changes}), 0, CPU)
    means: dict[int, list[torch.Tensor]] = {}

    def error() -> float:
        now = part(fit, AveragedSteps).now()
        for step, mean in means.items():
            if all(torch.equal(a, b) for a, b in zip(now, mean, strict=True)):
                return abs(math.log(step / wanted))
        pytest.fail("the tensors are no state of the fit")

    def watch(step: int, watchers: object, loss: object) -> None:
        means[step] = part(fit, AveragedSteps).values()

    monkeypatch.setattr(StateChoice, "error", lambda choice: error())
    report = SilentReport()
    return fit, run_fit(fit, budget or Budget(), report, after_step=watch), means


def test_a_fit_ends_with_the_state_that_draws_validation_frames_best(
    training: TrainingCapture,
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    fit, avatar, means = fitted(training, monkeypatch, 5)
    assert part(fit, StateChoice).candidates == [10, 5]
    assert all(
        torch.equal(a, b) for a, b in zip(part(fit, AveragedSteps).now(), means[5], strict=True)
    )
    assert (avatar.record.steps, avatar.record.chosen_steps) == (20, 5)
    assert "The state of step 5 draws the validation frames best" in capsys.readouterr().err
    again = load_avatar(save_avatar(avatar, tmp_path / "avatar"))
    assert again.record.chosen_steps == 5


def test_the_error_is_that_of_the_validation_frames(training: TrainingCapture) -> None:
    fit = make_fit(training, read_settings(FIT), 0, CPU)
    judges = part(fit, StateChoice).judges
    assert judges is not None
    assert judges.frames.indices.tolist() == training.validation.tolist()
    # Visibility is chosen after the state.
    assert fit.model.visibility is not None
    expected = judges.error(judges.predict_all(), None, None)
    assert part(fit, StateChoice).error() == expected > 0.0


@pytest.mark.parametrize(
    "changes", [{"schedule.validated": False}, {"mode": "paper", "schedule.epochs": 0}]
)
def test_without_the_choice_a_fit_ends_with_its_last_state(
    changes: dict[str, Any], training: TrainingCapture, monkeypatch: pytest.MonkeyPatch
) -> None:
    changes = {**changes, "schedule.batch": 1}
    fit, avatar, means = fitted(training, monkeypatch, 5, **changes)
    assert avatar.record.chosen_steps is None
    assert all(
        torch.equal(a, b) for a, b in zip(part(fit, AveragedSteps).now(), means[20], strict=True)
    )
    assert fit.part(StateChoice) is None


def test_the_seconds_of_the_choice_are_left_out_of_the_steps(
    training: TrainingCapture, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The report's clock runs one second for each step, and one for the start."""
    monkeypatch.setattr(Fit, "seconds_for_steps", lambda fit, seconds: seconds)
    monkeypatch.setattr(
        StateChoice, "seconds_now", lambda choice, fit: 3.0 * (len(choice.candidates) > 0)
    )
    _, avatar, _ = fitted(training, monkeypatch, 20, Budget(seconds=16.0))
    assert avatar.record.steps == 16 - 1 - 3


def test_seconds_are_asked_for_once_there_are_states(training: TrainingCapture) -> None:
    fit = make_fit(training, read_settings(FIT), 0, CPU)
    assert part(fit, StateChoice).seconds_now(fit) == 0.0
    for _ in range(10):
        part(fit, AveragedSteps).take()
        part(fit, StateChoice).take()
    assert part(fit, StateChoice).candidates == [5]
    before = {name: value.clone() for name, value in fit.model.state_dict().items()}
    assert part(fit, StateChoice).seconds_now(fit) > 0.0
    assert all(torch.equal(value, before[name]) for name, value in fit.model.state_dict().items())
