"""An imported clip: its inputs and results, the numbers that measure it, and how it is stored."""

from __future__ import annotations

import os
from collections.abc import Mapping
from dataclasses import asdict, dataclass

import numpy as np

from hwp_bench.base.files import sha256_file
from hwp_bench.base.images import write_image
from hwp_bench.capture import Cameras, CaptureInfo, identify_hand_model
from hwp_bench.hands import HandParameters
from hwp_bench.importers.shared.landmarks import Landmarks
from hwp_bench.importers.shared.output import (
    ProjectedHand,
    overlay_sheet,
    sheet_frames,
    write_capture,
)
from hwp_bench.importers.video.masks import ClipMasks, ProjectedClip
from hwp_bench.importers.video.solve import FittedClip, ReprojectionError
from hwp_bench.importers.video.source import (
    BOTH,
    LOW_OVERLAP,
    VideoImport,
    VideoSource,
    fit_warnings,
)

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
    clip: ImportedClip, out: str | os.PathLike[str], options: VideoImport, call: str | None = None
) -> None:
    """Write the capture, whole or not at all, and the separate sheet where one is asked for.

    `call` is the digest of the call that makes it, by which a second one knows that it is complete.
    """
    source = clip.source
    frames = len(source.indices)
    K = np.array(
        [
            [clip.focal, 0, source.video.width / 2],
            [0, clip.focal, source.video.height / 2],
            [0, 0, 1.0],
        ]
    )
    cameras = Cameras(source.windows.intrinsics(K), np.tile(np.eye(4), (frames, 1, 1)))
    drawn = draw_sheet(clip)
    write_capture(
        out,
        capture_info(clip, out, options),
        {side: clip.hands[side].parameters for side in BOTH if side in clip.hands},
        cameras,
        zip(source.images.frames, clip.masks.coverage, strict=True),
        lambda: drawn,
        {**clip.facts(), **({} if call is None else {"call": call})},
        overwrite=options.overwrite,
    )
    if options.sheet is not None:
        write_image(options.sheet, drawn)


def capture_info(
    clip: ImportedClip, out: str | os.PathLike[str], options: VideoImport
) -> CaptureInfo:
    """Return the capture's description."""
    source = clip.source
    video, windows = source.video, source.windows
    return CaptureInfo(
        id=options.capture_id(out),
        hands=clip.shown,
        action=options.action,
        device=options.device,
        fps=video.fps / options.frames.stride,
        width=windows.size,
        height=windows.size,
        frame_count=len(source.indices),
        hand_model=identify_hand_model(options.hand_model, clip.shown),
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
            "focal": {
                "px": clip.focal,
                "from": "estimate" if options.focal is None else "user",
            },
            "masks": "graph cut" if source.own_masks is None else "user",
            "fit": clip.facts(),
        },
        licence=options.licence,
    )


def draw_sheet(clip: ImportedClip) -> np.ndarray:
    """Draw evenly spaced frames with masks, meshes and joints, (H, W, 3) uint8."""
    source, hands = clip.source, list(clip.hands.values())
    count, size = len(source.indices), source.windows.size
    images, masks, tracked, captions = {}, {}, {}, {}
    for frame in sheet_frames(count, SHEET_FRAMES):
        number = f"{source.indices[frame]}"
        if source.reading is not None and source.reading.ends_early and frame == count - 1:
            # At the front: long captions are cut.
            number += f" (video ends early: {source.reading.counted()})"
        captions[frame] = f"frame {number}: overlap {clip.masks.overlap[frame]:.2f}"
        dots = [np.zeros((0, 2))]
        for hand in hands:
            if not hand.landmarks.detected[frame]:
                captions[frame] += ", not detected"
                continue
            valid = "" if hand.parameters.valid[frame] else ", not valid"
            captions[frame] += f", {hand.error.by_frame[frame]:.1f} px{valid}"
            dots.append(hand.projected.in_crop(hand.landmarks.image[frame], frame, size))
        images[frame], masks[frame] = source.images.frames[frame], clip.masks.coverage[frame]
        tracked[frame] = np.concatenate(dots)
    corners, scale = source.windows.corners[:, None], source.windows.scale
    drawn = [
        ProjectedHand(
            hand.projected.vertices,
            (hand.projected.pixels - corners) * scale,
            (hand.projected.landmarks - corners) * scale,
            hand.projected.faces,
            np.ones(count, dtype=bool),
        )
        for hand in hands
    ]
    return overlay_sheet(drawn, images, masks, tracked, captions)
