"""How long scoring takes: every weight-free metric in both protocols, next to scikit-image.

Run from the repository: `python -m benchmarks.scoring [--frames 1000] [--size 256]`, or with
`--quick` for the ratios alone.
The plain loop computes the PSNR and SSIM of both protocols with scikit-image (not the oriented
distance), and its numbers must equal ours. Both run in turns, so that other work on the machine
slows them alike; the processor time says what they cost whatever else runs.
"""

from __future__ import annotations

import argparse
import os
import time
from collections.abc import Callable, Iterator
from functools import partial

import numpy as np
from scipy import ndimage
from skimage.metrics import peak_signal_noise_ratio, structural_similarity

from hwp_bench.metrics.score import ScoredFrame, score_frames

#: Different frames that are made; the list of frames goes round them.
DISTINCT = 16
#: Turns that the two loops take.
ROUNDS = 5
#: The plain loop gets one frame in so many; its time is multiplied.
PLAIN_SHARE = 10
#: Processor time of ours over that of the plain loop, by the share that the hand fills.
BUDGETS = {0.25: 0.5, 1.0: 0.85}


def make_frames(size: int, share: float) -> list[ScoredFrame]:
    """Noisy predictions of a textured disc (or, for share 1, of the whole frame)."""
    rng = np.random.default_rng(0)
    rows, columns = np.mgrid[:size, :size] - (size - 1) / 2
    radius = np.sqrt(share / np.pi) * size
    mask = (rows**2 + columns**2 <= radius**2) | (share >= 1.0)
    frames = []
    for _ in range(DISTINCT):
        target = rng.integers(0, 256, (size, size, 3), dtype=np.uint8)
        noise = rng.normal(0.0, 12.0, target.shape)
        prediction = np.clip(np.rint(target + noise), 0, 255).astype(np.uint8)
        frames.append(ScoredFrame(prediction, target, mask.astype(np.uint8) * 255))
    return frames


def cycle(frames: list[ScoredFrame], count: int) -> Iterator[ScoredFrame]:
    for index in range(count):
        yield frames[index % len(frames)]


def run_ours(frames: list[ScoredFrame], count: int, workers: int) -> None:
    score_frames(cycle(frames, count), workers=workers)


def run_scikit_image(frames: list[ScoredFrame], count: int) -> None:
    for frame in cycle(frames, count):
        plain_scores(frame)


def plain_scores(frame: ScoredFrame) -> dict[str, float]:
    """PSNR and SSIM of both protocols as one writes them down with scikit-image."""
    assert isinstance(frame.prediction, np.ndarray)
    prediction, target = frame.prediction / 255.0, frame.target / 255.0
    hand = frame.mask > 127
    region = ndimage.binary_erosion(hand, np.ones((3, 3)), border_value=1)
    x, y = (np.pad(i * region[..., None], ((5, 5), (5, 5), (0, 0))) for i in (prediction, target))
    _, similarity = structural_similarity(
        x,
        y,
        full=True,
        channel_axis=2,
        gaussian_weights=True,
        sigma=1.5,
        use_sample_covariance=False,
        data_range=1.0,
    )
    similarity = similarity[5:-5, 5:-5].mean(axis=2)
    rows, columns = np.nonzero(hand)
    box = (slice(rows.min(), rows.max() + 1), slice(columns.min(), columns.max() + 1))
    x, y = (image * hand[..., None] for image in (prediction, target))
    return {
        "psnr": peak_signal_noise_ratio(target[region], prediction[region], data_range=1.0),
        "psnr_edge": peak_signal_noise_ratio(target[hand], prediction[hand], data_range=1.0),
        "ssim": similarity[region].mean(),
        "ssim_full": similarity[5:-5, 5:-5].mean(),
        "paper_psnr": peak_signal_noise_ratio(y, x, data_range=1.0),
        "paper_ssim": structural_similarity(x[box], y[box], channel_axis=2, data_range=2.0),
    }


def check_agreement(frames: list[ScoredFrame]) -> None:
    """Stop where the two loops do not compute the same numbers."""
    for frame, scores in zip(frames, score_frames(frames), strict=True):
        for name, value in plain_scores(frame).items():
            if abs(value - scores[name]) > 1e-9:
                raise SystemExit(f"{name}: {scores[name]} here, {value} by scikit-image")


def timed(work: Callable[[], None]) -> np.ndarray:
    """Seconds on the clock and seconds of processor time."""
    clock, processor = time.perf_counter(), time.process_time()
    work()
    return np.array([time.perf_counter() - clock, time.process_time() - processor])


def measure(size: int = 256, count: int = 40, rounds: int = 3) -> dict[str, float]:
    """Processor time of scoring over that of the plain scikit-image loop; lower is better.

    Ours scores more (the oriented distance), so below 1 it is faster by more than the ratio.

    Args:
        size: edge of a frame, px.
        count: frames of ours in a round; the plain loop gets a quarter as many.
        rounds: turns that the two take.

    Returns:
        Name of a ratio -> ratio; `BUDGETS` are for 256 px.
    """
    ratios = {}
    for share in BUDGETS:
        frames = make_frames(size, share)
        check_agreement(frames[:2])
        ours, plain = 0.0, 0.0
        for _ in range(rounds):
            ours += timed(partial(run_ours, frames, count, 1))[1] / count
            plain += timed(partial(run_scikit_image, frames, count // 4))[1] / (count // 4)
        ratios[f"scoring / scikit-image, hand fills {share:.0%}"] = float(ours / plain)
    return ratios


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.split("\n", maxsplit=1)[0])
    parser.add_argument("--frames", type=int, default=1000, help="frames to score (1000)")
    parser.add_argument("--size", type=int, default=256, help="side of a frame, px (256)")
    parser.add_argument("--workers", type=int, default=os.cpu_count() or 1, help="threads")
    parser.add_argument("--quick", action="store_true", help="ratios of processor time alone")
    args = parser.parse_args()
    if args.quick:
        for (name, ratio), budget in zip(measure(args.size).items(), BUDGETS.values(), strict=True):
            print(f"{name}: {ratio:.2f} (budget {budget:.2f})")
        return

    print(f"{args.frames} frames of {args.size} px, {args.workers} threads, both protocols\n")
    print("| hand fills | time | frames/s | processor | plain loop | processor | ratio |")
    print("| --- | --- | --- | --- | --- | --- | --- |")
    turn = max(PLAIN_SHARE, args.frames // ROUNDS)
    for share in (0.25, 1.0):
        frames = make_frames(args.size, share)
        check_agreement(frames)
        ours, plain = np.zeros(2), np.zeros(2)
        for _ in range(ROUNDS):
            ours += timed(partial(run_ours, frames, turn, args.workers))
            plain += timed(partial(run_scikit_image, frames, turn // PLAIN_SHARE))
        ours *= args.frames / (ROUNDS * turn)
        plain *= args.frames / (ROUNDS * (turn // PLAIN_SHARE))
        print(
            f"| {share:.0%} of the frame | {ours[0]:.1f} s | {args.frames / ours[0]:.0f} "
            f"| {ours[1]:.1f} s | {plain[0]:.1f} s | {plain[1]:.1f} s "
            f"| {plain[0] / ours[0]:.1f}x |"
        )


if __name__ == "__main__":
    main()
