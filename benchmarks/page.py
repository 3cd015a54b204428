"""How near the page of an avatar comes to `wildghand render`, in Chromium.

    python -m benchmarks.page AVATAR --poses CAPTURE [--pictures FOLDER]

Frames that were fitted, and named poses from the front, the sides and the back. PSNR and SSIM are
over the hand's box.
"""

from __future__ import annotations

import argparse
import tempfile
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

import numpy as np

from hwp_bench.base.arrays import evenly
from hwp_bench.base.images import as_uint8, write_image
from hwp_bench.capture import Capture, open_capture
from hwp_bench.hands.skeleton import Camera, HandPose
from hwp_bench.metrics.pixels import ssim_map
from tests.browser import open_page
from wildghand.avatar.avatar import WildGHandAvatar
from wildghand.avatar.files import load_avatar
from wildghand.page import write_page

# Named poses, turns of the hand in degrees, frames, and the edge of a picture of a named pose, px.
POSES, TURNS, FRAMES, SIZE = ("rest", "open", "fist"), (0, 90, 180, 270), 4, 480
# By how much the difference is stretched in pictures.
_STRETCH = 8.0


def main() -> None:
    """Print a table."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("avatar", type=Path)
    parser.add_argument("--poses", type=Path, required=True, help="the capture that was fitted")
    parser.add_argument("--pictures", type=Path, help="folder: render, page, difference")
    args = parser.parse_args()
    avatar, capture = load_avatar(args.avatar), open_capture(args.poses)
    found = []
    with tempfile.TemporaryDirectory() as folder:
        page = Path(folder) / "avatar.html"
        facts = write_page(avatar, page, capture=capture)
        print(f"{facts.gaussians:,} Gaussians, {facts.bytes / 1e6:.2f} MB")
        flags = ("--force-prefers-reduced-motion",)
        with open_page(page, Path(folder) / "profile", webgl=True, flags=flags) as driver:
            driver.execute_script("avatar.setBackground('#000000')")
            for name, hands, camera in _cases(avatar, capture):
                drawn = _drawn(driver, avatar.believed(hands), camera)
                truth = avatar.render(hands, camera)
                rows, columns = np.nonzero(truth[..., 3] > 0.5)
                box = slice(rows.min(), rows.max() + 1), slice(columns.min(), columns.max() + 1)
                pair = drawn[box], truth[box][..., :3].astype(np.float64)
                psnr = float(-10.0 * np.log10(np.square(pair[0] - pair[1]).mean() + 1e-12))
                print(f"{name:12} {psnr:5.1f} dB  SSIM {ssim_map(*pair).mean():.4f}", flush=True)
                found.append(psnr)
                if args.pictures:
                    off = np.clip(0.5 + _STRETCH * (pair[0] - pair[1]), 0.0, 1.0)
                    sheet = np.concatenate([pair[1], pair[0], off], axis=1)
                    write_image(args.pictures / f"{name}.png", as_uint8(sheet.astype(np.float32)))
    print(f"worst {min(found):.1f} dB, mean {np.mean(found):.1f} dB")


def _cases(
    avatar: WildGHandAvatar, capture: Capture
) -> Iterator[tuple[str, Mapping[str, HandPose], Camera]]:
    frames = avatar.record.frames
    for pick in evenly(len(frames), FRAMES):
        hands = capture.hand_poses(frames[pick])
        given = {side: hands[side] for side in avatar.sides}
        yield f"frame {frames[pick]}", given, capture.camera(frames[pick])
    for pose in POSES:
        for turn in TURNS:
            camera = avatar.studio.camera(SIZE, SIZE)
            yield f"{pose} {turn}", avatar.studio.posed(pose, turn), camera


def _drawn(driver: Any, hands: Mapping[str, HandPose], camera: Camera) -> np.ndarray:
    given = {side: [hand.pose.tolist(), hand.transl.tolist()] for side, hand in hands.items()}
    view = camera.viewmat.tolist(), camera.K.tolist(), camera.width, camera.height
    driver.execute_script("avatar.setPose(arguments[0])", given)
    driver.execute_script("avatar.setCamera(...arguments)", *view)
    pixels = driver.execute_script("return avatar.pixels()")
    return np.array(pixels).reshape(camera.height, camera.width, 3) / 255.0


if __name__ == "__main__":
    main()
