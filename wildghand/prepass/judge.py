"""The pre-pass: judges the frames of a capture before anything is fitted to them.

In order: where the hands are (`hands.footprint`), borders and an intensity model of all frames,
each frame against the model (`measurements`), the frames against each other, the model and the
measurements again with that verdict, and the weights of pixels (`weights`).
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from types import MappingProxyType

import numpy as np
import torch

from hwp_bench.base.errors import BadInput
from hwp_bench.hands.anchors import HandSurfaces
from wildghand.prepass.assessment import (
    CLEAN_FROM,
    CLEAN_SHARE,
    LEAST_CLEAN,
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
    DrawnFrame,
    FrameMeasurements,
    PrepassInput,
    measure_frame,
    shown_cells,
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
_GAIN_FLOOR = 0.08
_FLOORS: Mapping[str, float] = MappingProxyType(
    {
        "level": 0.25,
        "texture": 0.15,
        "border": 0.15,
        "misplacement": PrepassSettings.misplacement_floor,
        "hidden": 0.02,
    }
)
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
    known: Sequence[FrameMeasurements] = (),
) -> FrameAssessment:
    """Compare (R,) frames of ascending numbers and assess them; every pixel has full weight.

    They are compared with each other, unless few are clean: then with frames that are `known` to be
    so, and weights are relative. The best `CLEAN_SHARE` of the frames counts as clean ones do
    elsewhere, so that a clip without a clean frame is learnt from the least perturbed ones.
    """
    count = len(indices)
    rows = np.array(sorted(measured))
    usable = np.zeros(count, dtype=bool)
    usable[rows] = True

    def spread(values: np.ndarray) -> np.ndarray:
        result = np.zeros((count, *values.shape[1:]))
        result[rows] = values
        return result

    found = [measured[row] for row in rows.tolist()]
    gains, off = _compare_with(found, known) if known else _compare(found)
    against = evidence([*off.values()], indices[rows], settings.tolerance)
    clean = spread(clean_probability(against, tolerance))
    best = clean
    if known:
        least = max(tolerance, float(np.quantile(against, CLEAN_SHARE)))
        best = spread(clean_probability(against, least))
    certain = clean if (clean >= CLEAN_FROM).sum() >= LEAST_CLEAN else best
    border = _gathered(found, "border")
    sharp_border = float(np.exp(normal_value(np.log(border), CLEAN_SHARE)[0]))
    extent = np.sqrt(np.maximum(np.nan_to_num(border) ** 2 - sharp_border**2, 0.0))
    refine = (off["misplacement"] > _CLEAR) & (off["border"] < _CLEAR)
    return FrameAssessment(
        indices=indices,
        usable=usable,
        clean=clean,
        frame_weights=settings.weight_floor + (1.0 - settings.weight_floor) * best,
        omega_dropout=np.where(certain >= CLEAN_FROM, 1.0, 0.0),
        clean_share=float((clean >= CLEAN_FROM).mean()),
        refine_pose=spread(refine.astype(np.float64)) > 0.5,
        log_gains=spread(gains),
        gain_deviation=spread(off["gain"]),
        residual=spread(_gathered(found, "level")),
        blur_deviation=spread(np.maximum(off["border"], off["texture"])),
        blur_extent=spread(extent),
        misplacement=spread(_gathered(found, "misplacement")),
        misplacement_deviation=spread(off["misplacement"]),
        hidden=spread(_gathered(found, "hidden")),
        hidden_deviation=spread(off["hidden"]),
        motion=spread(_gathered(found, "motion")),
        pixel_weights=np.full((count, *size), 255, dtype=np.uint8),
    )


def clean_share(
    found: Sequence[FrameMeasurements],
    known: Sequence[FrameMeasurements],
    indices: np.ndarray,
    tolerance: float,
) -> float:
    """Share of frames that are like those which are known to be clean; 1 if these are too few.

    Args:
        indices: (R,) ascending numbers of the frames.
        tolerance: evidence at which a frame is as likely clean as not.
    """
    if len(known) < LEAST_FRAMES:
        return 1.0
    off = _compare_with(found, known)[1]
    return float((evidence([*off.values()], indices, tolerance) < tolerance).mean())


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


def _gathered(found: Sequence[FrameMeasurements], name: str) -> np.ndarray:
    """A measurement of all frames, (R, ...)."""
    return np.array([getattr(one, name) for one in found], dtype=np.float64)


def _compare(found: Sequence[FrameMeasurements]) -> tuple[np.ndarray, dict[str, np.ndarray]]:
    """Compare R frames with each other.

    Returns:
        (R, 3) log gains, relative to their mode, and by cue how far each frame is off, (R,),
        one-sided, in robust deviations.
    """
    gains = _gathered(found, "gain")
    gains = gains - densest(gains, CLEAN_SHARE)[0]
    off = {"gain": excess(np.linalg.norm(gains, axis=1), CLEAN_SHARE, _GAIN_FLOOR)}
    for (name, floor), values in zip(_FLOORS.items(), _cues(found), strict=True):
        off[name] = excess(values, CLEAN_SHARE, floor)
    return gains, off


def _cues(found: Sequence[FrameMeasurements]) -> list[np.ndarray]:
    """The cues of `_FLOORS`, (R,) each, the larger the worse."""
    return [
        np.log(np.maximum(_gathered(found, "level"), 1e-4)),
        -_gathered(found, "texture"),
        np.log(_gathered(found, "border")),
        _gathered(found, "misplacement"),
        _gathered(found, "hidden"),
    ]


def _compare_with(
    found: Sequence[FrameMeasurements], known: Sequence[FrameMeasurements]
) -> tuple[np.ndarray, dict[str, np.ndarray]]:
    """Compare R frames with frames that are known to be clean.

    The deviation of a frame is the distance of a cue beyond those of all known frames, in units of
    the smallest deviation that counts: a few frames do not show how widely clean ones spread.

    Returns:
        What `_compare` returns; gains are relative to the median of the known frames'.
    """
    gains, clean = _gathered(found, "gain"), _gathered(known, "gain")
    apart = np.linalg.norm(gains[:, None] - clean[None], axis=2).min(axis=1)
    off = {"gain": apart / _GAIN_FLOOR}
    for name, values, ordinary in zip(_FLOORS, _cues(found), _cues(known), strict=True):
        highest = np.max(ordinary, where=np.isfinite(ordinary), initial=-np.inf)
        beyond = np.maximum(values - highest, 0.0) / _FLOORS[name]
        off[name] = np.where(np.isfinite(beyond), beyond, 0.0)
    return gains - np.median(clean, axis=0), off


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
    cell_normals = surfaces.cell_normals
    drawn = _draw(given, surfaces)
    frames = _readable(drawn)
    if not frames:
        flat = sum(_is_flat(image) for image in given.images)
        raise BadInput(
            f"none of {len(given.indices)} training frames shows a hand where the parameters place "
            "one" + (f"; {flat} of them are black or of one colour" if flat else ""),
            remedy="Check the capture with `hwp-bench data show`.",
        )
    usable = np.isin(np.arange(len(given.indices)), list(frames))
    if len(frames) < LEAST_FRAMES:
        return neutral_assessment(given.indices, usable, given.size)
    quota = max(16, SAMPLE_COUNT // len(drawn))
    samples = _intensity_samples([*frames.values()], quota)
    shown = shown_cells(frames.values(), len(cell_normals))
    model = fit_intensity(samples, cell_normals)
    measured = _measure(model, frames, shown)
    tolerance, compared = settings.tolerance, list[FrameMeasurements]()
    if known_clean is not None:
        known = _readable(_draw(known_clean, surfaces))
        found = [*_measure(model, known, shown).values()]
        if clean_share([*measured.values()], found, given.indices[usable], tolerance) < CLEAN_SHARE:
            compared = found
        else:
            indices = np.concatenate([given.indices[usable], known_clean.indices[[*known]]])
            off = _compare([*measured.values(), *found])[1]
            against = evidence([*off.values()], indices, tolerance)
            tolerance = clip_tolerance(against[len(measured) :], tolerance)
    judged = classify_frames(given.indices, given.size, measured, settings, tolerance, compared)
    # Pixels are compared with what clean frames show, which is known only now.
    verdict = Verdict(judged.clean[usable], model.gains)
    model = fit_intensity(samples, cell_normals, verdict)
    measured = _measure(model, frames, shown)
    weights = weigh_pixels(given.masks, measured, judged.clean, model.known)
    return replace(judged, pixel_weights=weights)


def _draw(given: PrepassInput, surfaces: HandSurfaces) -> dict[int, DrawnFrame]:
    """Draw the hands of frames that can be measured, by row."""
    rows = np.flatnonzero(_measurable(given))
    drawn = surfaces.footprints(
        given.hands, given.cameras.Ks, given.cameras.viewmats, given.indices[rows], given.size
    )
    return {
        row: DrawnFrame(footprint, given.images[row], given.masks[row])
        for row, footprint in zip(rows.tolist(), drawn, strict=True)
    }


def _measure(
    model: IntensityModel, frames: Mapping[int, DrawnFrame], shown: np.ndarray
) -> dict[int, FrameMeasurements]:
    """Compare frames with the intensity model, by row, on as many threads as torch has."""

    def measure(frame: DrawnFrame) -> FrameMeasurements:
        return measure_frame(model, frame, shown)

    with ThreadPoolExecutor(torch.get_num_threads()) as pool:
        return dict(zip(frames, pool.map(measure, frames.values()), strict=True))


def _readable(drawn: Mapping[int, DrawnFrame]) -> dict[int, DrawnFrame]:
    """The frames whose hands are in the image, where the mask has them, and can be read."""
    return {row: one for row, one in drawn.items() if one.inner.sum() >= LEAST_PIXELS}


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
    """Whether an image is black or has one colour: no edge separates hand and background."""
    pixels = image.reshape(-1, 3)
    return int(pixels.max()) < LOWEST or bool((pixels == pixels[0]).all())


def _intensity_samples(frames: Sequence[DrawnFrame], quota: int) -> IntensitySamples:
    """The pixels from which the intensity model is fitted, at most so many of each frame."""
    table = log_light_table()
    cells, light, normals = [], [], []
    for frame in frames:
        chosen = np.flatnonzero(frame.inner)
        if len(chosen) > quota:
            chosen = chosen[np.linspace(0, len(chosen) - 1, quota).astype(np.int64)]
        cells.append(frame.footprint.cells[chosen].astype(np.int64))
        light.append(table[frame.values[chosen]])
        normals.append(frame.footprint.normals[chosen])
    return IntensitySamples(
        starts=np.cumsum([0, *map(len, cells)]),
        cells=np.concatenate(cells),
        light=np.concatenate(light),
        basis=shading_basis(np.concatenate(normals)),
    )
