"""A model of intensity without a network: log light = albedo + shading + gain, fitted robustly."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch

from hwp_bench.base.colors import log_light
from wildghand.gaussians.shading import sh_basis
from wildghand.prepass.assessment import CLEAN_FROM, CLEAN_SHARE, densest

#: 8-bit values outside this range say nothing about the light: noise, or clipped.
LOWEST, HIGHEST = 4, 250
# Added to linear light before the logarithm, so that noise in the dark stays small.
_FOOT = 0.004
_DEGREE = 2
# Ridge on shading, in samples; the basis has unit mean square.
_RIDGE = 20.0
# Gain deviation at which a frame counts half in albedo and shading.
_FRAME_SCALE = 0.25
# Part of a clip's frames over which clean views of a cell must be spread. An object that stays for
# one episode does not belong to the hand, even if nothing else is wrong with its frames.
_SPREAD = 1.0 / 3.0
# Samples that the skin colour is worth in the albedo of a cell, and of one that clean frames show.
_PRIOR, _KNOWN_PRIOR = 3.0, 1.0
# Passes of the robust fit: weights and gains no longer change then.
_PASSES = 10
# Distance from the skin colour beyond which a cell has another one, and the share of the cells that
# must have it.
_SECOND_OFF, _SECOND_SHARE = 0.7, 0.03
# Distance from the skin colour at which a cell counts half in it.
_SKIN_SCALE = 0.3
# A frame shows another side of the hand where at most this share of its samples lies in cells that
# frames of ordinary light show, and at least so many, which tell its light.
_OTHER_SIDE, _TELLING = 0.5, 10


def log_light_table() -> np.ndarray:
    """(256,) float32: log of linear light for each 8-bit sRGB value."""
    return log_light(np.arange(256) / 255.0, _FOOT).astype(np.float32)


def shading_basis(normals: np.ndarray) -> np.ndarray:
    """(P, 8) float32 spherical harmonics of degree 1 and 2 at unit normals (P, 3)."""
    return sh_basis(torch.from_numpy(normals), _DEGREE).numpy()[:, 1:]


@dataclass(frozen=True, eq=False)
class IntensitySamples:
    """M pixels of R frames, ordered by frame."""

    #: (R + 1,) int64: frame r has the samples starts[r] to starts[r + 1].
    starts: np.ndarray
    #: (M,) int64 cell.
    cells: np.ndarray
    #: (M, 3) float32 log light.
    light: np.ndarray
    #: (M, 8) float32 shading basis.
    basis: np.ndarray


@dataclass(frozen=True, eq=False)
class Verdict:
    """A first judgement of R frames."""

    #: (R,) probability that nothing perturbs the frame.
    clean: np.ndarray
    #: (R, 3) log gain, linear light.
    gains: np.ndarray


@dataclass(frozen=True, eq=False)
class IntensityModel:
    """Log light of the hands at every place; gains are relative to the mode of the gains."""

    #: (C, 3) float32 log albedo of every cell.
    albedo: np.ndarray
    #: (C, 3) float32 log skin colour of every cell's side of the hand: smooth, whatever the cell
    #: itself showed.
    skin: np.ndarray
    #: (8, 3) float32 coefficients of `shading_basis`.
    shading: np.ndarray
    #: (R, 3) log gain of every frame, linear light.
    gains: np.ndarray
    #: Median absolute residual of a channel in the frames around the mode.
    scale: float
    #: (C,) bool: clean frames from different parts of the clip show the cell.
    known: np.ndarray
    #: (3,) log colour of known cells that are far from the skin colour, such as the bare fingers of
    #: a glove; None where these are few.
    second: np.ndarray | None = None

    def predict(self, cells: np.ndarray, normals: np.ndarray) -> np.ndarray:
        """(P, 3) log light at gain 0."""
        return self.albedo[cells] + shading_basis(normals) @ self.shading


def fit_intensity(
    samples: IntensitySamples,
    cell_normals: np.ndarray,
    verdict: Verdict | None = None,
) -> IntensityModel:
    """Fit albedo, shading and gains by turns, with weights that leave outliers out.

    Without a verdict a place that looks like no other one is an outlier, because an object may
    cover it in every frame that shows it, and a frame that shows such places alone is one of other
    light. But the palms of dark skin are far lighter than the backs. Frames of the palm show the
    sides of fingers too, and where these are as bright as ever, the light is ordinary: the model is
    fitted again, with these frames' gains held at 0. With a verdict, what clean frames show of a
    place is how it looks: a bare finger of a glove, a palm of another colour.

    Args:
        samples: at least one.
        cell_normals: (C, 3) normal of every cell on the rest surface; zeros where unknown.
        verdict: on the frames of the samples.
    """
    model = _fit(samples, cell_normals, verdict, None)
    if verdict is not None:
        return model
    held = _in_ordinary_light(samples, model)
    return _fit(samples, cell_normals, None, held) if held.any() else model


def _in_ordinary_light(samples: IntensitySamples, model: IntensityModel) -> np.ndarray:
    """(R,) bool: frames of another side of the hand, of large gain, but not where others look."""
    counts = np.diff(samples.starts)
    rows = np.repeat(np.arange(len(counts)), counts)
    far = np.linalg.norm(model.gains, axis=1) > _FRAME_SCALE
    usual = ~far[rows]
    count = len(model.albedo)
    shown = np.unique(np.stack([samples.cells[usual], rows[usual]]), axis=1)[0]
    told = np.bincount(shown, minlength=count) > 1
    unlit = samples.light - samples.basis @ model.shading
    mass = np.maximum(np.bincount(samples.cells[usual], minlength=count), 1)
    albedo = np.stack(
        [np.bincount(samples.cells[usual], unlit[usual, k], minlength=count) for k in range(3)], 1
    )
    rest = unlit - (albedo / mass[:, None])[samples.cells]
    held = np.zeros(len(counts), dtype=bool)
    for row in np.flatnonzero(far):
        part = slice(samples.starts[row], samples.starts[row + 1])
        telling = told[samples.cells[part]]
        if telling.sum() >= _TELLING and telling.mean() <= _OTHER_SIDE:
            gain = np.median(rest[part][telling], axis=0)
            held[row] = np.linalg.norm(gain) < _FRAME_SCALE
    return held


def _fit(
    samples: IntensitySamples,
    cell_normals: np.ndarray,
    verdict: Verdict | None,
    held: np.ndarray | None,
) -> IntensityModel:
    """See `fit_intensity`; the gains of held frames, (R,) bool, stay 0."""
    counts = np.diff(samples.starts)
    rows = np.repeat(np.arange(len(counts)), counts)
    cell_count = len(cell_normals)
    used = np.flatnonzero(np.bincount(samples.cells, minlength=cell_count))
    dense = np.zeros(cell_count, dtype=np.int64)
    dense[used] = np.arange(len(used))
    cells = dense[samples.cells]
    sides = np.column_stack([np.ones(len(used)), shading_basis(cell_normals[used])])
    light = samples.light.astype(np.float64)
    basis = samples.basis.astype(np.float64)
    weights = np.ones(len(light))
    shading = np.zeros((basis.shape[1], 3))
    gains = np.zeros((len(counts), 3)) if verdict is None else verdict.gains
    sure = np.ones(len(rows))
    known = np.zeros(len(used), dtype=bool)
    if verdict is not None:
        known = _known_cells(verdict.clean, cells, rows, len(used))
        # Squared: doubtful frames count little, because they may all show the same object.
        sure = np.where(known[cells], verdict.clean[rows] ** 2, 1.0)
    elif held is not None:
        # What others do not show is what it looks like here.
        others = np.bincount(cells[~held[rows]], minlength=len(used))
        known = np.bincount(cells[held[rows]], minlength=len(used)) > others
    prior = np.where(known, _KNOWN_PRIOR, _PRIOR)
    shade = np.zeros_like(light)
    scale = 1.0
    for _ in range(_PASSES):
        near = 1.0 / (1.0 + (np.linalg.norm(gains, axis=1) / _FRAME_SCALE) ** 2)
        trust = weights * sure * near[rows]
        rest = light - shade - gains[rows]
        albedo, skin = _albedo(cells, rest, trust, sides, prior)
        rest = light - albedo[cells] - gains[rows]
        weighted = basis * trust[:, None]
        normal = weighted.T @ basis + _RIDGE * np.eye(basis.shape[1])
        shading = np.linalg.solve(normal, weighted.T @ rest)
        shade = basis @ shading
        rest = light - albedo[cells] - shade
        gains = _frame_medians(rest, samples.starts)
        centre, part = densest(gains, CLEAN_SHARE)
        gains = gains - centre
        if held is not None:
            gains[held] = 0.0
        residual = np.abs(rest - centre - gains[rows]) @ np.full(3, 1.0 / 3.0)
        scale = max(float(np.median(residual[part[rows]])), 0.01)
        ordinary: float | np.ndarray = scale
        if known.any():
            ordinary = _cell_scales(cells, residual, sure * known[cells], len(used), scale)[cells]
        weights = 1.0 / (1.0 + (residual / (2.5 * ordinary)) ** 4)
    everywhere = np.column_stack([np.ones(cell_count), shading_basis(cell_normals)])
    smooth = (everywhere @ skin + centre).astype(np.float32)
    full = smooth.copy()
    full[used] = albedo + centre
    shown = np.zeros(cell_count, dtype=bool)
    shown[used] = known & (verdict is not None)
    second = _second_colour(full[shown], smooth[shown])
    return IntensityModel(
        full, smooth, shading.astype(np.float32), gains, scale, known=shown, second=second
    )


def _albedo(
    cells: np.ndarray, rest: np.ndarray, weights: np.ndarray, sides: np.ndarray, prior: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Weighted means of the cells, drawn towards the skin colour of their side of the hand.

    The skin colour is a smooth function of the normal on the rest hand: palms are lighter than
    backs, and without it a turned hand looks like a change of the light.
    """
    count = len(sides)
    mass = np.bincount(cells, weights, minlength=count)
    sums = np.stack(
        [np.bincount(cells, weights * rest[:, k], minlength=count) for k in range(3)], axis=1
    )
    own = sums / np.maximum(mass, 1e-9)[:, None]
    trust = mass / (mass + prior)
    skin = np.zeros((sides.shape[1], 3))
    skin[0] = np.median(own[mass > 0], axis=0) if (mass > 0).any() else rest.mean(axis=0)
    ridge = np.diag([1e-6] + [0.01 * count] * (sides.shape[1] - 1))
    for _ in range(3):
        off = np.linalg.norm(own - sides @ skin, axis=1)
        weighted = sides * (trust / (1.0 + (off / _SKIN_SCALE) ** 2))[:, None]
        skin = np.linalg.solve(weighted.T @ sides + ridge, weighted.T @ own)
    return (sums + prior[:, None] * (sides @ skin)) / (mass + prior)[:, None], skin


def _known_cells(clean: np.ndarray, cells: np.ndarray, rows: np.ndarray, count: int) -> np.ndarray:
    """(count,) bool: clean frames from different parts of the clip show the cell."""
    good = clean[rows] >= CLEAN_FROM
    first = np.full(count, len(clean))
    last = np.full(count, -1)
    np.minimum.at(first, cells[good], rows[good])
    np.maximum.at(last, cells[good], rows[good])
    return np.asarray(last - first >= _SPREAD * len(clean))


def _cell_scales(
    cells: np.ndarray, residual: np.ndarray, trust: np.ndarray, count: int, least: float
) -> np.ndarray:
    """(count,) residual that is ordinary in each cell, from `least` on.

    The mean is geometric, so that some outliers hardly raise it. Where all samples of a cell are
    far off, its albedo is wrong and not the samples, and they must not be left out.
    """
    above = np.log(np.maximum(residual / least, 1.0))
    mass = np.bincount(cells, trust, minlength=count)
    sums = np.bincount(cells, trust * above, minlength=count)
    return np.asarray(least * np.exp(sums / np.maximum(mass, 1e-9)))


def _second_colour(albedo: np.ndarray, skin: np.ndarray) -> np.ndarray | None:
    """(3,) median log albedo of the cells that are far from the skin colour; None if few are."""
    off = np.linalg.norm(albedo - skin, axis=1) > _SECOND_OFF
    if not len(albedo) or off.mean() < _SECOND_SHARE:
        return None
    return np.asarray(np.median(albedo[off], axis=0))


def _frame_medians(values: np.ndarray, starts: np.ndarray) -> np.ndarray:
    """(R, 3) median of each frame's samples; zeros where it has none."""
    result = np.zeros((len(starts) - 1, values.shape[1]))
    for row in range(len(result)):
        part = values[starts[row] : starts[row + 1]]
        if len(part):
            result[row] = np.median(part, axis=0)
    return result
