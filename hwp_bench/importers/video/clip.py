"""An imported clip: its inputs and results, the numbers that measure it, and how it is stored."""

from __future__ import annotations

import os
from collections.abc import Mapping
from dataclasses import asdict, dataclass

import numpy as np

from hwp_bench.base.files import sha256_file
from hwp_bench.base.images import write_image
from hwp_bench.capture import Cameras
from hwp_bench.hands import HandParameters
from hwp_bench.hands.skeleton import SIDES
from hwp_bench.importers.shared.landmarks import Landmarks
from hwp_bench.importers.shared.output import write_capture
from hwp_bench.importers.video.masks import ClipMasks, ProjectedClip
from hwp_bench.importers.video.solve import FittedClip, ReprojectionError
from hwp_bench.importers.video.source import LOW_OVERLAP, VideoImport, VideoSource, fit_warnings

#: Version of the fit and the masks. It is raised when they come out otherwise for the same input,
#: because scores on captures of two versions do not compare.
IMPORTER_VERSION = 3
#: Frames on the overlay sheet.
SHEET_FRAMES = 24


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
        fitted = {side: hand.parameters.valid for side, hand in self.hands.items()}
        seen = {side: hand.landmarks.detected for side, hand in self.hands.items()}
        said = [*self.doubts, *fit_warnings(fitted, seen)]
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
        repaired = {"swaps_repaired": self.source.swaps, "doubles_left_out": self.source.doubles}
        return {**common, **repaired, "hands": each}


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
        fps=video.fps / options.frames.stride,
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
    """What the sheet says of a frame."""
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
