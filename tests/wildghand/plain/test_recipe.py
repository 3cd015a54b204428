"""The hooks of the plain fit. Oracles: a recipe that changes nothing, and one by construction."""

from __future__ import annotations

from typing import Any, ClassVar

import pytest
import torch
from painted import QUICK, SilentReport, TrainingMaker

from hwp_bench.base.errors import DidNotConverge
from hwp_bench.methods.contract import Budget
from wildghand.gaussians.training import load_frames
from wildghand.plain.loop import WINDOW, run_fit
from wildghand.plain.model import PlainAvatar
from wildghand.plain.recipe import Batch, Drawing, FitInputs, FitSettings, PlainRecipe, RecipeMethod


class FrameGain(PlainRecipe[FitSettings]):
    """One factor for each frame, and a record of the order of the hooks."""

    def __init__(self, material: FitInputs, settings: FitSettings) -> None:
        super().__init__(material, settings)
        self.log_gains = torch.zeros(len(material.frames))
        self.calls: list[str] = []

    def parameters(self) -> dict[str, torch.Tensor]:
        return {**super().parameters(), "log_gains": self.log_gains}

    def rates(self) -> dict[str, float]:
        return {**super().rates(), "log_gains": 0.05}

    def draw(self, batch: Batch) -> Drawing:
        self.calls.append("draw")
        drawn = super().draw(batch)
        return Drawing(
            drawn.image * self.log_gains[batch.rows].exp()[:, None, None, None], drawn.coverage
        )

    def weights(self, batch: Batch, drawing: Drawing) -> torch.Tensor:
        self.calls.append("weights")
        return super().weights(batch, drawing)

    def loss(self, batch: Batch, drawing: Drawing, weights: torch.Tensor) -> torch.Tensor:
        self.calls.append("loss")
        return super().loss(batch, drawing, weights)

    def move_back(self, batch: Batch) -> None:
        self.calls.append("move_back")
        super().move_back(batch)


class GainMethod(RecipeMethod):
    name: ClassVar[str] = "gain"
    recipe_type: ClassVar[type[PlainRecipe[Any]]] = FrameGain


def gain_recipe(make_training: TrainingMaker, **settings: Any) -> FrameGain:
    training = make_training()
    method = GainMethod({**QUICK, **settings})
    material = FitInputs(training, load_frames(training), 0, method.device)
    return FrameGain(material, method.settings)


def test_the_loop_calls_the_hooks_in_order(make_training: TrainingMaker) -> None:
    recipe = gain_recipe(make_training)
    run_fit(recipe, Budget(steps=3), SilentReport())
    assert recipe.calls == ["draw", "weights", "loss", "move_back"] * 3


def test_a_recipe_s_own_tensors_are_fitted(make_training: TrainingMaker) -> None:
    """Frames that are made darker ask for a gain below the others'."""
    recipe = gain_recipe(make_training)
    dark = 5
    recipe.material.frames.images[:dark] //= 2
    run_fit(recipe, Budget(steps=150), SilentReport())
    gains = recipe.log_gains.exp()
    assert gains[:dark].max() < 0.8 * gains[dark:].median()
    assert not any(value.requires_grad for value in recipe.parameters().values())


def test_without_changes_a_recipe_is_the_plain_fit_bit_for_bit(
    make_training: TrainingMaker,
) -> None:
    """A hook that draws the same must not change a bit of the other tensors."""
    training = make_training()

    class Same(PlainRecipe[FitSettings]):
        def draw(self, batch: Batch) -> Drawing:
            return super().draw(batch)

    class SameMethod(RecipeMethod):
        name = "same"
        recipe_type = Same

    class Plain(RecipeMethod):
        name = "plain"

    fits = [
        method(QUICK, 2).fit(training, Budget(steps=10), SilentReport())
        for method in (SameMethod, Plain)
    ]
    assert all(isinstance(fit, PlainAvatar) for fit in fits)
    for name, value in fits[0].model.parameters().items():
        assert torch.equal(value, fits[1].model.parameters()[name]), name


def test_a_fit_that_diverges_later_goes_back_to_its_best_state(
    make_training: TrainingMaker,
) -> None:
    """After 100 steps the drawing is no number; the state of a window's end must come back."""

    class Breaking(FrameGain):
        def draw(self, batch: Batch) -> Drawing:
            drawn = super().draw(batch)
            if batch.step < 100:
                return drawn
            return Drawing(drawn.image * float("nan"), drawn.coverage)

    training = make_training()
    method = GainMethod(QUICK)
    recipe = Breaking(FitInputs(training, load_frames(training), 0, method.device), method.settings)
    avatar = run_fit(recipe, Budget(steps=200), SilentReport())
    assert isinstance(avatar, PlainAvatar)
    assert avatar.steps in (50, 100)
    assert recipe.finite()


class Slopeless(FrameGain):
    """Some steps have a finite loss whose gradient is not finite.

    Attributes:
        broken: these steps, by number.
        states: what each of them left.
    """

    broken = range(3, 4)

    def __init__(self, material: FitInputs, settings: FitSettings) -> None:
        super().__init__(material, settings)
        self.states: dict[int, dict[str, torch.Tensor]] = {}

    def loss(self, batch: Batch, drawing: Drawing, weights: torch.Tensor) -> torch.Tensor:
        loss = super().loss(batch, drawing, weights)
        if batch.step in self.broken:
            loss = loss + (0.0 * self.log_gains).sqrt().sum()
        return loss

    def after_step(self) -> None:
        self.states[len(self.states)] = self.snapshot()
        super().after_step()


def slopeless(make_training: TrainingMaker, broken: range) -> Slopeless:
    plain = gain_recipe(make_training, validated=False)
    recipe = Slopeless(plain.material, plain.settings)
    recipe.broken = broken
    return recipe


def test_a_step_whose_gradient_is_no_number_is_skipped(
    make_training: TrainingMaker, capsys: pytest.CaptureFixture[str]
) -> None:
    """Oracles: nothing moves in that step, everything in the next; the fit is as long as asked."""
    recipe = slopeless(make_training, range(3, 4))
    avatar = run_fit(recipe, Budget(steps=6), SilentReport())
    assert isinstance(avatar, PlainAvatar)
    assert avatar.steps == 6
    assert recipe.skipped() == 1
    assert recipe.calls.count("move_back") == 5
    kept, states = recipe.states[2], recipe.states
    assert all(torch.equal(value, kept[name]) for name, value in states[3].items())
    assert not torch.equal(states[4]["offsets"], kept["offsets"])
    assert "1 of 6 steps were skipped" in capsys.readouterr().err


def test_only_a_window_of_skipped_steps_ends_a_fit(make_training: TrainingMaker) -> None:
    """49 of the second window's 50 steps are skipped, then all of them."""
    recipe = slopeless(make_training, range(WINDOW, 2 * WINDOW - 1))
    assert run_fit(recipe, Budget(steps=120), SilentReport()).steps == 120  # type: ignore[attr-defined]
    recipe = slopeless(make_training, range(WINDOW, 2 * WINDOW))
    assert run_fit(recipe, Budget(steps=120), SilentReport()).steps == WINDOW  # type: ignore[attr-defined]


def test_a_fit_that_diverges_at_once_says_so(make_training: TrainingMaker) -> None:
    recipe = gain_recipe(make_training, light_rate=1e30, offset_rate=1e30)
    with pytest.raises(DidNotConverge, match="diverged"):
        run_fit(recipe, Budget(), SilentReport())
