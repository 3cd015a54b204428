"""An avatar turned around: a contact sheet, its holes, and what stands off its outline.

Run from the repository: `python -m benchmarks.turntable AVATAR ... -o sheet.jpg` draws every hand
at rest from eight directions around each of two axes, two rows for each hand. For each hand it
prints the largest hole, px^2: connected pixels with less than half coverage, more than `MARGIN` px
within the outline of the posed mesh; and the fur: the sum of the coverage more than `MARGIN` px
outside of it, px^2, mean over the directions. Rims that are thinner than `MARGIN` are no holes: a
person's hand may be slimmer than the template.
"""

from __future__ import annotations

import argparse
import math
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from scipy.ndimage import binary_dilation, binary_erosion, label

from hwp_bench.hands import pose_hand, project
from hwp_bench.hands.raster import draw_faces
from hwp_bench.methods.contract import Camera, HandPose
from wildghand.avatar.avatar import WildGHandAvatar
from wildghand.avatar.files import load_avatar

#: px between the outline and what is counted.
MARGIN = 3
#: Directions around an axis.
VIEWS = 8
# Share of the picture that the hand fills; distance of the camera in radii of the hand.
_FILL, _AWAY = 0.92, 6.0


@dataclass(frozen=True, eq=False)
class View:
    """An avatar from one direction."""

    #: (H, W, 4) float32, sRGB over black and coverage.
    rgba: np.ndarray
    #: (H, W) bool, where the posed mesh is.
    silhouette: np.ndarray

    @property
    def hole(self) -> int:
        """Area of the largest hole, px^2."""
        inside = binary_erosion(self.silhouette, iterations=MARGIN)
        parts, _ = label(inside & (self.rgba[..., 3] < 0.5), np.ones((3, 3)))
        return int(np.bincount(parts.ravel())[1:].max(initial=0))

    @property
    def fur(self) -> float:
        """Coverage off the outline, px^2."""
        outside = ~binary_dilation(self.silhouette, iterations=MARGIN)
        return float(self.rgba[..., 3][outside].sum())


def camera_around(points: np.ndarray, up: np.ndarray, back: np.ndarray, size: int) -> Camera:
    """Return a square camera whose picture points fill.

    Args:
        points: (N, 3) m, world.
        up: (3,) unit, the upward direction of the picture.
        back: (3,) unit, from the points towards the camera.
        size: edge of the picture, px.
    """
    centre = 0.5 * (points.min(axis=0) + points.max(axis=0))
    radius = float(np.linalg.norm(points - centre, axis=1).max())
    focal = 0.5 * size * _FILL * _AWAY
    K = np.array([[focal, 0.0, size / 2], [0.0, focal, size / 2], [0.0, 0.0, 1.0]])
    rows = np.stack([np.cross(up, back), -up, -back])
    viewmat = np.eye(4)
    viewmat[:3, :3] = rows
    viewmat[:3, 3] = -rows @ (centre + _AWAY * radius * back)
    return Camera(viewmat=viewmat, K=K, width=size, height=size)


@torch.no_grad()
def turn(avatar: WildGHandAvatar, side: str, size: int = 256) -> Iterator[View]:
    """Draw one hand at rest from `VIEWS` directions around its length, then around its breadth.

    Args:
        avatar: what is drawn.
        side: which hand.
        size: edge of the square pictures, px.
    """
    rig, betas = avatar.model.rigs[side], avatar.betas[side]
    pose = HandPose(side, np.zeros((16, 3)), betas, np.zeros(3))
    given = (torch.zeros(1, 16, 3), torch.as_tensor(betas).float(), torch.zeros(1, 3))
    vertices = pose_hand(rig.template, *given).vertices
    points = vertices[0].double().numpy()
    axes = np.linalg.svd(points - points.mean(axis=0), full_matrices=False)[2]
    faces = rig.template.faces.numpy().astype(np.int64)
    for up in axes[:2]:
        for step in range(VIEWS):
            angle = 2.0 * math.pi * step / VIEWS
            back = math.cos(angle) * axes[2] + math.sin(angle) * np.cross(up, axes[2])
            camera = camera_around(points, up, back, size)
            rgba = avatar.render({side: pose}, camera)
            matrices = (torch.as_tensor(one).float()[None] for one in (camera.viewmat, camera.K))
            places, depth = project(vertices, *matrices)
            drawn = draw_faces(places[0].numpy(), depth[0].numpy(), faces, (size, size))[0]
            yield View(rgba, drawn >= 0)


def sheet(views: list[View]) -> np.ndarray:
    """The views over white, `VIEWS` in a row: (H, W, 3) uint8."""
    shown = [view.rgba[..., :3] + 1.0 - view.rgba[..., 3:] for view in views]
    rows = [np.concatenate(shown[i : i + VIEWS], axis=1) for i in range(0, len(shown), VIEWS)]
    picture: np.ndarray = np.rint(255.0 * np.concatenate(rows).clip(0.0, 1.0)).astype(np.uint8)
    return picture


def main() -> None:
    """Draw the avatars that the arguments name."""
    import cv2

    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("avatars", type=Path, nargs="+", metavar="AVATAR", help="avatar folder")
    parser.add_argument("-o", "--out", type=Path, help="picture to write")
    parser.add_argument("--size", type=int, default=256, help="edge of each view in pixels")
    parser.add_argument("--shrink", type=float, default=1.0, help="size of the picture's views")
    args = parser.parse_args()
    print("| avatar | hand | largest hole, px^2 | median of the views | fur, px^2 |")
    print("| --- | --- | ---: | ---: | ---: |")
    everything = []
    for path in args.avatars:
        avatar = load_avatar(path)
        for side in avatar.sides:
            views = list(turn(avatar, side, args.size))
            holes = [view.hole for view in views]
            fur = np.mean([view.fur for view in views])
            print(f"| {path.name} | {side} | {max(holes)} | {np.median(holes):.0f} | {fur:.0f} |")
            everything += views
    if args.out is not None:
        small = {"fx": args.shrink, "fy": args.shrink, "interpolation": cv2.INTER_AREA}
        picture = cv2.resize(sheet(everything)[..., ::-1], None, **small)
        cv2.imwrite(str(args.out), picture, [cv2.IMWRITE_JPEG_QUALITY, 80])


if __name__ == "__main__":
    main()
