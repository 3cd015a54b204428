"""Small folders in exactly the format of the official HWP release, with MANO-like hands.

Hands are posed as the release's tracker does it: the right MANO hand with either hand's
parameters relative to the mean pose, centred on the middle knuckle, the left one's x negated,
`root_rel` and the translation added.
"""

from __future__ import annotations

import pickle
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import torch

from hwp_bench.capture import Capture
from hwp_bench.hands import HandTemplate, pose_hand
from hwp_bench.hands.raster import draw_silhouette

WIDTH, HEIGHT = 400, 300
FOCAL = 5000.0 / 256.0 * WIDTH
SKIN = np.array([200, 150, 120])


def tracked_hand(
    right: HandTemplate, side: str, pose: np.ndarray, shape: np.ndarray, root_rel: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Vertices (778, 3) and landmarks (21, 3) before the translation is added, m."""
    posed = pose_hand(
        right.to_torch(torch.float64),
        torch.from_numpy(pose.reshape(1, 16, 3)),
        torch.from_numpy(shape),
        torch.zeros(1, 3, dtype=torch.float64),
        flat_hand_mean=False,
    )
    centre = posed.joints[0, 4].numpy()
    vertices, landmarks = (
        points[0].numpy() - centre for points in (posed.vertices, posed.landmarks)
    )
    if side == "left":
        vertices, landmarks = (
            points * [-1.0, 1.0, 1.0] + root_rel for points in (vertices, landmarks)
        )
    return vertices, landmarks


def project(points: np.ndarray) -> np.ndarray:
    """Pixels of the whole frame, principal point at its centre."""
    return FOCAL * points[:, :2] / points[:, 2:] + [WIDTH / 2, HEIGHT / 2]


def official_rows(
    right: HandTemplate, frames: int, *, apart: bool = True, box: bool = True, seed: int = 0
) -> list[dict[str, Any]]:
    """The records of `frames` frames, every key of the format, both hands."""
    rng = np.random.default_rng(seed)
    fingers = rng.normal(0, 0.08, (2, 45))
    shapes = rng.normal(0, 0.5, (2, 10))
    rows = []
    for frame in range(frames):
        phase = frame / max(frames - 1, 1)
        # A palm towards the camera: x to the fingers, y into the picture.
        turn = np.array([1.4, 0.2 * phase, 0.3 * phase])
        root_rel = np.array([[0.13, 0.01, 0.02]]) if apart else np.array([[0.0, 0.0, 0.0]])
        centre = np.array([-0.06 + 0.02 * phase, 0.0, 12.0 + phase])
        row: dict[str, Any] = {
            "img_path": f"/home/authors/data/clip/{frame:05d}.png",
            "scaled_focal_length": float(FOCAL),
            "root_rel": root_rel,
            "mask_sam1_path": f"/home/authors/data/clip/{frame:05d}_sam1_mask.png",
            "mask_bbox": np.full((HEIGHT, WIDTH, 1), 255, dtype=np.uint8),
        }
        points = []
        for index, side in enumerate(("right", "left")):
            pose = np.concatenate([turn, fingers[index] * (1 + 0.2 * phase)])
            shape = shapes[index] + rng.normal(0, 0.02, 10)
            vertices, landmarks = tracked_hand(right, side, pose, shape, root_rel[0])
            camera = centre + (0.0 if index == 0 else [0.004, 0.0, 0.05])
            pixels = project(landmarks + camera)
            points.append(pixels)
            row |= {
                f"mano_pose_{side}": pose[None].astype(np.float32),
                f"mano_shape_{side}": shape[None].astype(np.float32),
                f"verts3d_world_{side}": vertices[None],
                f"cam_aligned_{side}": camera[None],
                f"joints2d_world_{side}": pixels[None],
            }
        if box:
            both = np.concatenate(points)
            low, high = both.min(axis=0), both.max(axis=0)
            middle, half = (low + high) / 2, (high - low) * 1.5 // 2
            row["bbox_inter"] = np.array([int(v) for v in (*middle - half, *middle + half)])
        rows.append(row)
    return rows


def draw_frame(
    row: dict[str, Any], right: HandTemplate, sides: tuple[str, ...], seed: int
) -> tuple[np.ndarray, np.ndarray]:
    """The picture (H, W, 3) and mask (H, W) of a record: skin on noise."""
    rng = np.random.default_rng(seed)
    picture = rng.integers(20, 70, (HEIGHT, WIDTH, 3)).astype(np.uint8)
    mask = np.zeros((HEIGHT, WIDTH), dtype=np.uint8)
    for side in sides:
        vertices = row[f"verts3d_world_{side}"][0] + row[f"cam_aligned_{side}"]
        mask |= draw_silhouette(project(vertices), right.faces, WIDTH)[:HEIGHT]
    picture[mask > 0] = SKIN + rng.integers(-8, 8, (int((mask > 0).sum()), 1))
    return picture, mask


def write_release(
    folder: Path,
    right: HandTemplate,
    frames: int = 12,
    *,
    sides: tuple[str, ...] = ("right", "left"),
    pickles: int = 1,
    **options: Any,
) -> list[dict[str, Any]]:
    """Write a folder of the release; returns its records."""
    folder.mkdir(parents=True)
    rows = official_rows(right, frames, **options)
    for index, row in enumerate(rows):
        picture, mask = draw_frame(row, right, sides, index)
        cv2.imwrite(str(folder / Path(row["img_path"]).name), picture[:, :, ::-1])
        cv2.imwrite(str(folder / Path(row["mask_sam1_path"]).name), mask)
    write_pickles(folder, rows, pickles)
    return rows


def write_pickles(folder: Path, rows: list[dict[str, Any]], pickles: int = 1) -> None:
    for part in range(pickles):
        name = "output.pkl" if part == 0 else f"output_{part}.pkl"
        share = rows if pickles == 1 else rows[part::pickles]
        (folder / name).write_bytes(pickle.dumps(share))


def write_rendered(
    experiment: Path, capture: Capture, frames: list[int], size: int | None = None
) -> Path:
    """What the authors' code leaves of a test run, drawn at half the truth; returns `render`."""
    place = experiment / "images_all" / "-1" / "render"
    place.mkdir(parents=True)
    for frame in frames:
        truth = capture.frame(frame)[:, :, ::-1]
        drawn = np.where(capture.mask(frame)[..., None] > 127, truth // 2, 0).astype(np.uint8)
        if size is not None:
            drawn = cv2.resize(drawn, (size, size))
        stem = f"frame{frame}_view{frame}"
        cv2.imwrite(str(place / f"{stem}_gt.png"), truth)
        cv2.imwrite(str(place / f"{stem}_pred_31.25_lr1.png"), drawn)
        cv2.imwrite(str(place / f"{stem}_pred_31.25_lr1_bbox.png"), 0 * drawn)
    cut = place.parent / "pred"
    cut.mkdir()
    cv2.imwrite(str(cut / "frame0_view0.png"), np.zeros((9, 7, 3), np.uint8))
    return place
