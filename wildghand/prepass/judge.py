"""The pre-pass: judges the frames of a capture before anything is fitted to them.

The pipeline in order: `inputs` -> `footprint` (where the hands are) -> `borders` and `intensity`
(a model of all frames) -> `measurements` (each frame against it) -> `classify` (the frames against
each other, with `robust_location`) -> `intensity` and `measurements` again, with the verdict ->
`weights` (pixels) -> `assessment` (the result).
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np

from hwp_bench.base.errors import BadInput
from hwp_bench.hands.anchors import Footprint, HandSurfaces
from wildghand.prepass.assessment import FrameAssessment, enlarged, neutral_assessment
from wildghand.prepass.borders import ShownCells, border_width, misplacement
from wildghand.prepass.classify import classify_frames, clip_tolerance, evidence_against
from wildghand.prepass.inputs import PrepassInput
from wildghand.prepass.intensity import (
    LOWEST,
    IntensityModel,
    LightSamples,
    Verdict,
    fit_intensity,
    log_light_table,
    shading_basis,
)
from wildghand.prepass.measurements import (
    LEAST_PIXELS,
    FrameMeasurements,
    inner_pixels,
    measure_frame,
)
from wildghand.prepass.settings import PrepassSettings
from wildghand.prepass.weights import weigh_pixels


def judge_frames(
    given: PrepassInput,
    settings: PrepassSettings | None = None,
    known_clean: PrepassInput | None = None,
) -> FrameAssessment:
    """Judge frames that are already in memory; deterministic.

    Beyond `settings.pixel_budget` pixels the frames are judged at a lower resolution; weights
    and lengths are brought back to the full one. Fewer usable frames than
    `settings.least_frames` cannot be compared: all of them are judged clean.

    Args:
        given: the frames.
        settings: how.
        known_clean: other frames of the clip, of which it is known that nothing perturbs them.
            They say how much evidence a clean frame has here (`classify.clip_tolerance`).

    Raises:
        BadInput: no frame can be used: no hand is valid and lies in the image and in the mask.
    """
    settings = settings or PrepassSettings()
    excess_pixels = given.masks.size / settings.pixel_budget
    if excess_pixels <= 1.0:
        return _judge(given, settings, known_clean)
    factor = math.ceil(math.sqrt(excess_pixels))
    known = None if known_clean is None else known_clean.shrunk(factor)
    return enlarged(_judge(given.shrunk(factor), settings, known), factor, given.size)


def _judge(
    given: PrepassInput, settings: PrepassSettings, known_clean: PrepassInput | None
) -> FrameAssessment:
    surfaces = HandSurfaces(given.templates, settings.patch_size)
    usable = _measurable(given)
    drawn = list(_footprints(given, surfaces, usable))
    survey = _survey(given, drawn, len(surfaces.cell_normals), settings)
    usable = survey.readable
    if not usable.any():
        flat = sum(_is_flat(image) for image in given.images)
        raise BadInput(
            f"none of {len(usable)} training frames shows a hand where the parameters place one"
            + (f"; {flat} of them are black or of one colour" if flat else ""),
            remedy="Check the capture with `hwp-bench data show`.",
        )
    if usable.sum() < settings.least_frames:
        return neutral_assessment(given.indices, usable, given.size, settings.omega_dropout)
    drawn = [(row, footprint) for row, footprint in drawn if usable[row]]
    cell_normals = surfaces.cell_normals
    model = fit_intensity(survey.samples, cell_normals, settings)
    measured = _measured(given, survey, model, drawn)
    tolerance = settings.tolerance
    if known_clean is not None:
        clean = _measured_alike(known_clean, surfaces, survey, model, settings)
        tolerance = _tolerance(given, measured, known_clean, clean, settings)
    judged = classify_frames(given.indices, given.size, measured, settings, tolerance)
    # Pixels are compared with what clean frames show, which is known only now.
    verdict = Verdict(judged.clean[usable], model.gains)
    model = fit_intensity(survey.samples, cell_normals, settings, verdict)
    measured = _measured(given, survey, model, drawn)
    weights = weigh_pixels(given.masks, measured, judged.clean, model.known, settings)
    return replace(judged, pixel_weights=weights)


@dataclass(frozen=True, eq=False)
class _Survey:
    """The result of a first pass over all frames."""

    samples: LightSamples
    shown: ShownCells
    #: (R,) bool: the hands are in the image, where the mask has them, and can be read.
    readable: np.ndarray
    #: (R,) `misplacement` and `border_width`; NaN in frames that are not readable.
    misplacement: np.ndarray
    border: np.ndarray
    #: (R,) px.
    motion: np.ndarray


def _measured(
    given: PrepassInput,
    survey: _Survey,
    model: IntensityModel,
    drawn: Sequence[tuple[int, Footprint]],
) -> dict[int, FrameMeasurements]:
    """Compare each of the drawn frames, by row, with the model."""
    return {
        row: measure_frame(
            model,
            footprint,
            given.images[row],
            given.masks[row],
            shown=survey.shown,
            misplacement=float(survey.misplacement[row]),
            border=float(survey.border[row]),
            motion=float(survey.motion[row]),
        )
        for row, footprint in drawn
    }


def _measured_alike(
    known: PrepassInput,
    surfaces: HandSurfaces,
    survey: _Survey,
    model: IntensityModel,
    settings: PrepassSettings,
) -> dict[int, FrameMeasurements]:
    """Compare other frames of the clip, by row, with the model, which was made without them."""
    drawn = list(_footprints(known, surfaces, _measurable(known)))
    own = _survey(known, drawn, len(surfaces.cell_normals), settings)
    readable = [(row, footprint) for row, footprint in drawn if own.readable[row]]
    return _measured(known, replace(own, shown=survey.shown), model, readable)


def _tolerance(
    given: PrepassInput,
    measured: dict[int, FrameMeasurements],
    known_clean: PrepassInput,
    clean: dict[int, FrameMeasurements],
    settings: PrepassSettings,
) -> float:
    """The tolerance of the clip, from measurements of its frames and of those that are clean."""
    rows, known = sorted(measured), sorted(clean)
    indices = np.concatenate([given.indices[rows], known_clean.indices[known]])
    found = [measured[row] for row in rows] + [clean[row] for row in known]
    return clip_tolerance(evidence_against(indices, found, settings)[len(rows) :], settings)


def _measurable(given: PrepassInput) -> np.ndarray:
    """(R,) bool: valid parameters, a mask, and an image that is not black or of one colour."""
    valid = np.all([hand.valid[given.indices] for hand in given.hands.values()], axis=0)
    for row in np.flatnonzero(valid):
        shown = given.images[row][given.masks[row] > 127]
        valid[row] = (
            len(shown) >= LEAST_PIXELS
            and np.count_nonzero(shown.max(axis=1) >= LOWEST) >= LEAST_PIXELS
            and not _is_flat(given.images[row])
        )
    return valid


def _is_flat(image: np.ndarray) -> bool:
    """Whether an image is black or has one colour: no edge, so nothing tells hand from wall."""
    pixels = image.reshape(-1, 3)
    return int(pixels.max()) < LOWEST or bool((pixels == pixels[0]).all())


def _footprints(
    given: PrepassInput, surfaces: HandSurfaces, usable: np.ndarray
) -> Iterator[tuple[int, Footprint]]:
    rows = np.flatnonzero(usable)
    drawn = surfaces.footprints(
        given.hands, given.cameras.Ks, given.cameras.viewmats, given.indices[rows], given.size
    )
    return zip(rows.tolist(), drawn, strict=True)


def _survey(
    given: PrepassInput,
    drawn: Sequence[tuple[int, Footprint]],
    cell_count: int,
    settings: PrepassSettings,
) -> _Survey:
    count = len(given.indices)
    table = log_light_table()
    quota = max(16, settings.sample_count // max(len(drawn), 1))
    shown = ShownCells(cell_count)
    off, border = np.full(count, np.nan), np.full(count, np.nan)
    motion, sizes = np.zeros(count), np.zeros(count, dtype=np.int64)
    cells, light, normals = [], [], []
    for row, footprint in drawn:
        motion[row] = footprint.motion
        masked = given.masks[row] > 127
        values = given.images[row].reshape(-1, 3)[footprint.pixels]
        chosen = np.flatnonzero(inner_pixels(footprint, masked, values))
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
        samples=LightSamples(
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
