"""The light that a fit has found: frames of a capture, and white hands in shading and in shadow.

Run from the repository: `python -m benchmarks.cast_light AVATAR CAPTURE -o sheet.jpg` draws a row
for each frame: the frame over its mask, the avatar, and hands whose skin is white, in the shading
that they have with nothing in the way, with their shadows, and the shadows alone. It prints the
lamps: their directions in the world and their shares of the light.
"""

from __future__ import annotations

import argparse
from dataclasses import replace
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from hwp_bench.base.drawing import labelled, sheet
from hwp_bench.base.images import as_uint8, write_image
from hwp_bench.capture import Capture, open_capture
from wildghand.avatar.avatar import WildGHandAvatar
from wildghand.avatar.files import load_avatar
from wildghand.gaussians.quaternions import quat_third_axis
from wildghand.light import CastLight
from wildghand.light.light import CONE, SKY
from wildghand.model.dress import Gaussians
from wildghand.model.frames import rasterize_hands


def lamps_of(light: CastLight) -> list[tuple[np.ndarray, float]]:
    """Direction and share of the light of each lamp, the strongest first."""
    count = (len(light.directions) - SKY) // CONE
    total = float(light.strengths.sum()) + light.ambient
    parts = light.strengths[: count * CONE].reshape(count, CONE).sum(axis=1) / max(total, 1e-9)
    middles = light.directions[: count * CONE : CONE]
    order = np.argsort(-parts)
    return [(middles[lamp], float(parts[lamp])) for lamp in order]


@torch.no_grad()
def white_hands(avatar: WildGHandAvatar, capture: Capture, frame: int) -> list[np.ndarray]:
    """White hands as a frame has them: in shading, in shading and shadow, in shadow: (H, W, 3)."""
    model = avatar.model
    assert model.shadows is not None
    hands = avatar.posed({side: capture.hand_poses(frame)[side] for side in avatar.sides})
    dark = model.cast(hands)
    parts: list[Gaussians] = []
    factors: list[list[Tensor]] = []
    for side, given in hands.items():
        anchors = model.rigs[side].pose(*given)
        lit = model.shadows.shading(quat_third_axis(anchors.orientations))
        parts.append(model.gaussians(side, *given, dark=dark[side])[0])
        factors.append([lit, lit * dark[side], dark[side]])
    pictures = []
    for choice in range(3):
        # White is as bright as the brightest place in full light.
        white = [
            replace(part, colors=(0.6 * factor[choice])[..., None].expand_as(part.means))
            for part, factor in zip(parts, factors, strict=True)
        ]
        pictures.append(_drawn(white, capture, frame))
    return pictures


def _drawn(parts: list[Gaussians], capture: Capture, frame: int) -> np.ndarray:
    camera = capture.camera(frame)
    viewmats, Ks = (torch.as_tensor(one).float()[None] for one in (camera.viewmat, camera.K))
    image, _ = rasterize_hands(parts, viewmats, Ks, camera.width, camera.height)
    drawn: np.ndarray = image[0].clamp(0.0, 1.0).numpy()
    return drawn


def rows_of(avatar: WildGHandAvatar, capture: Capture, frames: list[int]) -> np.ndarray:
    """The sheet: (H, W, 3) uint8."""
    tiles = []
    for frame in frames:
        mask = capture.mask(frame)[..., None] / 255.0
        poses = {side: capture.hand_poses(frame)[side] for side in avatar.sides}
        drawn = avatar.render(poses, capture.camera(frame))[..., :3]
        pictures = [capture.frame(frame) / 255.0 * mask, drawn]
        pictures += white_hands(avatar, capture, frame)
        names = (f"frame {frame}", "avatar", "shading", "shading and shadow", "shadow")
        for picture, name in zip(pictures, names, strict=True):
            tiles.append(labelled(as_uint8(picture.astype(np.float32)), name))
    return sheet(tiles, 5)


def main() -> None:
    """Draw what the arguments name."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("avatar", type=Path, help="avatar folder")
    parser.add_argument("capture", type=Path, help="capture folder")
    parser.add_argument("-o", "--out", type=Path, required=True, help="picture to write")
    parser.add_argument("--frames", type=int, nargs="+", help="frames (default: five, spread)")
    args = parser.parse_args()
    avatar, capture = load_avatar(args.avatar), open_capture(args.capture)
    light = CastLight.from_tensors(dict(avatar.model.named_buffers()), str(args.avatar))
    if light is None:
        raise SystemExit(f"{args.avatar}: was fitted without shadows")
    print("| towards x | y | z | share of the light |")
    print("| ---: | ---: | ---: | ---: |")
    for (x, y, z), share in lamps_of(light):
        print(f"| {x:.2f} | {y:.2f} | {z:.2f} | {share:.2f} |")
    frames = args.frames or np.linspace(0, len(capture) - 1, 5).round().astype(int).tolist()
    write_image(args.out, rows_of(avatar, capture, frames))


if __name__ == "__main__":
    main()
