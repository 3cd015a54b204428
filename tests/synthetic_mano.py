"""A stand-in for MANO's files: every key in the published format, with made-up numbers.

The mesh has MANO's counts: 778 vertices, 1538 faces and an open boundary of 16 edges. It is a
triangulated disc pulled over an ellipsoid whose open end is the wrist.
"""

from __future__ import annotations

import pickle
import sys
import types
from pathlib import Path
from typing import Any

import numpy as np
from scipy.sparse import csc_matrix
from scipy.spatial import Delaunay

# Rough places of the 16 joints of a right hand: along the fingers (-x) and across (z), m.
_JOINTS = np.array(
    [
        (0.080, 0.000),
        *((-0.010, 0.024), (-0.040, 0.026), (-0.062, 0.028)),
        *((-0.012, 0.004), (-0.045, 0.004), (-0.070, 0.004)),
        *((0.000, -0.034), (-0.020, -0.036), (-0.036, -0.038)),
        *((-0.006, -0.016), (-0.036, -0.018), (-0.060, -0.019)),
        *((0.056, 0.026), (0.030, 0.036), (0.006, 0.038)),
    ]
)

# Beyond the last joints of thumb, index, middle, ring and little finger, and MANO's numbers.
_TIPS = np.array(
    [(-0.020, 0.042), (-0.080, 0.028), (-0.095, 0.004), (-0.080, -0.020), (-0.055, -0.040)]
)
_TIP_NUMBERS = (744, 320, 443, 554, 671)


def mano_content(side: str) -> dict[str, Any]:
    """The content of one file as plain arrays, the left one with the published sign error."""
    random = np.random.default_rng(778)
    vertices, faces = _mesh()
    shapes = 0.002 * random.normal(size=(778, 3, 20))
    poses = 0.001 * random.normal(size=(778, 3, 135))
    regressor = np.zeros((16, 778))
    for joint, (x, z) in enumerate(_JOINTS):
        for sign in (-1.0, 1.0):
            facing = np.where(vertices[:, 1] * sign > 0.0, 0.0, 1.0)
            distance = np.hypot(vertices[:, 0] - x, vertices[:, 2] - z) + facing
            regressor[joint, np.argmin(distance)] += 0.5
    joints = regressor @ vertices
    squared = ((vertices[:, None] - joints) ** 2).sum(axis=-1)
    weights = np.exp(-squared / 0.02**2)
    mean_pose = 0.1 * random.normal(size=45)
    if side == "left":
        vertices = vertices * [-1.0, 1.0, 1.0]
        faces = faces[:, ::-1]
    tree = np.array(
        [[2**32 - 1, 0, 1, 2, 0, 4, 5, 0, 7, 8, 0, 10, 11, 0, 13, 14], range(16)], dtype=np.int64
    )
    return {
        "v_template": vertices,
        "shapedirs": shapes,
        "posedirs": poses,
        "J_regressor": regressor,
        "weights": weights / weights.sum(axis=1, keepdims=True),
        "kintree_table": tree,
        "f": np.ascontiguousarray(faces, dtype=np.uint32),
        "hands_components": np.eye(45),
        "hands_coeffs": np.zeros((1554, 45)),
        "hands_mean": mean_pose,
        "bs_style": "lbs",
        "bs_type": "lrotmin",
        "J": joints,
    }


def as_published(content: dict[str, Any], scipy_module: str = "scipy.sparse.csc") -> bytes:
    """The pickle of a content with chumpy and scipy objects, as Python 2 wrote it."""
    shapes = content["shapedirs"]
    index = np.arange(shapes.size).reshape(shapes.shape)[:, :, :10].ravel()
    regressor = csc_matrix(content["J_regressor"])
    names = {
        "chumpy.ch": ["Ch"],
        "chumpy.reordering": ["Select"],
        "chumpy": [],
        scipy_module: ["csc_matrix"],
    }
    with _Modules(names) as made:
        table = dict(content)
        table["shapedirs"] = made["Select"](
            a=made["Ch"](x=shapes), idxs=index, preferred_shape=(778, 3, 10)
        )
        table["J_regressor"] = made["csc_matrix"](
            format="csc",
            _shape=(16, 778),
            maxprint=50,
            indptr=regressor.indptr,
            indices=regressor.indices,
            data=regressor.data,
        )
        return pickle.dumps(table, protocol=2)


def write_mano_folder(folder: Path) -> None:
    for side in ("right", "left"):
        (folder / f"MANO_{side.upper()}.pkl").write_bytes(as_published(mano_content(side)))


def mirrored_content() -> dict[str, Any]:
    """A left file that is the right one mirrored, but for the published sign of its shapes."""
    content = mano_content("right")
    flip = np.array([-1.0, 1.0, 1.0])
    signs = np.tile(np.outer(flip, flip).reshape(-1), 15)
    mean = content["hands_mean"].reshape(15, 3) * [1.0, -1.0, -1.0]
    return {
        **content,
        "v_template": content["v_template"] * flip,
        "f": np.ascontiguousarray(content["f"][:, ::-1]),
        "posedirs": content["posedirs"] * flip[:, None] * signs,
        "hands_mean": mean.reshape(-1),
    }


def write_mirrored_mano(folder: Path) -> Path:
    """A MANO folder whose hands mirror each other, as the published ones do."""
    folder.mkdir(parents=True, exist_ok=True)
    (folder / "MANO_RIGHT.pkl").write_bytes(as_published(mano_content("right")))
    (folder / "MANO_LEFT.pkl").write_bytes(as_published(mirrored_content()))
    return folder


class _Modules:
    """Classes under foreign module names for as long as a pickle is written."""

    def __init__(self, names: dict[str, list[str]]) -> None:
        self._names = names
        self._kept: dict[str, Any] = {}

    def __enter__(self) -> dict[str, type]:
        made = {}
        for module_name, classes in self._names.items():
            self._kept[module_name] = sys.modules.get(module_name)
            module = types.ModuleType(module_name)
            for name in classes:
                made[name] = type(name, (), {"__module__": module_name, "__init__": _keep})
                setattr(module, name, made[name])
            sys.modules[module_name] = module
        return made

    def __exit__(self, *error: object) -> None:
        for name, module in self._kept.items():
            if module is None:
                del sys.modules[name]
            else:
                sys.modules[name] = module


def _keep(self: Any, **attributes: Any) -> None:
    self.__dict__.update(attributes)


def _mesh() -> tuple[np.ndarray, np.ndarray]:
    """A disc of 762 inner and 16 border points, pulled over an ellipsoid; faces look out."""
    turns = 2.0 * np.pi * np.arange(16) / 16
    border = np.stack([np.cos(turns), np.sin(turns)], axis=1)
    steps = np.arange(762)
    radius = 0.93 * np.sqrt((steps + 0.5) / 762)
    angle = steps * np.pi * (3.0 - np.sqrt(5.0))
    inner = radius[:, None] * np.stack([np.cos(angle), np.sin(angle)], axis=1)
    disc = np.concatenate([inner, border])
    faces = Delaunay(disc).simplices
    polar = 0.85 * np.pi * np.linalg.norm(disc, axis=1)
    azimuth = np.arctan2(disc[:, 1], disc[:, 0])
    vertices = np.stack(
        [
            -0.10 * np.cos(polar),
            0.015 * np.sin(polar) * np.sin(azimuth),
            0.045 * np.sin(polar) * np.cos(azimuth),
        ],
        axis=1,
    )
    corners = vertices[faces]
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    inward = (normals * corners.mean(axis=1)).sum(axis=1) < 0.0
    faces[inward] = faces[inward, ::-1]
    for number, (x, z) in zip(_TIP_NUMBERS, _TIPS, strict=True):
        other = int(np.argmin(np.hypot(vertices[:, 0] - x, vertices[:, 2] - z)))
        vertices[[number, other]] = vertices[[other, number]]
        faces = np.where(faces == number, other, np.where(faces == other, number, faces))
    return vertices, faces
