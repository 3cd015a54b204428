"""An imported clip: its inputs and results, the numbers that measure it, and how it is stored."""

from __future__ import annotations

import os
from dataclasses import asdict, dataclass
from pathlib import Path

import numpy as np

from hwp_bench.base.files import sha256_file
from hwp_bench.base.images import write_image
from hwp_bench.capture import Cameras, CaptureInfo, HandModelId
from hwp_bench.hands import HandParameters
from hwp_bench.importers.shared.landmarks import Landmarks
from hwp_bench.importers.shared.overlay import OverlayFrame, overlay_sheet, sheet_frames
from hwp_bench.importers.shared.windows import CropWindows
from hwp_bench.importers.shared.writing import write_capture
from hwp_bench.importers.video.clip_masks import ClipMasks, ProjectedClip
from hwp_bench.importers.video.decode import ClipImages, VideoInfo
from hwp_bench.importers.video.fit_clip import FittedClip, ReprojectionError
from hwp_bench.importers.video.video_settings import VideoImport

#: Version of the fit and the masks. It is raised when they come out otherwise for the same input,
#: because scores on captures of two versions do not compare.
IMPORTER_VERSION = 2
#: Frames on the overlay sheet.
SHEET_FRAMES = 24


@dataclass(frozen=True, eq=False)
class VideoSource:
    """The inputs of an import.

    Attributes:
        video: the probed video.
        landmarks_path: the tracker's file.
        indices: (F,) frame numbers in the video.
        landmarks: of those frames.
        windows: where the hand is.
        images: the frames.
        own_masks: (F, S, S) uint8 or None.
    """

    video: VideoInfo
    landmarks_path: Path
    indices: np.ndarray
    landmarks: Landmarks
    windows: CropWindows
    images: ClipImages
    own_masks: np.ndarray | None


@dataclass(frozen=True, eq=False)
class ImportedClip:
    """The results of an import.

    Attributes:
        source: the inputs.
        hand: parameters of the hand.
        fitted: the fit.
        projected: the fit in the images.
        masks: final masks.
        error: reprojection error of the final fit.
        error_landmarks_only: the same before the outline was fitted.
        overlap_landmarks_only: mean overlap of mesh and mask before the outline was fitted.
    """

    source: VideoSource
    hand: HandParameters
    fitted: FittedClip
    projected: ProjectedClip
    masks: ClipMasks
    error: ReprojectionError
    error_landmarks_only: ReprojectionError
    overlap_landmarks_only: float

    @property
    def focal(self) -> float:
        """Focal length, px of the whole frame."""
        return float(self.fitted.model.focal.detach())

    def facts(self) -> dict[str, object]:
        """Return the numbers that measure the import, as JSON."""
        seen = self.source.landmarks.detected
        overlaps = self.masks.overlap[seen]

        def pixels(error: ReprojectionError) -> dict[str, object]:
            values = {key: value for key, value in asdict(error).items() if key != "by_frame"}
            return {k: round(v, 3) if isinstance(v, float) else v for k, v in values.items()}

        return {
            "frames": len(seen),
            "frames_detected": int(seen.sum()),
            "frames_valid": int(self.hand.valid.sum()),
            "reprojection_px": pixels(self.error),
            "reprojection_px_landmarks_only": pixels(self.error_landmarks_only),
            "overlap": round(float(overlaps.mean()), 4),
            "overlap_percentile_5": round(float(np.percentile(overlaps, 5)), 4),
            "overlap_landmarks_only": round(self.overlap_landmarks_only, 4),
            "focal_px": round(self.focal, 2),
            "depth_m": [
                round(float(z), 3) for z in np.percentile(self.hand.transl[:, 2], (0, 100))
            ],
            "world_scale": round(float(self.fitted.model.variables.log_size.detach().exp()), 4),
        }


def store_clip(clip: ImportedClip, out: str | os.PathLike[str], options: VideoImport) -> None:
    """Write the capture, whole or not at all, and the separate sheet where one is asked for."""
    source = clip.source
    frames = len(source.indices)
    Ks = source.windows.intrinsics(clip.focal, source.video.width, source.video.height)
    cameras = Cameras(Ks, np.tile(np.eye(4), (frames, 1, 1)))
    drawn = draw_sheet(clip)
    write_capture(
        out,
        capture_info(clip, out, options),
        {options.hand: clip.hand},
        cameras,
        zip(source.images.frames, clip.masks.coverage, strict=True),
        lambda: drawn,
        clip.facts(),
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
    template = clip.fitted.model.template
    return CaptureInfo(
        id=options.capture_id(out),
        hands=options.hand,
        action=options.action,
        device=options.device,
        fps=video.fps / options.frames.stride,
        width=windows.size,
        height=windows.size,
        frame_count=len(source.indices),
        hand_model=HandModelId(template.name, template.digest, options.hand_model),
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
    """Draw evenly spaced frames with masks, mesh and joints, (H, W, 3) uint8."""
    source, projected = clip.source, clip.projected
    count = len(source.indices)
    size = source.windows.size
    frames = []
    for frame in sheet_frames(count, SHEET_FRAMES):
        seen = bool(source.landmarks.detected[frame])
        caption = f"frame {source.indices[frame]}: overlap {clip.masks.overlap[frame]:.2f}"
        caption += f", {clip.error.by_frame[frame]:.1f} px" if seen else ", not detected"
        if seen and not clip.hand.valid[frame]:
            caption += ", not valid"
        tracked = projected.in_crop(source.landmarks.image[frame], frame, size) if seen else None
        frames.append(
            OverlayFrame(
                caption=caption,
                image=source.images.frames[frame],
                mask=clip.masks.coverage[frame],
                vertices=projected.vertices[frame],
                pixels=projected.in_crop(projected.pixels[frame], frame, size),
                fitted=projected.in_crop(projected.landmarks[frame], frame, size),
                tracked=tracked,
            )
        )
    return overlay_sheet(frames, projected.faces)
