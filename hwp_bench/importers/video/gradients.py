"""A clip's energy and its derivatives by all variables of the fit, in closed form.

The energy is a sum over frames. A point of the hand moves with its bones, so that what pulls at
points becomes a force and a moment at each bone; those of a finger add up from its tip to its base,
and turn the joints. Automatic differentiation of a clip's many small arrays takes ten times as
long. What the residuals mean, and their scales, stands in `residuals`.
"""

from __future__ import annotations

import itertools
import os
from collections.abc import Callable
from dataclasses import dataclass, fields
from math import sin, sqrt
from typing import Any, NamedTuple

import numpy as np
import torch

from hwp_bench.base.kernels import compiled, cross, dot, helper
from hwp_bench.hands.skeleton import JOINT_COUNT, PARENTS, landmark_order
from hwp_bench.importers.shared.frames import MOST_THREADS, each_frame
from hwp_bench.importers.video.model import ANCHOR_UNIT, FRAME_OF, ClipModel, ClipVariables
from hwp_bench.importers.video.pictures import SurfaceResidual
from hwp_bench.importers.video.residuals import (
    CONTACT_SCALE,
    CONTACT_WEIGHT,
    LIMIT_WEIGHT,
    OUTLINE_TURN,
    OUTLINE_WEIGHT,
    LandmarkResidual,
    OutlineResidual,
    Outlines,
)

# Fewer frames than this are not worth a thread.
_BLOCK = 48
# Tuples, which kernels read as constants.
_ORDER = landmark_order()
# Depths below this, m, count as this, as in `ClipModel.pixels`.
_NEAR = 1e-3


class Hand(NamedTuple):
    """A hand at rest in the clip's shape, and what its energy needs; float64."""

    #: (16, 3) m.
    joints: np.ndarray
    #: (16, 3, 10).
    joint_basis: np.ndarray
    #: (5, 3) m, finger tips; (5, 3, 10); (5, 3, 135), or nothing in the last axis.
    tips: np.ndarray
    tip_basis: np.ndarray
    tip_correctives: np.ndarray
    #: (5, 16).
    tip_weights: np.ndarray
    #: (21, 3) m, offsets of the tracker's landmarks.
    offsets: np.ndarray
    #: (K, 3) m, spheres inside the hand; (K, 3, 10); (K,) their joints.
    spheres: np.ndarray
    sphere_basis: np.ndarray
    sphere_joints: np.ndarray
    #: (P, 2) those that may touch, and (P,) m, how near they may come.
    pairs: np.ndarray
    least: np.ndarray
    #: (15, 3, 3), (15, 3), (15, 3) of `JointLimits`.
    axes: np.ndarray
    lower: np.ndarray
    upper: np.ndarray


class Frames(NamedTuple):
    """F frames of a posed hand."""

    #: (F, 15, 3, 3) turn of each finger joint, and the rate of the turn.
    turns: np.ndarray
    rates: np.ndarray
    #: (F, 16, 3, 3) and (F, 16, 3) m, axes and place of each joint in the hand.
    joint_axes: np.ndarray
    centres: np.ndarray
    #: (F, 3, 3) hand to camera, the rate of its turn, and (F, 3) m.
    rotation: np.ndarray
    rate: np.ndarray
    place: np.ndarray
    #: (F, 21, 3) m, in the camera's axes.
    landmarks: np.ndarray


class Slopes(NamedTuple):
    """Derivatives of the energy of F frames; `energy` (F,) is what the kernel itself adds."""

    energy: np.ndarray
    #: (F, 3), (F, 15, 3), (F, 2), (F, 1), (F, 10), (F, 21, 3), (F,).
    turn: np.ndarray
    fingers: np.ndarray
    anchor: np.ndarray
    log_depth: np.ndarray
    betas: np.ndarray
    offsets: np.ndarray
    log_focal: np.ndarray


@dataclass(frozen=True, eq=False)
class ClipEnergy:
    """The energy of a fit, as `descend` lowers it.

    `afar`: for the first steps, when most fingers are bent wrongly.
    """

    landmarks: LandmarkResidual
    outline: OutlineResidual | None = None
    surface: SurfaceResidual | None = None
    afar: bool = False

    def __call__(self, model: ClipModel) -> torch.Tensor:
        """Return the energy, a scalar, which is differentiable once by the model's variables."""
        leaves = [getattr(model.variables, field.name) for field in fields(ClipVariables)]
        # A fit that leaves the numbers ends with an error of its own; numpy need not warn of it.
        with np.errstate(over="ignore", invalid="ignore"):
            value: torch.Tensor = _Known.apply(lambda: self.differentiate(model), *leaves)
        return value

    def differentiate(self, model: ClipModel) -> tuple[float, dict[str, np.ndarray]]:
        """Return the energy and its derivatives by each of the `ClipVariables`."""
        free = model.variables.read()
        hand, focal = _at_rest(model, self.landmarks, free), float(np.exp(free["log_focal"]))
        frames = _pose_frames(model, hand, free, focal)
        value, pulls, by_size, by_focal = self.landmarks.pull(
            frames.landmarks, model.centre, focal, float(free["log_size"]), afar=self.afar
        )
        count = len(free["turn"])
        slopes = Slopes(*(np.zeros((count, *shape)) for shape in _SLOPES))
        outlines = Outlines.nothing(count)
        if self.outline is not None:
            outlines = self.outline.shaped(free["betas"])
        centre = model.centre

        def work(part: tuple[int, int]) -> None:
            _differentiate(
                *part, hand, frames, outlines, pulls, free["anchor"], free["log_depth"], focal,
                centre, slopes,
            )  # fmt: skip

        _in_parts(work, count)
        found = {name: getattr(slopes, name) for name in ("turn", "fingers", "anchor", "log_depth")}
        for name in ("betas", "offsets"):
            found[name] = getattr(slopes, name).sum(axis=0)
        found["log_focal"] = np.asarray(slopes.log_focal.sum() + by_focal)
        found["log_size"] = np.asarray(by_size)
        value += float(slopes.energy.sum()) + self.landmarks.add_priors(free, found)
        if self.surface is not None:
            value += self.surface.add(free, found)
        return value, found


class _Known(torch.autograd.Function):
    """A value whose derivatives are computed with it."""

    @staticmethod
    def forward(ctx: Any, compute: Callable[[], Any], *leaves: torch.Tensor) -> torch.Tensor:
        value, slopes = compute()
        ctx.slopes = [
            torch.as_tensor(slopes[field.name], dtype=leaf.dtype)
            for field, leaf in zip(fields(ClipVariables), leaves, strict=True)
        ]
        return torch.tensor(value, dtype=torch.float64)

    @staticmethod
    def backward(ctx: Any, *upstream: torch.Tensor) -> Any:
        (factor,) = upstream
        return (None, *(factor.to(slope.dtype) * slope for slope in ctx.slopes))


def _in_parts(work: Callable[[tuple[int, int]], None], count: int) -> None:
    """Call a function for ranges of frames in as many threads as are worth it."""
    threads = max(1, min(MOST_THREADS, os.cpu_count() or 1, count // _BLOCK))
    if threads == 1:
        work((0, count))
        return
    edges = [count * part // threads for part in range(threads + 1)]
    for _ in each_frame(work, list(itertools.pairwise(edges))):
        pass


def _at_rest(model: ClipModel, landmarks: LandmarkResidual, free: dict[str, np.ndarray]) -> Hand:
    template, betas, spheres = model.template, free["betas"], landmarks.contact
    tips, limits = template.fingertips, landmarks.limits
    correctives = np.zeros((len(tips), 3, 0))
    if template.pose_basis is not None:
        correctives = np.ascontiguousarray(template.pose_basis[tips], np.float64)

    def shaped(rest: np.ndarray, basis: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        rates = np.ascontiguousarray(basis, np.float64)
        return rest + rates @ betas, rates

    return Hand(
        *shaped(template.joints, template.joint_basis),
        *shaped(template.vertices[tips], template.shape_basis[tips]),
        correctives,
        np.ascontiguousarray(template.weights[tips], np.float64),
        np.ascontiguousarray(free["offsets"]),
        *shaped(spheres.centres, spheres.basis),
        spheres.joints,
        landmarks.pairs,
        landmarks.least,
        limits.axes,
        limits.lower,
        limits.upper,
    )


def _pose_frames(model: ClipModel, hand: Hand, free: dict[str, np.ndarray], focal: float) -> Frames:
    count, depth = len(free["turn"]), np.exp(free["log_depth"])
    wrist = np.concatenate([free["anchor"] * (ANCHOR_UNIT / focal) * depth, depth], axis=1)
    shapes = ((15, 3, 3), (15, 3, 3), (16, 3, 3), (16, 3), (3, 3), (3, 3), (3,), (21, 3))
    frames = Frames(*(np.zeros((count, *shape)) for shape in shapes))
    start, turn, fingers = model.start, free["turn"], free["fingers"]
    _in_parts(lambda part: _pose(*part, hand, start, turn, fingers, wrist, frames), count)
    return frames


_SLOPES: tuple[tuple[int, ...], ...] = ((), (3,), (15, 3), (2,), (1,), (10,), (21, 3), ())


# --- Kernels
#
# Vectors are written out: for arrays of three numbers every other way costs more than the sum.


@helper
def _rotate(vector: np.ndarray, turn: np.ndarray, rate: np.ndarray) -> None:
    """Rodrigues' rotation R of an axis-angle vector, and J with R(v + d) = R(v) exp(J d)."""
    squared = dot(vector, vector)
    if squared < 1e-2:
        x = squared
        first = 1.0 - x / 6.0 * (1.0 - x / 20.0 * (1.0 - x / 42.0 * (1.0 - x / 72.0)))
        second = 0.5 * (1.0 - x / 12.0 * (1.0 - x / 30.0 * (1.0 - x / 56.0 * (1.0 - x / 90.0))))
        third = (1.0 - x / 20.0 * (1.0 - x / 42.0 * (1.0 - x / 72.0 * (1.0 - x / 110.0)))) / 6.0
    else:
        angle = sqrt(squared)
        sine, half = sin(angle), sin(0.5 * angle)
        first = sine / angle
        second = 2.0 * half * half / squared
        third = (angle - sine) / (squared * angle)
    for a in range(3):
        for b in range(3):
            outer = vector[a] * vector[b]
            turn[a, b] = second * outer
            rate[a, b] = third * outer
        turn[a, a] += 1.0 - second * squared
        rate[a, a] += 1.0 - third * squared
    for a in range(3):
        # The cross product's matrix holds -v[c] at (a, b) and v[c] at (b, a).
        b, c = (a + 1) % 3, (a + 2) % 3
        turn[a, b] -= first * vector[c]
        turn[b, a] += first * vector[c]
        rate[a, b] += second * vector[c]
        rate[b, a] -= second * vector[c]


@helper
def _apply(matrix: np.ndarray, vector: np.ndarray, out: np.ndarray) -> None:
    """The product of a matrix (3, 3) and a vector, into `out`, which is neither of them."""
    for a in range(3):
        out[a] = matrix[a, 0] * vector[0] + matrix[a, 1] * vector[1] + matrix[a, 2] * vector[2]


@helper
def _apply_back(matrix: np.ndarray, vector: np.ndarray, out: np.ndarray) -> None:
    """The same with the transpose of the matrix."""
    for a in range(3):
        out[a] = matrix[0, a] * vector[0] + matrix[1, a] * vector[1] + matrix[2, a] * vector[2]


@helper
def _multiply(first: np.ndarray, second: np.ndarray, out: np.ndarray) -> None:
    for a in range(3):
        for b in range(3):
            out[a, b] = (
                first[a, 0] * second[0, b] + first[a, 1] * second[1, b] + first[a, 2] * second[2, b]
            )


@helper
def _carry(rest: np.ndarray, axes: np.ndarray, joint: np.ndarray, centre: np.ndarray,
           out: np.ndarray) -> None:  # fmt: skip
    """Where a bone carries a point: `axes` (rest - joint) + centre."""
    x, y, z = rest[0] - joint[0], rest[1] - joint[1], rest[2] - joint[2]
    for a in range(3):
        out[a] = axes[a, 0] * x + axes[a, 1] * y + axes[a, 2] * z + centre[a]


@helper
def _rest_tip(tip: int, hand: Hand, turns: np.ndarray, out: np.ndarray) -> None:
    """The rest place of a finger tip with its pose correctives."""
    for a in range(3):
        out[a] = hand.tips[tip, a]
    if hand.tip_correctives.shape[2] == 0:
        return
    for j in range(15):
        for b in range(3):
            for c in range(3):
                change = turns[j, b, c] - (1.0 if b == c else 0.0)
                for a in range(3):
                    out[a] += hand.tip_correctives[tip, a, 9 * j + 3 * b + c] * change


@compiled(nogil=True)
def _pose(
    first: int,
    last: int,
    hand: Hand,
    start: np.ndarray,
    turn: np.ndarray,
    fingers: np.ndarray,
    wrist: np.ndarray,
    frames: Frames,
) -> None:
    own, moved, rest, arm = np.zeros((3, 3)), np.zeros(3), np.zeros(3), np.zeros(3)
    points = np.zeros((21, 3))
    for f in range(first, last):
        axes, centres = frames.joint_axes[f], frames.centres[f]
        for a in range(3):
            axes[0, a, a] = 1.0
            centres[0, a] = hand.joints[0, a]
        for j in range(1, JOINT_COUNT):
            above = PARENTS[j]
            _rotate(fingers[f, j - 1], frames.turns[f, j - 1], frames.rates[f, j - 1])
            _carry(hand.joints[j], axes[above], hand.joints[above], centres[above], centres[j])
            _multiply(axes[above], frames.turns[f, j - 1], axes[j])
        points[:16] = centres
        points[16:] = 0.0
        for tip in range(5):
            _rest_tip(tip, hand, frames.turns[f], rest)
            for k in range(JOINT_COUNT):
                weight = hand.tip_weights[tip, k]
                if weight > 0.0:
                    _carry(rest, axes[k], hand.joints[k], centres[k], moved)
                    for a in range(3):
                        points[16 + tip, a] += weight * moved[a]
        _rotate(turn[f], own, frames.rate[f])
        _multiply(start[f], own, frames.rotation[f])
        _apply(frames.rotation[f], hand.joints[0], moved)
        for a in range(3):
            frames.place[f, a] = wrist[f, a] - moved[a]
        for n in range(21):
            _apply(axes[FRAME_OF[n]], hand.offsets[n], arm)
            for a in range(3):
                arm[a] += points[_ORDER[n], a]
            _apply(frames.rotation[f], arm, moved)
            for a in range(3):
                frames.landmarks[f, n, a] = moved[a] + frames.place[f, a]


@helper
def _pull_skin(
    pull: np.ndarray,
    weight: float,
    rest: np.ndarray,
    axes: np.ndarray,
    joint: np.ndarray,
    centre: np.ndarray,
    skin: np.ndarray,
    moment: np.ndarray,
    by_rest: np.ndarray,
) -> None:
    """Add the force and moment of a pull at a point to a bone, and the slope by its rest place."""
    arm_x, arm_y, arm_z = rest[0] - joint[0], rest[1] - joint[1], rest[2] - joint[2]
    x = axes[0, 0] * arm_x + axes[0, 1] * arm_y + axes[0, 2] * arm_z + centre[0]
    y = axes[1, 0] * arm_x + axes[1, 1] * arm_y + axes[1, 2] * arm_z + centre[1]
    z = axes[2, 0] * arm_x + axes[2, 1] * arm_y + axes[2, 2] * arm_z + centre[2]
    u, v, w = weight * pull[0], weight * pull[1], weight * pull[2]
    skin[0] += u
    skin[1] += v
    skin[2] += w
    moment[0] += y * w - z * v
    moment[1] += z * u - x * w
    moment[2] += x * v - y * u
    for a in range(3):
        by_rest[a] += axes[0, a] * u + axes[1, a] * v + axes[2, a] * w


@helper
def _add_shape(by_rest: np.ndarray, basis: np.ndarray, betas: np.ndarray) -> None:
    for b in range(10):
        betas[b] += basis[0, b] * by_rest[0] + basis[1, b] * by_rest[1] + basis[2, b] * by_rest[2]


@helper
def _add_turning(by_matrix: np.ndarray, matrix: np.ndarray, out: np.ndarray) -> None:
    """Add the slope by w of a function of R exp(w), from its slope by the entries of R."""
    for a in range(3):
        b, c = (a + 1) % 3, (a + 2) % 3
        for k in range(3):
            out[a] += matrix[k, c] * by_matrix[k, b] - matrix[k, b] * by_matrix[k, c]


@helper
def _outline_energy(
    f: int,
    hand: Hand,
    frames: Frames,
    outlines: Outlines,
    focal: float,
    centre: np.ndarray,
    skin: np.ndarray,
    moments: np.ndarray,
    slopes: Slopes,
) -> None:
    """Add the robust distance of outline vertices from their lines."""
    axes, centres, rotation = frames.joint_axes[f], frames.centres[f], frames.rotation[f]
    rest, moved, point, far = np.zeros(3), np.zeros(3), np.zeros(3), np.zeros(3)
    pull, by_rest = np.zeros(3), np.zeros(3)
    bound = 4.0 * OUTLINE_TURN * OUTLINE_TURN
    for p in range(outlines.vertices.shape[1]):
        normal = outlines.normal[f, p]
        if normal[0] == 0.0 and normal[1] == 0.0:
            continue
        vertex = outlines.vertices[f, p]
        for a in range(3):
            rest[a] = outlines.rest[f, p, a] + outlines.shaped[vertex, a]
        point[:] = 0.0
        for k in range(outlines.bones.shape[1]):
            weight, bone = outlines.weights[vertex, k], outlines.bones[vertex, k]
            if weight > 0.0:
                _carry(rest, axes[bone], hand.joints[bone], centres[bone], moved)
                for a in range(3):
                    point[a] += weight * moved[a]
        _apply(rotation, point, far)
        for a in range(3):
            far[a] += frames.place[f, a]
        z = max(far[2], _NEAR)
        u, v = far[0] / z * focal, far[1] / z * focal
        across = (u + centre[0] - outlines.corners[f, 0]) * outlines.ratio
        down = (v + centre[1] - outlines.corners[f, 1]) * outlines.ratio
        error = (across * normal[0] + down * normal[1] - outlines.target[f, p]) / outlines.scale
        flat = 1.0 / (1.0 + error * error / bound)
        slopes.energy[f] += OUTLINE_WEIGHT * error * error * flat
        slope = OUTLINE_WEIGHT * 2.0 * error * flat * flat * outlines.ratio / outlines.scale
        slopes.log_focal[f] += slope * (normal[0] * u + normal[1] * v)
        far[0] = slope * normal[0] * focal / z
        far[1] = slope * normal[1] * focal / z
        far[2] = -slope * (normal[0] * u + normal[1] * v) / z if far[2] > _NEAR else 0.0
        _apply_back(rotation, far, pull)
        by_rest[:] = 0.0
        for k in range(outlines.bones.shape[1]):
            weight, bone = outlines.weights[vertex, k], outlines.bones[vertex, k]
            if weight > 0.0:
                _pull_skin(
                    pull, weight, rest, axes[bone], hand.joints[bone], centres[bone], skin[bone],
                    moments[bone], by_rest,
                )  # fmt: skip
        _add_shape(by_rest, outlines.basis[vertex], slopes.betas[f])


@helper
def _contact_energy(
    f: int, hand: Hand, frames: Frames, skin: np.ndarray, moments: np.ndarray, slopes: Slopes
) -> None:
    """Add the squared overlap of spheres."""
    count = len(hand.spheres)
    places, pulls = np.zeros((count, 3)), np.zeros((count, 3))
    axes, centres, by_rest, apart = (
        frames.joint_axes[f],
        frames.centres[f],
        np.zeros(3),
        np.zeros(3),
    )
    for s in range(count):
        j = hand.sphere_joints[s]
        _carry(hand.spheres[s], axes[j], hand.joints[j], centres[j], places[s])
    for p in range(len(hand.pairs)):
        first, second = hand.pairs[p, 0], hand.pairs[p, 1]
        for a in range(3):
            apart[a] = places[first, a] - places[second, a]
        squared = dot(apart, apart)
        if squared >= hand.least[p] * hand.least[p]:
            continue
        # A tiny length keeps the slope finite for centres that meet.
        length = sqrt(squared + 1e-10)
        overlap = max(hand.least[p] - length, 0.0) / CONTACT_SCALE
        slopes.energy[f] += CONTACT_WEIGHT * overlap * overlap
        slope = -2.0 * CONTACT_WEIGHT * overlap / (CONTACT_SCALE * length)
        for a in range(3):
            pulls[first, a] += slope * apart[a]
            pulls[second, a] -= slope * apart[a]
    for s in range(count):
        if dot(pulls[s], pulls[s]) > 0.0:
            j = hand.sphere_joints[s]
            by_rest[:] = 0.0
            _pull_skin(
                pulls[s], 1.0, hand.spheres[s], axes[j], hand.joints[j], centres[j], skin[j],
                moments[j], by_rest,
            )  # fmt: skip
            _add_shape(by_rest, hand.sphere_basis[s], slopes.betas[f])


@helper
def _limit_energy(j: int, hand: Hand, turn: np.ndarray, out: np.ndarray) -> float:
    """Energy of a finger joint that bends too far; its slope is added to `out`.

    The angles are those of `joint_angles`.
    """
    axes, half, local = hand.axes[j], np.zeros((3, 3)), np.zeros((3, 3))
    for a in range(3):
        for b in range(3):
            half[a, b] = axes[0, a] * turn[0, b] + axes[1, a] * turn[1, b] + axes[2, a] * turn[2, b]
    _multiply(half, axes, local)
    squared = local[1, 2] * local[1, 2] + local[2, 2] * local[2, 2]
    other = local[0, 1] * local[0, 1] + local[0, 0] * local[0, 0]
    root = sqrt(squared)
    angles = (
        np.arctan2(-local[1, 2], local[2, 2]),
        np.arctan2(local[0, 2], root),
        np.arctan2(-local[0, 1], local[0, 0]),
    )
    energy, slope = 0.0, np.zeros(3)
    for n in range(3):
        beyond = max(angles[n] - hand.upper[j, n], 0.0) - max(hand.lower[j, n] - angles[n], 0.0)
        energy += LIMIT_WEIGHT * beyond * beyond
        slope[n] = 2.0 * LIMIT_WEIGHT * beyond
    # At an abduction of 90 degrees, which no finger reaches, the other angles are not unique.
    if energy == 0.0 or squared < 1e-24 or other < 1e-24:
        return energy
    by_local, by_own = np.zeros((3, 3)), np.zeros(3)
    by_root = -slope[1] * local[0, 2] / (local[0, 2] * local[0, 2] + squared)
    by_local[1, 2] = -slope[0] * local[2, 2] / squared + by_root * local[1, 2] / root
    by_local[2, 2] = slope[0] * local[1, 2] / squared + by_root * local[2, 2] / root
    by_local[0, 2] = slope[1] * root / (local[0, 2] * local[0, 2] + squared)
    by_local[0, 1] = -slope[2] * local[0, 0] / other
    by_local[0, 0] = slope[2] * local[0, 1] / other
    _add_turning(by_local, local, by_own)
    for a in range(3):
        out[a] += axes[a, 0] * by_own[0] + axes[a, 1] * by_own[1] + axes[a, 2] * by_own[2]
    return energy


@helper
def _pull_landmarks(
    f: int,
    hand: Hand,
    frames: Frames,
    pulls: np.ndarray,
    skin: np.ndarray,
    joints: np.ndarray,
    moments: np.ndarray,
    by_turns: np.ndarray,
    slopes: Slopes,
) -> None:
    """Add what pulls at the landmarks to the bones."""
    axes, centres, rotation = frames.joint_axes[f], frames.centres[f], frames.rotation[f]
    pull, arm, rest = np.zeros(3), np.zeros(3), np.zeros(3)
    by_rest, moment = np.zeros(3), np.zeros(3)
    for n in range(21):
        _apply_back(rotation, pulls[f, n], pull)
        bone, row = FRAME_OF[n], _ORDER[n]
        _apply(axes[bone], hand.offsets[n], arm)
        cross(arm, pull, moment)
        for a in range(3):
            moments[bone, a] += moment[a]
        _apply_back(axes[bone], pull, slopes.offsets[f, n])
        if row < JOINT_COUNT:
            cross(centres[row], pull, moment)
            for a in range(3):
                joints[row, a] += pull[a]
                moments[row, a] += moment[a]
            continue
        tip = row - JOINT_COUNT
        _rest_tip(tip, hand, frames.turns[f], rest)
        by_rest[:] = 0.0
        for k in range(JOINT_COUNT):
            if hand.tip_weights[tip, k] > 0.0:
                _pull_skin(
                    pull, hand.tip_weights[tip, k], rest, axes[k], hand.joints[k], centres[k],
                    skin[k], moments[k], by_rest,
                )  # fmt: skip
        _add_shape(by_rest, hand.tip_basis[tip], slopes.betas[f])
        if hand.tip_correctives.shape[2] > 0:
            for j in range(15):
                for b in range(3):
                    for c in range(3):
                        by_turns[j, b, c] += dot(
                            by_rest, hand.tip_correctives[tip, :, 9 * j + 3 * b + c]
                        )


@compiled(nogil=True)
def _differentiate(
    first: int,
    last: int,
    hand: Hand,
    frames: Frames,
    outlines: Outlines,
    pulls: np.ndarray,
    anchor: np.ndarray,
    log_depth: np.ndarray,
    focal: float,
    centre: np.ndarray,
    slopes: Slopes,
) -> None:
    skin, joints, moments = np.zeros((16, 3)), np.zeros((16, 3)), np.zeros((16, 3))
    by_turns, by_joints = np.zeros((15, 3, 3)), np.zeros((16, 3))
    torque, own, moved = np.zeros(3), np.zeros(3), np.zeros(3)
    for f in range(first, last):
        skin[:], joints[:], moments[:], by_turns[:], by_joints[:] = 0.0, 0.0, 0.0, 0.0, 0.0
        axes, centres = frames.joint_axes[f], frames.centres[f]
        _pull_landmarks(f, hand, frames, pulls, skin, joints, moments, by_turns, slopes)
        _contact_energy(f, hand, frames, skin, moments, slopes)
        _outline_energy(f, hand, frames, outlines, focal, centre, skin, moments, slopes)
        # From here on `joints` are all forces of a joint and of what it moves.
        for j in range(JOINT_COUNT):
            _apply_back(axes[j], skin[j], moved)
            for a in range(3):
                by_joints[j, a] -= moved[a]
                joints[j, a] += skin[j, a]
        for j in range(JOINT_COUNT - 1, 0, -1):
            above = PARENTS[j]
            cross(centres[j], joints[j], moved)
            for a in range(3):
                torque[a] = moments[j, a] - moved[a]
                moments[above, a] += moments[j, a]
                joints[above, a] += joints[j, a]
            _apply_back(axes[j], torque, own)
            _add_turning(by_turns[j - 1], frames.turns[f, j - 1], own)
            slopes.energy[f] += _limit_energy(j - 1, hand, frames.turns[f, j - 1], own)
            _apply_back(frames.rates[f, j - 1], own, slopes.fingers[f, j - 1])
            _apply_back(axes[above], joints[j], moved)
            for a in range(3):
                by_joints[j, a] += moved[a]
                by_joints[above, a] -= moved[a]
        # The hand turns about its wrist, which the anchor places: the wrist's own rest place
        # moves nothing.
        for j in range(JOINT_COUNT):
            _add_shape(by_joints[j], hand.joint_basis[j], slopes.betas[f])
        cross(hand.joints[0], joints[0], moved)
        for a in range(3):
            torque[a] = moments[0, a] - moved[a]
        _apply_back(frames.rate[f], torque, slopes.turn[f])
        _apply(frames.rotation[f], joints[0], moved)
        depth = np.exp(log_depth[f, 0])
        unit = ANCHOR_UNIT / focal * depth
        aside = (moved[0] * anchor[f, 0] + moved[1] * anchor[f, 1]) * unit
        slopes.anchor[f, 0] = moved[0] * unit
        slopes.anchor[f, 1] = moved[1] * unit
        slopes.log_depth[f, 0] = aside + moved[2] * depth
        slopes.log_focal[f] -= aside
