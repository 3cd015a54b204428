"""The hand y_h of every frame of a fit, as the setting `pao.hand` says."""

from __future__ import annotations

from collections.abc import Iterator, Mapping

import numpy as np
import torch

from hwp_bench.base.console import track
from hwp_bench.hands import HandTemplate, pose_hand, project
from hwp_bench.hands.raster import draw_faces
from hwp_bench.methods.contract import TrainingCapture
from hwp_bench.methods.settings import source_path
from wildghand.gaussians.training import TrainingFrames
from wildghand.pao.regions import PromptedHand, RegionCache, graph_cut_hands, mask_of, open_sam

# Frames that are posed at a time, so that memory does not grow with the clip.
_CHUNK = 32


def hand_masks(
    training: TrainingCapture, frames: TrainingFrames, source: str, device: torch.device
) -> torch.Tensor:
    """Return y_h of R frames, that of each frame found once.

    Args:
        training: hand parameters, cameras and templates of the capture.
        frames: those that are fitted.
        source: `estimated`, `graph-cut` or `sam:PATH`.
        device: where a network runs.

    Returns:
        (R, H, W) uint8, 255 = hand. A frame in which no hand is found keeps its estimated mask:
        nothing in it could be learnt otherwise.

    Raises:
        HwpError: the checkpoint cannot be used.
    """
    if source == "estimated":
        return frames.masks
    images = frames.images.numpy()
    found: Iterator[np.ndarray]
    if source == "graph-cut":
        found = graph_cut_hands(list(images), list(_silhouettes(training, frames)))
    else:
        found = _prompted(images, hand_roots(training, frames.indices), source, device)
    masks = frames.masks.clone()
    for row, mask in enumerate(track(found, "Finding hands", len(frames))):
        if mask.any():
            masks[row] = torch.from_numpy(np.where(mask, 255, 0).astype(np.uint8))
    return masks


def hand_roots(training: TrainingCapture, frames: np.ndarray) -> np.ndarray:
    """Where the wrists of all hands are seen.

    Args:
        training: hand parameters and cameras.
        frames: (R,) which frames.

    Returns:
        (R, hands, 2) px, the centre of the top left pixel at 0.5; NaN behind the camera.
    """
    roots = []
    for _, joints, depth in _projected(training, frames):
        roots.append(np.where(depth[..., None] > 0.0, joints, np.nan))
    return np.concatenate(roots)


def _prompted(
    images: np.ndarray, roots: np.ndarray, source: str, device: torch.device
) -> Iterator[np.ndarray]:
    sam, cache = open_sam(source_path(source) or "", str(device)), RegionCache()
    for image, places in zip(images, roots.tolist(), strict=True):
        prompt = PromptedHand(sam, tuple((x, y) for x, y in places))
        yield mask_of(cache.regions(image, prompt))
    cache.prune()


def _silhouettes(training: TrainingCapture, frames: TrainingFrames) -> Iterator[np.ndarray]:
    """(H, W) bool for each frame, where the posed hands would be seen if nothing covered them."""
    faces, start = [], 0
    for template in _templates(training).values():
        faces.append(template.faces + start)
        start += len(template.vertices)
    joined = np.concatenate(faces)
    for vertices, _, _ in _projected(training, frames.indices):
        for places, depth in vertices:
            yield draw_faces(places, depth, joined, (training.height, training.width))[0] >= 0


def _projected(
    training: TrainingCapture, frames: np.ndarray
) -> Iterator[tuple[list[tuple[np.ndarray, np.ndarray]], np.ndarray, np.ndarray]]:
    """For some frames at a time: vertices (px, depth) of each, and the roots (px, depth)."""
    templates = {side: t.to_torch() for side, t in _templates(training).items()}
    for start in range(0, len(frames), _CHUNK):
        part = frames[start : start + _CHUNK]
        posed = [
            pose_hand(template, _real(hand.pose[part]), _real(hand.betas), _real(hand.transl[part]))
            for hand, template in ((training.hands[side], templates[side]) for side in templates)
        ]
        cameras = _real(training.cameras.viewmats[part]), _real(training.cameras.Ks[part])
        places, depth = project(torch.cat([hand.vertices for hand in posed], dim=1), *cameras)
        roots, away = project(torch.stack([hand.joints[:, 0] for hand in posed], dim=1), *cameras)
        vertices = list(zip(places.numpy(), depth.numpy(), strict=True))
        yield vertices, roots.numpy(), away.numpy()


def _templates(training: TrainingCapture) -> Mapping[str, HandTemplate]:
    return {side: training.template(side) for side in training.sides}


def _real(array: np.ndarray) -> torch.Tensor:
    return torch.as_tensor(array, dtype=torch.float32)
