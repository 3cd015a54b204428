"""Hand models to load: the free hand that ships, or MANO from a file of the user."""

from __future__ import annotations

import contextlib
import os
import re
from pathlib import Path
from typing import Any

import numpy as np

from hwp_bench.base.arrays import read_npz
from hwp_bench.base.errors import BadHandModel, UsageError
from hwp_bench.base.unpickle import StandIn, load_pickle
from hwp_bench.hands.skeleton import JOINT_COUNT, PARENTS, SHAPE_COUNT, SIDES, palm_directions
from hwp_bench.hands.template import (
    MANO_HD_NAME,
    POSE_FEATURE_COUNT,
    HandTemplate,
    make_template,
    mano_hd,
    mirror_template,
)

#: Size of the MANO mesh.
VERTEX_COUNT = 778
FACE_COUNT = 1538
#: Finger tip vertices: thumb, index, middle, ring, little.
FINGERTIPS = (744, 320, 443, 554, 671)
#: The file has 4 MB.
MAX_FILE_BYTES = 64 * 1024 * 1024
#: The file has some 500 steps; lists of numbers in place of arrays have one each.
MAX_FILE_STEPS = 2_000_000
_STAND_INS = (
    "chumpy.*",
    "scipy.sparse.csc.csc_matrix",
    "scipy.sparse._csc.csc_matrix",
)
_REMEDY = "Use MANO_RIGHT.pkl or MANO_LEFT.pkl of mano_v1_2, as downloaded."
# The left file as published has the right hand's sign in x of its shape basis. Like every
# MANO layer we detect it by the summed difference from the right file (m).
_SAME_SHAPES_BELOW = 1.0
# Space between a chart and the border of its half, in texture units.
_MARGIN = 0.01


def load_mano(path: str | os.PathLike[str], side: str) -> HandTemplate:
    """Read one MANO hand.

    The left file's shape basis has the wrong sign in x as published. It is corrected, unless the
    right file in the same folder shows that it has been corrected already.

    Source: Romero et al., "Embodied Hands" (SIGGRAPH Asia 2017); the sign of the left hand is
    issue 48 of the `smplx` repository.
    """
    file = _find(Path(path), side)
    content = _read(file)
    vertices = _dense(content, "v_template", (VERTEX_COUNT, 3), file)
    faces = _dense(content, "f", (FACE_COUNT, 3), file).astype(np.int64)
    if faces.min() < 0 or faces.max() >= VERTEX_COUNT:
        raise BadHandModel("a face has a corner that is not a vertex", where=file, field="f")
    shape_basis = _dense(content, "shapedirs", (VERTEX_COUNT, 3, SHAPE_COUNT), file)
    if side == "left" and not _is_corrected(shape_basis, file):
        shape_basis = shape_basis * np.array([-1.0, 1.0, 1.0])[:, None]
    regressor = _dense(content, "J_regressor", (JOINT_COUNT, VERTEX_COUNT), file)
    # The root's parent is -1 in an unsigned type.
    tree = _dense(content, "kintree_table", (2, JOINT_COUNT), file)
    if tuple(tree[0, 1:].astype(np.int64)) != PARENTS[1:]:
        raise BadHandModel("is not MANO's joint tree", where=file, field="kintree_table")
    joints = regressor @ vertices
    uv, face_uv = two_chart_uv(vertices, faces, joints, side)
    return make_template(
        name="mano",
        side=side,
        vertices=vertices,
        faces=faces,
        shape_basis=shape_basis,
        pose_basis=_dense(content, "posedirs", (VERTEX_COUNT, 3, POSE_FEATURE_COUNT), file),
        joints=joints,
        joint_basis=np.einsum("jv,vck->jck", regressor, shape_basis),
        weights=_dense(content, "weights", (VERTEX_COUNT, JOINT_COUNT), file),
        mean_pose=_dense(content, "hands_mean", (3 * (JOINT_COUNT - 1),), file),
        uv=uv,
        face_uv=face_uv,
        fingertips=np.array(FINGERTIPS),
        where=os.fspath(file),
    )


def two_chart_uv(
    vertices: np.ndarray, faces: np.ndarray, joints: np.ndarray, side: str
) -> tuple[np.ndarray, np.ndarray]:
    """Flatten the back of a hand into the left half of the atlas, its palm into the right half.

    A face belongs to the side that it faces; both charts are the same parallel projection
    onto the palm's plane, fingers up, at one scale, so that no face is turned over and lengths
    in the atlas are comparable. Faces seen edge-on become thin. Returns `uv` and `face_uv`.
    """
    palm = palm_directions(joints, side)
    # Seen from behind, the thumb of a right hand is on the left; from its palm, on the right.
    from_behind = -palm.thumbward if side == "right" else palm.thumbward
    height = vertices @ palm.forward
    width = vertices @ from_behind
    extent = max(np.ptp(height) / (1.0 - 2.0 * _MARGIN), np.ptp(width) / (0.5 - 2.0 * _MARGIN))
    v = _MARGIN + (height - height.min()) / extent
    u_back = _MARGIN + (width - width.min()) / extent
    u_palm = 0.5 + _MARGIN + (width.max() - width) / extent
    corners = vertices[faces]
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    is_palm = normals @ palm.palmar > 0.0
    count = len(vertices)
    both = np.concatenate([np.stack([u_back, v], axis=1), np.stack([u_palm, v], axis=1)])
    used, face_uv = np.unique(faces + count * is_palm[:, None], return_inverse=True)
    return both[used], face_uv.reshape(faces.shape).astype(np.int64)


def _find(path: Path, side: str) -> Path:
    """Find the file of one side in a folder, or next to the file of the other side."""
    expected = f"MANO_{side.upper()}.pkl"
    if path.is_file():
        named = re.search("right|left", path.name, re.IGNORECASE)
        if named is None or named.group().lower() == side:
            return path
        path = path.parent
    for file in (path / expected, path / "models" / expected):
        if file.is_file():
            return file
    raise BadHandModel(
        f"does not contain {expected}",
        where=path,
        remedy="Download MANO from its own site (its licence forbids us to pass it on).",
    )


def _read(file: Path) -> dict[str, Any]:
    content = load_pickle(
        file, stand_ins=_STAND_INS, max_bytes=MAX_FILE_BYTES, max_steps=MAX_FILE_STEPS
    )
    if not isinstance(content, dict):
        raise BadHandModel("does not contain a table of named arrays", where=file, remedy=_REMEDY)
    return content


def _is_corrected(shape_basis: np.ndarray, left: Path) -> bool:
    try:
        right = _find(left.parent, "right")
    except BadHandModel:
        return False
    other = _dense(_read(right), "shapedirs", shape_basis.shape, right)
    return bool(np.abs(shape_basis[:, 0] - other[:, 0]).sum() >= _SAME_SHAPES_BELOW)


def _dense(content: dict[str, Any], field: str, shape: tuple[int, ...], file: Path) -> np.ndarray:
    """A field as a float64 array of the expected shape, from any of its stored types."""
    if field not in content:
        raise BadHandModel("is missing", where=file, field=field, remedy=_REMEDY)
    try:
        array = np.asarray(_unwrap(content[field]), dtype=np.float64)
        if array.ndim == 1:
            # chumpy selections are stored flat.
            array = array.reshape(shape)
        if array.shape != shape:
            raise ValueError(f"its shape is {array.shape}")
    # An integer beyond the floats overflows.
    except (TypeError, ValueError, ArithmeticError, LookupError, RecursionError) as error:
        raise BadHandModel(
            f"cannot be read as an array of shape {shape} ({error})",
            where=file,
            field=field,
            remedy=_REMEDY,
        ) from error
    if not np.isfinite(array).all():
        raise BadHandModel("holds NaN or infinity", where=file, field=field, remedy=_REMEDY)
    return array


def _unwrap(value: Any) -> Any:
    """The numbers inside chumpy's and scipy's objects."""
    if not isinstance(value, StandIn):
        return value
    state = value.state
    if value.origin.endswith("csc_matrix"):
        return _densify(state)
    if "idxs" in state:
        chosen = np.asarray(state["idxs"], dtype=np.int64)
        return np.asarray(_unwrap(state["a"]), dtype=np.float64).ravel()[chosen]
    return state["x"]


def _densify(state: dict[str, Any]) -> np.ndarray:
    from scipy.sparse import csc_matrix

    shape = state["_shape"] if "_shape" in state else state["shape"]
    rows, columns = (int(length) for length in shape)
    if rows > JOINT_COUNT or columns > VERTEX_COUNT:
        raise ValueError(f"its shape is {shape}")
    # With their types: text among numbers would make numpy give every number room for the text.
    data = np.asarray(state["data"], dtype=np.float64)
    indices, indptr = (np.asarray(state[key], dtype=np.int64) for key in ("indices", "indptr"))
    matrix = csc_matrix((data, indices, indptr), shape=(rows, columns))
    matrix.check_format(full_check=True)
    return matrix.toarray()


#: Name and version of the free template; a new version is another model with other digests.
FREE_NAME = "anny-1"

#: Digest of the free right hand: every machine must find the same one.
FREE_DIGEST = "5fa677ef2e4ce395ddecfa2b6c97608f5cbe6b93a0c6c13561572f98e0a7beba"

#: The free right hand: CC0 data, made by `python -m tools.extract_hand OUT.npz`. It
#: ships because making it takes 20 seconds, a gigabyte of memory, and packages that nothing else
#: needs, and because all users then have the same file.
FREE_FILE = Path(__file__).parent / "data" / f"{FREE_NAME}.npz"


def absolute_source(source: str) -> str:
    """A hand model's source with the full path of its files: methods run in other folders."""
    kind, _, path = source.partition(":")
    return f"{kind}:{Path(path).absolute()}" if path else source


def load_template(source: str = "anny", side: str = "right") -> HandTemplate:
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
        right = read_free(FREE_FILE)
        if right.digest != FREE_DIGEST:
            said, remedy = "is not the published free hand", "Install the toolkit again."
            raise BadHandModel(said, where=FREE_FILE, remedy=remedy)
        return right if side == "right" else mirror_template(right)
    if kind in ("mano", MANO_HD_NAME) and path:
        template = load_mano(path, side)
        return template if kind == "mano" else mano_hd(template)
    raise UsageError(
        f"{source!r} is not a hand model",
        field="source",
        remedy="Use anny, mano:PATH or mano-hd:PATH.",
    )


def template_files(source: str) -> list[Path]:
    """The user's files of both hands that `load_template` reads, without missing ones."""
    kind, _, path = source.partition(":")
    found = []
    for side in SIDES if kind in ("mano", MANO_HD_NAME) else ():
        with contextlib.suppress(BadHandModel):
            found.append(_find(Path(path), side))
    return found


def read_free(path: Path) -> HandTemplate:
    """Read a right hand that `tools.extract_hand` wrote."""
    arrays = read_npz(path)
    names = ["vertices", "faces", "shape_basis", "joints", "joint_basis", "weights"]
    names += ["uv", "face_uv", "fingertips"]
    for name in names:
        if name not in arrays:
            raise BadHandModel("is missing", where=path, field=name)
    return make_template(
        name=FREE_NAME,
        side="right",
        where=os.fspath(path),
        pose_basis=None,
        mean_pose=np.zeros(3 * (JOINT_COUNT - 1)),
        **{name: arrays[name] for name in names},
    )
