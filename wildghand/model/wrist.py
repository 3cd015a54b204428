"""A wall across the open end of a wrist.

A hand model ends at the wrist, and its mesh is open there. Whoever looks into it sees the inside of
the skin, which no frame has shown and which the fit has left thin in places: holes. A wall of
opaque discs, two millimetres inside the hand, closes it.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import torch
from torch import Tensor
from torch.nn.functional import normalize

from hwp_bench.hands import TemplateTensors, pose_hand
from hwp_bench.hands.topology import open_loops
from wildghand.gaussians.quaternions import matrix_to_quat
from wildghand.gaussians.rig import HandRig
from wildghand.model.dress import Gaussians

# m: the distance between discs, how deep they lie in the hand, and how far along the skin, from the
# border, Gaussians lend them their colour.
_SPACING, _DEPTH, _NEAR = 0.002, 0.002, 0.025
# A disc's standard deviations along the wall and across it, in spacings, and its opacity.
_WIDE, _THIN, _OPAQUE = 0.7, 0.2, 0.98
# m: no wrist is wider; the subject of a damaged avatar may be.
_WIDEST = 0.2
# Standard deviations of a disc between its centre and the border: it does not show from outside.
_INSIDE = 2.25


@dataclass(frozen=True, eq=False)
class WristWall:
    """M opaque discs that close the open end of a hand."""

    #: Of the hand; posing reads it.
    template: TemplateTensors
    #: (L,) int64, vertices around the open end.
    border: Tensor
    #: (M, L), rows sum to 1: discs lie at these means of the border's vertices.
    shares: Tensor
    #: (K,) int64, at least one: Gaussians of the wrist, whose median colour the wall has.
    skin: Tensor

    @classmethod
    def of(cls, rig: HandRig) -> WristWall | None:
        """The wall of a hand; None where its mesh is closed or the open end too narrow or wide.

        Args:
            rig: of the hand, with its anchors.
        """
        vertices = rig.template.vertices.detach().cpu().double().numpy()
        faces = rig.template.faces.cpu().numpy()
        loops = open_loops(faces)
        if not loops:
            return None
        border = max(loops, key=lambda loop: _length(vertices[loop]))
        if np.ptp(vertices[border], axis=0).max() > _WIDEST:
            return None
        shares = _fan(vertices[border])
        if not len(shares):
            return None
        corners = vertices[faces[torch.as_tensor(rig.anchors.face_index).cpu().numpy()]]
        weights = torch.as_tensor(rig.anchors.barycentric).cpu().numpy()
        anchors = (weights[..., None] * corners).sum(axis=1)
        away = np.linalg.norm(anchors[:, None] - vertices[border], axis=-1).min(axis=1)
        near = np.flatnonzero(away <= max(_NEAR, away.min()))
        device = rig.template.vertices.device
        return cls(
            rig.template,
            torch.from_numpy(border).to(device),
            torch.from_numpy(shares).float().to(device),
            torch.from_numpy(near).to(device),
        )

    def close(self, hand: Gaussians, pose: Tensor, betas: Tensor, transl: Tensor) -> Gaussians:
        """The wall of a posed hand.

        Args:
            hand: its Gaussians in B frames.
            pose: (B, 16, 3) axis-angle, rad.
            betas: (10,).
            transl: (B, 3) m.

        Returns:
            M Gaussians in B frames.
        """
        vertices = pose_hand(self.template, pose, betas, transl).vertices
        border = vertices[:, self.border]
        centre = border.mean(dim=1, keepdim=True)
        spokes = border - centre
        normal = normalize(torch.linalg.cross(spokes, spokes.roll(-1, dims=1)).sum(dim=1), dim=-1)
        # Inwards is where the hand is, whichever way round the border runs.
        inwards = (normal * (vertices.mean(dim=1) - centre[:, 0])).sum(dim=-1, keepdim=True)
        normal = torch.where(inwards < 0.0, -normal, normal)
        means = self.shares @ border + _DEPTH * normal[:, None]
        along = normalize(spokes[:, 0] - (spokes[:, 0] * normal).sum(-1, True) * normal, dim=-1)
        axes = torch.stack([along, torch.linalg.cross(normal, along), normal], dim=-1)
        count = len(self.shares)
        colors = hand.colors[..., self.skin, :].median(dim=-2, keepdim=True).values
        scales = _SPACING * means.new_tensor([_WIDE, _WIDE, _THIN])
        return replace(
            hand,
            means=means,
            quats=matrix_to_quat(axes)[:, None].expand(-1, count, -1),
            scales=scales.expand(*hand.scales.shape[:-2], count, 3),
            opacities=means.new_full((*hand.opacities.shape[:-1], count), _OPAQUE),
            colors=colors.expand(*colors.shape[:-2], count, 3),
        )


def _length(loop: np.ndarray) -> float:
    """Of a closed line, m."""
    return float(np.linalg.norm(loop - np.roll(loop, -1, axis=0), axis=1).sum())


def _fan(border: np.ndarray) -> np.ndarray:
    """Points of a grid inside a closed line, as shares of its vertices.

    The line is spanned by triangles around its centre, and a point lies in one of them.

    Args:
        border: (L, 3) m.

    Returns:
        (M, L), rows sum to 1. M is 0 where the line is narrower than two discs.
    """
    centre = border.mean(axis=0)
    spokes = border - centre
    plane = np.linalg.svd(spokes, full_matrices=False)[2][:2]
    flat = spokes @ plane.T
    reach = np.arange(0.0, np.abs(flat).max() + _SPACING, _SPACING)
    line = np.concatenate([-reach[:0:-1], reach])
    grid = np.stack(np.meshgrid(line, line), axis=-1).reshape(-1, 2)
    after = np.roll(flat, -1, axis=0)
    # grid = a flat + b after, in each triangle.
    weights = np.einsum("lij,pj->pli", np.linalg.pinv(np.stack([flat, after], axis=-1)), grid)
    inside = (weights >= -1e-9).all(axis=-1) & (weights.sum(axis=-1) <= 1.0)
    kept = np.flatnonzero(
        inside.any(axis=1) & (_from_line(grid, flat, after) >= _INSIDE * _WIDE * _SPACING)
    )
    triangle = inside[kept].argmax(axis=1)
    first, second = weights[kept, triangle].T
    count = len(border)
    shares = np.repeat((1.0 - first - second)[:, None] / count, count, axis=1)
    rows = np.arange(len(kept))
    shares[rows, triangle] += first
    shares[rows, (triangle + 1) % count] += second
    return shares


def _from_line(points: np.ndarray, starts: np.ndarray, ends: np.ndarray) -> np.ndarray:
    """(P,) distances of (P, 2) points from the nearest of L segments."""
    along = ends - starts
    square = np.maximum((along**2).sum(axis=1), 1e-18)
    to = points[:, None] - starts
    share = np.clip((to * along).sum(axis=-1) / square, 0.0, 1.0)
    distances: np.ndarray = np.linalg.norm(to - share[..., None] * along, axis=-1).min(axis=1)
    return distances
