"""The contact sheet of a capture: frames with mask outline and projected hand."""

from __future__ import annotations

from collections.abc import Iterator

import cv2
import numpy as np

from hwp_bench.base.drawing import fitted, labelled, outlined, sheet
from hwp_bench.base.evenly import evenly
from hwp_bench.capture.reader import Capture
from hwp_bench.taxonomy import perturbation

#: Colour of the projected hand, by side.
COLOURS = {"right": (255, 160, 0), "left": (0, 170, 255)}
#: The 20 bones between the 21 landmarks: wrist to each finger's base, then outwards.
BONES = tuple(
    (0 if joint == 0 else 4 * finger + joint, 4 * finger + joint + 1)
    for finger in range(5)
    for joint in range(4)
)


def contact_sheet(capture: Capture, *, count: int = 24, edge: int = 256) -> np.ndarray:
    """Draw frames of a capture, evenly spaced, each with its mask and hands.

    Args:
        capture: the capture.
        count: number of frames.
        edge: larger side of a frame on the sheet, px.

    Returns:
        (H, W, 3) uint8. Green outline: the mask that methods are given; coloured skeleton: the
        estimated hand (orange right, blue left), left out where it is not valid.
    """
    chosen = evenly(len(capture), count).tolist()
    tiles = [
        labelled(
            fitted(draw_hands(outlined(capture.frame(f), capture.mask(f)), points), edge),
            _caption(capture, f),
        )
        for f, points in zip(chosen, project_landmarks(capture, chosen), strict=True)
    ]
    return sheet(tiles, columns=6)


def project_landmarks(capture: Capture, frames: list[int]) -> Iterator[dict[str, np.ndarray]]:
    """Yield, for each frame, the projected landmarks (21, 2) px of every valid hand, by side."""
    import torch

    from hwp_bench.hands import load_template, pose_hand, project

    Ks = torch.from_numpy(capture.cameras.Ks[frames])
    viewmats = torch.from_numpy(capture.cameras.viewmats[frames])
    pixels: dict[str, np.ndarray] = {}
    for side, hand in capture.hands.items():
        tensors = load_template(capture.info.hand_model.source, side).to_torch(torch.float64)
        posed = pose_hand(
            tensors,
            torch.from_numpy(hand.pose[frames]),
            torch.from_numpy(hand.betas).expand(len(frames), -1),
            torch.from_numpy(hand.transl[frames]),
        )
        pixels[side] = project(posed.landmarks, viewmats, Ks)[0].numpy()
    for index, frame in enumerate(frames):
        yield {
            side: points[index]
            for side, points in pixels.items()
            if capture.hands[side].valid[frame]
        }


def draw_hands(image: np.ndarray, points: dict[str, np.ndarray]) -> np.ndarray:
    """Draw skeletons into a copy of an image.

    Args:
        image: (H, W, 3) uint8.
        points: (21, 2) px by side, pixel centres at +0.5.
    """
    canvas = image.copy()
    for side, landmarks in points.items():
        # OpenCV counts pixel centres from 0, in fixed point with 3 fractional bits here.
        # Beyond 1e6 it draws nothing anyway; NaN is far off too.
        places = np.nan_to_num((landmarks - 0.5) * 8, nan=1e6)
        spots = np.clip(places, -1e6, 1e6).round().astype(int)
        for first, last in BONES:
            cv2.line(
                canvas,
                tuple(spots[first].tolist()),
                tuple(spots[last].tolist()),
                COLOURS[side],
                1,
                cv2.LINE_AA,
                3,
            )
    return canvas


def _caption(capture: Capture, frame: int) -> str:
    parts = [str(frame)]
    for name, severity in capture.info.severity(frame).items():
        if severity:
            parts.append(f"{perturbation(name).short}{severity}")
    invalid = [side for side, hand in capture.hands.items() if not hand.valid[frame]]
    parts += [f"no {side}" for side in invalid]
    return " ".join(parts)
