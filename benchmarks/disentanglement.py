"""Do temporal weights follow the severity, and weight masks what is covered?

Run from the repository, after `hwp-bench evaluate wildghand` or `hwp-bench ablate`:
`python -m benchmarks.disentanglement RESULTS... --captures FOLDER... [--picture FILE]`, with
results folders and the simulated captures that they are of. The truth is read here and never by
the method.

For every capture: Spearman correlation over the training frames of |omega|, the largest among the
hands, with the true severity, the largest among the perturbations; mean |omega| of unperturbed
frames and of those of severity 3 to 5; and, in frames with objects, the area under the ROC curve
of the weight masks for visible against covered pixels of the hand, next to the estimated mask's.
Numbers are means over the results given, such as the seeds of a variant. The figure shows the
temporal weights of every capture over the true severity.
"""

from __future__ import annotations

import argparse
from pathlib import Path

import numpy as np
from scipy.stats import spearmanr

from benchmarks.prepass import covered_pixels, severities
from hwp_bench.base.files import read_json
from hwp_bench.base.images import read_gray
from hwp_bench.capture import Capture, open_capture


def temporal(folder: Path) -> tuple[np.ndarray, np.ndarray] | None:
    """Training frames (R,) and the largest |omega| among the hands (R,); None without them."""
    files = sorted(folder.glob("*-temporal.json"))
    if not files:
        return None
    read = [read_json(path) for path in files]
    weights = np.abs([record["weights"] for record in read]).max(axis=0)
    return np.array(read[0]["frames"]), weights


def stored_weights(folder: Path, frames: np.ndarray) -> dict[int, np.ndarray]:
    """The weight masks that a method left, by frame."""
    paths = {frame: folder / "weights" / f"{frame:06d}.png" for frame in frames.tolist()}
    return {frame: read_gray(path) for frame, path in paths.items() if path.is_file()}


def measure(folder: Path, capture: Capture) -> list[float]:
    """Correlation, mean |omega| of clean and of strong frames, both areas; nan where unknown."""
    course = temporal(folder)
    if course is None:
        return [float("nan")] * 5
    frames, weights = course
    severity = severities(capture, frames)
    worst = np.max(list(severity.values()), axis=0)
    objects = severity.get("hand_object_interaction", np.zeros_like(worst))
    return [
        float(spearmanr(weights, worst).statistic),
        float(weights[worst == 0].mean()),
        float(weights[worst >= 3].mean()),
        *covered_pixels(capture, stored_weights(folder, frames[objects > 0])),
    ]


def draw(results: list[Path], captures: list[Capture], path: Path) -> None:
    """Draw |omega| of every result over the true severity, a panel for each capture."""
    import matplotlib

    matplotlib.use("Agg")
    import matplotlib.pyplot as plt

    rows = -(-len(captures) // 2)
    figure, axes = plt.subplots(
        rows, 2, figsize=(10, 1.6 * rows), squeeze=False, sharex=True, layout="constrained"
    )
    for axis, capture in zip(axes.flat, captures, strict=False):
        course = None
        for result in results:
            course = temporal(result / "captures" / capture.info.id / "diagnostics")
            if course is not None:
                axis.plot(*course, color="tab:red", lw=0.9)
        axis.set_ylim(bottom=0.0)
        axis.set_title(capture.info.id, fontsize=8)
        if course is None:
            continue
        truth = axis.twinx()
        frames, bottom = course[0], np.zeros(len(course[0]))
        # Behind the lines; a frame takes its worst perturbation, as the table does.
        worst = np.max(list(severities(capture, frames).values()), axis=0)
        truth.fill_between(frames, bottom, worst, step="mid", color="0.85", lw=0)
        truth.set_ylim(0.0, 5.5)
        axis.set_zorder(truth.get_zorder() + 1)
        axis.patch.set_visible(False)
    figure.supylabel("|omega|, red, one line for each result", fontsize=8)
    figure.supxlabel("training frame; grey: true severity, 0 to 5", fontsize=8)
    figure.savefig(path, dpi=110)
    plt.close(figure)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.split("\n", maxsplit=1)[0])
    parser.add_argument("results", nargs="+", type=Path, help="results folders")
    parser.add_argument("--captures", nargs="+", type=Path, required=True, help="capture folders")
    parser.add_argument("--picture", type=Path, help="draw the temporal weights into this file")
    args = parser.parse_args()
    if args.picture:
        draw(args.results, [open_capture(path) for path in args.captures], args.picture)
    print(
        "| capture | Spearman | omega clean | omega severity 3-5 | pixel AUC | mask alone |\n"
        "| --- |" + " ---: |" * 5
    )
    for path in args.captures:
        capture = open_capture(path)
        rows = [
            measure(result / "captures" / capture.info.id / "diagnostics", capture)
            for result in args.results
        ]
        means = np.mean(rows, axis=0)
        cells = ["" if np.isnan(value) else f"{value:.2f}" for value in means]
        print(f"| {capture.info.id} | {' | '.join(cells)} |", flush=True)


if __name__ == "__main__":
    main()
