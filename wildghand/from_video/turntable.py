"""An avatar turned around: upright at rest, in front of a camera and a light that stand still.

The hand turns, and not the camera, because what the clip taught of the light holds in front of
its camera: so every side is shown in a light that frames have shown.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np
import torch
from scipy.spatial.transform import Rotation

from hwp_bench.base.images import as_uint8
from hwp_bench.base.movies import write_movie
from hwp_bench.base.progress import track
from hwp_bench.hands import pose_hand
from hwp_bench.methods.contract import Camera, HandPose
from wildghand.avatar.avatar import WildGHandAvatar
from wildghand.avatar.files import load_avatar
from wildghand.from_video.fit import avatar_digest
from wildghand.from_video.job import Job
from wildghand.from_video.stage import Stage

#: Edge of the clip, px; frames of one turn, and in a second.
SIZE, FRAMES, FPS = 480, 96, 24
#: sRGB grey behind the hand.
BACKGROUND = 28
# Raises when the clip comes out otherwise, so that an older one is drawn again.
_VERSION = 1
# Share of the picture that the hands fill; distance of the camera in radii of the hands.
_FILL, _AWAY = 0.92, 6.0
# Seconds for a frame, and those before the first.
_FRAME, _START = 0.1, 4.0


@dataclass(frozen=True, eq=False)
class _Placed:
    """A hand at rest.

    Attributes:
        betas: (10,) as it was fitted.
        upright: turns it so that its fingers point up and its palm to the camera.
        wrist: (3,) m, the point that pose rotations leave where it is.
        middle: (3,) m, where the middle of the upright hand is before it is moved.
        aside: m, how far to the right of the axis it stands.
    """

    betas: np.ndarray
    upright: Rotation
    wrist: np.ndarray
    middle: np.ndarray
    aside: float


class Turntable:
    """Draws an avatar from all around.

    Args:
        avatar: what is drawn; two hands stand next to each other and turn together.
        size: edge of the square pictures, px.
    """

    def __init__(self, avatar: WildGHandAvatar, size: int = SIZE) -> None:
        self._avatar = avatar
        self._hands: dict[str, _Placed] = {}
        placed = []
        for side in avatar.sides:
            self._hands[side], points = _placed(avatar, side, len(avatar.sides))
            placed.append(points)
        x, y, z = np.concatenate(placed).T
        across = np.hypot(x, z)
        away = _AWAY * float(np.hypot(across, y).max())
        # The largest slope at which any point is seen in any turn: from the side, and in front.
        aside, above = across / np.sqrt(away**2 - across**2), np.abs(y) / (away - across)
        slope = float(max(aside.max(), above.max()))
        focal = 0.5 * size * _FILL / slope
        K = np.array([[focal, 0.0, size / 2], [0.0, focal, size / 2], [0.0, 0.0, 1.0]])
        self._camera = Camera(viewmat=np.eye(4), K=K, width=size, height=size)
        self._axis = np.array([0.0, 0.0, away])

    def view(self, degrees: float) -> np.ndarray:
        """Draw the avatar turned by an angle about the vertical; at 0 the palm faces the camera.

        Returns:
            (size, size, 3) uint8 sRGB over `BACKGROUND`.
        """
        turn = Rotation.from_euler("y", degrees, degrees=True)
        rgba = self._avatar.render(
            {side: self._pose(side, hand, turn) for side, hand in self._hands.items()},
            self._camera,
        )
        return as_uint8(rgba[..., :3] + (1.0 - rgba[..., 3:]) * (BACKGROUND / 255.0))

    def _pose(self, side: str, hand: _Placed, turn: Rotation) -> HandPose:
        pose = np.zeros((16, 3))
        pose[0] = (turn * hand.upright).as_rotvec()
        # The posed hand stays at its wrist, so its middle moves; translation brings it back.
        middle = turn.apply(hand.middle - hand.wrist) + hand.wrist
        goal = self._axis + turn.apply([hand.aside, 0.0, 0.0])
        return HandPose(side, pose, hand.betas, goal - middle)


@torch.no_grad()
def _placed(avatar: WildGHandAvatar, side: str, hands: int) -> tuple[_Placed, np.ndarray]:
    """A hand upright, and its vertices (V, 3) relative to the middle of the turntable, m."""
    mirror = 1.0 if side == "right" else -1.0
    # At rest a right hand's fingers point along -x and its palm along -y; the camera looks along
    # z, and y points down.
    upright = Rotation.from_euler("zy", [90.0 * mirror, 90.0 * mirror], degrees=True)
    pose = torch.zeros(1, 16, 3)
    pose[0, 0] = torch.from_numpy(upright.as_rotvec())
    template, betas = avatar.model.rigs[side].template, avatar.betas[side]
    posed = pose_hand(template, pose, torch.as_tensor(betas).float(), torch.zeros(1, 3))
    points = posed.vertices[0].double().numpy()
    low, high = points.min(axis=0), points.max(axis=0)
    middle = 0.5 * (low + high)
    aside = 0.0 if hands == 1 else 0.6 * float(high[0] - low[0]) * mirror
    wrist = posed.joints[0, 0].double().numpy()
    placed = _Placed(betas, upright, wrist, middle, aside)
    return placed, points + np.array([aside, 0.0, 0.0]) - middle


def turntable_frames(table: Turntable, angles: Sequence[float]) -> Iterator[np.ndarray]:
    """Draw the frames of a clip, with progress."""
    for angle in track(angles, "drawing the turntable"):
        yield table.view(angle)


def _facts(job: Job) -> dict[str, str]:
    look = (_VERSION, SIZE, FRAMES, FPS, BACKGROUND)
    return {"avatar": avatar_digest(job.folder), "look of the turntable": str(look)}


def _run(job: Job) -> None:
    table = Turntable(load_avatar(job.folder, hand=job.options.hand_model))
    angles = [360.0 * frame / FRAMES for frame in range(FRAMES)]
    write_movie(job.turntable, turntable_frames(table, angles), FPS)


TURNTABLE = Stage(
    name="turntable",
    title="Drawing the turntable",
    facts=_facts,
    result=lambda job: job.turntable,
    run=_run,
    expected=lambda job: _START + _FRAME * FRAMES,
)
