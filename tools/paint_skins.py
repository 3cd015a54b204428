"""Make the skins of `baselines/texture-space`: `python -m tools.paint_skins skins.npz`.

It paints the skin of many simulated people, and keeps mean and principal components of the
logarithm of their albedo.
"""

from __future__ import annotations

import argparse
import io
from collections.abc import Iterator
from pathlib import Path

import numpy as np

from hwp_bench.base.console import track
from hwp_bench.base.files import atomic_write
from hwp_bench.sim.subject.hand import painted_atlas, subject_hand
from hwp_bench.sim.subject.subject import Looks, Subject

#: People, and the number of the first one; no scene that ships has one of these.
PEOPLE, FIRST_SEED = 240, 700_000
#: People who are painted after them, and only measure how well the space holds other people.
OTHERS = 16
#: Texels along an edge: painted, and kept.
PAINTED, EDGE = 256, 128
#: Principal components.
COMPONENTS = 64
#: Albedos below this are as dark as anything is.
DARKEST = 0.005


def people(count: int, first: int = FIRST_SEED) -> Iterator[Subject]:
    """Yield people of every tone and age, with looks as skin has them; nothing is worn."""
    for seed in range(first, first + count):
        random = np.random.default_rng(seed)
        tone, age = random.uniform(-0.3, 1.3), random.uniform(8.0, 90.0)
        blood, yellow = random.uniform(-0.8, 0.8, 2)
        some = random.random(3) < 0.5
        freckles, wrinkles, hair = np.where(some, random.random(3), 0.0)
        looks = Looks(
            blood=float(blood),
            yellow=float(yellow),
            freckles=float(freckles),
            wrinkles=float(wrinkles),
            hair=float(hair),
        )
        yield Subject(seed=seed, tone=float(tone), age=float(age), looks=looks)


def log_albedo(subject: Subject) -> np.ndarray:
    """Paint a person: (EDGE, EDGE, 3) float32, logarithm of the linear reflectance."""
    albedo = painted_atlas(subject_hand(subject, "right"), subject, PAINTED).albedo
    step = PAINTED // EDGE
    means = albedo.reshape(EDGE, step, EDGE, step, 3).mean(axis=(1, 3))
    return np.log(np.maximum(means, DARKEST)).astype(np.float32)


def principal_components(samples: np.ndarray, count: int) -> tuple[np.ndarray, np.ndarray, float]:
    """Return mean, components and what they explain of samples.

    Args:
        samples: (P, D).

    Returns:
        (D,) mean; (count, D) components, each as long as the samples' standard deviation along
        it; share of the variance that they explain.
    """
    mean = samples.mean(axis=0)
    centred = samples - mean
    _, lengths, rows = np.linalg.svd(centred, full_matrices=False)
    deviations = lengths / np.sqrt(len(samples) - 1)
    explained = float((deviations[:count] ** 2).sum() / (deviations**2).sum())
    # The sign of a component is free: its largest entry is positive.
    signs = np.sign(rows[np.arange(count), np.abs(rows[:count]).argmax(axis=1)])
    return mean, rows[:count] * (signs * deviations[:count])[:, None], explained


def eight_bits(components: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """(K, D) as int8 and a scale for each row, (K,) float32."""
    scales = np.abs(components).max(axis=1) / 127.0
    return np.round(components / scales[:, None]).astype(np.int8), scales.astype(np.float32)


def main() -> None:
    """Write the file and say how well it holds people."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("out", type=Path, help="the file to write, .npz")
    out = parser.parse_args().out
    painted = [
        log_albedo(one).ravel() for one in track(list(people(PEOPLE + OTHERS)), "Painting people")
    ]
    samples, others = np.stack(painted[:PEOPLE]), np.stack(painted[PEOPLE:])
    mean, components, explained = principal_components(samples.astype(np.float64), COMPONENTS)
    steps, scales = eight_bits(components)
    kept = steps * scales[:, None].astype(np.float64)
    weights, *_ = np.linalg.lstsq(kept.T, (others - mean).T, rcond=None)
    error = float(np.sqrt(np.mean((others - mean - (kept.T @ weights).T) ** 2)))
    spread = float(np.sqrt(np.mean((others - mean) ** 2)))
    print(
        f"{PEOPLE} people: {COMPONENTS} components explain {100 * explained:.1f} % of the variance"
    )
    print(f"{OTHERS} others: {error:.3f} of {spread:.3f} is left (log albedo, RMS)")
    buffer = io.BytesIO()
    shape = (EDGE, EDGE, 3)
    np.savez_compressed(
        buffer,
        mean=mean.reshape(shape).astype(np.float16),
        components=steps.reshape(COMPONENTS, *shape),
        scales=scales,
    )
    atomic_write(out, buffer.getvalue())
    print(f"{out}: {len(buffer.getvalue()) / 1e6:.1f} MB")


if __name__ == "__main__":
    main()
