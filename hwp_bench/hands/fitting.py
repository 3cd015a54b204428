"""Fit a hand template to known points: joints, lines of sight, and points on the skin."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch

from hwp_bench.base.errors import BadInput, DidNotConverge
from hwp_bench.base.numerics import kd_tree
from hwp_bench.hands.anchors import vertex_normals
from hwp_bench.hands.articulation import anatomical_limits, joint_limit_penalty
from hwp_bench.hands.skeleton import HandParameters
from hwp_bench.hands.skinning import PosedHand, only_fingertips, pose_hand
from hwp_bench.hands.template import HandTemplate, TemplateTensors, boundary_vertices

#: Points farther from the fitted surface than this have no effect, m.
REACH = 0.03
# Steps with landmarks and lines of sight only, and with the skin.
_LANDMARK_STEPS, _SKIN_STEPS = 150, 60
# The nearest vertices are found again after this many steps.
_REFRESH = 15
# Weight of the landmarks in the steps with skin: models put joints in different places.
_LANDMARK_WEIGHT = 0.1
# Weights of anatomical joint limits, mm^2 per rad^2, and of the squared shape parameters, mm^2.
_LIMITS, _SHAPE = 30.0, 0.02
# Shares of the gradient's mean and square that a step of Adam keeps.
_MEAN_KEPT, _SQUARE_KEPT = 0.9, 0.99


@dataclass(frozen=True, eq=False)
class FitTargets:
    """The known points of one hand in F frames, in the coordinate frame of `transl`; metres.

    Landmarks or skin must be known; NaN marks unknown values.
    """

    #: (F, 21, 3) landmarks, OpenPose order.
    landmarks: np.ndarray | None = None
    #: (F, 21, 3) unit directions from the origin on which landmarks lie (a camera there).
    rays: np.ndarray | None = None
    #: (F, P, 3) points on the skin, without correspondence.
    skin: np.ndarray | None = None


@dataclass(frozen=True, eq=False)
class FittedHand:
    """A hand fitted to targets, and its distances from them."""

    #: The parameters.
    parameters: HandParameters
    #: (F,) mean distance of the known landmarks, mm; NaN where none is known.
    landmark_mm: np.ndarray
    #: (F,) mean distance of the skin points to the fitted surface, mm; NaN without skin.
    skin_mm: np.ndarray


def fit_hand(
    template: HandTemplate,
    targets: FitTargets,
    start: HandParameters,
    *,
    keep_shape: bool = False,
) -> FittedHand:
    """Fit pose, one shape and translation, by Adam from a start; all frames at once.

    With `keep_shape` the shape stays that of the start.
    """
    if not start.valid.any() or (targets.landmarks is None and targets.skin is None):
        raise BadInput("no frame is valid, or no points are known", field="targets")
    chosen = np.flatnonzero(start.valid)
    fit = _Fit(template, targets, start, chosen)
    if keep_shape:
        del fit.rates["betas"]
    fit.run(_LANDMARK_STEPS, skin=False)
    if targets.skin is not None:
        fit.run(_SKIN_STEPS, skin=True)
    return fit.result(start)


def minimize(
    groups: list[dict[str, Any]],
    energy: Callable[[int], torch.Tensor],
    steps: int,
    *,
    warm_up: int = 1,
    remedy: str | None = None,
    tick: Callable[[], None] = lambda: None,
) -> None:
    """Lower an energy, which takes the number of its step, by Adam over groups of parameters.

    The rates rise over the steps of `warm_up`, and fall to a fiftieth along a cosine; `tick` is
    called after each step.
    """
    # `torch.optim.Adam` imports torch's compiler for 1.5 s of processor time, and steps slower.
    moved = [
        (parameter, group["lr"], torch.zeros_like(parameter), torch.zeros_like(parameter))
        for group in groups
        for parameter in group["params"]
    ]
    for step in range(steps):
        for parameter, *_ in moved:
            parameter.grad = None
        value = energy(step)
        if not math.isfinite(float(value.detach())):
            said = f"the fit of the hand left the finite numbers in step {step}"
            raise DidNotConverge(said, remedy=remedy)
        value.backward()
        rate = min(1.0, (step + 1) / warm_up)
        rate *= 0.02 + 0.49 * (1.0 + math.cos(math.pi * step / max(steps, 1)))
        rate /= 1.0 - _MEAN_KEPT ** (step + 1)
        grown = math.sqrt(1.0 - _SQUARE_KEPT ** (step + 1))
        with torch.no_grad():
            for parameter, own, mean, square in moved:
                if (slope := parameter.grad) is not None:
                    mean.lerp_(slope, 1.0 - _MEAN_KEPT)
                    square.mul_(_SQUARE_KEPT).addcmul_(slope, slope, value=1.0 - _SQUARE_KEPT)
                    parameter.addcdiv_(mean, (square.sqrt() / grown).add_(1e-8), value=-own * rate)
        tick()


class _Fit:
    """Variables and targets of the valid frames."""

    def __init__(
        self, template: HandTemplate, targets: FitTargets, start: HandParameters, chosen: np.ndarray
    ) -> None:
        self.whole = template.to_torch(torch.float64)
        self.tips = only_fingertips(self.whole)
        self.limits = anatomical_limits(template)
        self.faces = self.whole.faces
        # Points nearest to the open wrist may be on the forearm.
        self.border = boundary_vertices(template.faces)
        self.chosen = chosen

        def known(values: np.ndarray | None) -> torch.Tensor | None:
            return None if values is None else torch.from_numpy(np.array(values[chosen], float))

        self.landmarks, self.rays = known(targets.landmarks), known(targets.rays)
        self.skin = known(targets.skin)
        self.pose = torch.tensor(start.pose[chosen], requires_grad=True)
        self.betas = torch.tensor(start.betas, requires_grad=True)
        self.transl = torch.tensor(start.transl[chosen], requires_grad=True)
        self.rates = {"pose": 0.03, "betas": 0.05, "transl": 0.004}

    def run(self, steps: int, *, skin: bool) -> None:
        """Take `steps` steps, with the skin or without it."""
        factor = 0.3 if skin else 1.0
        groups = [
            {"params": [getattr(self, name)], "lr": rate * factor}
            for name, rate in self.rates.items()
        ]
        matches: tuple[torch.Tensor, ...] = ()

        def energy(step: int) -> torch.Tensor:
            nonlocal matches
            posed = self._posed(self.whole if skin else self.tips)
            total = self._landmark_energy(posed)
            if skin:
                if step % _REFRESH == 0:
                    matches = self._match(posed)
                index, normals, near = matches
                total = _LANDMARK_WEIGHT * total
                total = total + 1e6 * _squared(self._gaps(posed, index, normals), near)
            total = total + _LIMITS * joint_limit_penalty(self.pose, self.limits).mean()
            return total + _SHAPE * (self.betas**2).sum()

        minimize(groups, energy, steps)

    def result(self, start: HandParameters) -> FittedHand:
        """The parameters of all frames, with the errors of the fitted ones."""
        with torch.no_grad():
            posed = self._posed(self.whole)
            frames = len(start.valid)
            landmark_mm, skin_mm = np.full(frames, np.nan), np.full(frames, np.nan)
            if self.landmarks is not None:
                distance = (posed.landmarks - self.landmarks).norm(dim=-1)
                known = torch.isfinite(distance)
                total = torch.where(known, distance, 0.0).sum(dim=1) / known.sum(dim=1)
                landmark_mm[self.chosen] = 1000.0 * total.numpy()
            if self.skin is not None:
                index, normals, near = self._match(posed)
                gaps = self._gaps(posed, index, normals).abs()
                # Where no point is in reach, all points count by their distance to the vertices.
                nearest = torch.gather(posed.vertices, 1, index[..., None].expand(-1, -1, 3))
                missed = ~near.any(dim=1, keepdim=True)
                gaps = torch.where(missed, (self.skin - nearest).norm(dim=-1), gaps)
                near = near | missed
                total = torch.where(near, gaps, 0.0).sum(dim=1) / near.sum(dim=1)
                skin_mm[self.chosen] = 1000.0 * total.numpy()
        pose, transl = start.pose.copy(), start.transl.copy()
        pose[self.chosen], transl[self.chosen] = self.pose.detach(), self.transl.detach()
        fitted = HandParameters(pose, self.betas.detach().numpy(), transl, start.valid)
        return FittedHand(fitted, landmark_mm, skin_mm)

    def _posed(self, tensors: TemplateTensors) -> PosedHand:
        return pose_hand(tensors, self.pose, self.betas, self.transl)

    def _landmark_energy(self, posed: PosedHand) -> torch.Tensor:
        energy = self.betas.sum() * 0.0
        if self.landmarks is not None:
            known = torch.isfinite(self.landmarks).all(dim=-1)
            gap = posed.landmarks - torch.where(known[..., None], self.landmarks, 0.0)
            energy = energy + 1e6 * _squared(gap.norm(dim=-1), known)
        if self.rays is not None:
            known = torch.isfinite(self.rays).all(dim=-1)
            rays = torch.where(known[..., None], self.rays, 0.0)
            along = (posed.landmarks * rays).sum(dim=-1, keepdim=True)
            energy = energy + 1e6 * _squared((posed.landmarks - along * rays).norm(dim=-1), known)
        return energy

    def _match(self, posed: PosedHand) -> tuple[torch.Tensor, ...]:
        """For every skin point the nearest vertex, its normal, and whether it may be used."""
        assert self.skin is not None
        vertices = posed.vertices.detach()
        normals = vertex_normals(vertices, self.faces)
        index, usable = [], []
        for points, own in zip(self.skin.numpy(), vertices.numpy(), strict=True):
            distance, nearest = kd_tree(own).query(points)
            index.append(nearest)
            usable.append((distance < REACH) & ~np.isin(nearest, self.border))
        found = torch.from_numpy(np.stack(index))
        picked = torch.gather(normals, 1, found[..., None].expand(-1, -1, 3))
        return found, picked, torch.from_numpy(np.stack(usable))

    def _gaps(self, posed: PosedHand, index: torch.Tensor, normals: torch.Tensor) -> torch.Tensor:
        """(F, P) signed distance of the points to the tangent planes of their vertices, m."""
        assert self.skin is not None
        nearest = torch.gather(posed.vertices, 1, index[..., None].expand(-1, -1, 3))
        return ((self.skin - nearest) * normals).sum(dim=-1)


def _squared(values: torch.Tensor, known: torch.Tensor) -> torch.Tensor:
    return (torch.where(known, values, 0.0) ** 2).sum() / known.sum().clamp_min(1)
