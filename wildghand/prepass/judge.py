"""The pre-pass: judges the frames of a training capture before anything is fitted to them."""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass, replace

import cv2
import numpy as np

from hwp_bench.base.errors import BadInput, ShapeMismatch
from hwp_bench.capture import Cameras, Capture
from hwp_bench.hands import HandParameters, HandTemplate, load_template
from hwp_bench.methods.contract import TrainingCapture
from wildghand.prepass.conclusion import conclude
from wildghand.prepass.cues import LEAST_PIXELS, explain
from wildghand.prepass.edges import border_width
from wildghand.prepass.footprint import Footprint, HandSurfaces
from wildghand.prepass.intensity import (
    HIGHEST,
    LOWEST,
    Samples,
    fit_intensity,
    log_light_table,
    shading_basis,
)
from wildghand.prepass.judgement import Judgement, enlarged, neutral_judgement
from wildghand.prepass.look import Look
from wildghand.prepass.outlines import ShownCells, interior, misplacement
from wildghand.prepass.settings import PrepassSettings

# Margin inside mask and silhouette that is left out, px.
_MARGIN = 2
# Least cosine between normal and viewing direction of a pixel that is fitted.
_FACING = 0.25


@dataclass(frozen=True, eq=False)
class PrepassInput:
    """All that the pre-pass looks at: R frames and the estimates that come with them."""

    #: (R,) ascending numbers of the frames in `hands` and `cameras`.
    indices: np.ndarray
    #: (R, H, W, 3) uint8 sRGB.
    images: np.ndarray
    #: (R, H, W) uint8, 255 = visible hand.
    masks: np.ndarray
    #: Estimated parameters of every frame, by side.
    hands: Mapping[str, HandParameters]
    #: Cameras of every frame.
    cameras: Cameras
    #: Template of every side.
    templates: Mapping[str, HandTemplate]

    def __post_init__(self) -> None:
        shape = (len(self.indices), *self.images.shape[1:3])
        if self.images.shape != (*shape, 3) or self.masks.shape != shape:
            raise ShapeMismatch(
                f"images {self.images.shape} and masks {self.masks.shape} do not belong to "
                f"{len(self.indices)} frames"
            )

    @property
    def size(self) -> tuple[int, int]:
        """Height and width."""
        return (self.images.shape[1], self.images.shape[2])

    def shrunk(self, factor: int) -> PrepassInput:
        """The same at `1 / factor` of the resolution, sizes rounded down."""
        height, width = (edge // factor for edge in self.size)
        scale = np.array([[width / self.size[1]], [height / self.size[0]], [1.0]])

        def small(pictures: np.ndarray) -> np.ndarray:
            return np.stack(
                [cv2.resize(p, (width, height), interpolation=cv2.INTER_AREA) for p in pictures]
            )

        return replace(
            self,
            images=small(self.images),
            masks=small(self.masks),
            cameras=Cameras(self.cameras.Ks * scale, self.cameras.viewmats),
        )


def capture_input(
    capture: Capture, indices: np.ndarray, frames: Iterable[int] | None = None
) -> PrepassInput:
    """Read frames of a capture; its truth is not looked at.

    Args:
        capture: the capture.
        indices: (R,) ascending, which frames.
        frames: the same numbers, where reading them is to be watched.

    Raises:
        BadImage: an image is missing or damaged.
    """
    numbers = indices.tolist() if frames is None else frames
    images, masks = zip(*((capture.frame(k), capture.mask(k)) for k in numbers), strict=True)
    source = capture.info.hand_model.source
    return PrepassInput(
        indices=indices,
        images=np.stack(images),
        masks=np.stack(masks),
        hands=capture.hands,
        cameras=capture.cameras,
        templates={side: load_template(source, side) for side in capture.info.sides},
    )


def judge_capture(training: TrainingCapture, settings: PrepassSettings | None = None) -> Judgement:
    """Read and judge all training frames of a request.

    Raises:
        BadImage: an image is missing or damaged.
        BadInput: the capture has no training frame, or none can be used.
    """
    indices = training.train
    if not len(indices):
        raise BadInput("has no training frame", where=training.root)
    return judge_frames(
        PrepassInput(
            indices=indices,
            images=np.stack([training.frame(frame) for frame in indices.tolist()]),
            masks=np.stack([training.mask(frame) for frame in indices.tolist()]),
            hands=training.hands,
            cameras=training.cameras,
            templates={side: training.template(side) for side in training.sides},
        ),
        settings,
    )


def judge_frames(given: PrepassInput, settings: PrepassSettings | None = None) -> Judgement:
    """Judge frames that are already in memory; deterministic.

    Beyond `settings.pixel_budget` pixels the frames are judged at a lower resolution, and
    weights and lengths are brought back to theirs.
    Fewer usable frames than `settings.least_frames` cannot be compared: all of them are judged
    clean.

    Raises:
        BadInput: no frame can be used: no hand is valid, in the picture and in the mask.
    """
    settings = settings or PrepassSettings()
    excess_pixels = given.masks.size / settings.pixel_budget
    if excess_pixels <= 1.0:
        return _judge(given, settings)
    factor = math.ceil(math.sqrt(excess_pixels))
    return enlarged(_judge(given.shrunk(factor), settings), factor, given.size)


def _judge(given: PrepassInput, settings: PrepassSettings) -> Judgement:
    surfaces = HandSurfaces(given.templates, settings.patch_size)
    usable = _measurable(given)
    survey = _survey(given, surfaces, usable, settings)
    usable = survey.readable
    if not usable.any():
        raise BadInput(
            f"none of {len(usable)} training frames shows a hand where the parameters place one",
            remedy="Check the capture with `hwp-bench data show`.",
        )
    if usable.sum() < settings.least_frames:
        return neutral_judgement(given.indices, usable, given.size, settings.omega_dropout)
    model = fit_intensity(survey.samples, surfaces.cell_normals, settings)
    looks = {}
    table = log_light_table()
    for row, footprint in _footprints(given, surfaces, usable):
        values = given.images[row].reshape(-1, 3)[footprint.pixels]
        masked = given.masks[row] > 127
        inner = _inner(footprint, masked, values)
        beyond = np.flatnonzero((given.masks[row] > 0) & ~footprint.silhouette)
        outer = table[given.images[row].reshape(-1, 3)[beyond]]
        looks[row] = Look(
            explained=explain(model, footprint, table[values], inner, outer),
            pixels=footprint.pixels,
            beyond=beyond.astype(np.int32),
            cells=footprint.cells,
            hidden=survey.shown.hidden_share(footprint.cells, masked.reshape(-1)[footprint.pixels]),
            misplacement=float(survey.misplacement[row]),
            border=float(survey.border[row]),
            motion=float(survey.motion[row]),
        )
    return conclude(given.indices, given.masks, looks, len(surfaces.cell_normals), settings)


@dataclass(frozen=True, eq=False)
class _Survey:
    """What the first look at all frames gives."""

    samples: Samples
    shown: ShownCells
    #: (R,) bool: the hands are in the picture, where the mask has them, and can be read.
    readable: np.ndarray
    #: (R,) `misplacement` and `border_width`; not a number in frames that are not readable.
    misplacement: np.ndarray
    border: np.ndarray
    #: (R,) px.
    motion: np.ndarray


def _measurable(given: PrepassInput) -> np.ndarray:
    """(R,) bool: valid parameters, a mask, and a picture that is not black or one colour."""
    valid = np.all([hand.valid[given.indices] for hand in given.hands.values()], axis=0)
    for row in np.flatnonzero(valid):
        shown = given.images[row][given.masks[row] > 127]
        valid[row] = (
            len(shown) >= LEAST_PIXELS
            and np.count_nonzero(shown.max(axis=1) >= LOWEST) >= LEAST_PIXELS
            and int(given.images[row].max()) > int(given.images[row].min())
        )
    return valid


def _footprints(
    given: PrepassInput, surfaces: HandSurfaces, usable: np.ndarray
) -> Iterator[tuple[int, Footprint]]:
    rows = np.flatnonzero(usable)
    drawn = surfaces.footprints(
        given.hands, given.cameras.Ks, given.cameras.viewmats, given.indices[rows], given.size
    )
    return zip(rows.tolist(), drawn, strict=True)


def _inner(footprint: Footprint, masked: np.ndarray, values: np.ndarray) -> np.ndarray:
    """(P,) bool: pixels that should show skin in a known place, and can be read."""
    inside = interior(footprint.silhouette, _MARGIN) & interior(masked, _MARGIN)
    return (
        inside.reshape(-1)[footprint.pixels]
        & (footprint.facing > _FACING)
        & ((values >= LOWEST) & (values <= HIGHEST)).all(axis=1)
    )


def _survey(
    given: PrepassInput, surfaces: HandSurfaces, usable: np.ndarray, settings: PrepassSettings
) -> _Survey:
    count = len(given.indices)
    table = log_light_table()
    quota = max(16, settings.sample_count // max(int(usable.sum()), 1))
    shown = ShownCells(len(surfaces.cell_normals))
    off, border = np.full(count, np.nan), np.full(count, np.nan)
    motion, sizes = np.zeros(count), np.zeros(count, dtype=np.int64)
    cells, light, normals = [], [], []
    for row, footprint in _footprints(given, surfaces, usable):
        motion[row] = footprint.motion
        masked = given.masks[row] > 127
        values = given.images[row].reshape(-1, 3)[footprint.pixels]
        chosen = np.flatnonzero(_inner(footprint, masked, values))
        if len(chosen) < LEAST_PIXELS:
            continue
        shown.add(footprint.cells, masked.reshape(-1)[footprint.pixels])
        off[row] = misplacement(masked, footprint.silhouette)
        border[row] = border_width(given.images[row], masked)
        if len(chosen) > quota:
            chosen = chosen[np.linspace(0, len(chosen) - 1, quota).astype(np.int64)]
        sizes[row] = len(chosen)
        cells.append(footprint.cells[chosen].astype(np.int64))
        light.append(table[values[chosen]])
        normals.append(footprint.normals[chosen])
    return _Survey(
        samples=Samples(
            starts=np.concatenate([[0], np.cumsum(sizes[sizes > 0])]),
            cells=np.concatenate([np.empty(0, dtype=np.int64), *cells]),
            light=np.concatenate([np.empty((0, 3), dtype=np.float32), *light]),
            basis=shading_basis(np.concatenate([np.empty((0, 3), dtype=np.float32), *normals])),
        ),
        shown=shown,
        readable=sizes > 0,
        misplacement=off,
        border=border,
        motion=motion,
    )
