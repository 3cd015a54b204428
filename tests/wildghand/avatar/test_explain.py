"""`wildghand explain`. Oracles: what was put into the biases, the drawing of the avatar itself."""

from __future__ import annotations

import copy
import dataclasses
import json
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
import torch
from tiny_fits import UNJUDGED

import wildghand
from hwp_bench.base.errors import UsageError
from hwp_bench.base.images import read_rgb
from hwp_bench.capture import Capture
from hwp_bench.hands import HandParameters
from wildghand.avatar.avatar import WildGHandAvatar
from wildghand.avatar.files import save_avatar
from wildghand.avatar.render import explain_frames, explanation_sheet, temporal_weights
from wildghand.cli.main import main
from wildghand.fitting import start


@pytest.fixture(scope="module")
def fitted(make_painted: Callable[..., Capture]) -> tuple[WildGHandAvatar, Capture]:
    capture = make_painted()
    avatar = wildghand.fit(capture.root, settings=UNJUDGED, steps=2, all_frames=True)
    with torch.no_grad():
        for module in avatar.model.biases:
            module.psi.weight.zero_()
            module.psi.bias.fill_(1.0)
            module.varphi["logit_colors"].bias.copy_(torch.tensor([3.0, 0.0, -3.0]))
    return avatar, capture


def test_biases_show_and_the_canonical_hand_is_the_avatars(fitted) -> None:
    avatar, capture = fitted
    frame = avatar.record.frames[3]
    (found,) = explain_frames(avatar, capture, [frame])
    assert found.frame == frame
    assert found.omega == pytest.approx(2.0 / (1.0 + np.exp(-1.0)) - 1.0, abs=1e-5)
    # Redder and less blue than the canonical hand.
    change = (found.biased - found.canonical)[found.canonical.max(axis=-1) > 0.05].mean(axis=0)
    assert change[0] > 0.01
    assert change[2] < -0.01
    assert found.image.shape == found.biased.shape


def test_the_canonical_hand_stands_as_the_avatar_draws_it(
    make_painted: Callable[..., Capture], monkeypatch: pytest.MonkeyPatch
) -> None:
    # Oracle: the avatar's own drawing, where it adds nothing but its hand. The fit has corrected
    # poses, and frames have poses of their own in both ways.
    capture = make_painted()

    def bent(templates: object, hands: dict[str, HandParameters], *_: object) -> object:
        return {side: dataclasses.replace(h, pose=h.pose + 0.1) for side, h in hands.items()}

    monkeypatch.setattr(start, "believed_hands", bent)
    alone = {"visibility.enabled": False, "light.enabled": False, "dpd.poses": True}
    avatar = wildghand.fit(capture.root, settings=UNJUDGED | alone, steps=2, all_frames=True)
    frame = avatar.record.frames[3]
    (before,) = explain_frames(avatar, capture, [frame])
    with torch.no_grad():
        avatar.model.pose_steps.fill_(0.05)
        for module in avatar.model.biases:
            assert module.pose_head is not None
            module.pose_head[2].bias.fill_(1.0)
            module.get_buffer("bounds").fill_(0.05)
    (found,) = explain_frames(avatar, capture, [frame])
    drawn = avatar.render(capture.hand_poses(frame), capture.camera(frame))[..., :3]
    np.testing.assert_allclose(found.canonical, drawn, atol=1e-3)
    assert np.abs(found.biased - before.biased).max() > 0.05


def test_the_frames_of_largest_omega_are_shown_in_order(fitted) -> None:
    found = explain_frames(*fitted)
    frames = [item.frame for item in found]
    assert len(frames) == 8
    assert frames == sorted(frames)
    page = explanation_sheet(found, {frames[0]: "motion blur"})
    assert page.dtype == np.uint8
    assert page.shape[0] > 8 * fitted[1].info.height


def test_the_command_writes_a_picture(fitted, tmp_path: Path, capsys) -> None:
    avatar, capture = fitted
    save_avatar(avatar, tmp_path / "avatar")
    out = tmp_path / "sheet.png"
    frame = avatar.record.frames[0]
    given = [str(tmp_path / "avatar"), str(capture.root), "--frames", str(frame), "-o", str(out)]
    assert main(["explain", *given]) == 0
    told = capsys.readouterr().out
    assert "1 frames" in told
    assert "right hand: mean |omega| 0.46, rank correlation with severity not known" in told
    assert read_rgb(out).shape[1] > 4 * capture.info.width
    assert main(["explain", *given, "--overwrite", "--json"]) == 0
    (explained,) = explain_frames(avatar, capture, [frame])
    assert json.loads(capsys.readouterr().out) == {
        "file": str(out),
        "frames": {str(frame): pytest.approx(explained.omega)},
        "hands": {
            "right": {"mean_omega": pytest.approx(0.46, abs=0.01), "rank_with_severity": None}
        },
    }


def test_what_cannot_be_explained_is_refused(fitted) -> None:
    avatar, capture = fitted
    with pytest.raises(UsageError, match="was not fitted"):
        explain_frames(avatar, capture, [len(capture) - 1])
    bare = wildghand.fit(
        capture.root,
        settings={**UNJUDGED, "dpd.enabled": False},
        steps=1,
        all_frames=True,
    )
    with pytest.raises(UsageError, match="without DPD"):
        explain_frames(bare, capture)
    other = WildGHandAvatar(
        avatar.model,
        avatar.settings,
        avatar.hand_model,
        avatar.betas,
        avatar.mean_color,
        avatar.seed,
        dataclasses.replace(avatar.record, source={"capture": "another"}),
    )
    with pytest.raises(UsageError, match="'another'"):
        explain_frames(other, capture)


def test_temporal_weights_are_ranked_with_the_severity(fitted) -> None:
    # Oracle: Spearman's correlation on ranks by hand, ties at their mean.
    avatar, capture = copy.deepcopy(fitted[0]), copy.deepcopy(fitted[1])
    count = len(capture)
    levels = {
        "motion_blur": [i % 4 for i in range(count)],
        "illumination": [i % 3 for i in range(count)],
    }
    capture.info = dataclasses.replace(capture.info, perturbations=levels)
    (module,) = avatar.model.biases
    with torch.no_grad():
        torch.nn.init.normal_(module.psi.weight, generator=torch.Generator().manual_seed(0))
    frames = avatar.record.frames
    omega = module.temporal(torch.arange(len(frames))).omega.abs().detach().numpy()
    severity = np.array([frame % 4 + frame % 3 for frame in frames])

    def ranks(values: np.ndarray) -> np.ndarray:
        less, same = values[:, None] > values, values[:, None] == values
        return less.sum(axis=1) + same.sum(axis=1) / 2

    ((size, rank),) = temporal_weights(avatar, capture).values()
    assert size == pytest.approx(omega.mean(), rel=1e-6)
    assert rank == pytest.approx(np.corrcoef(ranks(omega), ranks(severity))[0, 1], abs=1e-9)
    capture.info = dataclasses.replace(capture.info, perturbations={"motion_blur": None})
    assert temporal_weights(avatar, capture)["right"][1] is None
