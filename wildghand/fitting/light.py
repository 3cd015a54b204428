"""Light in a fit: the shadows that hands cast, before it, and the light beyond its normals, after.

Both are told by places of the skin that turn: shadows by their colours in the frames, as the
network does not exist yet; the light by what the finished model says of them.
"""

from __future__ import annotations

import itertools
import time

import numpy as np
import torch
from torch import Tensor

from hwp_bench.base.colors import srgb_to_linear
from hwp_bench.hands import pose_hand
from wildghand.evidence.count import facing_of, read_images, seen_anchors
from wildghand.fitting.fit import Batch, Component, DrawOptions, Fit
from wildghand.gaussians.quaternions import quat_third_axis
from wildghand.gaussians.rig import HandRig
from wildghand.gaussians.training import TrainingClip
from wildghand.light import (
    KnownLight,
    LightSamples,
    Obstacles,
    ShadowSamples,
    ShadowTable,
    find_light,
    fit_light,
    obstacles_in_frames,
)
from wildghand.model.model import WildGHandModel

# Weight of a frame from which it is read, if at least so many frames have it.
_GOOD, _LEAST = 0.5, 4
# Cosine between normal and viewing direction, and weight of a pixel, from which it is read.
_FACING, _VISIBLE = 0.35, 0.05
# Cosine between normal and viewing direction from which a place is seen, and from which its colour
# counts: at a grazing angle pixels are mixed with what is behind.
_SEEN, _COUNTED = 0.02, 0.25
#: Frames that are read at most for the light that casts shadows, spread over the clip, and places
#: on each hand: rays to all candidate lamps take a second.
FRAMES, PLACES = 96, 400
#: Samples from which the light beyond the normals is fitted, at most: more change nothing, and take
#: time.
SAMPLES = 40_000
#: Frames that are predicted at a time.
CHUNK = 16


class Shadows(Component):
    """The hands cast shadows on themselves and on each other, under a light that frames tell."""

    def __init__(self) -> None:
        self._table: ShadowTable | None = None

    def before(self, fit: Fit) -> None:
        """Find the light, and let the model keep it; none where too little of a hand is seen."""
        light = find_light(shadow_samples(fit))
        if light is not None:
            fit.model.keep(light)
            assert fit.model.shadows is not None
            self._table = ShadowTable(fit.model.shadows, fit.clip)

    def dark(self, rows: Tensor) -> dict[str, Tensor]:
        """(B, N) factors of the shadows in training frames by side; empty without any.

        Args:
            rows: (B,) int64, which of the R frames; on the CPU.
        """
        return {} if self._table is None else self._table(rows)

    def draws(self, fit: Fit, batch: Batch) -> DrawOptions:
        """The shadows in the frames of a batch."""
        return {"dark": self.dark(batch.mine)}


class UnseenLight(Component):
    """Normals that no frame has shown are drawn by a light that is fitted to the others."""

    def after(self, fit: Fit) -> None:
        """Fit the light; none where too little of it is seen."""
        found = learn_light(fit)
        if found is not None:
            fit.model.keep(found)

    def seconds(self, fit: Fit) -> float:
        """The light of a few frames is fitted to see how long that takes."""
        _timed(fit, 1)  # The first time takes longer than others.
        count = len(fit.data.frames)
        one, many = _timed(fit, 1), min(count, CHUNK)
        each = max(0.0, _timed(fit, many) - one) / max(1, many - 1)
        return one + each * (count - 1)


def learn_light(fit: Fit, frames: int | None = None) -> KnownLight | None:
    """Fit a light to what a model says of the clip; None where too little of it is seen."""
    weights = fit.data.judgement.frame_weights
    count = len(weights)
    read = count if frames is None else frames
    most = SAMPLES * read // count
    return fit_light(light_samples(fit.model, fit.clip, weights[:read], most, fit.seed))


def _timed(fit: Fit, frames: int) -> float:
    entered = time.perf_counter()
    learn_light(fit, frames)
    return time.perf_counter() - entered


@torch.no_grad()
def light_samples(
    model: WildGHandModel, clip: TrainingClip, frame_weights: Tensor, count: int, seed: int
) -> LightSamples:
    """Read the colours that a model gives to visible places in the training frames.

    Args:
        frame_weights: (R,) how much each frame counts.
    """
    generator = torch.Generator().manual_seed(seed)
    rows = torch.arange(len(frame_weights))
    whole = sum(len(rig) for rig in model.rigs.values()) * len(rows)
    share = min(1.0, 2.0 * count / max(whole, 1))  # about half of the skin faces away
    places, normals, light, weights = [], [], [], []
    first = 0
    for side, rig in model.rigs.items():
        for start in range(0, len(rows), CHUNK):
            part = rows[start : start + CHUNK].to(clip.viewmats.device)
            anchors = clip.hand(side, part)
            prediction = model.predict(side, anchors, clip.parameters[side][0][part])
            turned = quat_third_axis(anchors.orientations)
            facing = facing_of(anchors, clip.viewmats[part]).cpu()
            chosen = (facing > _SEEN) & (torch.rand(facing.shape, generator=generator) < share)
            frame, place = chosen.nonzero(as_tuple=True)
            colors = prediction.raw.logit_colors.sigmoid() * prediction.shadow
            colors = colors.expand(*facing.shape, 3).cpu()[frame, place]
            counted = torch.where(facing > _COUNTED, facing, 0.0)[frame, place]
            places.append(place.numpy() + first)
            normals.append(turned.cpu()[frame, place].double().numpy())
            light.append(srgb_to_linear(colors.double().numpy()).mean(axis=1))
            weights.append((counted * frame_weights[start + frame]).double().numpy())
        first += len(rig)
    return LightSamples(
        np.concatenate(places),
        np.concatenate(normals),
        np.concatenate(light),
        np.concatenate(weights),
    )


@torch.no_grad()
def shadow_samples(fit: Fit) -> ShadowSamples:
    """Read the colours of places in the frames that the pre-pass weighs most."""
    data, rigs, clip = fit.data, fit.model.rigs, fit.clip
    judgement = data.judgement
    rows = best_of_each_part(judgement.frame_weights, FRAMES)
    good = judgement.frame_weights[rows] > _GOOD
    rows = rows[good] if int(good.sum()) >= _LEAST else rows
    here = rows.to(clip.viewmats.device)
    says = data.visible(rows)
    hands = {side: clip.hand(side, here) for side in rigs}
    seen = seen_anchors(hands, clip.viewmats[here], clip.Ks[here], says.shape[1:])
    images = data.frames.images[rows].to(here.device)
    generator = np.random.default_rng(fit.seed)
    found: list[tuple[np.ndarray, ...]] = []
    first = 0
    for side, rig in rigs.items():
        chosen = generator.permutation(len(rig))[:PLACES]
        pixels, facing = (part[:, chosen] for part in seen[side])
        weights = (read_images(says, pixels) * facing).cpu().numpy()
        weights[facing.cpu().numpy() <= _FACING] = 0.0
        frame, place = np.nonzero(weights > _VISIBLE)
        colors = [read_images(images[..., k].float(), pixels).cpu().numpy() for k in range(3)]
        light = srgb_to_linear(np.stack(colors, axis=-1)[frame, place] / 255.0).mean(axis=-1)
        normals = quat_third_axis(hands[side].orientations[:, chosen]).cpu().numpy()
        points = hands[side].positions[:, chosen].cpu().numpy()
        gains = judgement.gains[rows].numpy()
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


def best_of_each_part(weights: Tensor, count: int) -> Tensor:
    """Which frame weighs most in each of some parts of a clip; the first of equal ones.

    Args:
        weights: (R,) of the frames, in their order.

    Returns:
        (count,) int64, ascending, on the CPU; fewer if there are fewer frames.
    """
    given = weights.cpu()
    edges = torch.linspace(0, len(given), min(count, len(given)) + 1).long().tolist()
    parts = itertools.pairwise(edges)
    return torch.tensor([start + int(given[start:end].argmax()) for start, end in parts])
