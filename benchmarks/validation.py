"""Scores of a method's settings on validation frames: what a baseline is tuned with.

Run from the repository, with a `--set` for each row:
`python -m benchmarks.validation baselines/trimmed --captures wild-dev-0 --set patch=false`
fits each capture with the preset, and once more with each `--set`, and prints mean PSNR over the
validation frames. Test frames are neither read nor rendered.
"""

from __future__ import annotations

import argparse
import tempfile
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from hwp_bench.capture import open_capture
from hwp_bench.capture.splits import contiguous_split
from hwp_bench.cli.options import overrides
from hwp_bench.evaluation.scoring import Prediction, mean_scores, read_targets, score_predictions
from hwp_bench.methods import find_method, read_manifest
from hwp_bench.methods.contract import Avatar, Budget, RunSettings
from hwp_bench.methods.request import open_request, write_request
from hwp_bench.run.worker import load_entry, render
from hwp_bench.sim.produce.capture import ensure_suite, suite


class _Quiet:
    """A report that keeps nothing."""

    elapsed = 0.0

    def __call__(self, step: int, avatar: Avatar) -> None:
        """Do nothing."""

    def progress(self, done: int, total: int) -> None:
        """Do nothing."""


def validation_score(
    method: str, capture: Path, settings: Mapping[str, Any], steps: int, seed: int
) -> float:
    """Fit a method to the training frames of a capture, and score its validation frames.

    Args:
        method: its folder, or its name.
        capture: a capture folder.
        settings: all that differ from the defaults.
        steps: optimizer steps.
        seed: of everything random.

    Returns:
        mean PSNR over the validation frames, dB, by the protocol's mask.
    """
    folder = find_method(method)
    opened, budget = open_capture(capture), Budget(steps=steps)
    split = contiguous_split(opened.info.id, opened.info.frame_count)
    with tempfile.TemporaryDirectory() as place:
        run = RunSettings(settings, seed, budget)
        training = open_request(write_request(Path(place) / "request", opened, split, run))
        entry = load_entry(folder, str(read_manifest(folder).entry.python))
        avatar = entry(training.run.settings, seed).fit(training, budget, _Quiet())
        frames = split.validation.tolist()
        made = [Prediction(frame, render(avatar, training, frame), None) for frame in frames]
    return mean_scores(score_predictions(read_targets(opened, frames), made))["psnr"]


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("method", help="method directory, or the name of a shipped method")
    parser.add_argument("--suite", default="wild-dev", help="where the captures are from")
    parser.add_argument("--captures", nargs="+", required=True, help="their names")
    parser.add_argument("--preset", default="mini")
    parser.add_argument("--steps", type=int, default=400)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument(
        "--set", action="append", default=[], help="NAME=VALUE,...: one more row of the table"
    )
    arguments = parser.parse_args()
    items = [item for item in suite(arguments.suite) if item.scene.id in arguments.captures]
    captures = ensure_suite(items, free_view=False)
    preset = read_manifest(find_method(arguments.method)).presets[arguments.preset]
    print("| settings |", " | ".join(item.scene.id for item in items), "| mean |")
    print("| --- |" + " ---: |" * (len(items) + 1), flush=True)
    for text in ["", *arguments.set]:
        settings = {**preset, **overrides(text.split(",") if text else [])}
        scores = [
            validation_score(arguments.method, path, settings, arguments.steps, arguments.seed)
            for path in captures
        ]
        cells = " | ".join(f"{score:.2f}" for score in (*scores, float(np.mean(scores))))
        print(f"| {text.replace(',', ' ') or 'preset'} | {cells} |", flush=True)


if __name__ == "__main__":
    main()
