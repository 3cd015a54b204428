"""The hands of one frame as meshes that other programs open, written by trimesh."""

from __future__ import annotations

import os
from pathlib import Path

import numpy as np
import torch
import trimesh

from hwp_bench.base.errors import UsageError
from hwp_bench.base.files import atomic_write
from hwp_bench.capture.reader import Capture
from hwp_bench.hands import pose_hand, to_trimesh

#: Mesh formats by the ending of the file; of these only `.glb` keeps two hands apart by name.
FORMATS = (".glb", ".obj", ".ply", ".stl")


def hand_meshes(capture: Capture, frame: int, *, truth: bool = False) -> dict[str, trimesh.Trimesh]:
    """Return the posed meshes of the hands in one frame, by side, in world coordinates, m.

    Args:
        capture: the capture.
        frame: the frame.
        truth: take the true parameters, which simulated captures know, instead of the estimates.

    Raises:
        UsageError: there is no such frame, or the capture does not know the truth.
        BadInput: the hand model that is installed here is another than the capture's.
    """
    poses = capture.hand_poses(frame)
    hands = capture.hands
    if truth:
        known = capture.true_hands
        if known is None:
            raise UsageError(
                "does not know the true hand parameters",
                where=capture.root,
                remedy="Only simulated captures do; leave out --truth.",
            )
        hands = known
    meshes = {}
    for side in poses:
        template, hand = capture.template(side), hands[side]
        arrays = (hand.pose[frame : frame + 1], hand.betas, hand.transl[frame : frame + 1])
        tensors = [torch.from_numpy(np.asarray(array, dtype=np.float64)) for array in arrays]
        posed = pose_hand(template.to_torch(torch.float64), tensors[0], tensors[1], tensors[2])
        meshes[side] = to_trimesh(posed.vertices[0], template.faces)
    return meshes


def write_meshes(meshes: dict[str, trimesh.Trimesh], path: str | os.PathLike[str]) -> Path:
    """Write meshes into one file, whose ending says the format.

    Args:
        meshes: by name.
        path: a file that ends in one of `FORMATS`; replaced if it exists.

    Raises:
        UsageError: the ending is not a known format.
        HwpError: the file cannot be written.
    """
    path = Path(path)
    if path.suffix.lower() not in FORMATS:
        raise UsageError(
            f"ends in {path.suffix or 'nothing'!r}",
            where=path,
            remedy=f"Use one of {', '.join(FORMATS)}.",
        )
    kind = path.suffix.lower().removeprefix(".")
    scene = trimesh.Scene()
    for side, mesh in meshes.items():
        scene.add_geometry(mesh, geom_name=f"{side}_hand")
    whole = scene if kind == "glb" else scene.to_mesh()
    return atomic_write(path, whole.export(file_obj=None, file_type=kind))
