"""The subject's own hands at rest, where their maker knows them: `truth/template.npz`.

A subject may be another person than every shape of the hand model. Of a subject with the hand
model's triangles, the file holds the surface, the joints it bends about, and its skinning; the
rest of a template is the hand model's. It is truth with the capture and no part of its digest:
it follows from the scene.
"""

from __future__ import annotations

import os
from collections.abc import Mapping

import numpy as np

from hwp_bench.base.arrays import read_npz, take, write_npz
from hwp_bench.base.errors import BadInput
from hwp_bench.hands.template import JOINT_COUNT, HandTemplate, rebuilt

# Largest file that is read, unpacked, in bytes: both hands of a MANO-HD have a tenth of it.
_MAX_BYTES = 128 * 1024 * 1024
# Farthest that a point of a hand at rest may be from the model's wrist, m.
_FARTHEST = 1.0


def write_subject_mesh(path: str | os.PathLike[str], templates: Mapping[str, HandTemplate]) -> None:
    """Write the rest hands of a subject by side, to be read with `read_subject_mesh`."""
    arrays = {
        f"{side}_{field}": getattr(template, field).astype(np.float32)
        for side, template in templates.items()
        for field in ("vertices", "joints", "weights")
    }
    write_npz(path, arrays)


def read_subject_mesh(path: str | os.PathLike[str], model: HandTemplate) -> HandTemplate:
    """Read one hand of a subject.

    Args:
        path: the file.
        model: the hand model, of the hand's side.

    Returns:
        A template with the model's name and triangles that no shape parameter changes.

    Raises:
        BadInput: missing, damaged, too large, not of the model's vertices, not finite, farther
            than 1 m away, or its skinning weights are negative or do not sum to 1.
    """
    arrays = read_npz(path, max_bytes=_MAX_BYTES)
    count, side = len(model.vertices), model.side
    vertices = take(arrays, f"{side}_vertices", (count, 3), where=path)
    joints = take(arrays, f"{side}_joints", (JOINT_COUNT, 3), where=path)
    weights = take(arrays, f"{side}_weights", (count, JOINT_COUNT), where=path)
    for field, places in (("vertices", vertices), ("joints", joints)):
        if np.abs(places - model.joints[0]).max() > _FARTHEST:
            raise BadInput("lies 1 m away from the hand", where=path, field=f"{side}_{field}")
    sums = weights.sum(axis=1)
    if weights.min() < -1e-6 or np.abs(sums - 1.0).max() > 1e-3:
        raise BadInput("is negative or does not sum to 1", where=path, field=f"{side}_weights")
    weights = np.clip(weights, 0.0, None)
    return rebuilt(
        model,
        vertices=vertices,
        shape_basis=np.zeros_like(model.shape_basis),
        joints=joints,
        joint_basis=np.zeros_like(model.joint_basis),
        weights=weights / weights.sum(axis=1, keepdims=True),
    )
