"""Where exported Gaussians lie: their scale, and the axes of other programs."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace

import numpy as np
from scipy.spatial.transform import Rotation

from hwp_bench.base.errors import UsageError
from hwp_bench.methods.contract import HandPose
from wildghand.avatar.avatar import PosedGaussians, WildGHandAvatar
from wildghand.export.all_round import SeenGaussians, middle, wrist_at_rest

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
        factor: units of the file in a metre, above 0.

    Raises:
        UsageError: the factor is not a number above 0, or numbers become infinite by it.
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
    """Refuse a scale that is none.

    Raises:
        UsageError: the factor is not a number above 0.
    """
    if not (np.isfinite(factor) and factor > 0.0):
        raise UsageError(f"is {factor}", field="--scale", remedy="Use a number above 0.")


def laid_to_rest(
    avatar: WildGHandAvatar, given: SeenGaussians, hands: Mapping[str, HandPose]
) -> SeenGaussians:
    """Move hands from the studio to where the hand model lies at rest, with their colours.

    Args:
        avatar: whose hands they are.
        given: of all hands.
        hands: by side, as they stand in the studio; only the first rotation differs from rest.
    """
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

    Args:
        avatar: whose hands they are.
        given: of all hands.
        hands: by side, as they stand.
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
