"""The strengths of visibility and fill are chosen. Oracles: the avatar's own pictures as truth."""

from __future__ import annotations

import copy
import dataclasses
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import cv2
import numpy as np
import pytest
import torch
from odd_fits import a_light, odd_fit, part
from painted import TrainingMaker
from tiny_fits import UNJUDGED

from hwp_bench.capture.splits import Split
from hwp_bench.methods.contract import TrainingCapture
from wildghand.avatar.files import load_avatar, save_avatar
from wildghand.fitting.choice import StateChoice
from wildghand.fitting.colors import FilledColors
from wildghand.fitting.data import FitData
from wildghand.fitting.fit import Fit
from wildghand.fitting.visibility import FewShown, Gaps
from wildghand.gaussians.training import LEAST_CHOOSING, load_validation_frames
from wildghand.model.dress import Gaussians
from wildghand.model.frames import rasterize_hands
from wildghand.visibility import (
    ColorChanges,
    Visibility,
    VisibilitySettings,
    fill_shares,
    strengths,
    weigh_visibility,
)

QUICK: dict[str, Any] = {**UNJUDGED, "light.enabled": False}


def begun(training: TrainingCapture, **changes: Any) -> Fit:
    """A fit whose Gaussians stand off the skin, as chance wills."""
    return odd_fit(training, {**QUICK, **changes})


@pytest.fixture
def training(make_training: TrainingMaker) -> TrainingCapture:
    """Six of the painted frames are for validation."""
    made = make_training()
    first, last = made.split.test[[0, -1]].tolist()
    made.split = Split(made.id, last + 1, (0, first - 6), (first - 6, first), (first, last + 1))
    made._train = made.split.train
    return made


def spared(fit: Fit, index: int) -> Visibility:
    """The visibility of one of the strengths, without the Gaussians that close gaps."""
    several, choice = strengths(fit.settings.visibility), part(fit, FewShown)
    visibility = [
        weigh_visibility(choice.shown, len(fit.data.frames), each).without(choice.unseen)
        for each in several
    ]
    # The third opens the most: it asks for four times the frames.
    return visibility[index].spare(choice.gaps.closers(visibility[2])).without(choice.unseen)


def drawn_with(fit: Fit, training: TrainingCapture, index: int) -> np.ndarray:
    """(F, H, W, 3) validation frames as the avatar draws them with one of the strengths."""
    before = fit.model.visibility
    fit.model.visibility = spared(fit, index)
    avatar = fit.avatar(0)
    images = [
        avatar.render(training.hand_poses(frame), training.camera(frame))[..., :3]
        for frame in training.validation.tolist()
    ]
    fit.model.visibility = before
    return np.clip(np.stack(images), 0.0, 1.0)


def error_with(
    choice: FewShown, visibility: Visibility | None, colors: ColorChanges | None
) -> float:
    """The error of all validation frames as they are drawn with both."""
    drawings = choice.judges
    assert drawings is not None
    return drawings.error(drawings.predict_all(), visibility, colors)


def judged_by(choice: FewShown, images: torch.Tensor) -> FewShown:
    """The same choice, with (F, H, W, 3) uint8 images as the truth."""
    choice, drawings = copy.copy(choice), choice.judges
    assert drawings is not None
    frames = dataclasses.replace(drawings.frames, images=images)
    choice.judges = dataclasses.replace(drawings, frames=frames)
    return choice


def test_errors_are_those_of_the_avatars_pictures(training: TrainingCapture) -> None:
    fit = begun(training)
    judges = part(fit, FewShown).judges
    assert judges is not None
    frames = judges.frames
    erode = np.ones((3, 3), np.uint8)
    inside = [cv2.erode((mask > 127).astype(np.uint8), erode) for mask in frames.masks.numpy()]
    hand = np.stack(inside)[..., None]
    truth = frames.images.numpy() / 255.0
    for index in range(len(strengths(fit.settings.visibility))):
        off = (drawn_with(fit, training, index) - truth) ** 2 * hand
        expected = off.sum() / hand.sum() / 3.0
        found = error_with(part(fit, FewShown), spared(fit, index), None)
        assert found == pytest.approx(expected, rel=1e-4)


@pytest.mark.parametrize("index", range(4))
def test_the_strength_that_draws_the_frames_best_is_chosen(
    index: int, training: TrainingCapture
) -> None:
    fit = begun(training)
    images = torch.from_numpy((255.0 * drawn_with(fit, training, index)).round().astype(np.uint8))
    choice = judged_by(part(fit, FewShown), images)
    (visibility,) = choice.best(fit)
    assert isinstance(visibility, Visibility)
    assert visibility.equals(spared(fit, index))
    fit.model.keep(visibility)
    assert choice.best(fit) == []  # the model has it already


def test_gaussians_stay_as_learnt_where_that_draws_the_frames_much_better(
    training: TrainingCapture,
) -> None:
    fit = begun(training)
    learnt = spared(fit, 0).spare_all().without(part(fit, FewShown).unseen)
    before, fit.model.visibility = fit.model.visibility, learnt
    avatar = fit.avatar(0)
    drawn = [
        avatar.render(training.hand_poses(frame), training.camera(frame))[..., :3]
        for frame in training.validation.tolist()
    ]
    fit.model.visibility = before
    images = torch.from_numpy((255.0 * np.clip(np.stack(drawn), 0.0, 1.0)).round().astype(np.uint8))
    (visibility,) = judged_by(part(fit, FewShown), images).best(fit)
    assert isinstance(visibility, Visibility)
    assert visibility.equals(learnt)
    for side, unseen in part(fit, FewShown).unseen.items():
        assert torch.equal(visibility.shapes[side] == 0.0, unseen)
        assert torch.equal(visibility.shapes[side] == 1.0, ~unseen)


def test_a_wall_in_the_way_is_left_out_and_stays_out_of_a_file(
    training: TrainingCapture, tmp_path: Path
) -> None:
    fit = begun(training)
    side = next(iter(fit.model.rigs))
    assert fit.model.wall(side) is not None
    opened = dataclasses.replace(spared(fit, 0), open_wrists=frozenset({side}))
    fit.model.keep(opened)
    assert fit.model.wall(side) is None
    save_avatar(fit.avatar(0), tmp_path / "avatar")
    assert load_avatar(tmp_path / "avatar").model.wall(side) is None

    # The error of a drawing with walls is twice that without.
    class Walls:
        def predict_all(self) -> dict[int, Any]:
            return {}

        def error(self, _: Any, visibility: Visibility, __: Any) -> float:
            return 1.0 if side in visibility.open_wrists else 2.0

    choice = part(fit, FewShown)
    choice.judges = Walls()  # type: ignore[assignment]
    fit.model.keep(spared(fit, 0))
    (visibility,) = choice.best(fit)
    assert isinstance(visibility, Visibility)
    assert visibility.equals(opened)


def test_visibility_has_no_say_in_the_choice_of_a_state(training: TrainingCapture) -> None:
    fit = odd_fit(training, {**QUICK, "schedule.validated": True})
    expected = part(fit, StateChoice).error()
    discs = weigh_visibility(
        {side: torch.zeros_like(count) for side, count in part(fit, FewShown).shown.items()},
        len(fit.data.frames),
        fit.settings.visibility,
    )
    fit.model.keep(discs)
    assert part(fit, StateChoice).error() == expected


class GapModel:
    """Nine Gaussians side by side and a tenth apart from them, which visibility takes away."""

    def __init__(self) -> None:
        self.rigs = {"right": range(10)}
        self.log_gains = torch.zeros(1, 3)
        self.visibility: Visibility | None = None

    def cast(self, hands: Any) -> dict[str, torch.Tensor]:
        """No shadows."""
        return {}

    def predict_hand(self, side: str, hand: Any, viewmats: None) -> Any:
        """What `dressed` takes."""
        return hand

    def dressed(self, side: str, hand: Any, **options: Any) -> tuple[Gaussians, Any]:
        """Fill a square of 12 px on the left; the last one is a spot on the right."""
        grid = torch.tensor([-8.0, -4.0, 0.0])
        means = torch.stack(
            [*torch.meshgrid(grid - 4.0, grid + 4.0, indexing="ij"), torch.full((3, 3), 32.0)], -1
        ).reshape(1, 9, 3)
        far = means[:, :1] if self.visibility is not None else torch.tensor([[[10.0, 0.0, 32.0]]])
        made = Gaussians(
            means=torch.cat([means, far], dim=1),
            quats=torch.tensor([1.0, 0.0, 0.0, 0.0]).expand(1, 10, 4),
            scales=torch.full((10, 3), 2.0),
            opacities=torch.full((10,), 0.95),
            colors=torch.full((1, 10, 3), 0.5),
        )
        return made, hand

    def rasterize(self, found: Any, *camera: Any) -> tuple[torch.Tensor, torch.Tensor]:
        """Draw them."""
        return rasterize_hands([made for made, _ in found.values()], *camera)


@pytest.mark.parametrize("seen", [True, False])
def test_gaussians_that_close_a_gap_are_found(seen: bool) -> None:
    model, frames = GapModel(), 3
    camera = torch.tensor([[32.0, 0.0, 16.0], [0.0, 32.0, 16.0], [0.0, 0.0, 1.0]])
    clip = SimpleNamespace(
        parameters={"right": (torch.zeros(frames, 16, 3), torch.zeros(10), torch.zeros(frames, 3))},
        viewmats=torch.eye(4).expand(frames, 4, 4),
        Ks=camera.expand(frames, 3, 3),
    )
    visible = torch.full((1, 32, 32), float(seen))
    gaps = Gaps(model, clip, lambda rows: visible, frames)  # type: ignore[arg-type]
    found = gaps.closers(Visibility({}, {}))["right"]
    assert found.tolist() == [False] * 9 + [seen]
    assert model.visibility is None


def test_all_of_what_is_spared_is_kept() -> None:
    shares = {"right": torch.tensor([0.0, 0.25, 0.5])}
    chosen = {"right": torch.tensor([True, False, False])}
    spared = Visibility(shares, shares, frozenset({"right"})).spare(chosen)
    assert spared.offsets["right"].tolist() == [1.0, 0.25, 0.5]
    assert spared.shapes["right"].tolist() == [1.0, 0.25, 0.5]
    assert spared.open_wrists == {"right"}


def test_the_border_of_an_estimated_mask_judges_nothing(training: TrainingCapture) -> None:
    fit = begun(training)
    drawings = part(fit, FewShown).judges
    assert drawings is not None
    expected = error_with(part(fit, FewShown), spared(fit, 0), None)
    frames, images = drawings.frames, drawings.frames.images.clone()
    kernel = np.ones((3, 3), np.uint8)
    for image, mask in zip(images, frames.masks.numpy(), strict=True):
        hand = (mask > 127).astype(np.uint8)
        image[torch.from_numpy(hand != cv2.erode(hand, kernel))] = 255
    assert error_with(judged_by(part(fit, FewShown), images), spared(fit, 0), None) == expected


def test_strengths_are_around_the_settings_own() -> None:
    own = VisibilitySettings(offset_share=0.2)
    shares = [(one.offset_share, one.shape_share) for one in strengths(own)]
    assert shares == [(0.2, 0.002), (0.05, 0.002), (0.8, 0.002), (0.0, 0.002)]


@pytest.mark.parametrize("index", range(3))
def test_the_fill_that_draws_the_frames_best_is_chosen(
    index: int, training: TrainingCapture
) -> None:
    fit = begun(training)
    fit.model.keep(a_light())
    # Hardly anything is shown, so that each share changes what the frames show.
    shown = {side: 0.05 * count for side, count in part(fit, FewShown).shown.items()}
    choice = copy.copy(part(fit, FewShown))
    choice.filled = filled = FilledColors(fit, shown, choice.unseen)
    fills = filled.carried_on(fill_shares(fit.settings.visibility))
    fit.model.color_changes = fills[index]
    images = torch.from_numpy((255.0 * drawn_with(fit, training, 0)).round().astype(np.uint8))
    fit.model.color_changes = None
    fit.model.keep(spared(fit, 0))
    found = judged_by(choice, images).best(fit)
    (colors,) = found
    expected = fills[index]
    assert isinstance(colors, ColorChanges)
    assert expected is not None
    if index == 2:  # as they were learnt, but for what no frame shows
        changed = expected.changes["right"].abs().amax(dim=1) > 1e-6
        assert torch.equal(changed, changed & choice.unseen["right"])
        assert changed.any()
    assert torch.equal(colors.changes["right"], expected.changes["right"])


def test_fills_are_around_the_settings_own() -> None:
    assert fill_shares(VisibilitySettings(fill_share=0.04)) == [0.04, 0.2, 0.0]
    assert fill_shares(VisibilitySettings(fill_share=0.0)) == [0.0]


def test_looking_changes_nothing_and_finishing_keeps_the_best(
    training: TrainingCapture, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    fit = begun(training)
    before = {name: value.clone() for name, value in fit.model.state_dict().items()}
    assert part(fit, FewShown).seconds(fit) > 0.0
    part(fit, FewShown).best(fit)
    assert all(torch.equal(value, before[name]) for name, value in fit.model.state_dict().items())
    # Offsets as they were learnt are made to be the best.
    kept = weigh_visibility(
        part(fit, FewShown).shown, len(fit.data.frames), strengths(fit.settings.visibility)[3]
    )
    monkeypatch.setattr(FewShown, "best", lambda choice, fit: [kept])
    fit.finish(0, 0.0)
    frame = int(training.validation[0])
    where = training.hand_poses(frame), training.camera(frame)
    drawn = fit.avatar(0).render(*where)
    fit.model.visibility = weigh_visibility(
        part(fit, FewShown).shown, len(fit.data.frames), fit.settings.visibility
    )
    assert np.abs(fit.avatar(0).render(*where) - drawn).max() > 0.01
    fit.model.visibility = kept
    np.testing.assert_allclose(fit.avatar(0).render(*where), drawn, atol=1e-6)
    again = load_avatar(save_avatar(fit.avatar(0), tmp_path / "avatar"))
    np.testing.assert_allclose(again.render(*where), drawn, atol=1e-6)


@pytest.mark.parametrize(
    "changes", [{"validated": False}, {"visibility.enabled": False}, {"mode": "paper"}]
)
def test_nothing_is_chosen_where_it_is_off(
    changes: dict[str, Any], training: TrainingCapture, monkeypatch: pytest.MonkeyPatch
) -> None:
    if "validated" in changes:
        monkeypatch.setattr(FitData, "judges", None)
        changes = {}
    fit = begun(training, **changes)
    choice = fit.part(FewShown)
    assert (choice is not None) == fit.settings.visibility.enabled
    if choice is None:
        return
    assert choice.judges is None
    # Gaps are closed all the same.
    assert choice.seconds(fit) > 0.0
    fit.model.keep(spared(fit, 0))
    assert choice.best(fit) == []


def test_a_frame_or_two_do_not_judge(training: TrainingCapture) -> None:
    first, last = training.targets[[0, -1]].tolist()
    few = first - LEAST_CHOOSING + 1
    training.split = Split(training.id, last + 1, (0, few), (few, first), (first, last + 1))
    training._train = training.split.train
    assert part(begun(training), FewShown).judges is None


def test_validation_frames_are_spread_and_never_fitted_ones(training: TrainingCapture) -> None:
    first, last = training.validation[[0, -1]].tolist()
    assert load_validation_frames(training, 2).indices.tolist() == [first, last]
    training._train = np.sort(np.append(training.train, first))
    assert first not in load_validation_frames(training, 100).indices
    hand = training.hands["right"]
    valid = hand.valid.copy()
    valid[last] = False
    training.hands = {"right": dataclasses.replace(hand, valid=valid)}
    assert last not in load_validation_frames(training, 100).indices
