"""Judgements of frames and pixels before the fit: the pre-pass, the hand, hidden skin."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import replace
from typing import Any

import cv2
import numpy as np
import torch

from hwp_bench.base.console import track
from hwp_bench.hands import pose_hand, project
from hwp_bench.methods.contract import TrainingCapture
from hwp_bench.methods.settings import source_path
from wildghand.fitting.data import FitData, Judgement
from wildghand.fitting.fit import Component, DrawOptions, Fit, FrameTarget, StepBatch
from wildghand.gaussians.training import FrameTable, TrainingFrames, upload
from wildghand.model.frames import RenderedFrames
from wildghand.pao.sam import PromptedHand, mask_of, open_sam
from wildghand.pao.segmenters import RegionCache, graph_cut_hands
from wildghand.prepass import FrameAssessment, PrepassInput, frames_text, judge_frames
from wildghand.prepass.assessment import CLEAN_SHARE

#: How far inside the posed hand's outline a pixel must lie to count as hidden, as a share of the
#: image's height: closer to it a mask leaves a pixel out because the given pose is not exact.
MARGIN = 0.0085


class Prepass(Component):
    """Frames are judged before the fit: which are clean, and which pixels are covered.

    Attributes:
        assessment: of the frames that are fitted.
    """

    assessment: FrameAssessment

    def prepare(self, fit: Fit) -> None:
        """Judge the frames, with validation frames for clean ones."""
        data, settings = fit.data, fit.settings.prepass
        bent = data.bent

        def given(frames: TrainingFrames) -> PrepassInput:
            return PrepassInput(
                indices=frames.indices,
                images=np.asarray(frames.images),
                masks=np.asarray(frames.masks),
                hands=data.training.hands,
                cameras=data.training.cameras,
                templates=bent,
            )

        judges = data.judges
        found = judge_frames(
            given(data.frames), settings, None if judges is None else given(judges)
        )
        self.assessment = found
        if found.clean_share < CLEAN_SHARE:
            weights = (found.clean.tolist(), found.frame_weights.tolist())
            fit.tell(frames_text(*weights, settings.weight_floor))
        self._refine_pose = torch.from_numpy(found.refine_pose)
        data.judgement = Judgement(
            torch.from_numpy(found.clean).float(),
            torch.from_numpy(found.frame_weights).float(),
            torch.from_numpy(np.exp(found.log_gains.mean(axis=1))),
            torch.from_numpy(found.pixel_weights),
        )

    def draws(self, fit: Fit, batch: StepBatch) -> DrawOptions:
        """The pose of frames that disagree with their mask is refined, in a batch with any."""
        moved = self._refine_pose[batch.rows]
        if not fit.settings.prepass.frame_poses or not bool(moved.any()):
            return {}
        return {"move": upload(moved[batch.part], fit.device)}

    def compare(
        self, fit: Fit, batch: StepBatch, drawing: RenderedFrames, target: FrameTarget
    ) -> FrameTarget:
        """Pixels that are covered count less, with PAO and without."""
        uncovered = fit.data.uncovered(batch.mine)
        return target if uncovered is None else replace(target, weights=target.weights * uncovered)

    def record(self, fit: Fit, *, final: bool) -> dict[str, Any]:
        """The judgements of the frames."""
        judged = fit.data.judgement
        return {
            "clean": judged.clean.tolist(),
            "frame_weights": judged.frame_weights.tolist(),
        }


class HandMasks(Component):
    """The hand y_h of every frame, found as the setting `pao.hand` says."""

    def prepare(self, fit: Fit) -> None:
        """Put what is found in place of the estimated masks."""
        fit.data.replace_masks(hand_masks(fit.data, fit.settings.pao.hand, fit.device))


class HiddenSkin(Component):
    """Pixels in which something hides the hand are compared with nothing."""

    def before(self, fit: Fit) -> None:
        """Find the hidden pixels before the first step."""
        frames = fit.data.frames
        hidden = torch.from_numpy(hidden_skin(fit.data.places, frames.masks.numpy()))
        self._hidden = FrameTable(
            lambda rows: upload(hidden[rows], fit.device),
            len(frames),
            frames.masks[0].numel(),
            fit.device,
        )

    def compare(
        self, fit: Fit, batch: StepBatch, drawing: RenderedFrames, target: FrameTarget
    ) -> FrameTarget:
        """Compare them with the drawing itself."""
        # So a pixel asks for nothing, in the windows of SSIM neither.
        image = torch.where(
            self._hidden(batch.mine)[..., None], drawing.image.detach(), target.image
        )
        return replace(target, image=image)


def hidden_skin(places: Sequence[np.ndarray], masks: np.ndarray) -> np.ndarray:
    """Find the pixels that the masks leave out though the posed hands cover them.

    There a sleeve or an object is in front of the hand. A drawing that is compared with black
    learns black skin, which shows where an avatar is turned around.

    Args:
        places: R times (H, W), 0 where the posed hands are not (`skin_places`).
        masks: (R, H, W) uint8, 255 = visible hand.

    Returns:
        (R, H, W) bool.
    """
    margin = max(1, round(MARGIN * masks.shape[1]))
    square = np.ones((2 * margin + 1, 2 * margin + 1), dtype=np.uint8)
    hidden = np.empty(masks.shape, dtype=bool)
    for row, (place, mask) in enumerate(zip(places, masks, strict=True)):
        inside = cv2.erode((place > 0).astype(np.uint8), square)
        hidden[row] = (inside > 0) & (mask < 128)
    return hidden


def hand_masks(data: FitData, source: str, device: torch.device) -> torch.Tensor:
    """Return y_h of R frames, that of each frame found once.

    Returns:
        (R, H, W) uint8, 255 = hand. A frame in which no hand is found keeps its estimated mask:
        nothing in it could be learnt otherwise.
    """
    frames = data.frames
    images = frames.images.numpy()
    found: Iterator[np.ndarray]
    if source == "graph-cut":
        # From where the posed hands would be seen if nothing covered them.
        found = graph_cut_hands(list(images), [places > 0 for places in data.places])
    else:
        found = _prompted(images, hand_roots(data.training, frames.indices), source, device)
    masks = frames.masks.clone()
    for row, mask in enumerate(track(found, "Finding hands", len(frames))):
        if mask.any():
            masks[row] = torch.from_numpy(np.where(mask, 255, 0).astype(np.uint8))
    return masks


def hand_roots(training: TrainingCapture, frames: np.ndarray) -> np.ndarray:
    """Where the wrists of all hands are seen.

    Args:
        frames: (R,) which frames.

    Returns:
        (R, hands, 2) px, the centre of the top left pixel at 0.5; NaN behind the camera.
    """
    roots = []
    for side in training.sides:
        hand, template = training.hands[side], training.template(side).to_torch()
        given = (hand.pose[frames], hand.betas, hand.transl[frames])
        roots.append(pose_hand(template, *map(_real, given)).joints[:, 0])
    cameras = training.cameras
    places, depth = project(
        torch.stack(roots, dim=1), _real(cameras.viewmats[frames]), _real(cameras.Ks[frames])
    )
    return np.where(depth.numpy()[..., None] > 0.0, places.numpy(), np.nan)


def _prompted(
    images: np.ndarray, roots: np.ndarray, source: str, device: torch.device
) -> Iterator[np.ndarray]:
    sam, cache = open_sam(source_path(source) or "", str(device)), RegionCache()
    for image, places in zip(images, roots.tolist(), strict=True):
        prompt = PromptedHand(sam, tuple((x, y) for x, y in places))
        yield mask_of(cache.regions(image, prompt))
    cache.prune()


def _real(array: np.ndarray) -> torch.Tensor:
    return torch.as_tensor(array, dtype=torch.float32)
