"""Judgements of frames and pixels before the fit: the pre-pass, the hand, hidden skin."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace

import cv2
import numpy as np
import torch

from hwp_bench.base.console import track
from hwp_bench.hands import HandTemplate, pose_hand, project
from hwp_bench.hands.raster import draw_faces
from hwp_bench.methods.contract import TrainingCapture
from hwp_bench.methods.settings import source_path
from wildghand.fitting.data import Judgement
from wildghand.fitting.fit import Batch, Component, DrawOptions, Fit, FrameTarget
from wildghand.gaussians.training import FrameTable, TrainingFrames, upload
from wildghand.model.frames import RenderedFrames
from wildghand.pao.sam import PromptedHand, mask_of, open_sam
from wildghand.pao.segmenters import RegionCache, graph_cut_hands
from wildghand.prepass import FrameAssessment, PrepassInput, judge_frames

#: How far inside the posed hand's outline a pixel must lie to count as hidden, as a share of the
#: image's height: closer to it a mask leaves a pixel out because the given pose is not exact.
MARGIN = 0.0085
# Frames that are posed at a time, so that memory does not grow with the clip.
_CHUNK = 32


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

        judges = data.judges if settings.validated else None
        found = judge_frames(
            given(data.frames), settings, None if judges is None else given(judges)
        )
        self.assessment = found
        self._refine_pose = torch.from_numpy(found.refine_pose)
        data.judgement = Judgement(
            torch.from_numpy(found.clean).float(),
            torch.from_numpy(found.frame_weights).float(),
            torch.from_numpy(np.exp(found.log_gains.mean(axis=1))),
            torch.from_numpy(found.pixel_weights),
        )

    def draws(self, fit: Fit, batch: Batch) -> DrawOptions:
        """The pose of frames that disagree with their mask is refined, in a batch with any."""
        move = fit.settings.prepass.frame_poses and bool(self._refine_pose[batch.rows].any())
        return {"move": move}

    def compare(
        self, fit: Fit, batch: Batch, drawing: RenderedFrames, target: FrameTarget
    ) -> FrameTarget:
        """Pixels that are covered count less, with PAO and without."""
        uncovered = fit.data.uncovered(batch.mine)
        return target if uncovered is None else replace(target, weights=target.weights * uncovered)


class HandMasks(Component):
    """The hand y_h of every frame, found as the setting `pao.hand` says."""

    def prepare(self, fit: Fit) -> None:
        """Put what is found in place of the estimated masks."""
        data = fit.data
        data.replace_masks(
            hand_masks(data.training, data.frames, fit.settings.pao.hand, fit.device)
        )


class HiddenSkin(Component):
    """Pixels in which something hides the hand are compared with nothing."""

    def before(self, fit: Fit) -> None:
        """Find these pixels."""
        frames = fit.data.frames
        hidden = torch.from_numpy(hidden_skin(fit.data.places, frames.masks.numpy()))
        self._hidden = FrameTable(
            lambda rows: upload(hidden[rows], fit.device),
            len(frames),
            frames.masks[0].numel(),
            fit.device,
        )

    def compare(
        self, fit: Fit, batch: Batch, drawing: RenderedFrames, target: FrameTarget
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


def hand_masks(
    training: TrainingCapture, frames: TrainingFrames, source: str, device: torch.device
) -> torch.Tensor:
    """Return y_h of R frames, that of each frame found once.

    Returns:
        (R, H, W) uint8, 255 = hand. A frame in which no hand is found keeps its estimated mask:
        nothing in it could be learnt otherwise.
    """
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
