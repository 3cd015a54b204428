"""From a video and its tracked landmarks to a capture, in turns of fitting and cutting masks."""

from __future__ import annotations

import os
from collections.abc import Callable, Sequence
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

import numpy as np

from hwp_bench.base.console import notice, progress
from hwp_bench.base.errors import BadInput, UsageError, bounded
from hwp_bench.base.files import atomic_write, read_json, sha256_file, sha256_json
from hwp_bench.base.images import is_blank
from hwp_bench.capture.schema import EXTRA, METADATA, check_id
from hwp_bench.hands import load_template
from hwp_bench.importers.shared.landmarks import Landmarks
from hwp_bench.importers.shared.output import REPORT_NAME, SHEET_NAME, refuse_existing
from hwp_bench.importers.video.clip import ImportedClip, ImportedHand, store_clip
from hwp_bench.importers.video.masks import (
    NARROW,
    WIDE,
    ClipMasks,
    MaskSettings,
    ProjectedHands,
    cut_masks,
    project_clip,
)
from hwp_bench.importers.video.pictures import HandPictures, PictureResidual, TextureResidual
from hwp_bench.importers.video.residuals import FIELD_SIZE, REACH, OutlineResidual
from hwp_bench.importers.video.solve import (
    PICTURE_STEPS,
    FittedClip,
    Footage,
    ReprojectionError,
    fit_landmarks,
    fit_outline,
    fit_picture,
    reprojection_error,
    share_camera,
)
from hwp_bench.importers.video.source import (
    VideoImport,
    VideoSource,
    landmark_doubts,
    read_source,
    refuse_other_units,
    refuse_unfitted,
)
from hwp_bench.taxonomy import perturbation

#: Endings of the names of images that a sheet can be written to.
SHEET_KINDS = (".png", ".jpg", ".jpeg", ".bmp", ".tif", ".tiff")
#: A frame whose landmarks are missed by more than this share of the hand's size is not valid.
FAILED_FIT = 0.10


def import_video(
    video: str | os.PathLike[str],
    landmarks: str | os.PathLike[str],
    out: str | os.PathLike[str],
    options: VideoImport | None = None,
) -> ImportedClip:
    """Make a capture of a video of one hand or two.

    Args:
        video: any file that `hwp_bench.importers.video.decode` reads.
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
    call = _call(video, landmarks, out, options)
    source = drop_blank_frames(read_source(video, landmarks, options))
    refuse_other_units(source)
    doubts = landmark_doubts(source)
    for doubt in doubts:
        notice(f"warning: {os.fspath(landmarks)}: it seems that {doubt}.")
    clip = fit_video(source, options, doubts)
    for warning in clip.warnings[len(doubts) :]:
        notice(f"warning: {warning}. Look at the sheet.")
    store_clip(clip, out, options, call)
    return clip


def read_finished_import(
    video: str | os.PathLike[str],
    landmarks: str | os.PathLike[str],
    out: str | os.PathLike[str],
    options: VideoImport,
) -> dict[str, Any] | None:
    """Return the numbers of an import that the same call has finished; None where it has not.

    A process may be killed after its capture was whole, and before its sheet was written, which is
    made up for. Code and hand model do not count. Arguments as of `import_video`.
    """
    report = Path(out) / EXTRA / REPORT_NAME
    if options.overwrite or not report.is_file() or not (Path(out) / METADATA).is_file():
        return None
    try:
        facts = read_json(report)
    except BadInput:
        return None
    if not isinstance(facts, dict) or "call" not in facts:
        return None
    if facts.pop("call") != _call(video, landmarks, out, options):
        return None
    if options.sheet is not None and not options.sheet.exists():
        atomic_write(options.sheet, (Path(out) / EXTRA / SHEET_NAME).read_bytes())
    return facts


def _call(
    video: str | os.PathLike[str],
    landmarks: str | os.PathLike[str],
    out: str | os.PathLike[str],
    options: VideoImport,
) -> str:
    """The digest of everything that a person gives an import; empty where a file is not there."""
    chosen = asdict(replace(options, overwrite=False, sheet=None, id=options.capture_id(out)))
    masks = sorted(options.masks.glob("*")) if options.masks is not None else []
    files = [Path(video), Path(landmarks), *masks]
    digests = [sha256_file(path) if path.is_file() else "" for path in files]
    chosen["masks"] = None if options.masks is None else [path.name for path in masks]
    return sha256_json([chosen, digests])


def drop_blank_frames(source: VideoSource) -> VideoSource:
    """The same clip; no hand counts as detected in a frame of one colour, such as a black one."""
    blank = np.array([is_blank(frame) for frame in source.images.frames])
    hands = {
        side: replace(hand, detected=hand.detected & ~blank) for side, hand in source.hands.items()
    }
    wrong = np.flatnonzero(source.detected & blank)
    if not len(wrong):
        return source
    numbers = [int(source.indices[frame]) for frame in wrong]
    notice(f"warning: no hand is taken from frames of one colour: {bounded(numbers)}.")
    for side, hand in hands.items():
        if not hand.detected.any():
            raise BadInput(
                f"the {side} hand is detected in frames of one colour only", where=source.video.path
            )
    return replace(source, hands=hands)


def fit_video(
    source: VideoSource, options: VideoImport, doubts: Sequence[str] = ()
) -> ImportedClip:
    """Fit the hands and cut the masks in turns.

    Landmarks, masks, outline, masks, outline and texture, masks, whole pictures, masks. Two hands
    are fitted one after the other and share their camera and their masks.
    """
    hands = list(source.hands.values())
    fits = _fit_hands(source, options)
    first_errors = [
        reprojection_error(fitted, hand) for fitted, hand in zip(fits, hands, strict=True)
    ]
    good = map(follow_landmarks, first_errors, hands)
    refuse_unfitted(dict(zip(source.hands, good, strict=True)), source, doubts)
    turns = _Turns(source, options, fits)
    projected, masks = turns.cut(WIDE, reduction=2)
    overlap_landmarks_only = float(masks.overlap[source.detected].mean())
    if len(fits) == 2:
        for hand, fitted in enumerate(fits):
            fitted.landmarks.weaken(projected.trust(hand))
    turns.fit_outlines(projected, masks)
    turns.fit_outlines(*turns.cut(NARROW), texture=options.fit.texture)
    if options.fit.picture_rounds > 0:
        turns.fit_pictures(*turns.cut(NARROW))
    projected, masks = turns.cut(NARROW)
    imported = {}
    for (side, landmarks), fitted, clip, first in zip(
        source.hands.items(), fits, projected.hands, first_errors, strict=True
    ):
        error = reprojection_error(fitted, landmarks)
        parameters = fitted.model.parameters(follow_landmarks(error, landmarks))
        imported[side] = ImportedHand(landmarks, parameters, fitted, clip, error, first)
    valid = {side: hand.parameters.valid for side, hand in imported.items()}
    refuse_unfitted(valid, source, doubts)
    return ImportedClip(source, imported, masks, overlap_landmarks_only, tuple(doubts))


def follow_landmarks(error: ReprojectionError, landmarks: Landmarks) -> np.ndarray:
    """(F,) bool, the frames in which a fit follows the landmarks."""
    missed = np.nan_to_num(error.by_frame, nan=np.inf) > FAILED_FIT * landmarks.hand_size
    return np.asarray(landmarks.detected & ~missed)


def _fit_hands(source: VideoSource, options: VideoImport) -> list[FittedClip]:
    """Fit the landmarks of each hand, then both to one camera."""
    settings, video = options.fit, source.video
    footage = Footage(video.width, video.height, video.fps / options.frames.stride, options.focal)
    steps = settings.start_steps + settings.landmark_steps
    fits: list[FittedClip] = []
    with progress("fitting landmarks", steps * len(source.hands)) as update:
        for side, landmarks in source.hands.items():
            template = load_template(options.hand_model, side)
            later = _counting_on(update, steps * len(fits))
            fits.append(fit_landmarks(landmarks, template, footage, settings, later))
    if len(fits) == 2 and options.focal is None:
        share_camera(fits, steps=settings.landmark_steps // 3)
    return fits


def _counting_on(update: Callable[[int], None], done: int) -> Callable[[int], None]:
    return lambda more: update(done + more)


class _Turns:
    """The turns of masks and fits of one clip."""

    def __init__(
        self, source: VideoSource, options: VideoImport, fits: Sequence[FittedClip]
    ) -> None:
        self._source, self._fits, self._settings = source, fits, options.fit
        self._landmarks = list(source.hands.values())
        self._outlines = self._masks = 0
        self._turns = 4 if options.fit.picture_rounds > 0 else 3

    def cut(self, trust: MaskSettings, reduction: int = 1) -> tuple[ProjectedHands, ClipMasks]:
        """Cut the masks of all hands, prompted by the fits as they are now."""
        source, images = self._source, self._source.images
        size = sum(hand.hand_size for hand in self._landmarks) / len(self._landmarks)
        size *= images.working.shape[1] / source.windows.side
        self._masks += 1
        title = f"cutting masks ({self._masks} of {self._turns})"
        with progress(title, len(source.indices)) as update:
            clips = [project_clip(fitted.model, source.windows) for fitted in self._fits]
            projected = ProjectedHands(clips, self._landmarks)
            masks = cut_masks(
                images,
                projected,
                source.detected,
                size,
                trust,
                own=source.own_masks,
                reduction=reduction,
                update=update,
            )
        return projected, masks

    def fit_outlines(
        self, projected: ProjectedHands, masks: ClipMasks, *, texture: bool = False
    ) -> None:
        """Refine the hands by their outlines, and by their textures too."""
        windows = self._source.windows
        steps = self._settings.contour_rounds * self._settings.contour_steps
        self._outlines += 1
        with progress(
            f"fitting outlines ({self._outlines} of 2)", steps * len(self._fits)
        ) as update:
            pictures = self._pictures(projected, masks) if texture else None
            for hand, (fitted, landmarks) in enumerate(
                zip(self._fits, self._landmarks, strict=True)
            ):
                size = landmarks.hand_size
                # Where the other hand is, the masks' outline is not this one's.
                ignored = projected.covered(hand, REACH * size * FIELD_SIZE / windows.side)
                outline = OutlineResidual(masks.fields, landmarks.detected, windows, size, ignored)
                more = [] if pictures is None else [TextureResidual(pictures[hand], fitted.model)]
                later = _counting_on(update, hand * steps)
                fit_outline(fitted, outline, *more, update=later)

    def fit_pictures(self, projected: ProjectedHands, masks: ClipMasks) -> None:
        """Refine the hands' poses by whole pictures."""
        steps = self._settings.picture_rounds * PICTURE_STEPS
        with progress("fitting pictures", steps * len(self._fits)) as update:
            pictures = self._pictures(projected, masks)
            for hand, fitted in enumerate(self._fits):
                residual = PictureResidual(pictures[hand], fitted.model)
                fit_picture(fitted, residual, _counting_on(update, hand * steps))

    def _pictures(self, projected: ProjectedHands, masks: ClipMasks) -> list[HandPictures]:
        """The frames as the fit of each hand sees them."""
        visible = projected.coverage(masks.coverage)
        return [
            HandPictures(
                images=self._source.images.frames,
                masks=visible[hand],
                usable=landmarks.detected,
                windows=self._source.windows,
                hand_size=landmarks.hand_size,
                other=visible[1 - hand] if len(visible) == 2 else None,
            )
            for hand, landmarks in enumerate(self._landmarks)
        ]


def _check_output(out: Path, options: VideoImport) -> None:
    """Check the output before minutes of work, not after them."""
    refuse_existing(out, overwrite=options.overwrite)
    check_id(options.capture_id(out), os.fspath(out))
    for name in options.perturbations:
        perturbation(name)
    sheet = options.sheet
    if sheet is None:
        return
    if sheet.suffix.lower() not in SHEET_KINDS:
        kinds = ", ".join(SHEET_KINDS)
        raise UsageError(f"must end in one of {kinds}", where=sheet, field="--sheet")
    if sheet.is_dir() or any(part.is_file() for part in sheet.parents):
        raise UsageError("cannot be written there", where=sheet, field="--sheet")
