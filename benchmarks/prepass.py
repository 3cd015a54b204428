"""How well and how fast the pre-pass judges frames, against the truth of simulated captures.

Run from the repository: `python -m benchmarks.prepass CAPTURE... [--known 8] [--pictures FOLDER]`,
with captures made by `hwp-bench sim render`. The truth is read here and never by the pre-pass.
With `--known` so many validation frames are judged too, as a fit does it, known to be clean.

For every capture: processor seconds of the second call (the first compiles), images in memory;
Spearman correlation of 1 - clean with the true severity (the largest of its perturbations) and the
area under the ROC curve of clean against perturbed frames; the share of all frames judged clean,
of clean frames judged so, and of frames of severity 3 to 5 judged not; median absolute error of
the log gains; and, over pixels of the hand in frames with objects, the area under the curve of the
pixel weights for visible against covered pixels, next to that of the estimated mask. A second
table compares the estimated severity of every perturbation that the capture carries with the true
one.
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Mapping
from pathlib import Path

import cv2
import numpy as np
import torch
from scipy.stats import rankdata, spearmanr

from hwp_bench.base.arrays import evenly
from hwp_bench.capture import Capture, open_capture
from hwp_bench.capture.splits import contiguous_split
from wildghand.prepass import (
    FrameAssessment,
    PrepassInput,
    capture_input,
    estimated_severity,
    judge_frames,
)
from wildghand.prepass.intensity import log_light_table


def load(capture: Capture, known: int) -> tuple[PrepassInput, PrepassInput | None]:
    """The training frames of a capture and some of its validation frames, without its truth."""
    split = contiguous_split(capture.info.id, len(capture))
    given = capture_input(capture, split.train)
    if not known:
        return given, None
    return given, capture_input(capture, split.validation[evenly(len(split.validation), known)])


def severities(capture: Capture, frames: np.ndarray) -> dict[str, np.ndarray]:
    return {
        name: np.array(values)[frames]
        for name, values in capture.info.perturbations.items()
        if values is not None
    }


def area_under_curve(scores: np.ndarray, positive: np.ndarray) -> float:
    """Chance that a positive scores above a negative; ties count half."""
    ones, zeros = int(positive.sum()), int((~positive).sum())
    if not ones or not zeros:
        return float("nan")
    return float((rankdata(scores)[positive].sum() - ones * (ones + 1) / 2) / (ones * zeros))


def gain_error(capture: Capture, judgement: FrameAssessment) -> tuple[float, float]:
    """Median and 90 % quantile of the absolute error of the log gains."""
    table, errors = log_light_table(), []
    for row, frame in enumerate(judgement.indices.tolist()):
        hand = capture.true_mask(frame) > 250
        if judgement.usable[row] and hand.any():
            change = table[capture.frame(frame)] - table[capture.clean(frame)]
            errors.append(np.abs(judgement.log_gains[row] - np.median(change[hand], axis=0)))
    return float(np.median(errors)), float(np.quantile(errors, 0.9))


def covered_pixels(capture: Capture, weights: Mapping[int, np.ndarray]) -> tuple[float, float]:
    """Area under the curve of weights and of the estimated mask, visible against covered.

    Args:
        capture: with the truth.
        weights: (H, W) of each frame that counts; frames whose clean mask is unknown do not.
    """
    found, masks, visible = [], [], []
    for frame, weight in weights.items():
        if not (capture.root / "truth" / "clean_masks" / f"{frame:06d}.png").is_file():
            continue
        truth = capture.true_mask(frame)
        known = (capture.clean_mask(frame) > 250) & ((truth > 250) | (truth < 5))
        found.append(weight[known])
        masks.append(capture.mask(frame)[known])
        visible.append(truth[known] > 250)
    if not found:
        return float("nan"), float("nan")
    shown = np.concatenate(visible)
    return (
        area_under_curve(np.concatenate(found), shown),
        area_under_curve(np.concatenate(masks), shown),
    )


def judged_weights(judgement: FrameAssessment, objects: np.ndarray | None) -> dict[int, np.ndarray]:
    """Pixel weights of the frames in which objects act."""
    acting = np.zeros(len(judgement)) if objects is None else objects
    rows = np.flatnonzero(acting)
    return {int(judgement.indices[row]): judgement.pixel_weights[row] for row in rows}


def level_rows(name: str, judgement: FrameAssessment, truth: dict[str, np.ndarray]) -> list[str]:
    """Rows of the second table: estimated against true levels of what the capture carries."""
    rows, levels = [], estimated_severity(judgement)
    for kind, true in truth.items():
        found = levels[kind]
        correlation = spearmanr(found, true).statistic
        error = np.abs(found - true).mean()
        rows.append(f"| {name} | {kind.replace('_', ' ')} | {correlation:.2f} | {error:.1f} |")
    return rows


def draw(capture: Capture, given: PrepassInput, judgement: FrameAssessment, folder: Path) -> None:
    """Draw the judgement over time next to the truth, and some frames with their weights."""
    import matplotlib

    matplotlib.use("Agg")
    import matplotlib.pyplot as plt

    figure, axes = plt.subplots(2, 1, figsize=(9, 3.6), sharex=True, layout="constrained")
    truth = severities(capture, judgement.indices)
    for name, values in truth.items():
        axes[0].step(judgement.indices, values, where="mid", label=name.replace("_", " "))
    axes[0].set_ylabel("true severity" if truth else "severity unknown")
    if truth:
        axes[0].legend(fontsize=7, loc="upper right")
    axes[1].plot(judgement.indices, judgement.clean, color="black", label="clean")
    for name in ("gain", "blur", "misplacement", "hidden", "residual"):
        deviation = getattr(judgement, f"{name}_deviation")
        axes[1].plot(judgement.indices, np.minimum(deviation / 10, 1), lw=0.8, label=f"{name} / 10")
    axes[1].plot(
        judgement.indices[judgement.refine_pose],
        np.full(int(judgement.refine_pose.sum()), 1.05),
        "v",
        ms=3,
        label="refine pose",
    )
    axes[1].set_xlabel("training frame")
    axes[1].legend(fontsize=6, loc="center left", bbox_to_anchor=(1.0, 0.5))
    figure.savefig(folder / f"{capture.info.id}-time.png", dpi=110)
    plt.close(figure)
    rows = np.linspace(1, len(judgement) - 2, 10).astype(int)
    strips = []
    for row in rows.tolist():
        image = given.images[row]
        weights = judgement.pixel_weights[row].astype(np.float32)[..., None] / 255.0
        overlay = image * weights + (1.0 - weights) * np.array([255.0, 0.0, 255.0])
        both = np.concatenate([image, overlay.astype(np.uint8)])
        label = f"{judgement.indices[row]}: {judgement.clean[row]:.2f}"
        strips.append(
            cv2.putText(
                np.ascontiguousarray(both),
                label,
                (3, 12),
                cv2.FONT_HERSHEY_SIMPLEX,
                0.4,
                (255,) * 3,
            )
        )
    sheet = np.concatenate(strips, axis=1)[..., ::-1]
    cv2.imwrite(
        str(folder / f"{capture.info.id}-weights.jpg"), sheet, [cv2.IMWRITE_JPEG_QUALITY, 85]
    )


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.split("\n", maxsplit=1)[0])
    parser.add_argument("captures", nargs="+", type=Path, help="capture folders")
    parser.add_argument("--known", type=int, default=0, help="validation frames (0)")
    parser.add_argument("--pictures", type=Path, help="folder for images")
    parser.add_argument("--threads", type=int, default=1, help="threads (1)")
    args = parser.parse_args()
    torch.set_num_threads(args.threads)
    cv2.setNumThreads(args.threads)
    if args.pictures:
        args.pictures.mkdir(parents=True, exist_ok=True)

    print(
        "| capture | frames | px | perturbed | s | judged clean | Spearman | AUC | clean kept "
        "| strong caught | gain error (90 %) | pixel AUC (mask only) |"
    )
    print("| --- |" + " ---: |" * 11)
    levels = []
    for path in args.captures:
        capture = open_capture(path)
        given, known = load(capture, args.known)
        judge_frames(given, known_clean=known)
        start = time.process_time()
        judgement = judge_frames(given, known_clean=known)
        seconds = time.process_time() - start
        row = [capture.info.id, str(len(judgement)), str(given.size[0])]
        kept = f"{np.mean(judgement.clean > 0.5):.0%}"
        truth = severities(capture, judgement.indices)
        if truth and capture.has_clean:
            worst = np.max(list(truth.values()), axis=0)
            levels += level_rows(capture.info.id, judgement, truth)
            error = gain_error(capture, judgement)
            objects = truth.get("hand_object_interaction")
            pixels = covered_pixels(capture, judged_weights(judgement, objects))
            row += [
                str(int((worst > 0).sum())),
                f"{seconds:.2f}",
                kept,
                f"{spearmanr(1 - judgement.clean, worst).statistic:.2f}",
                f"{area_under_curve(1 - judgement.clean, worst > 0):.2f}",
                f"{np.mean(judgement.clean[worst == 0] > 0.5):.0%}",
                f"{np.mean(judgement.clean[worst >= 3] < 0.5):.0%}",
                f"{error[0]:.3f} ({error[1]:.3f})",
                "" if np.isnan(pixels[0]) else f"{pixels[0]:.2f} ({pixels[1]:.2f})",
            ]
        else:
            row += ["?", f"{seconds:.2f}", kept, *[""] * 6]
        print(f"| {' | '.join(row)} |", flush=True)
        if args.pictures:
            draw(capture, given, judgement, args.pictures)
    print(
        "\n| capture | perturbation | Spearman | mean error, levels |\n| --- | --- | ---: | ---: |"
    )
    print("\n".join(levels))


if __name__ == "__main__":
    main()
