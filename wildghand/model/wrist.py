"""A cap across the open end of a wrist, and a clean edge around it.

A hand model ends at the wrist, and its mesh is open there. A camera that looks into it sees the
inside of the skin, which no frame has shown and which has holes. A cap of opaque discs, two
millimetres inside the hand, closes it. Gaussians reach over the border by their own width, which
would give a jagged edge, so they are flattened towards the border.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import cv2
import numpy as np
import torch
from torch import Tensor
from torch.nn.functional import normalize

from hwp_bench.hands import TemplateTensors, anchor_positions, pose_hand
from hwp_bench.hands.template import boundary_loop
from wildghand.gaussians.quaternions import matrix_to_quat, quat_rotate
from wildghand.gaussians.rig import HandRig
from wildghand.model.dress import Gaussians

#: m: the distance between discs, and how deep they lie in the hand.
SPACING, DEPTH = 0.002, 0.002
# How far along the skin, from the border, Gaussians lend them their colour, m.
_NEAR = 0.025
#: A disc's standard deviations along the cap and across it, in spacings, and its opacity.
WIDE, THIN, OPAQUE = 0.7, 0.2, 0.98
# m: no wrist is wider; the subject of a damaged avatar may be.
_WIDEST = 0.2
# Standard deviations of a disc between its centre and the border: it does not show from outside.
_INSIDE = 2.25
# Standard deviations of a Gaussian that end before the border; the least distance of its centre
# from it, and the least standard deviation, m.
_REACH, _LEAST, _FLAT = 3.0, 3e-4, 2e-5


@dataclass(frozen=True, eq=False)
class WristWall:
    """M opaque discs that close the open end of a hand, and the edge of its skin there."""

    #: Of the hand; posing reads it.
    template: TemplateTensors
    #: (L,) int64, vertices around the open end.
    border: Tensor
    #: (M, L), rows sum to 1: discs lie at these means of the border's vertices.
    shares: Tensor
    #: (K,) int64, at least one: Gaussians of the wrist, whose median colour the cap has.
    skin: Tensor

    def __len__(self) -> int:
        return len(self.shares)

    @classmethod
    def of(cls, rig: HandRig) -> WristWall | None:
        """Return the cap of a hand; None if its mesh is closed or its open end unusual in size."""
        vertices, faces = rig.template.vertices, rig.template.faces
        border = torch.from_numpy(boundary_loop(faces.cpu().numpy())).to(vertices.device)
        if not len(border):
            return None
        places = vertices[border]
        if float((places.amax(dim=0) - places.amin(dim=0)).max()) > _WIDEST:
            return None
        shares = _fan(places.cpu().double().numpy())
        if not len(shares):
            return None
        away = torch.cdist(anchor_positions(vertices, faces, rig.anchors), places).amin(dim=1)
        skin = torch.nonzero(away <= away.min().clamp(min=_NEAR))[:, 0]
        return cls(rig.template, border, torch.from_numpy(shares).to(vertices), skin)

    def close(self, hand: Gaussians, pose: Tensor, betas: Tensor, transl: Tensor) -> Gaussians:
        """Return the cap of a posed hand.

        Args:
            pose: (B, 16, 3) axis-angle, rad.
            betas: (10,) or (B, 10).
            transl: (B, 3) m.
        """
        vertices = pose_hand(self.template, pose, betas, transl).vertices
        border = vertices[:, self.border]
        spokes, normal = self.plane(vertices)
        means = self.shares @ border + DEPTH * normal[:, None]
        along = normalize(spokes[:, 0] - (spokes[:, 0] * normal).sum(-1, True) * normal, dim=-1)
        axes = torch.stack([along, torch.linalg.cross(normal, along), normal], dim=-1)
        count = len(self)
        colors = hand.colors[..., self.skin, :].median(dim=-2, keepdim=True).values
        scales = SPACING * means.new_tensor([WIDE, WIDE, THIN])
        return replace(
            hand,
            means=means,
            quats=matrix_to_quat(axes)[:, None].expand(-1, count, -1),
            scales=scales.expand(*hand.scales.shape[:-2], count, 3),
            opacities=means.new_full((*hand.opacities.shape[:-1], count), OPAQUE),
            colors=colors.expand(*colors.shape[:-2], count, 3),
        )

    @torch.no_grad()
    def trim(self, hand: Gaussians, pose: Tensor, betas: Tensor, transl: Tensor) -> Gaussians:
        """A posed hand whose Gaussians end before the plane of the border.

        With depth d behind the plane and standard deviation s along its normal, a Gaussian is
        pressed together along the normal by d / (3 s) where that is below 1. Others, and those more
        than 25 mm from the border, are as before.

        Args:
            pose: (B, 16, 3) axis-angle, rad.
            betas: (10,) or (B, 10).
            transl: (B, 3) m.
        """
        vertices = pose_hand(self.template, pose, betas, transl).vertices
        normal = self.plane(vertices)[1][:, None]
        means = hand.means.clone()
        frames, count, _ = means.shape
        scales = hand.scales.expand(frames, count, 3).clone()
        quats = hand.quats.expand(frames, count, 4).clone()
        near = means[:, self.skin]
        depth = ((near - vertices[:, self.border].mean(dim=1, keepdim=True)) * normal).sum(-1, True)
        # Its axes as columns, each as long as the standard deviation.
        turns = quat_rotate(quats[:, self.skin, None], torch.eye(3).to(near)).mT
        axes = turns * scales[:, self.skin, None]
        along = (axes.mT @ normal[..., None])[..., 0]
        room = depth.clamp(min=_LEAST)
        kept = room / (_REACH * along.norm(dim=-1, keepdim=True)).clamp(min=1e-9)
        row, column = torch.nonzero(kept[..., 0] < 1.0, as_tuple=True)
        cut, own, axis = self.skin[column], kept[row, column], normal[row, 0]
        means[row, cut] += (room - depth)[row, column] * axis
        pressed = axes[row, column]
        pressed = pressed - (1.0 - own)[..., None] * axis[..., None] * along[row, column, None]
        pressed = pressed.double()
        squares, turned = torch.linalg.eigh(pressed @ pressed.mT)
        turned[..., 0] *= torch.linalg.det(turned)[:, None].sign()
        scales[row, cut] = squares.clamp(min=0.0).sqrt().clamp(min=_FLAT).to(scales)
        quats[row, cut] = matrix_to_quat(turned).to(quats)
        return replace(hand, means=means, scales=scales, quats=quats)

    def plane(self, vertices: Tensor) -> tuple[Tensor, Tensor]:
        """The plane of the open end of a posed hand.

        Args:
            vertices: (B, V, 3) m.

        Returns:
            (B, L, 3) m from the middle of the border to its vertices, and (B, 3) unit normals that
            point into the hand.
        """
        border = vertices[:, self.border]
        centre = border.mean(dim=1, keepdim=True)
        spokes = border - centre
        normal = normalize(torch.linalg.cross(spokes, spokes.roll(-1, dims=1)).sum(dim=1), dim=-1)
        # Inwards is where the hand is, whichever way round the border runs.
        inwards = (normal * (vertices.mean(dim=1) - centre[:, 0])).sum(dim=-1, keepdim=True)
        return spokes, torch.where(inwards < 0.0, -normal, normal)


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
    reach = np.arange(0.0, np.abs(flat).max() + SPACING, SPACING)
    line = np.concatenate([-reach[:0:-1], reach])
    grid = np.stack(np.meshgrid(line, line), axis=-1).reshape(-1, 2)
    closed = flat.astype(np.float32)
    depths = [cv2.pointPolygonTest(closed, point, True) for point in grid.tolist()]
    grid = grid[np.array(depths) >= _INSIDE * WIDE * SPACING]
    after = np.roll(flat, -1, axis=0)
    # grid = a flat + b after, in each triangle.
    weights = np.einsum("lij,pj->pli", np.linalg.pinv(np.stack([flat, after], axis=-1)), grid)
    inside = (weights >= -1e-9).all(axis=-1) & (weights.sum(axis=-1) <= 1.0)
    rows, triangle = np.arange(len(grid)), inside.argmax(axis=1)
    first, second = weights[rows, triangle].T
    count = len(border)
    shares = np.repeat((1.0 - first - second)[:, None] / count, count, axis=1)
    shares[rows, triangle] += first
    shares[rows, (triangle + 1) % count] += second
    return shares
