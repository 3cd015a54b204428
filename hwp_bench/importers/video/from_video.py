"""From a video and its tracked landmarks to a capture."""

from __future__ import annotations

import os
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass, replace
from functools import cached_property
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
from hwp_bench.importers.shared.writing import REPORT_NAME, SHEET_NAME, refuse_existing
from hwp_bench.importers.video.clip_masks import ClipMasks, Masking, ProjectedClip, project_clip
from hwp_bench.importers.video.contour import FIELD_SIZE, ContourEnergy
from hwp_bench.importers.video.fit_clip import (
    FittedClip,
    Footage,
    ReprojectionError,
    fit_landmarks,
    fit_outline,
    fit_picture,
    reprojection_error,
    share_camera,
)
from hwp_bench.importers.video.fit_terms import hand_size
from hwp_bench.importers.video.hand_pictures import HandPictures
from hwp_bench.importers.video.imported_clip import ImportedClip, ImportedHand, store_clip
from hwp_bench.importers.video.landmark_check import (
    landmark_doubts,
    refuse_other_units,
    refuse_unfitted,
)
from hwp_bench.importers.video.picture_energy import PictureEnergy
from hwp_bench.importers.video.segmentation import NARROW, WIDE, MaskSettings
from hwp_bench.importers.video.source import VideoSource, read_source
from hwp_bench.importers.video.texture_energy import TextureEnergy
from hwp_bench.importers.video.two_hands import ProjectedHands, project_hands
from hwp_bench.importers.video.video_settings import VideoImport
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
    source = without_blank_frames(read_source(video, landmarks, options))
    refuse_other_units(source)
    doubts = landmark_doubts(source)
    for doubt in doubts:
        notice(f"warning: {os.fspath(landmarks)}: it seems that {doubt}.")
    clip = fit_video(source, options, doubts)
    for warning in clip.warnings[len(doubts) :]:
        notice(f"warning: {warning}. Look at the sheet.")
    store_clip(clip, out, options, call)
    return clip


def finished_import(
    video: str | os.PathLike[str],
    landmarks: str | os.PathLike[str],
    out: str | os.PathLike[str],
    options: VideoImport,
) -> dict[str, Any] | None:
    """Return the numbers of an import that the same call has finished; None where it has not.

    A process may be killed after its capture was whole, and before its sheet was written, which is
    made up for. Code and hand model do not count.

    Args:
        video, landmarks, out, options: as `import_video`.

    Raises:
        BadInput: one of the files cannot be read.
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


def without_blank_frames(source: VideoSource) -> VideoSource:
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
    settings = options.fit
    hands = list(source.hands.values())
    fits = _fit_hands(source, options)
    first_errors = [
        reprojection_error(fitted, hand) for fitted, hand in zip(fits, hands, strict=True)
    ]
    good = map(followed, first_errors, hands)
    refuse_unfitted(dict(zip(source.hands, good, strict=True)), source, doubts)
    size = sum(hand_size(hand) for hand in hands) / len(hands)
    scale = source.images.working.shape[1] / source.windows.side
    masking = Masking(source.images, source.detected, size * scale, source.own_masks)
    pictures = settings.picture_weight > 0 and settings.picture_rounds > 0
    turns = 4 if pictures else 3

    def cut(turn: int, trust: MaskSettings, reduction: int = 1) -> _Cut:
        with progress(f"cutting masks ({turn} of {turns})", len(source.indices)) as update:
            clips = [project_clip(fitted.model, source.windows) for fitted in fits]
            pair = project_hands(clips, hands) if len(clips) == 2 else None
            masks = masking.masks(pair or clips[0], trust, reduction=reduction, update=update)
        return _Cut(masks, clips, pair)

    found = cut(1, WIDE, reduction=2)
    overlap_landmarks_only = float(found.masks.overlap[source.detected].mean())
    if found.pair is not None:
        for hand, fitted in enumerate(fits):
            fitted.energy.trust(found.pair.trust(hand))
    _fit_outlines(source, options, fits, found, turn=1)
    _fit_outlines(source, options, fits, cut(2, NARROW), turn=2)
    if pictures:
        _fit_pictures(source, options, fits, cut(3, NARROW))
    last = cut(turns, NARROW)
    imported = {}
    for (side, landmarks), fitted, projected, first in zip(
        source.hands.items(), fits, last.clips, first_errors, strict=True
    ):
        error = reprojection_error(fitted, landmarks)
        imported[side] = ImportedHand(
            landmarks=landmarks,
            parameters=fitted.model.parameters(followed(error, landmarks)),
            fitted=fitted,
            projected=projected,
            error=error,
            error_landmarks_only=first,
        )
    valid = {side: hand.parameters.valid for side, hand in imported.items()}
    refuse_unfitted(valid, source, doubts)
    return ImportedClip(source, imported, last.masks, overlap_landmarks_only, tuple(doubts))


def followed(error: ReprojectionError, landmarks: Landmarks) -> np.ndarray:
    """(F,) bool, the frames in which a fit follows the landmarks."""
    missed = np.nan_to_num(error.by_frame, nan=np.inf) > FAILED_FIT * hand_size(landmarks)
    return np.asarray(landmarks.detected & ~missed)


@dataclass(frozen=True, eq=False)
class _Cut:
    """Masks of all hands, each hand projected, and both together where there are two."""

    masks: ClipMasks
    clips: list[ProjectedClip]
    pair: ProjectedHands | None

    @cached_property
    def coverages(self) -> list[np.ndarray]:
        """The visible part of each hand, (F, S, S) uint8."""
        if self.pair is None:
            return [self.masks.coverage]
        return list(self.pair.coverage(self.masks.coverage))


def _fit_outlines(
    source: VideoSource, options: VideoImport, fits: list[FittedClip], found: _Cut, turn: int
) -> None:
    """Refine the hands by their outlines; in the second turn by their textures too."""
    settings = options.fit
    steps = settings.contour_rounds * settings.contour_steps
    with progress(f"fitting outlines ({turn} of 2)", steps * len(fits)) as update:
        for hand, fitted in enumerate(fits):
            contour = _contour(source, options, hand, found.masks, found.pair)
            texture = None
            if turn == 2 and settings.texture_weight > 0:
                pictures = _pictures(source, hand, found)
                texture = TextureEnergy(pictures, settings, fitted.model)
            fit_outline(fitted, contour, _after(update, hand * steps), texture)


def _fit_pictures(
    source: VideoSource, options: VideoImport, fits: list[FittedClip], found: _Cut
) -> None:
    """Refine the hands' poses by whole pictures."""
    settings = options.fit
    steps = settings.picture_rounds * settings.picture_steps
    with progress("fitting pictures", steps * len(fits)) as update:
        for hand, fitted in enumerate(fits):
            picture = PictureEnergy(_pictures(source, hand, found), settings, fitted.model)
            fit_picture(fitted, picture, _after(update, hand * steps))


def _pictures(source: VideoSource, hand: int, found: _Cut) -> HandPictures:
    """The frames as the fit of one hand sees them."""
    landmarks: Landmarks = list(source.hands.values())[hand]
    return HandPictures(
        images=source.images.frames,
        masks=found.coverages[hand],
        usable=landmarks.detected,
        windows=source.windows,
        hand_size=hand_size(landmarks),
        other=found.coverages[1 - hand] if len(found.coverages) == 2 else None,
    )


def _fit_hands(source: VideoSource, options: VideoImport) -> list[FittedClip]:
    """Fit the landmarks of each hand, then both to one camera."""
    settings, video = options.fit, source.video
    footage = Footage(video.width, video.height, video.fps / options.frames.stride, options.focal)
    steps = settings.start_steps + settings.landmark_steps
    fits: list[FittedClip] = []
    with progress("fitting landmarks", steps * len(source.hands)) as update:
        for side, landmarks in source.hands.items():
            template = load_template(options.hand_model, side)
            later = _after(update, steps * len(fits))
            fits.append(fit_landmarks(landmarks, template, footage, settings, later))
    if len(fits) == 2 and options.focal is None:
        share_camera(fits, steps=settings.landmark_steps // 3)
    return fits


def _contour(
    source: VideoSource,
    options: VideoImport,
    hand: int,
    masks: ClipMasks,
    pair: ProjectedHands | None,
) -> ContourEnergy:
    """The outline of one hand; where the other one is, the masks' outline is not this one's."""
    landmarks: Landmarks = list(source.hands.values())[hand]
    size, settings = hand_size(landmarks), options.fit
    ignored = None
    if pair is not None:
        reach = settings.contour_reach * size * FIELD_SIZE / source.windows.side
        ignored = pair.covered(hand, reach)
    return ContourEnergy(masks.fields, landmarks.detected, source.windows, settings, size, ignored)


def _after(update: Callable[[int], None], done: int) -> Callable[[int], None]:
    """A report of progress that counts on."""
    return lambda more: update(done + more)


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
