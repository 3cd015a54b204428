"""From a video and its tracked landmarks to a capture."""

from __future__ import annotations

import os
from pathlib import Path

import numpy as np

from hwp_bench.base.errors import UsageError
from hwp_bench.base.progress import progress
from hwp_bench.capture.schema import MAX_FRAMES, check_id
from hwp_bench.hands import load_template
from hwp_bench.importers.shared.hand_tracks import tracked_votes
from hwp_bench.importers.shared.landmarks import check_against_video, read_landmarks
from hwp_bench.importers.shared.windows import follow_hand
from hwp_bench.importers.shared.writing import refuse_existing
from hwp_bench.importers.video.clip_masks import Masking, project_clip
from hwp_bench.importers.video.contour import ContourEnergy
from hwp_bench.importers.video.decode import check_memory, probe, read_images, read_masks
from hwp_bench.importers.video.fit_clip import (
    Footage,
    fit_landmarks,
    fit_outline,
    reprojection_error,
)
from hwp_bench.importers.video.fit_terms import hand_size
from hwp_bench.importers.video.imported_clip import ImportedClip, VideoSource, store_clip
from hwp_bench.importers.video.segmentation import NARROW, WIDE
from hwp_bench.importers.video.side_check import side_scores, warn_of_contradiction
from hwp_bench.importers.video.texture_energy import TextureEnergy
from hwp_bench.importers.video.video_settings import VideoImport
from hwp_bench.taxonomy import perturbation

#: A frame whose landmarks are missed by more than this share of the hand's size is not valid.
FAILED_FIT = 0.10


def import_video(
    video: str | os.PathLike[str],
    landmarks: str | os.PathLike[str],
    out: str | os.PathLike[str],
    options: VideoImport | None = None,
) -> ImportedClip:
    """Make a capture of a video of one hand.

    Args:
        video: any file that OpenCV decodes.
        landmarks: the tracker's npz, as `read_landmarks` describes it.
        out: the capture folder to make.
        options: choices; the defaults where None.

    Returns:
        The clip as it was written, with the numbers that measure it.

    Raises:
        BadInput: one of the files is unusable; file and field are named.
        UsageError: `out` exists, or an option makes no sense.
    """
    options = options or VideoImport()
    _check_output(Path(out), options)
    source = read_source(video, landmarks, options)
    _check_side(source, options)
    clip = fit_video(source, options)
    store_clip(clip, out, options)
    return clip


def read_source(
    video: str | os.PathLike[str], landmarks: str | os.PathLike[str], options: VideoImport
) -> VideoSource:
    """Read and check everything that the import needs from outside."""
    info = probe(video)
    every = read_landmarks(landmarks, min_score=options.min_score, side=options.hand)
    # Containers may state a wrong number of frames. A whole video is counted as it is decoded.
    # The end of a part is never read, so the header is trusted.
    part = options.frames.stop is not None
    total = info.stated_frames if part and info.stated_frames else len(every.score)
    tracked = check_against_video(every, total, info.width, info.height, landmarks)
    indices = options.frames.indices(total)
    if not 3 <= len(indices) <= MAX_FRAMES:
        raise UsageError(
            f"{len(indices)} of {total} frames are selected, a capture has 3 to {MAX_FRAMES}",
            field="--frames",
        )
    tracked = tracked.select(indices)
    if not tracked.detected.any():
        raise UsageError("no hand is detected in the selected frames", field="--frames")
    windows = follow_hand(tracked, info.fps / options.frames.stride, options.size)
    check_memory(windows)
    own = None if options.masks is None else read_masks(options.masks, info, indices, windows)
    with progress("reading frames", len(indices)) as update:
        images = read_images(info, options.frames, windows, update)
    return VideoSource(info, Path(landmarks), indices, tracked, windows, images, own)


def fit_video(source: VideoSource, options: VideoImport) -> ImportedClip:
    """Fit the hand and cut the masks in turns.

    Landmarks, masks, outline, masks, outline and texture, masks.
    """
    landmarks, windows, settings = source.landmarks, source.windows, options.fit
    footage = _footage(source, options)
    steps = settings.start_steps + settings.landmark_steps
    with progress("fitting landmarks", steps) as update:
        template = load_template(options.hand_model, options.hand)
        fitted = fit_landmarks(landmarks, template, footage, settings, update)
    first_error = reprojection_error(fitted, landmarks)
    size = hand_size(landmarks)
    scale = source.images.working.shape[1] / windows.side
    masking = Masking(source.images, landmarks.detected, size * scale, source.own_masks)
    overlaps = []
    frames = len(source.indices)
    steps = settings.contour_rounds * settings.contour_steps
    for turn, trust, reduction in ((1, WIDE, 2), (2, NARROW, 1)):
        with progress(f"cutting masks ({turn} of 3)", frames) as update:
            projected = project_clip(fitted.model, windows)
            masks = masking.masks(projected, trust, reduction=reduction, update=update)
        overlaps.append(float(masks.overlap[landmarks.detected].mean()))
        with progress(f"fitting outlines ({turn} of 2)", steps) as update:
            contour = ContourEnergy(masks.fields, landmarks.detected, windows, settings, size)
            texture = None
            if settings.texture_weight > 0 and turn == 2:
                texture = TextureEnergy(
                    source.images.frames,
                    masks.coverage,
                    landmarks.detected,
                    windows,
                    settings,
                    size,
                    fitted.model,
                )
            fit_outline(fitted, contour, update, texture)
    projected = project_clip(fitted.model, windows)
    with progress("cutting masks (3 of 3)", frames) as update:
        masks = masking.masks(projected, NARROW, update=update)
    error = reprojection_error(fitted, landmarks)
    missed = np.nan_to_num(error.by_frame, nan=np.inf) > FAILED_FIT * size
    return ImportedClip(
        source=source,
        hand=fitted.model.parameters(landmarks.detected & ~missed),
        fitted=fitted,
        projected=projected,
        masks=masks,
        error=error,
        error_landmarks_only=first_error,
        overlap_landmarks_only=overlaps[0],
    )


def _footage(source: VideoSource, options: VideoImport) -> Footage:
    video = source.video
    return Footage(video.width, video.height, video.fps / options.frames.stride, options.focal)


def _check_side(source: VideoSource, options: VideoImport) -> None:
    """Warn where the pictures contradict the side; they are asked before minutes of work."""
    scores = side_scores(source.landmarks, options.hand_model, _footage(source, options))
    votes = tracked_votes(source.landmarks_path, options.hand)
    warn_of_contradiction(options.hand, scores, votes)


def _check_output(out: Path, options: VideoImport) -> None:
    """Check the output before minutes of work, not after them."""
    refuse_existing(out, overwrite=options.overwrite)
    check_id(options.capture_id(out), os.fspath(out))
    for name in options.perturbations:
        perturbation(name)
