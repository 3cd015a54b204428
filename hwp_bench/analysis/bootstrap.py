"""Paired hierarchical bootstrap: captures, then seeds and blocks of frames within a capture.

The resamples give a standard error, which is read with Student's t. With a long tail in the
captures' differences Student's interval covers too rarely: a few captures seldom show the tail,
and then both the mean and the spread are small. Hall's transformation moves both ends towards the
tail. An interval that reaches the farther of the two covers often enough, and where nothing
is skewed not much too often (`python -m benchmarks.coverage`).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from hwp_bench.base.errors import UsageError

#: Resamples unless told otherwise.
RESAMPLES = 10_000
#: Probability that an interval is made to cover.
LEVEL = 0.95
#: Power at which the minimum detectable difference is given.
POWER = 0.8
#: Fewest captures whose skewness is looked at: three points lean to a side in any case.
FEWEST = 4


@dataclass(frozen=True)
class Estimate:
    """A mean difference and how sure it is. The interval and the rest are None without spread."""

    #: The weighted mean over captures of means over seeds and frames.
    value: float
    #: Lower end of the 95 % interval.
    low: float | None
    #: Upper end of the 95 % interval.
    high: float | None
    #: Probability that the mean over further captures is above 0.
    above: float | None
    #: Two-sided p-value of "there is no difference".
    p: float | None
    #: Smallest true difference that would be found at the 5 % level in 80 % of such studies.
    detectable: float | None
    #: Captures it rests on; with one, it speaks only of further frames of that capture.
    captures: int


def bootstrap_mean(
    samples: Sequence[np.ndarray],
    weights: Sequence[float] | None = None,
    *,
    resamples: int = RESAMPLES,
    seed: int = 0,
) -> Estimate:
    """Estimate the mean of paired differences over captures, with its uncertainty.

    A resample draws captures with replacement, and within each drawn capture seeds and blocks of
    frames. Three things differ from the textbook percentile bootstrap, which covers 50 to 90 %
    where it claims 95 with 2 to 11 captures (`python -m benchmarks.coverage`):

    - capture means are drawn towards their mean first, by as much as frames and seeds spread
      them, which the second level puts back (Davison and Hinkley 1997, section 3.8), and then
      widened for the captures' small number, so that the resamples spread as the mean does;
    - the standard deviation of the resamples is read with Student's t, with one degree of
      freedom less than captures (than their effective number 1 / sum(w^2), if weighted);
    - from four captures on, the end of the interval on the side of a long tail is moved out
      by the captures' skewness (`interval_reaches`).

    Args:
        samples: one (S, F) float array a capture: the difference for each seed and frame.
    """
    blocks = []
    for sample in samples:
        array = np.asarray(sample, dtype=np.float64)
        if array.ndim != 2 or not array.size or not np.isfinite(array).all():
            raise UsageError("a sample must be a finite (seeds, frames) array with frames in it")
        blocks.append(make_blocks(array))
    share = np.ones(len(blocks)) if weights is None else np.asarray(weights, dtype=np.float64)
    sound = share.shape == (len(blocks),) and (np.isfinite(share) & (share > 0)).all()
    if not blocks or not sound:
        raise UsageError("there must be a capture, and each needs a weight above 0")
    share = share / share.sum()
    values = np.array([block.value for block in blocks])
    value = float(share @ values)
    random = np.random.default_rng(seed)
    skew = 0.0
    if len(blocks) == 1:
        freedom = float(blocks[0].degrees_of_freedom)
        draws = blocks[0].errors(resamples, random)
    else:
        freedom = float(1 / (share**2).sum() - 1)
        draws = _draws(blocks, share, values, resamples, random)
        skew = skewness_of_mean(values, share)
    return _read(value, float(draws.std()), freedom, skew, len(blocks))


def _draws(
    blocks: Sequence[Blocks],
    share: np.ndarray,
    values: np.ndarray,
    resamples: int,
    random: np.random.Generator,
) -> np.ndarray:
    """Return (resamples,) errors of the weighted mean over drawn captures."""
    count, mean = len(blocks), share @ values
    spread = share @ (values - mean) ** 2 / (1 - (share**2).sum())
    within = share**2 @ [block.variance for block in blocks] / (share**2).sum()
    # How much of the captures' spread is theirs, and how much of the frames' spread fits in it.
    between = np.sqrt(max(0.0, 1 - within / spread)) if spread > 0 else 0.0
    inner = np.sqrt(min(1.0, spread / within)) if within > 0 else 0.0
    # What drawing from few captures loses of the variance of a weighted mean.
    lost = (share**2).sum() - 2 * (share**3).sum() + (share**2).sum() ** 2
    between *= np.sqrt((share**2).sum() / lost)
    picks = random.integers(0, count, (resamples, count))
    drawn = between * (values - mean)[picks]
    for index, block in enumerate(blocks):
        places = picks == index
        drawn[places] += inner * block.errors(int(places.sum()), random)
    chosen = share[picks]
    return (chosen * drawn).sum(axis=1) / chosen.sum(axis=1)


def _read(value: float, error: float, freedom: float, skew: float, captures: int) -> Estimate:
    """Read the value and the standard deviation of the resamples."""
    # What `scipy.stats.t` calls, without its checks, which take a hundred times as long.
    from scipy.special import stdtr, stdtrit

    if freedom <= 0:
        return Estimate(value, None, None, None, None, None, captures)
    if error == 0:
        # Every frame says the same: nothing is left to chance.
        above = 0.5 if value == 0 else float(value > 0)
        return Estimate(value, value, value, above, float(value == 0), 0.0, captures)
    quantile = float(stdtrit(freedom, 0.5 + LEVEL / 2))
    below, beyond = interval_reaches(quantile, skew)
    above = least_extreme(
        stdtr(freedom, value / error), stdtr(freedom, hall_transform(value / error, skew))
    )
    detectable = (max(below, beyond) + float(stdtrit(freedom, POWER))) * error
    p = 2 * min(above, 1 - above)
    low, high = value - below * error, value + beyond * error
    return Estimate(value, low, high, above, p, detectable, captures)


@dataclass(frozen=True, eq=False)
class Blocks:
    """The overlapping blocks of frames of one capture.

    Neighbouring frames of a video are nearly the same, so single frames must not be drawn as if
    they were independent; blocks of about sqrt(F) frames are. Blocks wrap around at the end, so
    that every frame is in as many as any other (circular block bootstrap, Politis and Romano 1992).
    """

    #: (S, F) mean over the block that starts at each frame, for each seed.
    means: np.ndarray
    #: Blocks that make up one resampled capture.
    count: int

    @property
    def value(self) -> float:
        """Mean over all seeds and frames."""
        return float(self.means.mean())

    @property
    def variance(self) -> float:
        """Estimated variance of `value`: that of blocks, and of seeds where there are several."""
        frames = float(self.means.mean(axis=0).var()) / max(self.count - 1, 1)
        seeds = len(self.means)
        return frames + (float(self.means.mean(axis=1).var(ddof=1)) / seeds if seeds > 1 else 0.0)

    @property
    def degrees_of_freedom(self) -> int:
        """Units behind `variance`, less one: the fewest of blocks and (if several) seeds."""
        units = [self.count, len(self.means)] if len(self.means) > 1 else [self.count]
        return min(units) - 1

    def errors(self, draws: int, random: np.random.Generator) -> np.ndarray:
        """Draw (draws,) resampled means minus `value`, spread as `variance` says.

        Blocks are drawn with replacement; so are seeds, independently of the blocks, because
        every seed is scored on the same frames. Drawing from few loses part of the variance,
        which is put back.
        """
        starts = random.integers(0, self.means.shape[1], (draws, self.count))
        errors = _restored(self.count) * (self.means.mean(axis=0)[starts].mean(axis=1) - self.value)
        if len(self.means) > 1:
            seeds = random.integers(0, len(self.means), (draws, len(self.means)))
            drawn = self.means.mean(axis=1)[seeds].mean(axis=1)
            errors += _restored(len(self.means)) * (drawn - self.value)
        return errors


def _restored(count: int) -> float:
    """Factor that restores the spread which `count` draws from `count` units lose."""
    return (count / max(count - 1, 1)) ** 0.5


def make_blocks(values: np.ndarray) -> Blocks:
    """Return the blocks of one capture: (S, F) float, one row per seed, frames in order."""
    frames = values.shape[1]
    length = max(1, round(frames**0.5))
    around = np.concatenate([values, values[:, : length - 1]], axis=1)
    totals = np.concatenate([np.zeros((len(values), 1)), around.cumsum(axis=1)], axis=1)
    return Blocks((totals[:, length:] - totals[:, :frames]) / length, -(-frames // length))


def skewness_of_mean(values: np.ndarray, share: np.ndarray) -> float:
    """Return the estimated skewness of a weighted mean of (N,) captures; weights add up to 1."""
    deviations = values - share @ values
    spread = share @ deviations**2
    # Differences that differ only by rounding have no shape.
    if len(values) < FEWEST or spread <= (1e-12 * np.abs(values).max()) ** 2:
        return 0.0
    own = share @ deviations**3 / spread**1.5
    return float(own * (share**3).sum() / (share**2).sum() ** 1.5)


def hall_transform(studentised: float, skew: float) -> float:
    """Return Hall's transformation of a Student statistic, which takes the skewness out of it.

    T + k T^2 / 3 + k^2 T^3 / 27 + k / 6, increasing in T.

    Args:
        studentised: the mean less the truth, over its standard error: T.
        skew: skewness of the mean: k.

    Source: Hall, On the removal of skewness by transformation, 1992, with the constants for a
    studentised mean (a = 1/3, b = 1/6).
    """
    return studentised + skew * studentised**2 / 3 + skew**2 * studentised**3 / 27 + skew / 6


def inverse_hall_transform(value: float, skew: float) -> float:
    """Return the inverse of `hall_transform` in its first argument."""
    if abs(skew) < 1e-9:
        return value
    return float(3 / skew * (np.cbrt(1 + skew * (value - skew / 6)) - 1))


def interval_reaches(quantile: float, skew: float) -> tuple[float, float]:
    """Return how far an interval reaches below and above the mean, in standard errors."""
    below = max(quantile, inverse_hall_transform(quantile, skew))
    return below, max(quantile, -inverse_hall_transform(-quantile, skew))


def least_extreme(first: float, second: float) -> float:
    """Return the probability that claims less, of two: 0.5 where they contradict each other."""
    low, high = sorted((float(first), float(second)))
    return min(max(0.5, low), high)
