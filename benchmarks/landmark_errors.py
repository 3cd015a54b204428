"""How a tracker's landmarks err on a real clip: their distances from the importer's fit."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch

from hwp_bench.importers.video import VideoImport
from hwp_bench.importers.video.api import fit_video, read_source
from hwp_bench.sim.produce.estimates import curl, edge_on

#: Share of the frames with the smallest errors that says how large errors are in easy frames.
EASY = 0.05


@dataclass(frozen=True, eq=False)
class RealClip:
    """A real clip and the importer's fit to it."""

    #: (F, 21, 2) px and (F, 21, 3) m of the tracker.
    image: np.ndarray
    world: np.ndarray
    #: (F, 21, 2) px and (F, 21, 3) m, camera axes, of the fit, with the tracker's offsets.
    fitted_image: np.ndarray
    fitted: np.ndarray
    #: (F, 16, 3) axis-angle rad of the fit.
    pose: np.ndarray


@dataclass(frozen=True, eq=False)
class LandmarkErrors:
    """How a tracker's landmarks err."""

    #: (F, 21, 2) shares of the hand's extent and (F, 21, 3) m, less the mean of the clip.
    image: np.ndarray
    world: np.ndarray
    #: Size of the errors against the clip's mean: at rest, per curl, per edge-on view.
    growth: tuple[float, float, float]
    #: (F,) of each frame.
    grown: np.ndarray
    #: Correlation of two frames that follow each other, of the errors over their growth: the
    #: median of all numbers.
    memory: float


def real_clip(video: Path, landmarks: Path, keep: Path) -> RealClip:
    """Fit the hand of a real clip; the fit is kept in a folder and read from there."""
    file = keep / "real.npz"
    if not file.exists():
        options = VideoImport(side="right")
        clip = fit_video(read_source(video, landmarks, options), options)
        model, source = clip.first.fitted.model, clip.source.landmarks
        with torch.no_grad():
            posed = model.pose()
            pixels = model.pixels(posed.landmarks).numpy()
        arrays = (
            source.image,
            source.world,
            pixels,
            posed.landmarks.numpy(),
            clip.first.parameters.pose,
        )
        np.savez(file, *[np.asarray(array, dtype=np.float64) for array in arrays])
    return kept_clip(keep)


def kept_clip(keep: Path) -> RealClip:
    """Read the fit that `real_clip` left in a folder."""
    file = keep / "real.npz"
    if not file.exists():
        raise SystemExit(f"{file} is missing: run benchmarks.tracker_errors with --keep {keep}")
    with np.load(file) as stored:
        return RealClip(*(stored[f"arr_{index}"] for index in range(5)))


def landmark_errors(clip: RealClip) -> LandmarkErrors:
    """Distances of a clip's landmarks from its fit."""
    boxes = clip.image.max(axis=1) - clip.image.min(axis=1)
    extent = float(np.median(boxes.max(axis=1)))
    image = (clip.image - clip.fitted_image) / extent
    fitted = clip.fitted - clip.fitted.mean(axis=1, keepdims=True)
    tracked = clip.world - clip.world.mean(axis=1, keepdims=True)
    # The tracker's metres have a scale of their own.
    world = tracked * float((fitted * tracked).sum() / np.square(tracked).sum()) - fitted
    image, world = image - image.mean(axis=0), world - world.mean(axis=0)
    size = np.sqrt(np.square(image).sum(axis=2).mean(axis=1))
    hard = np.stack([curl(clip.pose), edge_on(clip.fitted)], axis=1)
    from scipy.optimize import nnls

    still = float(np.quantile(size, EASY))
    more = nnls(hard, size - still)[0]
    grown = still + hard @ more
    mean = float(grown.mean())
    both = np.concatenate([image.reshape(-1, 42), world.reshape(-1, 63)], axis=1)
    normal = both / grown[:, None]
    memory = (normal[1:] * normal[:-1]).sum(axis=0) / np.square(normal).sum(axis=0)
    growth = (still / mean, float(more[0]) / mean, float(more[1]) / mean)
    return LandmarkErrors(image, world, growth, grown / mean, float(np.median(memory)))
