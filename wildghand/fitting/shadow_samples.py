"""Places of the skin that are read from training frames, for the light that casts shadows."""

from __future__ import annotations

import numpy as np
import torch
from torch import Tensor

from hwp_bench.base.colors import srgb_to_linear
from hwp_bench.hands import pose_hand
from wildghand.evidence.count import read_images, seen_anchors
from wildghand.fitting.chosen_frames import best_of_each_part
from wildghand.fitting.weighting import Weighting
from wildghand.gaussians.quaternions import quat_third_axis
from wildghand.gaussians.rig import HandRig
from wildghand.gaussians.training import TrainingClip, TrainingFrames
from wildghand.light import Obstacles, ShadowSamples, ShadowSettings, obstacles_in_frames

# Weight of a frame from which it is read, if at least so many frames have it.
_GOOD, _LEAST = 0.5, 4
# Cosine between normal and viewing direction, and weight of a pixel, from which it is read.
_FACING, _VISIBLE = 0.35, 0.05


@torch.no_grad()
def shadow_samples(
    rigs: dict[str, HandRig],
    clip: TrainingClip,
    frames: TrainingFrames,
    weighting: Weighting,
    settings: ShadowSettings,
    seed: int,
) -> ShadowSamples:
    """Read the colours of places in the frames that the pre-pass weighs most.

    Args:
        rigs: by side.
        clip: hands and cameras of the R frames.
        frames: that are fitted.
        weighting: how much each pixel says of the hand, and the gain of each frame.
        settings: how much is read.
        seed: of the choice of places.
    """
    rows = best_of_each_part(weighting.frame_weights, settings.frames)
    good = weighting.frame_weights[rows] > _GOOD
    rows = rows[good] if int(good.sum()) >= _LEAST else rows
    here = rows.to(clip.viewmats.device)
    says = weighting.visible(rows)
    hands = {side: clip.hand(side, here) for side in rigs}
    seen = seen_anchors(hands, clip.viewmats[here], clip.Ks[here], says.shape[1:])
    images = frames.images[rows].to(here.device)
    generator = np.random.default_rng(seed)
    found: list[tuple[np.ndarray, ...]] = []
    first = 0
    for side, rig in rigs.items():
        chosen = generator.permutation(len(rig))[: settings.places]
        pixels, facing = (part[:, chosen] for part in seen[side])
        weights = (read_images(says, pixels) * facing).cpu().numpy()
        weights[facing.cpu().numpy() <= _FACING] = 0.0
        frame, place = np.nonzero(weights > _VISIBLE)
        colors = [read_images(images[..., k].float(), pixels).cpu().numpy() for k in range(3)]
        light = srgb_to_linear(np.stack(colors, axis=-1)[frame, place] / 255.0).mean(axis=-1)
        normals = quat_third_axis(hands[side].orientations[:, chosen]).cpu().numpy()
        points = hands[side].positions[:, chosen].cpu().numpy()
        gains = weighting.gains[rows].numpy()
        found.append(
            (
                first + chosen[place],
                normals[frame, place].astype(np.float64),
                light / gains[frame],
                weights[frame, place].astype(np.float64),
                points[frame, place].astype(np.float64),
                frame,
            )
        )
        first += len(rig)
    places, normals, light, weights, points, frame = (
        np.concatenate(column) for column in zip(*found, strict=True)
    )
    obstacles = _obstacles(rigs, clip, here)

    def free(directions: np.ndarray) -> np.ndarray:
        open_ = np.ones((len(places), len(directions)))
        for number, in_the_way in enumerate(obstacles):
            mine = np.flatnonzero(frame == number)
            if len(mine):
                open_[mine] = in_the_way.free(points[mine], normals[mine], directions)
        return open_

    return ShadowSamples(places, normals, light, weights, free)


def _obstacles(rigs: dict[str, HandRig], clip: TrainingClip, rows: Tensor) -> list[Obstacles]:
    """The posed hands of each of some frames."""
    surfaces = []
    for side, rig in rigs.items():
        pose, betas, transl = clip.parameters[side]
        vertices = pose_hand(rig.template, pose[rows], betas, transl[rows]).vertices
        surfaces.append((vertices.cpu().numpy(), rig.template.faces.cpu().numpy()))
    return list(obstacles_in_frames(surfaces))
