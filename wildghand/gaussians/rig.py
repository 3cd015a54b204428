"""Anchors on one hand, posed frame by frame; the Gaussians ride on them."""

from __future__ import annotations

import functools
from dataclasses import dataclass
from typing import TYPE_CHECKING

import torch

from hwp_bench.hands import HandTemplate, TemplateTensors, pose_hand
from hwp_bench.hands.anchors import (
    SurfaceAnchors,
    anchor_frames,
    anchor_positions,
    sample_surface,
)
from wildghand.gaussians.quaternions import matrix_to_quat
from wildghand.splat.threads import kernels_take

if TYPE_CHECKING:
    from wildghand.gaussians.posing_cpu import PosingTables

#: Frames that are posed at a time, so that memory does not grow with the clip.
CHUNK = 32


@dataclass(frozen=True, eq=False)
class AnchorPoses:
    """N anchors in F frames, world coordinates."""

    #: (F, N, 3) m.
    positions: torch.Tensor
    #: (F, N, 4) unit quaternions (w, x, y, z) of the surface frames; z is the normal.
    orientations: torch.Tensor


@dataclass(frozen=True, eq=False)
class HandRig:
    """The anchors of one hand."""

    #: The template, as posing reads it.
    template: TemplateTensors
    #: N anchors.
    anchors: SurfaceAnchors
    #: Mean distance between neighbouring anchors on the rest surface, m.
    spacing: float

    def __len__(self) -> int:
        return len(self.anchors)

    @torch.no_grad()
    def pose(self, pose: torch.Tensor, betas: torch.Tensor, transl: torch.Tensor) -> AnchorPoses:
        """Pose the anchors; no gradient.

        Args:
            pose: (F, 16, 3) axis-angle, rad.
            betas: (10,).
            transl: (F, 3) m.
        """
        # Filled part by part: joining finished parts would hold all of them twice.
        posed = AnchorPoses(
            pose.new_empty(len(pose), len(self), 3), pose.new_empty(len(pose), len(self), 4)
        )
        for start in range(0, len(pose), CHUNK):
            part = slice(start, start + CHUNK)
            found = self.follow(pose[part], betas, transl[part])
            posed.positions[part] = found.positions
            posed.orientations[part] = found.orientations
        return posed

    def follow(self, pose: torch.Tensor, betas: torch.Tensor, transl: torch.Tensor) -> AnchorPoses:
        """Pose the anchors of a few frames; the positions are differentiable.

        Their frames carry no gradient: it would double the cost, and turning a splat changes the
        image much less than moving it.

        Args:
            pose: (F, 16, 3) axis-angle, rad.
            betas: (10,) or (F, 10).
            transl: (F, 3) m.
        """
        if kernels_take(self.template.vertices, pose, betas, transl):
            from wildghand.gaussians.posing_cpu import FollowCpu

            return AnchorPoses(*FollowCpu.apply(pose, betas, transl, self.tables))
        faces = self.template.faces
        vertices = pose_hand(self.template, pose, betas, transl).vertices
        with torch.no_grad():
            orientations = matrix_to_quat(anchor_frames(vertices, faces, self.anchors))
        return AnchorPoses(anchor_positions(vertices, faces, self.anchors), orientations)

    @functools.cached_property
    def tables(self) -> PosingTables:
        """What posing on the CPU reads; made once."""
        from wildghand.gaussians.posing_cpu import PosingTables

        return PosingTables.of(self.template, self.anchors)


def make_rig(
    template: HandTemplate,
    count: int,
    seed: int = 0,
    device: torch.device | str = "cpu",
) -> HandRig:
    """Spread `count` anchors evenly over a hand.

    Args:
        template: the hand.
        count: number of anchors, at least 1.
        seed: of the anchors.
        device: where the tensors live.

    Raises:
        UsageError: `count` is below 1.
        BadHandModel: the surface has no area.
    """
    return rig_of(template, sample_surface(template, count, seed), device)


def rig_of(
    template: HandTemplate, anchors: SurfaceAnchors, device: torch.device | str = "cpu"
) -> HandRig:
    """Make a rig of given anchors; see `make_rig`."""
    tensors = template.to_torch(torch.float32, device)
    corners = tensors.vertices[tensors.faces]
    edges = corners[:, 1:] - corners[:, :1]
    area = 0.5 * torch.linalg.cross(edges[:, 0], edges[:, 1]).norm(dim=-1).sum()
    spacing = float((area / len(anchors)).sqrt())
    return HandRig(tensors, anchors.to_torch(torch.float32, device), spacing)
