"""Light in a fit: the shadows that hands cast, before it, and the light beyond its normals, after.

Both follow from places of the skin that turn: shadows from their colours in the frames, because
there is no network yet; the light from the finished model's colours.
"""

from __future__ import annotations

import itertools
import time
from collections.abc import Callable, Sequence

import numpy as np
import torch
from torch import Tensor

from hwp_bench.base.colors import srgb_to_linear
from hwp_bench.hands import pose_hand
from wildghand.fitting.fit import Component, DrawOptions, Fit, StepBatch
from wildghand.gaussians.quaternions import quat_third_axis
from wildghand.light import (
    KnownLight,
    LightSamples,
    ShadowTable,
    find_light,
    fit_light,
    obstacles_in_frames,
)
from wildghand.visibility.count import facing_of, read_images, seen_anchors

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


class Lighting(Component):
    """Hands cast shadows under a light that is estimated from the frames (`shadows`), and normals
    that no frame has shown are drawn by a light that is fitted to the others (`light`).
    """

    def __init__(self) -> None:
        self._table: ShadowTable | None = None

    def before(self, fit: Fit) -> None:
        """Let the model keep the light of the shadows; none where too little of a hand is seen."""
        light = find_light(shadow_samples(fit)) if fit.settings.shadows.enabled else None
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

    def draws(self, fit: Fit, batch: StepBatch) -> DrawOptions:
        """The shadows in the frames of a batch."""
        return {"dark": self.dark(batch.mine)}

    def after(self, fit: Fit) -> None:
        """Fit the light of unknown normals; none where too little of it is seen."""
        found = learn_light(fit) if fit.settings.light.enabled else None
        if found is not None:
            fit.model.keep(found)

    def seconds(self, fit: Fit) -> float:
        """Measure the time by fitting the light of a few frames."""
        if not fit.settings.light.enabled:
            return 0.0

        def timed(frames: int) -> float:
            entered = time.perf_counter()
            learn_light(fit, frames)
            return time.perf_counter() - entered

        timed(1)  # The first time takes longer than others.
        count = len(fit.data.frames)
        one, many = timed(1), min(count, CHUNK)
        each = max(0.0, timed(many) - one) / max(1, many - 1)
        return one + each * (count - 1)


def learn_light(fit: Fit, frames: int | None = None) -> KnownLight | None:
    """Fit a light to the model's colours in the clip; None if too little of the hand is seen."""
    count = len(fit.data.frames)
    read = count if frames is None else frames
    return fit_light(light_samples(fit, read, SAMPLES * read // count))


@torch.no_grad()
def light_samples(fit: Fit, frames: int, count: int) -> LightSamples:
    """About so many colours that a model gives to visible places in the first frames."""
    model, clip, frame_weights = fit.model, fit.clip, fit.data.judgement.frame_weights
    generator = torch.Generator().manual_seed(fit.seed)
    rows = torch.arange(frames)
    whole = sum(len(rig) for rig in model.rigs.values()) * len(rows)
    share = min(1.0, 2.0 * count / max(whole, 1))  # about half of the skin faces away
    found = []
    first = 0
    for side, rig in model.rigs.items():
        for part in rows.split(CHUNK):
            here = part.to(clip.viewmats.device)
            anchors = clip.hand(side, here)
            prediction = model.predict(side, anchors, clip.parameters[side][0][here])
            facing = facing_of(anchors, clip.viewmats[here]).cpu()
            chosen = (facing > _SEEN) & (torch.rand(facing.shape, generator=generator) < share)
            frame, place = chosen.nonzero(as_tuple=True)
            colors = prediction.raw.logit_colors.sigmoid() * prediction.shadow
            colors = colors.expand(*facing.shape, 3).cpu()[frame, place]
            counted = torch.where(facing > _COUNTED, facing, 0.0)[frame, place]
            normals = quat_third_axis(anchors.orientations).cpu()[frame, place]
            found.append(
                (
                    place.numpy() + first,
                    normals.double().numpy(),
                    srgb_to_linear(colors.double().numpy()).mean(axis=1),
                    (counted * frame_weights[part[frame]]).double().numpy(),
                )
            )
        first += len(rig)
    numbers, turned, light, weights = _joined(found)
    return LightSamples(numbers, turned, light, weights)


@torch.no_grad()
def shadow_samples(fit: Fit) -> LightSamples:
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
    gains = judgement.gains[rows].numpy()
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
    places, normals, light, weights, points, frame = _joined(found)
    free = _free(fit, here, points, normals, frame)
    return LightSamples(places, normals, light, weights, free)


def _joined(columns: Sequence[tuple[np.ndarray, ...]]) -> list[np.ndarray]:
    return [np.concatenate(column) for column in zip(*columns, strict=True)]


def _free(
    fit: Fit, rows: Tensor, points: np.ndarray, normals: np.ndarray, frame: np.ndarray
) -> Callable[[np.ndarray], np.ndarray]:
    """Of (M, 3) points in some of the frames: from directions to which of them is free."""
    surfaces = []
    for side, rig in fit.model.rigs.items():
        pose, betas, transl = fit.clip.parameters[side]
        vertices = pose_hand(rig.template, pose[rows], betas, transl[rows]).vertices
        surfaces.append((vertices.cpu().numpy(), rig.template.faces.cpu().numpy()))
    obstacles = list(obstacles_in_frames(surfaces))

    def free(directions: np.ndarray) -> np.ndarray:
        open_ = np.ones((len(points), len(directions)))
        for number, in_the_way in enumerate(obstacles):
            mine = np.flatnonzero(frame == number)
            if len(mine):
                open_[mine] = in_the_way.free(points[mine], normals[mine], directions)
        return open_

    return free


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
