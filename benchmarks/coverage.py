"""How often the 95 % interval covers the truth, by simulation.

`python -m benchmarks.coverage` prints the table of `docs/studies/bootstrap-coverage.md`.
"""

from __future__ import annotations

import argparse
from dataclasses import dataclass

import numpy as np

from hwp_bench.analysis.bootstrap import bootstrap_mean


@dataclass(frozen=True)
class Study:
    """A simulated comparison; its true mean difference is 0."""

    #: Captures.
    captures: int
    #: Test frames of each; a capture has between half and all of them.
    frames: int
    #: Standard deviation of the captures' own differences.
    between: float = 1.0
    #: Standard deviation of one frame's difference within its capture.
    within: float = 1.0
    #: Correlation of neighbouring frames.
    correlation: float = 0.9
    #: Seeds, and the standard deviation of one seed's difference within its capture.
    seeds: int = 1
    #: See `seeds`.
    seed_spread: float = 0.3
    #: Captures' differences are exponential instead of normal.
    skewed: bool = False
    #: Captures weigh 1, 2, 1, 2, ... as where perturbations have unequal numbers of them.
    weighted: bool = False

    @property
    def weights(self) -> list[float]:
        """Weights of the captures."""
        return [1.0 + (self.weighted and index % 2) for index in range(self.captures)]


#: The suites' numbers of captures, and those of one perturbation, under several kinds of data.
STUDIES = (
    *(Study(captures, 6) for captures in (2, 3, 4, 8)),
    *(Study(captures, 15) for captures in (4, 11)),
    Study(8, 6, within=0.3),
    Study(8, 6, within=3.0),
    Study(8, 6, between=0.0),
    Study(11, 150, correlation=0.97),
    Study(8, 6, seeds=3),
    Study(8, 6, weighted=True),
    Study(11, 15, weighted=True, seeds=3),
    Study(8, 6, skewed=True),
    Study(11, 15, skewed=True),
    *(Study(captures, 6, within=0.3, skewed=True) for captures in (3, 4, 8)),
    Study(11, 15, within=0.3, skewed=True),
    Study(8, 6, within=0.3, skewed=True, weighted=True),
)


def simulate(study: Study, random: np.random.Generator) -> list[np.ndarray]:
    """Draw the paired differences of one study: an (S, F) array a capture, true mean 0."""
    samples = []
    for _ in range(study.captures):
        frames = int(random.integers(-(-study.frames // 2), study.frames + 1))
        own = random.exponential() - 1 if study.skewed else random.normal()
        seeds = study.seed_spread * random.normal(size=(study.seeds, 1)) * (study.seeds > 1)
        course = study.within * _correlated(frames, study.correlation, random)
        samples.append(study.between * own + seeds + course)
    return samples


def _correlated(frames: int, correlation: float, random: np.random.Generator) -> np.ndarray:
    """(F,) stationary autoregressive noise of standard deviation 1."""
    from scipy.signal import lfilter

    noise = random.normal(size=frames)
    noise[1:] *= np.sqrt(1 - correlation**2)
    return lfilter([1.0], [1.0, -correlation], noise)


@dataclass(frozen=True)
class Coverage:
    """How often intervals hold the truth, as shares of the simulated studies."""

    #: The interval of `bootstrap_mean`.
    ours: float
    #: The same without the correction for long tails: Student's t only.
    student: float
    #: The textbook's percentile interval over captures.
    percentile: float
    #: Median length of the first, in lengths of the second.
    length: float


def coverage(study: Study, repeats: int, seed: int = 0, resamples: int = 500) -> Coverage:
    """Simulate a study many times.

    Args:
        study: the study.
        repeats: how many times.
        seed: of everything random.
        resamples: resamples of each interval.
    """
    random = np.random.default_rng(seed)
    weights = np.array(study.weights) / sum(study.weights)
    covered = student = textbook = 0
    lengths = []
    for repeat in range(repeats):
        samples = simulate(study, random)
        estimate = bootstrap_mean(samples, study.weights, resamples=resamples, seed=repeat)
        assert estimate.low is not None
        assert estimate.high is not None
        covered += estimate.low <= 0 <= estimate.high
        # A tail moves one end out; the other is Student's.
        reach = min(estimate.high - estimate.value, estimate.value - estimate.low)
        student += abs(estimate.value) <= reach
        lengths.append((estimate.high - estimate.low) / (2 * reach))
        means = np.array([sample.mean() for sample in samples])
        picks = random.integers(0, len(means), (resamples, len(means)))
        drawn = (weights[picks] * means[picks]).sum(axis=1) / weights[picks].sum(axis=1)
        low, high = np.quantile(drawn, [0.025, 0.975])
        textbook += low <= 0 <= high
    return Coverage(
        covered / repeats, student / repeats, textbook / repeats, float(np.median(lengths))
    )


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else "")
    parser.add_argument("--repeats", type=int, default=2000, help="studies of each kind")
    parser.add_argument("--seed", type=int, default=0)
    args = parser.parse_args()
    print(
        "| captures | frames | seeds | data | 95 % interval covers | Student's t covers "
        "| percentile covers | length |"
    )
    print("| ---: | ---: | ---: | --- | ---: | ---: | ---: | ---: |")
    for study in STUDIES:
        found = coverage(study, args.repeats, args.seed)
        print(
            f"| {study.captures} | {study.frames} | {study.seeds} | {_describe(study)} "
            f"| {found.ours:.1%} | {found.student:.1%} | {found.percentile:.1%} "
            f"| {found.length:.2f} |",
            flush=True,
        )


def _describe(study: Study) -> str:
    parts = [f"captures {study.between:g}, frames {study.within:g} at {study.correlation:g}"]
    parts += ["skewed"] * study.skewed + ["unequal weights"] * study.weighted
    return ", ".join(parts)


if __name__ == "__main__":
    main()
