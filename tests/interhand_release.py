"""A small folder in exactly the format of InterHand2.6M, with MANO-like hands."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import torch

from hwp_bench.hands import HandTemplate, pose_hand
from hwp_bench.hands.raster import draw_silhouette
from hwp_bench.importers.interhand import LANDMARK_ROWS

WIDTH, HEIGHT = 334, 512
FRAMES = (7, 10, 13, 16, 19, 22, 25, 28, 31, 34, 37, 40)
FOCAL, CENTRE = (1270.0, 1268.0), (170.0, 250.0)


def camera(angle: float = 0.3) -> tuple[np.ndarray, np.ndarray]:
    """A camera that looks at the origin from 1 m: rotation, position in mm."""
    rotation = np.array(
        [
            [np.cos(angle), 0, -np.sin(angle)],
            [0, 1, 0],
            [np.sin(angle), 0, np.cos(angle)],
        ]
    )
    return rotation, -rotation.T @ np.array([0.0, 0.0, 1000.0])


def project(points: np.ndarray, angle: float = 0.3) -> np.ndarray:
    """(N, 2) px of world points in metres, by the data set's own formula."""
    rotation, position = camera(angle)
    local = (points * 1000.0 - position) @ rotation.T
    return local[:, :2] / local[:, 2:] * FOCAL + CENTRE


def write_interhand(
    root: Path,
    templates: dict[str, HandTemplate],
    *,
    sequence: str = "0390_dh_touchROM",
    capture: int = 21,
    cam: str = "400015",
    split: str = "test",
    angle: float = 0.3,
) -> dict[str, np.ndarray]:
    """Write images and annotations; returns the true vertices (F, 778, 3) by side, m, world."""
    rng = np.random.default_rng(3)
    tables: dict[str, dict[str, Any]] = {"joint_3d": {}, "MANO_NeuralAnnot": {}}
    data: dict[str, list] = {"images": [], "annotations": []}
    truth: dict[str, list] = {side: [] for side in templates}
    fingers = {side: rng.normal(0, 0.08, 45) for side in templates}
    shape = {side: rng.normal(0, 0.5, 10) for side in templates}
    rotation, position = camera(angle)
    for index, frame in enumerate(FRAMES):
        picture = rng.integers(0, 40, (HEIGHT, WIDTH, 3)).astype(np.uint8)
        world, valid = np.ones((42, 3)), np.zeros((42, 1))
        annotated: dict[str, Any] = {"right": None, "left": None}
        for side, template in templates.items():
            # The left hand is missing from one frame.
            present = not (side == "left" and index == 4)
            pose = np.concatenate([[1.3, 0.02 * index, 0.1], fingers[side]])
            offset = np.array([-0.07 if side == "right" else 0.07, 0.001 * index, 0.0])
            posed = pose_hand(
                template.to_torch(torch.float64),
                torch.from_numpy(pose.reshape(1, 16, 3)),
                torch.from_numpy(shape[side]),
                torch.from_numpy(offset[None]),
                flat_hand_mean=False,
            )
            vertices = posed.vertices[0].numpy()
            truth[side].append(vertices)
            if not present:
                continue
            hand = draw_silhouette(project(vertices, angle), template.faces, HEIGHT)[:, :WIDTH] > 0
            picture[hand] = (200, 150, 120)
            first = 0 if side == "right" else 21
            rows = first + np.array(LANDMARK_ROWS)
            world[rows], valid[rows] = posed.landmarks[0].numpy() * 1000.0, 1
            annotated[side] = {
                "pose": pose.tolist(),
                "shape": shape[side].tolist(),
                "trans": offset.tolist(),
            }
        name = f"Capture{capture}/{sequence}/cam{cam}/image{frame}.jpg"
        path = root / "images" / split / name
        path.parent.mkdir(parents=True, exist_ok=True)
        cv2.imwrite(str(path), picture[:, :, ::-1], [cv2.IMWRITE_JPEG_QUALITY, 95])
        kind = "interacting" if len(templates) == 2 else next(iter(templates))
        data["images"].append(
            {
                "id": index,
                "file_name": name,
                "width": WIDTH,
                "height": HEIGHT,
                "capture": capture,
                "subject": 0,
                "seq_name": sequence,
                "camera": cam,
                "frame_idx": frame,
            }
        )
        data["annotations"].append(
            {
                "id": index,
                "image_id": index,
                "bbox": [10.0, 10.0, 300.0, 400.0],
                "joint_valid": valid.tolist(),
                "hand_type": kind,
                "hand_type_valid": 1,
            }
        )
        tables["joint_3d"][str(frame)] = {
            "world_coord": world.tolist(),
            "joint_valid": valid.tolist(),
            "hand_type": kind,
            "hand_type_valid": True,
        }
        tables["MANO_NeuralAnnot"][str(frame)] = annotated
    # Another camera's image, which must not be taken.
    data["images"].append({**data["images"][0], "id": 99, "camera": "400016"})
    cameras = {
        "campos": {cam: position.tolist()},
        "camrot": {cam: np.round(rotation, 6).tolist()},
        "focal": {cam: list(FOCAL)},
        "princpt": {cam: list(CENTRE)},
    }
    folder = root / "annotations" / split
    folder.mkdir(parents=True)
    contents = {"data": data, "camera": {str(capture): cameras}}
    contents |= {kind: {str(capture): table} for kind, table in tables.items()}
    for kind, content in contents.items():
        (folder / f"InterHand2.6M_{split}_{kind}.json").write_text(json.dumps(content))
    return {side: np.stack(vertices) for side, vertices in truth.items()}
