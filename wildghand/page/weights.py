"""How much PAO let each place of the hand count in training frames, for a page that shows it."""

from __future__ import annotations

from collections.abc import Mapping

import cv2
import numpy as np
import torch

from hwp_bench.capture import Capture
from wildghand.avatar import WildGHandAvatar
from wildghand.evidence.count import seen_anchors


@torch.no_grad()
def mean_weights(
    avatar: WildGHandAvatar, capture: Capture, masks: Mapping[int, np.ndarray]
) -> dict[str, np.ndarray]:
    """Average weight masks over the frames that show each Gaussian's anchor.

    Args:
        avatar: of the capture.
        capture: hands and cameras.
        masks: (H, W) uint8 weights of some training frames, 255 = full weight.

    Returns:
        (N,) by side, in [0, 1]; NaN where no frame of `masks` shows the anchor. Empty without
        masks.
    """
    rigs = avatar.model.rigs
    sums = {side: np.zeros((2, len(rig))) for side, rig in rigs.items()}
    for frame, mask in masks.items():
        hands, camera = capture.hand_poses(frame), capture.camera(frame)
        given = avatar.posed({side: hands[side] for side in rigs})
        anchors = {side: rigs[side].pose(*values) for side, values in given.items()}
        viewmat, K = (torch.as_tensor(m, dtype=torch.float32) for m in (camera.viewmat, camera.K))
        size = torch.Size((camera.height, camera.width))
        shown = seen_anchors(anchors, viewmat[None], K[None], size)
        for side, (pixels, facing) in shown.items():
            # Masks have the size of the frame, unless a person has made them smaller.
            scale = np.array(mask.shape[::-1]) / (camera.width, camera.height)
            x, y = (pixels[0].cpu().numpy() * scale - 0.5).astype(np.float32).T
            weight = cv2.remap(mask, x[None], y[None], cv2.INTER_LINEAR)[0] / 255.0
            counts = (facing[0] > 0.0).cpu().numpy()
            sums[side] += counts * np.stack([weight, np.ones_like(weight)])
    if not masks:
        return {}
    with np.errstate(invalid="ignore"):
        return {side: total / count for side, (total, count) in sums.items()}
