"""The pre-pass: judges the frames of a capture before anything is fitted to them.

In order: where the hands are (`hands.footprint`), borders and an intensity model of all frames,
each frame against the model (`measurements`), the frames against each other, the model and the
measurements again with that verdict, and the weights of pixels (`weights`).
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from hwp_bench.base.errors import BadInput
from hwp_bench.hands.anchors import Footprint, HandSurfaces
from wildghand.prepass.assessment import (
    CLEAN_FROM,
    CLEAN_SHARE,
    FrameAssessment,
    PrepassSettings,
    densest,
    enlarged,
    excess,
    neutral_assessment,
    normal_value,
)
from wildghand.prepass.intensity import (
    LOWEST,
    IntensityModel,
    IntensitySamples,
    Verdict,
    fit_intensity,
    log_light_table,
    shading_basis,
)
from wildghand.prepass.measurements import (
    LEAST_PIXELS,
    FrameMeasurements,
    PrepassInput,
    ShownCells,
    border_width,
    inner_pixels,
    measure_frame,
    misplacement,
)
from wildghand.prepass.weights import weigh_pixels

#: Edge of the cells that share one albedo, m on the rest surface: some pixels of a frame each.
PATCH_SIZE = 0.004
#: Pixels of all frames together from which the intensity model is fitted: a tenth of a second.
SAMPLE_COUNT = 120_000
#: Pixels of all frames together beyond which they are judged at a lower resolution, so that the
#: pre-pass stays at some seconds.
PIXEL_BUDGET = 30_000_000
#: Fewer usable frames than this cannot be compared: all are judged clean. Nor do fewer validation
#: frames raise the tolerance.
LEAST_FRAMES = 4
# Least deviations that count as one: log gain that shading leaves unexplained, change of the log of
# the residual, loss of texture, change of the log of the border's width, hidden share of the hand.
# They are what clean frames of simulated captures show, so that a clip without perturbations has
# no outliers.
_GAIN_FLOOR, _RESIDUAL_FLOOR, _TEXTURE_FLOOR = 0.08, 0.25, 0.15
_BORDER_FLOOR, _HIDDEN_FLOOR = 0.15, 0.02
# Deviation from which a cue by itself calls a frame blurred or misplaced.
_CLEAR = 3.0
# Deviation at which a cue starts to count; it grows like a logarithm beyond.
_ONSET = 3.0
# Steepness of the probability.
_EXPONENT = 3


def classify_frames(
    indices: np.ndarray,
    size: tuple[int, int],
    measured: Mapping[int, FrameMeasurements],
    settings: PrepassSettings,
    tolerance: float,
) -> FrameAssessment:
    """Compare the frames with each other and assess them; every pixel has full weight.

    Args:
        indices: (R,) ascending frame numbers.
    """
    count = len(indices)
    rows = np.array(sorted(measured))
    usable = np.zeros(count, dtype=bool)
    usable[rows] = True

    def spread(values: np.ndarray, missing: float = 0.0) -> np.ndarray:
        result = np.full((count, *values.shape[1:]), missing)
        result[rows] = values
        return result

    found = [measured[row] for row in rows.tolist()]
    cues = _compare(found)
    found_evidence = evidence(cues.deviations, indices[rows], settings.tolerance)
    clean = spread(clean_probability(found_evidence, tolerance))
    border, texture = _gathered(found, "border"), _gathered(found, "texture")
    sharp_border = float(np.exp(normal_value(np.log(border), CLEAN_SHARE)[0]))
    extent = np.sqrt(np.maximum(np.nan_to_num(border) ** 2 - sharp_border**2, 0.0))
    clear = _CLEAR
    refine = (cues.misplacement > clear) & (cues.border < clear)
    return FrameAssessment(
        indices=indices,
        usable=usable,
        clean=clean,
        frame_weights=settings.weight_floor + (1.0 - settings.weight_floor) * clean,
        omega_dropout=np.where(clean >= CLEAN_FROM, 1.0, 0.0),
        refine_pose=spread(refine.astype(np.float64)) > 0.5,
        log_gains=spread(cues.gains),
        gain_deviation=spread(cues.gain),
        residual=spread(_gathered(found, "level")),
        residual_deviation=spread(cues.level),
        sharpness=spread(np.nan_to_num(texture, nan=1.0), missing=1.0),
        blur_deviation=spread(np.maximum(cues.border, cues.texture)),
        blur_extent=spread(extent),
        misplacement=spread(_gathered(found, "misplacement")),
        misplacement_deviation=spread(cues.misplacement),
        hidden=spread(_gathered(found, "hidden")),
        hidden_deviation=spread(cues.hidden),
        motion=spread(_gathered(found, "motion")),
        pixel_weights=np.full((count, *size), 255, dtype=np.uint8),
    )


def clip_tolerance(found: np.ndarray, least: float) -> float:
    """Evidence at which a frame of a clip is as likely clean as not.

    Where poses or masks are poor, cues differ from frame to frame though nothing perturbs any. Most
    frames that are known to be clean must be judged so: they raise the least tolerance to the
    median of what is found against them.

    Args:
        found: (K,) evidence of frames of which it is known that nothing perturbs them.
    """
    if len(found) < LEAST_FRAMES:
        return least
    return max(least, float(np.median(found)))


def evidence_against(
    indices: np.ndarray, measured: Sequence[FrameMeasurements], tolerance: float
) -> np.ndarray:
    """Compare R frames with each other; returns what speaks against each, (R,), not negative."""
    return evidence(_compare(measured).deviations, indices, tolerance)


@dataclass(frozen=True, eq=False)
class _Cues:
    """R frames compared with each other: how far each is off, one-sided, in robust deviations."""

    #: (R, 3) log gains, relative to their mode.
    gains: np.ndarray
    #: (R,) each.
    gain: np.ndarray
    level: np.ndarray
    texture: np.ndarray
    border: np.ndarray
    misplacement: np.ndarray
    hidden: np.ndarray

    @property
    def deviations(self) -> tuple[np.ndarray, ...]:
        """All that speaks against a frame, (R,) each."""
        place = (self.misplacement, self.hidden)
        return (self.gain, self.level, self.texture, self.border, *place)


def _gathered(found: Sequence[FrameMeasurements], name: str) -> np.ndarray:
    """A measurement of all frames, (R, ...)."""
    return np.array([getattr(one, name) for one in found], dtype=np.float64)


def _compare(found: Sequence[FrameMeasurements]) -> _Cues:
    share = CLEAN_SHARE
    gains = _gathered(found, "gain")
    gains = gains - densest(gains, share)[0]
    level = np.log(np.maximum(_gathered(found, "level"), 1e-4))
    misplaced, hidden = _gathered(found, "misplacement"), _gathered(found, "hidden")
    return _Cues(
        gains=gains,
        gain=excess(np.linalg.norm(gains, axis=1), share, _GAIN_FLOOR),
        level=excess(level, share, _RESIDUAL_FLOOR),
        texture=excess(-_gathered(found, "texture"), share, _TEXTURE_FLOOR),
        border=excess(np.log(_gathered(found, "border")), share, _BORDER_FLOOR),
        misplacement=excess(misplaced, share, PrepassSettings.misplacement_floor),
        hidden=excess(hidden, share, _HIDDEN_FLOOR),
    )


def evidence(deviations: Sequence[np.ndarray], indices: np.ndarray, tolerance: float) -> np.ndarray:
    """Weigh all cues together, and neighbouring frames with them.

    Each cue adds log(1 + (deviation / 3)^2): a single cue can decide, none outweighs the rest.
    Perturbations last for a while, so that a frame takes half of its evidence from the frames
    before and after, if they are given. A neighbour counts up to `tolerance`: it can decide
    about a doubtful frame, but the last clean frame before an episode stays clean.

    Args:
        deviations: arrays (R,), not negative.
        indices: (R,) ascending frame numbers.

    Returns:
        (R,) not negative.
    """
    own = sum((np.log1p((d / _ONSET) ** 2) for d in deviations), start=np.zeros(len(indices)))
    before, after = own.copy(), own.copy()
    neighbours = np.diff(indices) == 1
    heard = np.minimum(own, tolerance)
    before[1:][neighbours] = heard[:-1][neighbours]
    after[:-1][neighbours] = heard[1:][neighbours]
    return 0.25 * before + 0.5 * own + 0.25 * after


def clean_probability(evidence: np.ndarray, tolerance: float) -> np.ndarray:
    """(R,) in (0, 1]: 1 without evidence, a half at `tolerance`."""
    return 1.0 / (1.0 + (evidence / tolerance) ** _EXPONENT)


def judge_frames(
    given: PrepassInput,
    settings: PrepassSettings | None = None,
    known_clean: PrepassInput | None = None,
) -> FrameAssessment:
    """Judge frames that are already in memory; deterministic.

    Beyond `PIXEL_BUDGET` pixels the frames are judged at a lower resolution; weights and lengths
    are brought back to the full one. Fewer usable frames than `LEAST_FRAMES` cannot be compared:
    all of them are judged clean.
    """
    settings = settings or PrepassSettings()
    excess_pixels = given.masks.size / PIXEL_BUDGET
    if excess_pixels <= 1.0:
        return _judge(given, settings, known_clean)
    factor = math.ceil(math.sqrt(excess_pixels))
    known = None if known_clean is None else known_clean.shrunk(factor)
    return enlarged(_judge(given.shrunk(factor), settings, known), factor, given.size)


def _judge(
    given: PrepassInput, settings: PrepassSettings, known_clean: PrepassInput | None
) -> FrameAssessment:
    surfaces = HandSurfaces(given.templates, PATCH_SIZE)
    usable = _measurable(given)
    drawn = list(_footprints(given, surfaces, usable))
    survey = _survey(given, drawn, len(surfaces.cell_normals))
    usable = survey.readable
    if not usable.any():
        flat = sum(_is_flat(image) for image in given.images)
        raise BadInput(
            f"none of {len(usable)} training frames shows a hand where the parameters place one"
            + (f"; {flat} of them are black or of one colour" if flat else ""),
            remedy="Check the capture with `hwp-bench data show`.",
        )
    if usable.sum() < LEAST_FRAMES:
        return neutral_assessment(given.indices, usable, given.size)
    drawn = [(row, footprint) for row, footprint in drawn if usable[row]]
    cell_normals = surfaces.cell_normals
    model = fit_intensity(survey.samples, cell_normals)
    measured = _measured(given, survey, model, drawn)
    tolerance = settings.tolerance
    if known_clean is not None:
        clean = _measured_alike(known_clean, surfaces, survey, model)
        tolerance = _tolerance(given, measured, known_clean, clean, settings)
    judged = classify_frames(given.indices, given.size, measured, settings, tolerance)
    # Pixels are compared with what clean frames show, which is known only now.
    verdict = Verdict(judged.clean[usable], model.gains)
    model = fit_intensity(survey.samples, cell_normals, verdict)
    measured = _measured(given, survey, model, drawn)
    weights = weigh_pixels(given.masks, measured, judged.clean, model.known)
    return replace(judged, pixel_weights=weights)


@dataclass(frozen=True, eq=False)
class _Survey:
    """The result of a first pass over all frames."""

    samples: IntensitySamples
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
) -> dict[int, FrameMeasurements]:
    """Compare other frames of the clip, by row, with the model, which was made without them."""
    drawn = list(_footprints(known, surfaces, _measurable(known)))
    own = _survey(known, drawn, len(surfaces.cell_normals))
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
    return clip_tolerance(
        evidence_against(indices, found, settings.tolerance)[len(rows) :], settings.tolerance
    )


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
) -> _Survey:
    count = len(given.indices)
    table = log_light_table()
    quota = max(16, SAMPLE_COUNT // max(len(drawn), 1))
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
        samples=IntensitySamples(
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
