"""The hand model: parameters, templates, skinning, surface anchors, joint limits, projection.

The names are imported when they are first asked for, so that importing this package loads no
torch.
"""

from __future__ import annotations

import importlib
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from hwp_bench.hands.anchors import (
        SurfaceAnchors,
        anchor_frames,
        anchor_normals,
        anchor_positions,
        anchor_uv,
        anchors_from_vertices,
        sample_surface,
    )
    from hwp_bench.hands.articulation import (
        JointLimits,
        anatomical_limits,
        joint_angles,
        joint_axes,
        joint_limit_penalty,
        pose_from_joint_angles,
    )
    from hwp_bench.hands.parameters import HandParameters
    from hwp_bench.hands.skeleton import landmark_order
    from hwp_bench.hands.skinning import PosedHand, pose_hand, project
    from hwp_bench.hands.sources import load_template
    from hwp_bench.hands.surface import to_trimesh, vertex_normals
    from hwp_bench.hands.template import HandTemplate, TemplateTensors, mirror_template
    from hwp_bench.hands.topology import boundary_vertices, subdivide

__all__ = [
    "HandParameters",
    "HandTemplate",
    "JointLimits",
    "PosedHand",
    "SurfaceAnchors",
    "TemplateTensors",
    "anatomical_limits",
    "anchor_frames",
    "anchor_normals",
    "anchor_positions",
    "anchor_uv",
    "anchors_from_vertices",
    "boundary_vertices",
    "joint_angles",
    "joint_axes",
    "joint_limit_penalty",
    "landmark_order",
    "load_template",
    "mirror_template",
    "pose_from_joint_angles",
    "pose_hand",
    "project",
    "sample_surface",
    "subdivide",
    "to_trimesh",
    "vertex_normals",
]

_HOMES = {
    "anchors": (
        "SurfaceAnchors",
        "anchor_frames",
        "anchor_normals",
        "anchor_positions",
        "anchor_uv",
        "anchors_from_vertices",
        "sample_surface",
    ),
    "articulation": (
        "JointLimits",
        "anatomical_limits",
        "joint_angles",
        "joint_axes",
        "joint_limit_penalty",
        "pose_from_joint_angles",
    ),
    "skeleton": ("landmark_order",),
    "parameters": ("HandParameters",),
    "skinning": ("PosedHand", "pose_hand", "project"),
    "sources": ("load_template",),
    "topology": ("boundary_vertices", "subdivide"),
    "surface": ("to_trimesh", "vertex_normals"),
    "template": ("HandTemplate", "TemplateTensors", "mirror_template"),
}


def __getattr__(name: str) -> Any:
    for home, names in _HOMES.items():
        if name in names:
            return getattr(importlib.import_module(f"{__name__}.{home}"), name)
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
