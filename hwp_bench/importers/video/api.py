"""From a video and its tracked landmarks to a capture, in turns of fitting and cutting masks."""

from __future__ import annotations

import itertools
import os
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from hwp_bench.base.console import notice, progress
from hwp_bench.base.errors import BadInput, UsageError, bounded
from hwp_bench.base.files import check_places, sha256_file, sha256_json
from hwp_bench.base.images import is_blank, read_rgb, write_image
from hwp_bench.capture.folder import refuse_taken
from hwp_bench.capture.schema import EXTRA, Cameras, check_id
from hwp_bench.hands import HandParameters, load_template
from hwp_bench.hands.skeleton import SIDES
from hwp_bench.importers.shared.landmarks import Landmarks
from hwp_bench.importers.shared.output import (
    SHEET_NAME,
    read_report,
    write_capture,
)
from hwp_bench.importers.video.glimpse import Glimpse, paint_hand
from hwp_bench.importers.video.masks import (
    LAST,
    NARROW,
    WIDE,
    ClipMasks,
    MaskSettings,
    ProjectedClip,
    ProjectedHands,
    cut_masks,
    project_clip,
)
from hwp_bench.importers.video.pictures import (
    HandPictures,
    PictureResidual,
    SurfaceResidual,
    TextureResidual,
)
from hwp_bench.importers.video.residuals import FIELD_SIZE, REACH, OutlineResidual
from hwp_bench.importers.video.solve import (
    PICTURE_STEPS,
    FittedClip,
    ReprojectionError,
    fit_landmarks,
    refine,
    reprojection_error,
    share_camera,
)
from hwp_bench.importers.video.source import (
    FEW_FITTED,
    LOW_OVERLAP,
    VideoImport,
    VideoSource,
    landmark_doubts,
    read_source,
    refuse_other_units,
    refuse_unfitted,
)
from hwp_bench.importers.video.usable import say_faults

#: Version of the fit and the masks. It is raised when they come out otherwise for the same input,
#: because scores on captures of two versions do not compare.
IMPORTER_VERSION = 5
#: What captures of it say in `CaptureInfo.made_by`.
MADE_BY = f"video {IMPORTER_VERSION}"
#: Frames on the overlay sheet.
SHEET_FRAMES = 24
#: Endings of the names of images that a sheet can be written to.
SHEET_KINDS = (".png", ".jpg", ".jpeg", ".bmp", ".tif", ".tiff")
#: A frame whose landmarks are missed by more than this share of the hand's size is not valid.
FAILED_FIT = 0.10


@dataclass(frozen=True, eq=False)
class ImportedHand:
    """One hand of an import."""

    #: The tracker's.
    landmarks: Landmarks
    #: Pose, shape and place.
    parameters: HandParameters
    #: The fit, and the fit in the images.
    fitted: FittedClip
    projected: ProjectedClip
    #: Reprojection error of the final fit, and before the outline was fitted.
    error: ReprojectionError
    error_landmarks_only: ReprojectionError

    def facts(self) -> dict[str, object]:
        """Return the numbers that measure the fit of this hand, as JSON."""

        def pixels(error: ReprojectionError) -> dict[str, object]:
            values = {key: value for key, value in asdict(error).items() if key != "by_frame"}
            return {k: round(v, 3) if isinstance(v, float) else v for k, v in values.items()}

        size = self.fitted.model.variables.log_size.detach().exp()
        return {
            "frames_detected": int(self.landmarks.detected.sum()),
            "frames_valid": int(self.parameters.valid.sum()),
            "reprojection_px": pixels(self.error),
            "reprojection_px_landmarks_only": pixels(self.error_landmarks_only),
            "depth_m": [
                round(float(z), 3) for z in np.percentile(self.parameters.transl[:, 2], (0, 100))
            ],
            "world_scale": round(float(size), 4),
        }


@dataclass(frozen=True, eq=False)
class ImportedClip:
    """The results of an import."""

    #: The inputs.
    source: VideoSource
    #: By side, the hand that is detected most first.
    hands: Mapping[str, ImportedHand]
    #: Final masks, of all hands.
    masks: ClipMasks
    #: Mean overlap of mesh and mask before the outline was fitted.
    overlap_landmarks_only: float
    #: What tells against the landmarks.
    doubts: tuple[str, ...] = ()

    @property
    def overlap(self) -> float:
        """Mean overlap of mesh and mask in the frames that show a hand."""
        return float(self.masks.overlap[self.source.detected].mean())

    @property
    def warnings(self) -> tuple[str, ...]:
        """Things to know before the capture is used; empty for a sound clip."""
        said = list(self.doubts)
        for side, hand in self.hands.items():
            fitted, seen = int(hand.parameters.valid.sum()), int(hand.landmarks.detected.sum())
            if fitted < FEW_FITTED * seen:
                said.append(
                    f"the {side} hand is fitted in {fitted} of the {seen} frames that show it"
                )
        if self.overlap < LOW_OVERLAP:
            said.append(
                f"the overlap of mesh and mask is {self.overlap:.2f}, of a sound clip 0.9 and more"
            )
        return tuple(said)

    @property
    def first(self) -> ImportedHand:
        """The hand that is detected most."""
        return next(iter(self.hands.values()))

    @property
    def shown(self) -> str:
        """The hands as a capture names them: `right`, `left` or `both`."""
        return "both" if len(self.hands) == 2 else next(iter(self.hands))

    @property
    def focal(self) -> float:
        """Focal length, px of the whole frame; the same for all hands."""
        return float(self.first.fitted.model.focal.detach())

    def facts(self) -> dict[str, object]:
        """Return the numbers that measure the import, as JSON; of two hands each has its own."""
        seen = self.source.detected
        overlaps = self.masks.overlap[seen]
        common: dict[str, object] = {
            "frames": len(seen),
            "overlap": round(self.overlap, 4),
            "overlap_percentile_5": round(float(np.percentile(overlaps, 5)), 4),
            "overlap_landmarks_only": round(self.overlap_landmarks_only, 4),
            "focal_px": round(self.focal, 2),
        }
        reading = self.source.reading and self.source.reading.warning()
        warnings = [f"the video {reading}"] if reading else []
        warnings += self.warnings
        if warnings:
            common["warnings"] = warnings
        if len(self.hands) == 1:
            return {**common, **self.first.facts()}
        each = {side: hand.facts() for side, hand in self.hands.items()}
        tracked = self.source.tracked
        repaired = {
            "swaps_repaired": tracked.swaps if tracked else 0,
            "doubles_left_out": tracked.doubles if tracked else 0,
        }
        return {**common, **repaired, "hands": each}


def import_video(
    video: str | os.PathLike[str],
    landmarks: str | os.PathLike[str],
    out: str | os.PathLike[str],
    options: VideoImport | None = None,
    glimpse: Glimpse | None = None,
) -> ImportedClip:
    """Make a capture of a video of one hand or two.

    Args:
        video: any file that `hwp_bench.importers.video.decode` reads.
        landmarks: the tracker's npz, as `read_landmarks` describes it.
        out: the capture folder to make.
        options: choices; the defaults where None.
        glimpse: is shown the hands after each step of the fit.

    Returns:
        The clip as it was written, with the numbers that measure it.

    Raises:
        BadInput: one of the files is unusable; file and field are named.
        UsageError: `out` exists, or an option makes no sense.
    """
    options = options or VideoImport()
    given = {"video": video, "landmarks": landmarks, "masks": options.masks}
    check_places({"out": out}, given, replaces=options.overwrite, makes_captures=True)
    _check_output(Path(out), options)
    call = _call(video, landmarks, out, options)
    source = drop_blank_frames(read_source(video, landmarks, options))
    refuse_other_units(source)
    say_faults(source, out, options)
    doubts = landmark_doubts(source)
    for doubt in doubts:
        notice(f"warning: {os.fspath(landmarks)}: it seems that {doubt}.")
    clip = fit_video(source, options, doubts, glimpse)
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
    facts = None if options.overwrite else read_report(out)
    if not facts or facts.pop("call", None) != _call(video, landmarks, out, options):
        return None
    if options.sheet is not None and not options.sheet.exists():
        check_sheet(options.sheet)
        write_image(options.sheet, read_rgb(Path(out) / EXTRA / SHEET_NAME))
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
    wrong = source.indices[source.detected & blank]
    if not len(wrong):
        return source
    notice(f"warning: no hand is taken from frames of one colour: {bounded(wrong.tolist())}.")
    hands = {}
    for side, hand in source.hands.items():
        left = replace(hand, detected=hand.detected & ~blank)
        if left.detected.any():
            hands[side] = left
        else:
            notice(f"The {side} hand is in none of the other frames and is left out.")
    if not hands:
        problem = "a hand is detected in frames of one colour only"
        raise BadInput(problem, where=source.video.path)
    return replace(source, hands=hands)


def fit_video(
    source: VideoSource,
    options: VideoImport,
    doubts: Sequence[str] = (),
    glimpse: Glimpse | None = None,
) -> ImportedClip:
    """Fit the hands and cut the masks in turns.

    Landmarks, masks, outline, masks, outline and texture, masks, whole pictures, masks. Two hands
    are fitted one after the other and share their camera and their masks.
    """
    hands = list(source.hands.values())
    fits = _fit_hands(source, options)
    first_errors = list(map(reprojection_error, fits, hands))
    good = map(follow_landmarks, first_errors, hands)
    refuse_unfitted(dict(zip(source.hands, good, strict=True)), source, doubts)
    turns = _Turns(source, options, fits, glimpse)
    edge = source.images.working.shape[1]
    projected, masks = turns.cut(WIDE, min(edge // 2, FIELD_SIZE))
    overlap_landmarks_only = float(masks.overlap[source.detected].mean())
    if len(fits) == 2:
        for hand, fitted in enumerate(fits):
            fitted.landmarks.weaken(projected.trust(hand))
    turns.refine(projected, masks, "outline")
    stored = min(edge, source.windows.size)
    turns.refine(*turns.cut(NARROW, stored), "outline", *["texture"] * options.fit.texture)
    if options.fit.picture_rounds > 0:
        turns.refine(*turns.cut(NARROW, stored), "pictures")
    projected, masks = turns.cut(LAST)
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


@contextmanager
def _steps(title: str, total: int) -> Iterator[Callable[[], None]]:
    """Show the progress of work that calls what it is given after each of its steps."""
    count = itertools.count(1)
    with progress(title, total) as update:
        yield lambda: update(next(count))


def _fit_hands(source: VideoSource, options: VideoImport) -> list[FittedClip]:
    """Fit the landmarks of each hand, then both to one camera."""
    settings, footage = options.fit, source.footage
    steps = settings.start_steps + settings.landmark_steps
    with _steps("fitting landmarks", steps * len(source.hands)) as step:
        fits = [
            fit_landmarks(hand, load_template(options.hand_model, side), footage, settings, step)
            for side, hand in source.hands.items()
        ]
    if len(fits) == 2 and options.focal is None:
        share_camera(fits, steps=settings.landmark_steps // 3)
    return fits


class _Turns:
    """The turns of masks and fits of one clip."""

    def __init__(
        self,
        source: VideoSource,
        options: VideoImport,
        fits: Sequence[FittedClip],
        glimpse: Glimpse | None,
    ) -> None:
        self._source, self._fits, self._settings = source, fits, options.fit
        self._glimpse = glimpse
        self._landmarks = list(source.hands.values())
        self._outlines = self._masks = 0
        self._turns = 4 if options.fit.picture_rounds > 0 else 3

    def cut(self, trust: MaskSettings, edge: int | None = None) -> tuple[ProjectedHands, ClipMasks]:
        """Cut the masks of all hands, prompted by the fits as they are now."""
        source, images = self._source, self._source.images
        size = sum(hand.hand_size for hand in self._landmarks) / len(self._landmarks)
        size *= images.working.shape[1] / source.windows.side
        self._masks += 1
        title = f"cutting masks ({self._masks} of {self._turns})"
        with progress(title, len(source.indices)) as update:
            clips = [project_clip(fitted.model, source.windows) for fitted in self._fits]
            projected = ProjectedHands(clips, self._landmarks)
            if self._glimpse is not None:
                shown = zip(clips, self._landmarks, strict=True)
                self._glimpse(
                    [paint_hand(clip, images.frames, one.detected) for clip, one in shown]
                )
            seen, own = source.detected, source.own_masks
            masks = cut_masks(images, projected, seen, size, trust, own, edge, update)
        return projected, masks

    def refine(self, projected: ProjectedHands, masks: ClipMasks, *kinds: str) -> None:
        """Refine each hand by its `outline`, by that and its `texture`, or by whole `pictures`."""
        source, fit = self._source, self._settings
        if kinds == ("pictures",):
            title, steps = "fitting pictures", fit.picture_rounds * PICTURE_STEPS
        else:
            self._outlines += 1
            title = f"fitting outlines ({self._outlines} of 2)"
            steps = fit.contour_rounds * fit.contour_steps
        with _steps(title, steps * len(self._fits)) as step:
            seen = [] if kinds == ("outline",) else projected.coverage(masks.coverage)
            for hand, (fitted, tracked) in enumerate(zip(self._fits, self._landmarks, strict=True)):
                size, windows = tracked.hand_size, source.windows
                outline: OutlineResidual | None = None
                surface: SurfaceResidual | None = None
                if "outline" in kinds:
                    # Where the other hand is, the masks' outline is not this one's.
                    ignored = projected.covered(hand, REACH * size * FIELD_SIZE / windows.side)
                    outline = OutlineResidual(
                        masks.fields, tracked.detected, windows, size, ignored
                    )
                if seen:
                    other = seen[1 - hand] if len(seen) == 2 else None
                    shown = source.images.frames, seen[hand], tracked.detected, windows, size, other
                    kind = TextureResidual if "texture" in kinds else PictureResidual
                    surface = kind(HandPictures(*shown), fitted.model)
                refine(fitted, outline, surface, tick=step)


def _check_output(out: Path, options: VideoImport) -> None:
    """Check the output before minutes of work, not after them."""
    refuse_taken(out, overwrite=options.overwrite)
    check_id(options.capture_id(out), os.fspath(out))
    if options.sheet is not None:
        check_sheet(options.sheet)


def check_sheet(sheet: Path) -> None:
    """Refuse a place that no sheet can be written to."""
    if sheet.suffix.lower() not in SHEET_KINDS:
        kinds = ", ".join(SHEET_KINDS)
        raise UsageError(f"must end in one of {kinds}", where=sheet, field="--sheet")
    if sheet.is_dir() or any(part.is_file() for part in sheet.parents):
        raise UsageError("cannot be written there", where=sheet, field="--sheet")


# --- The capture


def store_clip(
    clip: ImportedClip, out: str | os.PathLike[str], options: VideoImport, call: str
) -> None:
    """Write the capture, whole or not at all, and the separate sheet where one is asked for.

    `call` is the digest of the call that makes it, by which a second one knows that it is complete.
    """
    source, facts = clip.source, clip.facts()
    video, windows = source.video, source.windows
    count = len(source.indices)
    middle = (video.width / 2, video.height / 2)
    K = np.array([[clip.focal, 0, middle[0]], [0, clip.focal, middle[1]], [0, 0, 1.0]])
    overview = write_capture(
        out,
        {side: clip.hands[side].parameters for side in SIDES if side in clip.hands},
        Cameras(windows.intrinsics(K), np.tile(np.eye(4), (count, 1, 1))),
        zip(source.images.frames, clip.masks.coverage, strict=True),
        [hand.projected.drawn() for hand in clip.hands.values()],
        {**facts, "call": call},
        overwrite=options.overwrite,
        model=options.hand_model,
        size=windows.size,
        tracked=_tracked_points(clip),
        captions=[_caption(clip, frame) for frame in range(count)],
        most=SHEET_FRAMES,
        id=options.capture_id(out),
        action=options.action,
        device=options.device,
        fps=source.footage.fps,
        times=None if source.footage.times is None else tuple(source.footage.times.tolist()),
        perturbations=dict.fromkeys(options.perturbations),
        source={
            "kind": "video",
            "importer": {"name": "video", "version": IMPORTER_VERSION},
            "video": {
                "name": video.path.name,
                "sha256": sha256_file(video.path),
                "width": video.width,
                "height": video.height,
                "fps": video.fps,
                "codec": video.codec,
                "colours": video.colours,
                **({} if source.reading is None else source.reading.facts()),
            },
            "landmarks": {
                "name": source.landmarks_path.name,
                "sha256": sha256_file(source.landmarks_path),
            },
            "frames": source.indices.tolist(),
            "crop": {"side": windows.side, "corners": windows.corners.tolist()},
            "focal": {"px": clip.focal, "from": "estimate" if options.focal is None else "user"},
            "masks": "graph cut" if source.own_masks is None else "user",
            "fit": facts,
        },
        licence=options.licence,
    )
    if options.sheet is not None:
        write_image(options.sheet, overview)


def _tracked_points(clip: ImportedClip) -> np.ndarray:
    """The tracker's landmarks in the crops, (F, N, 2) px; NaN where a hand is not detected."""
    windows, points = clip.source.windows, []
    for hand in clip.hands.values():
        moved = windows.place(hand.landmarks.image)
        points.append(np.where(hand.landmarks.detected[:, None, None], moved, np.nan))
    return np.concatenate(points, axis=1)


def _caption(clip: ImportedClip, frame: int) -> str:
    """The text of the sheet about a frame."""
    number, reading = f"{clip.source.indices[frame]}", clip.source.reading
    if reading is not None and reading.ends_early and frame == len(clip.source.indices) - 1:
        # At the front: long captions are cut.
        number += f" (video ends early: {reading.counted()})"
    said = f"frame {number}: overlap {clip.masks.overlap[frame]:.2f}"
    for hand in clip.hands.values():
        if not hand.landmarks.detected[frame]:
            said += ", not detected"
            continue
        valid = "" if hand.parameters.valid[frame] else ", not valid"
        said += f", {hand.error.by_frame[frame]:.1f} px{valid}"
    return said
