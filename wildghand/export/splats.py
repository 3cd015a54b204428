"""Gaussians for other programs: colours from all around, scale, and the axes of those programs.

What a clip taught of its light holds in front of its camera. Hands are therefore turned in front of
the camera, as the turntable does it, and a file remembers which colour each Gaussian had from which
side, as spherical harmonics of the direction in which it is looked at.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np
import torch
from scipy.spatial.transform import Rotation

from hwp_bench.base.errors import UsageError
from hwp_bench.capture import Capture
from hwp_bench.hands import TemplateTensors
from hwp_bench.methods.contract import HandPose
from wildghand.avatar.avatar import PosedGaussians, WildGHandAvatar
from wildghand.avatar.render import shown_sides
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
class Standing:
    """Hands in front of a camera."""

    #: By side; in the poses that the fit believes in.
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
        """The Gaussians after x -> turn x + shift, with their colours.

        Args:
            turn: (3, 3) rotation, or (N, 3, 3).
            shift: (3,) m, or (N, 3).
        """
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


def standing(avatar: WildGHandAvatar, capture: Capture | None, frame: int) -> Standing:
    """Hands as a frame of a capture shows them; without a capture, as they stand in the studio."""
    if capture is None:
        return Standing(avatar.studio.posed(), np.eye(4))
    shown = capture.hand_poses(frame)
    hands = avatar.believed({side: shown[side] for side in shown_sides(avatar, capture)})
    return Standing(hands, capture.camera(frame).viewmat)


def turned(
    avatar: WildGHandAvatar, hands: Mapping[str, HandPose], turn: np.ndarray, centre: np.ndarray
) -> dict[str, HandPose]:
    """Hands after x -> turn (x - centre) + centre.

    Args:
        turn: (3, 3) rotation.
        centre: (3,) m.
    """
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


def seen(avatar: WildGHandAvatar, place: Standing) -> SeenGaussians:
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
        return ((color - 0.5) / SH_CONSTANT)[:, None].astype(np.float32)
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
    """Make Gaussians larger or smaller about the origin.

    Args:
        splats: the Gaussians, m.
    """
    require_scale(factor)
    with np.errstate(over="ignore"):
        made = replace(
            splats,
            means=(splats.means.astype(np.float64) * factor).astype(np.float32),
            scales=(splats.scales.astype(np.float64) * factor).astype(np.float32),
        )
    if not (np.isfinite(made.means).all() and np.isfinite(made.scales).all()):
        raise UsageError(
            f"is {factor:g}, by which numbers become infinite",
            field="--scale",
            remedy="Use a smaller one.",
        )
    return made


def require_scale(factor: float) -> None:
    """Refuse a scale that is none."""
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
    """(N,) which hand each Gaussian belongs to: those of the hands, then those of their walls."""
    counts = [len(avatar.model.rigs[side]) for side in sides]
    for side in sides:
        wall = avatar.model.wall(side)
        counts.append(0 if wall is None else len(wall))
    return np.repeat([*range(len(sides)), *range(len(sides))], counts)
