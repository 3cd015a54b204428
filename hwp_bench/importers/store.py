"""Writing an imported clip as a capture, with its overlay sheet."""

from __future__ import annotations

import json
import os
from typing import TYPE_CHECKING

import numpy as np

from hwp_bench.base.files import sha256_file
from hwp_bench.base.images import write_image
from hwp_bench.base.progress import progress
from hwp_bench.capture import Cameras, CaptureInfo, CaptureWriter, HandModelId
from hwp_bench.importers.options import VideoImport
from hwp_bench.importers.overlay import OverlayFrame, overlay_sheet

if TYPE_CHECKING:
    from hwp_bench.importers.video import ImportedClip

#: Frames on the overlay sheet.
SHEET_FRAMES = 24
#: Name of the sheet among the capture's extra files.
SHEET_NAME = "overlay.png"
#: Name of the report among the capture's extra files.
REPORT_NAME = "import.json"


def store_clip(clip: ImportedClip, out: str | os.PathLike[str], options: VideoImport) -> None:
    """Write the capture, whole or not at all, and the sheet beside it where asked for."""
    import cv2

    source = clip.source
    frames = len(source.indices)
    Ks = source.windows.intrinsics(clip.focal, source.video.width, source.video.height)
    cameras = Cameras(Ks, np.tile(np.eye(4), (frames, 1, 1)))
    picture = draw_sheet(clip)
    with (
        CaptureWriter(
            out,
            capture_info(clip, out, options),
            {options.hand: clip.hand},
            cameras,
            overwrite=options.overwrite,
        ) as writer,
        progress("writing the capture", frames) as update,
    ):
        for frame in range(frames):
            writer.frame(frame, source.pictures.frames[frame])
            writer.mask(frame, clip.masks.coverage[frame])
            update(frame + 1)
        writer.extra(SHEET_NAME, cv2.imencode(".png", picture[:, :, ::-1])[1].tobytes())
        writer.extra(REPORT_NAME, json.dumps(clip.facts(), indent=1) + "\n")
    if options.sheet is not None:
        write_image(options.sheet, picture)


def capture_info(
    clip: ImportedClip, out: str | os.PathLike[str], options: VideoImport
) -> CaptureInfo:
    """Return what the capture says of itself."""
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
    chosen = np.unique(np.linspace(0, count - 1, min(count, SHEET_FRAMES)).round().astype(int))
    frames = []
    for frame in chosen.tolist():
        seen = bool(source.landmarks.detected[frame])
        caption = f"frame {source.indices[frame]}: overlap {clip.masks.overlap[frame]:.2f}"
        caption += f", {clip.error.by_frame[frame]:.1f} px" if seen else ", not detected"
        if seen and not clip.hand.valid[frame]:
            caption += ", not valid"
        tracked = projected.in_crop(source.landmarks.image[frame], frame, size) if seen else None
        frames.append(
            OverlayFrame(
                caption=caption,
                picture=source.pictures.frames[frame],
                mask=clip.masks.coverage[frame],
                vertices=projected.vertices[frame],
                pixels=projected.in_crop(projected.pixels[frame], frame, size),
                fitted=projected.in_crop(projected.landmarks[frame], frame, size),
                tracked=tracked,
            )
        )
    return overlay_sheet(frames, projected.faces)
