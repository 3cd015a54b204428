"""`wildghand explain`. Oracles: what was put into the biases, the drawing of the avatar itself."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
import torch
from tiny_fits import TINY

import wildghand
from hwp_bench.base.errors import UsageError
from hwp_bench.base.images import read_rgb
from hwp_bench.capture import Capture
from wildghand.avatar.avatar import WildGHandAvatar
from wildghand.avatar.files import save_avatar
from wildghand.avatar.render import explain_frames, explanation_sheet
from wildghand.cli.main import main


@pytest.fixture(scope="module")
def fitted(make_painted: Callable[..., Capture]) -> tuple[WildGHandAvatar, Capture]:
    capture = make_painted()
    avatar = wildghand.fit(capture.root, settings=TINY, steps=2, all_frames=True)
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
    assert "1 frames" in capsys.readouterr().out
    assert read_rgb(out).shape[1] > 4 * capture.info.width


def test_what_cannot_be_explained_is_refused(fitted) -> None:
    avatar, capture = fitted
    with pytest.raises(UsageError, match="was not fitted"):
        explain_frames(avatar, capture, [len(capture) - 1])
    bare = wildghand.fit(
        capture.root,
        settings={**TINY, "dpd.enabled": False},
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
