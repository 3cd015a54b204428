"""Gaussians for other programs: colours from all around, scale, axes; PLY, SPZ and glTF.

What a clip taught of its light holds in front of its camera. Hands are therefore turned in front of
the camera, as the turntable does it, and a file remembers which colour each Gaussian had from which
side, as spherical harmonics of the direction in which it is looked at.
"""

from __future__ import annotations

import gzip
import json
import math
import struct
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import torch
from scipy.spatial.transform import Rotation

from hwp_bench.base.colors import srgb_to_linear
from hwp_bench.base.errors import BadInput, UsageError
from hwp_bench.capture import Capture
from hwp_bench.hands import TemplateTensors
from hwp_bench.methods.contract import HandPose
from wildghand.avatar.avatar import PosedGaussians, WildGHandAvatar
from wildghand.avatar.render import hands_of
from wildghand.gaussians.quaternions import quat_multiply, quat_third_axis

#: Turns in degrees: about the camera's vertical, then about its horizontal. The first is the front.
TURNS = (
    *((float(turn), 0.0) for turn in range(0, 360, 30)),
    *((float(turn), tilt) for tilt in (-40.0, 40.0) for turn in range(20, 380, 45)),
)
#: Highest degree of the harmonics of splat formats.
MAX_DEGREE = 3
# What the front counts more than another side: a file opens there. Cosine to the viewer from which
# a side counts, and what holds harmonics of degree 1 and more near zero.
_FRONT, _RIM, _RIDGE = 30.0, -0.2, 8e-5
# Without harmonics the front's colour is taken up to the rim: cosines of the change.
_AWAY, _TOWARDS = -0.2, 0.1
# Gaussians that are solved for at once.
_BATCH = 4096
# The polynomials of the 3DGS authors, with the constants in their order.
_C1 = 0.4886025119029199
_C2 = (1.0925484305920792, 0.31539156525252005, 0.5462742152960396)
_C3 = (
    0.5900435899266435,
    2.890611442640554,
    0.4570457994644658,
    0.3731763325901154,
    1.445305721320277,
)
#: Value of the constant spherical harmonic, 1 / (2 sqrt(pi)).
SH_CONSTANT = 0.28209479177387814


@dataclass(frozen=True, eq=False)
class PosedCamera:
    """Hands in front of a camera."""

    #: By side; in the fit's corrected poses.
    hands: Mapping[str, HandPose]
    #: (4, 4) world to camera.
    viewmat: np.ndarray


@dataclass(frozen=True, eq=False)
class SeenGaussians:
    """N Gaussians, and how they look from V sides."""

    #: In the place of the front; the colours are those seen there.
    splats: PosedGaussians
    #: (V, N, 3) unit, from the camera to the Gaussian.
    directions: np.ndarray
    #: (V, N, 3) sRGB.
    colors: np.ndarray
    #: (V, N) cosine between the Gaussian's normal and the way to the camera.
    facing: np.ndarray

    def moved(self, turn: np.ndarray, shift: np.ndarray) -> SeenGaussians:
        """The Gaussians after x -> turn x + shift, one for all or each its own, with colours."""
        turns = np.broadcast_to(turn, (len(self.splats), 3, 3))
        spins = np.roll(Rotation.from_matrix(turns).as_quat(), 1, axis=1).astype(np.float32)
        quats = torch.from_numpy(self.splats.quats.astype(np.float32))
        splats = replace(
            self.splats,
            means=(np.einsum("nij,nj->ni", turns, self.splats.means) + shift).astype(np.float32),
            quats=quat_multiply(torch.from_numpy(spins), quats).numpy(),
        )
        directions = np.einsum("nij,vnj->vni", turns, self.directions)
        return replace(self, splats=splats, directions=directions)


def standing(avatar: WildGHandAvatar, capture: Capture | None, frame: int) -> PosedCamera:
    """Hands as a frame of a capture shows them; without a capture, as they stand in the studio."""
    if capture is None:
        return PosedCamera(avatar.studio.posed(), np.eye(4))
    return PosedCamera(hands_of(avatar, capture, frame), capture.camera(frame).viewmat)


def turned(
    avatar: WildGHandAvatar, hands: Mapping[str, HandPose], turn: np.ndarray, centre: np.ndarray
) -> dict[str, HandPose]:
    """Hands after x -> turn (x - centre) + centre."""
    made, rotation = {}, Rotation.from_matrix(turn)
    for side, hand in hands.items():
        pose = np.array(hand.pose, dtype=np.float64)
        pose[0] = (rotation * Rotation.from_rotvec(pose[0])).as_rotvec()
        # Rotations leave the wrist where it is, so the translation carries it around.
        wrist = wrist_at_rest(avatar.model.rigs[side].template, hand.betas)
        transl = turn @ (wrist + hand.transl - centre) + centre - wrist
        made[side] = HandPose(side, pose, hand.betas, transl)
    return made


def wrist_at_rest(template: TemplateTensors, betas: np.ndarray) -> np.ndarray:
    """(3,) m, the joint about which a pose turns the whole hand."""
    basis = template.joint_basis[0].double().cpu().numpy()
    return np.asarray(template.joints[0].double().cpu().numpy() + basis @ np.asarray(betas))


def view_turn(viewmat: np.ndarray, turn: float, tilt: float) -> np.ndarray:
    """(3, 3) turn in the world about a camera's vertical, then its horizontal; degrees."""
    to_camera = viewmat[:3, :3]
    spin = Rotation.from_euler("yx", [turn, tilt], degrees=True).as_matrix()
    return np.asarray(to_camera.T @ spin @ to_camera)


def middle(splats: PosedGaussians) -> np.ndarray:
    """(3,) m, the middle of the box around Gaussians."""
    return np.asarray(0.5 * (splats.means.min(axis=0) + splats.means.max(axis=0)), dtype=np.float64)


def seen(avatar: WildGHandAvatar, place: PosedCamera) -> SeenGaussians:
    """The Gaussians of hands, and their colours while they turn in front of the camera."""
    front = avatar.pose(place.hands, closed=True, viewmat=place.viewmat)
    front.require_finite()
    centre = middle(front)
    camera = -place.viewmat[:3, :3].T @ place.viewmat[:3, 3]
    directions, colors, facing = [], [], []
    for turn, tilt in TURNS:
        spin = view_turn(place.viewmat, turn, tilt)
        splats = front
        if (turn, tilt) != TURNS[0]:
            hands = turned(avatar, place.hands, spin, centre)
            splats = avatar.pose(hands, closed=True, viewmat=place.viewmat)
            splats.require_finite()
        away = splats.means.astype(np.float64) - camera
        away /= np.linalg.norm(away, axis=1, keepdims=True)
        normals = quat_third_axis(torch.from_numpy(splats.quats.astype(np.float32))).numpy()
        facing.append(-(normals * away).sum(axis=1))
        directions.append(away @ spin)
        colors.append(splats.colors)
    return SeenGaussians(front, np.stack(directions), np.stack(colors), np.stack(facing))


def harmonics(given: SeenGaussians, degree: int) -> np.ndarray:
    """Spherical harmonics of the colours of N Gaussians, as splat formats keep them.

    A viewer draws 0.5 + sum of harmonics, cut at 0, in the direction from it to the Gaussian.

    Returns:
        (N, (degree + 1)^2, 3) float32, degree by degree.
    """
    count, size = len(given.splats), (degree + 1) ** 2
    if degree == 0:
        share = ((given.facing[0] - _AWAY) / (_TOWARDS - _AWAY)).clip(0.0, 1.0)[:, None]
        weights = given.facing.clip(min=0.0) ** 2 + 1e-9
        mean = (weights[..., None] * given.colors).sum(axis=0) / weights.sum(axis=0)[:, None]
        color = share * given.colors[0] + (1.0 - share) * mean
        return even_harmonics(color)
    weights = (given.facing - _RIM).clip(min=0.0) ** 2 + 1e-4
    weights[0] *= _FRONT
    ridge = _RIDGE * np.eye(size)
    ridge[0, 0] = 0.0
    found = np.empty((count, size, 3), dtype=np.float32)
    for start in range(0, count, _BATCH):
        rows = slice(start, start + _BATCH)
        basis, shares = sh_basis(given.directions[:, rows], degree), weights[:, rows]
        matrix = np.einsum("vn,vnk,vnl->nkl", shares, basis, basis, optimize=True)
        matrix += ridge * shares.sum(axis=0)[:, None, None]
        wanted = given.colors[:, rows].astype(np.float64) - 0.5
        right = np.einsum("vn,vnk,vnc->nkc", shares, basis, wanted, optimize=True)
        found[rows] = np.linalg.solve(matrix, right)
    return found


def even_harmonics(colors: np.ndarray) -> np.ndarray:
    """(N, 1, 3) harmonics of degree 0 of colours (N, 3) that are the same from every side."""
    return ((colors - 0.5) / SH_CONSTANT)[:, None].astype(np.float32)


def sh_basis(directions: np.ndarray, degree: int) -> np.ndarray:
    """Real spherical harmonics in the order and with the signs of splat formats."""
    x, y, z = np.moveaxis(directions, -1, 0)
    terms = [np.full_like(x, SH_CONSTANT)]
    if degree >= 1:
        terms += [-_C1 * y, _C1 * z, -_C1 * x]
    if degree >= 2:
        a, b, c = _C2
        terms += [a * x * y, -a * y * z, b * (2.0 * z * z - x * x - y * y), -a * x * z]
        terms += [c * (x * x - y * y)]
    if degree >= 3:
        a, b, c, d, e = _C3
        terms += [-a * y * (3.0 * x * x - y * y), b * x * y * z]
        terms += [-c * y * (4.0 * z * z - x * x - y * y)]
        terms += [d * z * (2.0 * z * z - 3.0 * x * x - 3.0 * y * y)]
        terms += [-c * x * (4.0 * z * z - x * x - y * y), e * z * (x * x - y * y)]
        terms += [-a * x * (x * x - 3.0 * y * y)]
    return np.stack(terms, axis=-1)


#: SuperSplat's grid has cells of one unit: a hand of 0.2 m is two of them long.
SUPERSPLAT_SCALE = 10.0
#: Half a turn about x: between y up and y down, z back and z front.
HALF_TURN = np.diag([1.0, -1.0, -1.0])
# Degrees about the vertical from the camera of a capture, which looks along z, to that of
# SuperSplat. It turns files half around z and looks from azimuth -45 degrees (controls.initialAzim
# of src/scene-config.ts in playcanvas/supersplat): from +x and +z of the file.
_SUPERSPLAT_TURN = 225.0


def scaled(splats: PosedGaussians, factor: float) -> PosedGaussians:
    """Make Gaussians larger or smaller about the origin."""
    require_scale(factor)
    with np.errstate(over="ignore"):
        made = replace(
            splats,
            means=(splats.means.astype(np.float64) * factor).astype(np.float32),
            scales=(splats.scales.astype(np.float64) * factor).astype(np.float32),
        )
    if not (np.isfinite(made.means).all() and np.isfinite(made.scales).all()):
        problem = f"is {factor:g}, by which numbers become infinite"
        raise UsageError(problem, field="--scale", remedy="Use a smaller one.")
    return made


def require_scale(factor: float) -> None:
    """Refuse a scale that is not one."""
    if not (np.isfinite(factor) and factor > 0.0):
        raise UsageError(f"is {factor}", field="--scale", remedy="Use a number above 0.")


def laid_to_rest(
    avatar: WildGHandAvatar, given: SeenGaussians, hands: Mapping[str, HandPose]
) -> SeenGaussians:
    """Move hands from the studio to where the hand model lies at rest, with their colours."""
    rest, owners = avatar.rest_poses(), _owners(avatar, tuple(hands))
    turns, shifts = np.empty((len(owners), 3, 3)), np.empty((len(owners), 3))
    for number, (side, hand) in enumerate(hands.items()):
        turn = Rotation.from_rotvec(hand.pose[0]).as_matrix().T
        wrist = wrist_at_rest(avatar.model.rigs[side].template, hand.betas)
        own = owners == number
        turns[own] = turn
        shifts[own] = wrist + rest[side].transl - turn @ (wrist + hand.transl)
    return given.moved(turns, shifts)


def for_supersplat(
    avatar: WildGHandAvatar, given: SeenGaussians, hands: Mapping[str, HandPose]
) -> SeenGaussians:
    """Turn hands so that SuperSplat opens them upright, palms to the viewer; y is down.

    Two hands keep their places to each other: what is upright is the mean of both.
    """
    angles = avatar.studio.angles
    upright = Rotation.concatenate(
        [
            angles[side].upright * Rotation.from_rotvec(hand.pose[0]).inv()
            for side, hand in hands.items()
        ]
    ).mean()
    turn = (Rotation.from_euler("y", _SUPERSPLAT_TURN, degrees=True) * upright).as_matrix()
    made = given.moved(turn, np.zeros(3))
    return made.moved(np.eye(3), -middle(made.splats))


def _owners(avatar: WildGHandAvatar, sides: tuple[str, ...]) -> np.ndarray:
    """(N,) which hand each Gaussian belongs to: those of the hands, then those of their caps."""
    counts = [len(avatar.model.rigs[side]) for side in sides]
    for side in sides:
        wall = avatar.model.wall(side)
        counts.append(0 if wall is None else len(wall))
    return np.repeat([*range(len(sides)), *range(len(sides))], counts)


_TYPES = {(): "SCALAR", (2,): "VEC2", (3,): "VEC3", (4,): "VEC4", (4, 4): "MAT4"}
_COMPONENTS = {"uint8": 5121, "uint16": 5123, "uint32": 5125, "float32": 5126}
#: What a buffer view is for: vertex attributes, indices of corners, or neither.
ATTRIBUTES, INDICES, OTHER = 34962, 34963, None


class GlbBuilder:
    """Collects arrays and JSON of one glTF file; the caller adds nodes and so on to `content`."""

    def __init__(self, generator: str) -> None:
        asset = {"version": "2.0", "generator": generator}
        self.content: dict[str, Any] = {"asset": asset, "accessors": [], "bufferViews": []}
        self._body = bytearray()

    def array(self, values: np.ndarray, target: int | None = OTHER, *, bounds: bool = False) -> int:
        """Add an array and return the number of its accessor.

        Matrices (N, 4, 4) are given by rows and kept by columns.
        """
        if not np.isfinite(values).all():
            raise BadInput(
                "holds NaN or infinity, which glTF does not know",
                field=f"array {len(self.content['accessors'])}",
                remedy="The avatar or the motion is damaged; nothing is written.",
            )
        kind = _TYPES[values.shape[1:]]
        flat = values.transpose(0, 2, 1) if kind == "MAT4" else values
        accessor: dict[str, Any] = {
            "bufferView": self._view(np.ascontiguousarray(flat).tobytes(), target),
            "componentType": _COMPONENTS[values.dtype.name],
            "count": len(values),
            "type": kind,
        }
        if bounds:
            rows = values.reshape(len(values), -1)
            accessor["min"] = rows.min(axis=0).tolist()
            accessor["max"] = rows.max(axis=0).tolist()
        self.content["accessors"].append(accessor)
        return len(self.content["accessors"]) - 1

    def image(self, png: bytes) -> int:
        """Add a PNG image and return its number."""
        images = self.content.setdefault("images", [])
        images.append({"bufferView": self._view(png, OTHER), "mimeType": "image/png"})
        return len(images) - 1

    def _view(self, data: bytes, target: int | None) -> int:
        self._body.extend(b"\0" * (-len(self._body) % 4))
        view: dict[str, Any] = {"buffer": 0, "byteOffset": len(self._body), "byteLength": len(data)}
        if target is not None:
            view["target"] = target
        self.content["bufferViews"].append(view)
        self._body.extend(data)
        return len(self.content["bufferViews"]) - 1

    def to_bytes(self) -> bytes:
        """Return the file: a header, a chunk of JSON and a chunk of binary data."""
        content = {**self.content, "buffers": [{"byteLength": len(self._body)}]}
        text = json.dumps(content, separators=(",", ":"), allow_nan=False).encode()
        text += b" " * (-len(text) % 4)
        body = bytes(self._body) + b"\0" * (-len(self._body) % 4)
        length = 12 + 8 + len(text) + 8 + len(body)
        return b"".join(
            (
                struct.pack("<4sII", b"glTF", 2, length),
                struct.pack("<I4s", len(text), b"JSON"),
                text,
                struct.pack("<I4s", len(body), b"BIN\0"),
                body,
            )
        )


#: Viewers take logits and logarithms: an opacity of 1 or a scale of 0 would be infinite.
OPACITIES = (1e-6, 1.0 - 1e-6)
#: Smallest standard deviation, m.
SMALLEST_SCALE = 1e-12


def ply_bytes(splats: PosedGaussians, harmonics: np.ndarray, comments: Sequence[str] = ()) -> bytes:
    """Return N Gaussians as binary little-endian PLY, with the (N, K, 3) harmonics of colours."""
    count = len(splats)
    visible = np.clip(splats.opacities, *OPACITIES)
    rest = harmonics[:, 1:].transpose(0, 2, 1).reshape(count, 3 * (harmonics.shape[1] - 1))
    table = np.concatenate(
        (
            splats.means,
            np.zeros((count, 3)),
            harmonics[:, 0],
            rest,
            np.log(visible / (1.0 - visible))[:, None],
            np.log(np.maximum(splats.scales, SMALLEST_SCALE)),
            splats.quats,
        ),
        axis=1,
    ).astype("<f4")
    names = ["x", "y", "z", "nx", "ny", "nz", "f_dc_0", "f_dc_1", "f_dc_2"]
    names += [f"f_rest_{number}" for number in range(rest.shape[1])]
    names += ["opacity", "scale_0", "scale_1", "scale_2", "rot_0", "rot_1", "rot_2", "rot_3"]
    header = ["ply", "format binary_little_endian 1.0", *(f"comment {line}" for line in comments)]
    header.append(f"element vertex {count}")
    header += [f"property float {name}" for name in names] + ["end_header", ""]
    return "\n".join(header).encode("ascii") + table.tobytes()


#: "NGSP", read as a little-endian number, and the version of the format.
MAGIC, VERSION = 0x5053474E, 3
#: Bits of a coordinate behind the point: 24-bit numbers reach +-64 units in steps of 0.01 mm.
FRACTIONAL_BITS = 17
#: A colour's harmonic is kept in steps of 1 / (255 * 0.15).
COLOR_SCALE = 0.15
_LOG_SCALES = (-10.0, 16.0)
_SMALLEST_THREE = 511.0


def spz_bytes(splats: PosedGaussians, harmonics: np.ndarray) -> bytes:
    """Return N Gaussians as SPZ, with the (N, K, 3) harmonics of their colours.

    Those of degree 1 and more are cut to [-1, 1].
    """
    fixed = np.rint(splats.means.astype(np.float64) * 2**FRACTIONAL_BITS)
    if len(fixed) and np.abs(fixed).max() >= 2**23:
        raise UsageError(
            f"a Gaussian lies {np.abs(splats.means).max():.1f} units from the origin",
            field="means",
            remedy=f"SPZ reaches {2 ** (23 - FRACTIONAL_BITS)} units; use a smaller --scale.",
        )
    places = fixed.astype("<i4").view(np.uint8).reshape(-1, 3, 4)[..., :3]
    opacities = _byte(255.0 * splats.opacities)
    degree = math.isqrt(harmonics.shape[1]) - 1
    colors = _byte(harmonics[:, 0] * (COLOR_SCALE * 255.0) + 127.5)
    others = _byte(harmonics[:, 1:] * 128.0 + 128.0)
    low, steps = _LOG_SCALES
    scales = _byte((np.log(np.maximum(splats.scales, 1e-12)) - low) * steps)
    header = struct.pack("<IIIBBBB", MAGIC, VERSION, len(splats), degree, FRACTIONAL_BITS, 0, 0)
    arrays = (places, opacities, colors, scales, packed_rotations(splats.quats), others)
    body = header + b"".join(np.ascontiguousarray(array).tobytes() for array in arrays)
    return gzip.compress(body, mtime=0)


def packed_rotations(quats: np.ndarray) -> np.ndarray:
    """Pack unit quaternions (N, 4) into (N,) uint32.

    They hold the three smallest components in 10 bits each, and which one is missing.
    """
    # The format counts components x, y, z, w.
    turned = np.roll(quats.astype(np.float64), -1, axis=1)
    turned /= np.linalg.norm(turned, axis=1, keepdims=True)
    largest = np.abs(turned).argmax(axis=1)
    rows = np.arange(len(turned))
    # A quaternion and its negative are one rotation: the largest component is positive.
    turned *= np.where(turned[rows, largest] < 0.0, -1.0, 1.0)[:, None]
    packed = largest.astype(np.uint32)
    for component in range(4):
        value = turned[:, component]
        size = np.rint(np.abs(value) * np.sqrt(2.0) * _SMALLEST_THREE).clip(0, 511)
        bits = size.astype(np.uint32) | (value < 0.0).astype(np.uint32) << np.uint32(9)
        packed = np.where(component == largest, packed, packed << np.uint32(10) | bits)
    return packed.astype("<u4")


def _byte(values: np.ndarray) -> np.ndarray:
    return np.rint(values).clip(0, 255).astype(np.uint8)


#: Name of the extension.
EXTENSION = "KHR_gaussian_splatting"


def splat_glb_bytes(splats: PosedGaussians, harmonics: np.ndarray, generator: str) -> bytes:
    """Return N Gaussians as one primitive of points, with the (N, K, 3) harmonics of colours.

    Programs that do not know the extension show coloured points.
    """
    made = GlbBuilder(generator)
    # COLOR_0 is linear in glTF, the extension's own colours are sRGB.
    shown = srgb_to_linear(splats.colors.clip(0.0, 1.0))
    colors = np.concatenate((shown, splats.opacities[:, None]), axis=1).clip(0.0, 1.0)
    quats = np.roll(splats.quats, -1, axis=1)
    own = {
        "SCALE": splats.scales,
        "ROTATION": quats / np.linalg.norm(quats, axis=1, keepdims=True),
        "OPACITY": splats.opacities,
    }
    for number in range(harmonics.shape[1]):
        degree = math.isqrt(number)
        own[f"SH_DEGREE_{degree}_COEF_{number - degree**2}"] = harmonics[:, number]
    attributes = {
        "POSITION": made.array(splats.means.astype(np.float32), ATTRIBUTES, bounds=True),
        "COLOR_0": made.array(colors.astype(np.float32), ATTRIBUTES),
        **{
            f"{EXTENSION}:{name}": made.array(values.astype(np.float32), ATTRIBUTES)
            for name, values in own.items()
        },
    }
    kernel = {
        "kernel": "ellipse",
        "colorSpace": "srgb_rec709_display",
        "projection": "perspective",
        "sortingMethod": "cameraDistance",
    }
    points = {"attributes": attributes, "mode": 0, "extensions": {EXTENSION: kernel}}
    made.content |= {
        "extensionsUsed": [EXTENSION],
        "scene": 0,
        "scenes": [{"nodes": [0]}],
        "nodes": [{"mesh": 0, "name": "hand"}],
        "meshes": [{"primitives": [points]}],
    }
    return made.to_bytes()
