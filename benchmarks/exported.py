"""How near exported files come to the turntable of their avatar.

    python -m benchmarks.exported AVATAR [--pictures FOLDER]

The avatar is exported at rest, as a .ply of Gaussians with harmonics and without, and as a mesh.
The files are read again and drawn from sides of the turntable; PSNR is over the hand's box.
"""

from __future__ import annotations

import argparse
import tempfile
from pathlib import Path
from typing import Any

import numpy as np
import torch
import trimesh
from scipy.ndimage import map_coordinates
from scipy.spatial.transform import Rotation

from hwp_bench.base.images import as_uint8, write_image
from hwp_bench.base.rays import ray_mesh
from hwp_bench.hands.skeleton import Camera, HandPose
from wildghand.avatar.avatar import WildGHandAvatar
from wildghand.avatar.files import load_avatar
from wildghand.export.formats import ExportSettings, export
from wildghand.export.splats import sh_basis, turned, view_turn, wrist_at_rest
from wildghand.splat import rasterize

# Sides that are drawn: degrees about the vertical, then about the horizontal.
SIDES = ((0, 0), (30, 0), (90, 0), (180, 0), (270, 0), (20, 30))
SIZE = 480
# Samples along an edge of a pixel of the mesh.
_SAMPLES = 2
Place = tuple[np.ndarray, np.ndarray]


def main() -> None:
    """Print a table."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("avatar", type=Path)
    parser.add_argument("--pictures", type=Path, help="folder for pictures side by side")
    args = parser.parse_args()
    avatar = load_avatar(args.avatar)
    # The exports of two hands lie elsewhere; one is enough to measure.
    side, camera = avatar.sides[0], avatar.studio.camera(SIZE, SIZE)
    front = avatar.studio.posed()[side]
    with tempfile.TemporaryDirectory() as folder:
        files = {
            "splats": (Path(folder) / "splats.ply", ExportSettings()),
            "one colour": (Path(folder) / "plain.ply", ExportSettings(harmonics=0)),
            "mesh": (Path(folder) / "mesh.glb", ExportSettings(mesh=True)),
        }
        for path, settings in files.values():
            export(avatar, path, settings)
        print(f"{'turn':>5} {'tilt':>5} " + " ".join(f"{name:>10}" for name in files) + "   dB")
        for turn, tilt in SIDES:
            spin = view_turn(np.eye(4), turn, tilt)
            hand = turned(avatar, {side: front}, spin, avatar.studio.centre)[side]
            shown, place = avatar.render({side: hand}, camera), _from_rest(avatar, hand)
            drawn = {
                "splats": _draw_splats(files["splats"][0], place, camera),
                "one colour": _draw_splats(files["one colour"][0], place, camera),
                "mesh": _draw_mesh(files["mesh"][0], place, camera),
            }
            box = _box(shown)
            found = [_psnr(image[box], shown[box][..., :3]) for image in drawn.values()]
            print(f"{turn:5d} {tilt:5d} " + " ".join(f"{each:10.1f}" for each in found), flush=True)
            if args.pictures:
                pair = np.concatenate([shown[..., :3], *drawn.values()], axis=1)
                write_image(args.pictures / f"{turn:03d}_{tilt:02d}.png", as_uint8(pair))


def _from_rest(avatar: WildGHandAvatar, hand: HandPose) -> Place:
    """The motion from the file, where the hand is at rest, to where it stands."""
    wrist = wrist_at_rest(avatar.model.rigs[hand.side].template, hand.betas)
    turn = Rotation.from_rotvec(hand.pose[0]).as_matrix()
    rest = avatar.rest_poses()[hand.side].transl
    return turn, wrist + hand.transl - turn @ (wrist + rest)


def _draw_splats(path: Path, place: Place, camera: Camera) -> np.ndarray:
    header, _, body = path.read_bytes().partition(b"end_header\n")
    names = [line.split()[2] for line in header.decode().splitlines() if "property" in line]
    table = np.frombuffer(body, "<f4").reshape(-1, len(names))
    column = dict(zip(names, table.T, strict=True))

    def stacked(pattern: str, count: int) -> np.ndarray:
        return np.stack([column[pattern.format(number)] for number in range(count)], axis=1)

    turn, shift = place
    means = np.stack([column[axis] for axis in "xyz"], axis=1) @ turn.T + shift
    spins = Rotation.from_quat(np.roll(stacked("rot_{}", 4), -1, axis=1))
    quats = np.roll((Rotation.from_matrix(turn) * spins).as_quat(), 1, axis=1)
    rest = sum(name.startswith("f_rest") for name in names)
    others = np.zeros((len(means), 3, 0))
    if rest:
        others = stacked("f_rest_{}", rest).reshape(len(means), 3, -1)
    harmonics = np.concatenate([stacked("f_dc_{}", 3)[..., None], others], axis=2)
    directions = means / np.linalg.norm(means, axis=1, keepdims=True)
    basis = sh_basis(directions @ turn, int(np.sqrt(harmonics.shape[2])) - 1)
    colors = (0.5 + np.einsum("nk,nck->nc", basis, harmonics)).clip(min=0.0)
    opacities = 1.0 / (1.0 + np.exp(-column["opacity"]))
    tensors: dict[str, Any] = {
        "means": means,
        "quats": quats,
        "scales": np.exp(stacked("scale_{}", 3)),
        "opacities": opacities,
        "colors": colors,
        "viewmats": camera.viewmat[None],
        "Ks": camera.K[None],
    }
    for name, values in tensors.items():
        tensors[name] = torch.as_tensor(np.ascontiguousarray(values), dtype=torch.float32)
    image, _, _ = rasterize(**tensors, width=camera.width, height=camera.height)
    return image[0].clamp(0.0, 1.0).numpy()


def _draw_mesh(path: Path, place: Place, camera: Camera) -> np.ndarray:
    mesh = next(iter(trimesh.load(path).geometry.values()))
    texture = np.asarray(mesh.visual.material.baseColorTexture.convert("RGB")) / 255.0
    turn, shift = place
    surface = ray_mesh(mesh.vertices @ turn.T + shift, np.asarray(mesh.faces))
    rows, columns = np.mgrid[: SIZE * _SAMPLES, : SIZE * _SAMPLES]
    pixels = np.stack([columns + 0.5, rows + 0.5, np.full(rows.shape, _SAMPLES)], axis=-1)
    rays = pixels.reshape(-1, 3) / _SAMPLES @ np.linalg.inv(camera.K).T
    ray, face, u, v, _ = surface.first_hits(np.zeros((1, 3)), rays)
    mix = np.stack([1.0 - u - v, u, v], axis=1)
    uv = (mesh.visual.uv[mesh.faces[face]] * mix[..., None]).sum(axis=1)
    texel = np.stack([1.0 - uv[:, 1], uv[:, 0]]) * len(texture) - 0.5
    image = np.zeros((len(rays), 3))
    for channel in range(3):
        image[ray, channel] = map_coordinates(texture[..., channel], texel, order=1, mode="nearest")
    return image.reshape(SIZE, _SAMPLES, SIZE, _SAMPLES, 3).mean(axis=(1, 3))


def _psnr(image: np.ndarray, other: np.ndarray) -> float:
    return float(-10.0 * np.log10(np.square(image - other).mean() + 1e-12))


def _box(rgba: np.ndarray) -> tuple[slice, slice]:
    rows, columns = np.nonzero(rgba[..., 3] > 0.5)
    return slice(rows.min(), rows.max() + 1), slice(columns.min(), columns.max() + 1)


if __name__ == "__main__":
    main()
