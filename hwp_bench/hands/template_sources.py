"""Load a template: the free hand that ships, or MANO from a file of the user."""

from __future__ import annotations

import os
from pathlib import Path

import numpy as np

from hwp_bench.base.arrays import read_npz, take
from hwp_bench.base.errors import BadHandModel, UsageError
from hwp_bench.hands.skeleton import SIDES
from hwp_bench.hands.template import (
    JOINT_COUNT,
    SHAPE_COUNT,
    HandTemplate,
    make_template,
    mirror_template,
)
from hwp_bench.hands.topology import MANO_HD_NAME, mano_hd

#: Name and version of the free template; a new version is another model with other digests.
FREE_NAME = "anny-1"

#: Digest of the free right hand: every machine must find the same one.
FREE_DIGEST = "5fa677ef2e4ce395ddecfa2b6c97608f5cbe6b93a0c6c13561572f98e0a7beba"

#: The free right hand: CC0 data, made by `python -m hwp_bench.hands.anny_extract OUT.npz`. It
#: ships because making it takes 20 seconds, a gigabyte of memory, and packages that nothing else
#: needs, and because all users then have the same file.
FREE_FILE = Path(__file__).parent / "data" / f"{FREE_NAME}.npz"


def load_template(
    source: str = "anny",
    side: str = "right",
) -> HandTemplate:
    """Load a hand template.

    Args:
        source: "anny", the free hand that ships with the toolkit; "mano:PATH", a MANO file or
            the folder that holds MANO_RIGHT.pkl and MANO_LEFT.pkl; "mano-hd:PATH", the same at
            49,281 vertices.
        side: "right" or "left".

    Raises:
        UsageError: the source or the side is unknown.
        BadHandModel: the file is missing, damaged, or not a hand model.
        UnsafePickle: the MANO file asks for something that is not plain data.
    """
    if side not in SIDES:
        raise UsageError(f"{side!r} is not a side", field="side", remedy="Use right or left.")
    kind, _, path = source.partition(":")
    if kind == "anny" and not path:
        right = _free_template()
        return right if side == "right" else mirror_template(right)
    if kind in ("mano", MANO_HD_NAME) and path:
        from hwp_bench.hands.mano import load_mano

        template = load_mano(path, side)
        return template if kind == "mano" else mano_hd(template)
    raise UsageError(
        f"{source!r} is not a hand model",
        field="source",
        remedy="Use anny, mano:PATH or mano-hd:PATH.",
    )


def _free_template() -> HandTemplate:
    template = read_free(FREE_FILE)
    if template.digest != FREE_DIGEST:
        raise BadHandModel(
            "is not the published free hand",
            where=FREE_FILE,
            remedy="Install the toolkit again.",
        )
    return template


def read_free(path: Path) -> HandTemplate:
    """Read a right hand that `hwp_bench.hands.anny_extract` wrote.

    Raises:
        BadInput: missing, damaged, or not such arrays.
    """
    arrays = read_npz(path)

    def floats(name: str, *shape: int | None) -> np.ndarray:
        return take(arrays, name, shape, where=path)

    def indices(name: str, *shape: int | None) -> np.ndarray:
        return take(arrays, name, shape, where=path, dtype=np.int64)

    return make_template(
        name=FREE_NAME,
        side="right",
        vertices=floats("vertices", None, 3),
        faces=indices("faces", None, 3),
        shape_basis=floats("shape_basis", None, 3, SHAPE_COUNT),
        pose_basis=None,
        joints=floats("joints", JOINT_COUNT, 3),
        joint_basis=floats("joint_basis", JOINT_COUNT, 3, SHAPE_COUNT),
        weights=floats("weights", None, JOINT_COUNT),
        mean_pose=np.zeros(3 * (JOINT_COUNT - 1)),
        uv=floats("uv", None, 2),
        face_uv=indices("face_uv", None, 3),
        fingertips=indices("fingertips", 5),
        where=os.fspath(path),
    )
