"""Results made of numbers, for tests of what is computed from results."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace

from small_captures import results_example

from hwp_bench.results import CurvePoint, FrameResult, Results

#: (capture number, frame number, seed) -> PSNR.
Scorer = Callable[[int, int, int], float]

#: What the captures of `made_results` carry, by number.
PERTURBED = (["illumination"], ["illumination"], ["motion_blur"], ["motion_blur"])


def made_results(
    name: str,
    score: Scorer,
    *,
    seed: int = 0,
    captures: int = 4,
    frames: int = 6,
    seconds: float = 10.0,
    steps: int = 100,
    curve: Sequence[tuple[float, float]] = ((1.0, 15.0), (10.0, 20.0)),
    **changes: object,
) -> Results:
    """An evaluation of a method called `name`; odd captures show two hands.

    Args:
        name: of the method.
        score: gives every frame's PSNR; the oriented distance is 1 - PSNR / 100.
        seed: of the run.
        captures: number of captures.
        frames: test frames of each.
        seconds: of each fit.
        steps: of each fit.
        curve: (seconds, PSNR) of each fit's checkpoints.
        changes: fields of the results to replace.
    """
    base = results_example(name)
    made = []
    for number in range(captures):
        rows = []
        for frame in range(frames):
            value = score(number, frame, seed)
            scores = {"psnr": value, "oriented_distance": 1 - value / 100}
            rows.append(FrameResult(90 + frame, scores, None))
        made.append(
            replace(
                base.captures[0],
                id=f"capture{number}",
                hands="both" if number % 2 else "right",
                perturbations=PERTURBED[number % 4],
                frames=rows,
                fit_seconds=seconds,
                steps=steps,
                curve=[
                    CurvePoint(int(steps * t / seconds), t, 10**8, {"psnr": value})
                    for t, value in curve
                ],
            )
        )
    return replace(base, captures=made, seed=seed, **changes)  # type: ignore[arg-type]
