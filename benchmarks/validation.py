"""Scores of a method's settings on validation frames: what a baseline is tuned with.

Run from the repository: `python -m benchmarks.validation trimmed wild` fits the captures that
`trials.toml` names for a baseline with its preset, and once more with each of the six trials there,
and prints mean PSNR over the validation frames; without a name all baselines have their turn. Other
rows are asked for like this:
`python -m benchmarks.validation trimmed --captures wild-dev-0 --set patch=false`.

With `--seconds` fits end after so many processor seconds. Each fit of a listed trial leaves a line
in `tuning.jsonl`, and is not made a second time; `hwp-bench dev docs-results` writes the tables of
`docs/studies/tuning.md` from it. Test frames are read with `--test` alone, which shows what a
setting brings: nothing is tuned by it, and nothing is kept.
"""

from __future__ import annotations

import argparse
import json
import os
import tempfile
import time
import tomllib
from collections.abc import Callable, Mapping
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import torch

from benchmarks.ratio_store import origin
from hwp_bench.base.errors import BadInput
from hwp_bench.base.records import merged
from hwp_bench.capture import open_capture
from hwp_bench.capture.splits import contiguous_split
from hwp_bench.cli.options import overrides
from hwp_bench.evaluation.evaluate import make_budget
from hwp_bench.evaluation.scoring import Prediction, read_targets, score_predictions
from hwp_bench.methods import find_method, read_manifest
from hwp_bench.methods.contract import Avatar, Budget, RunSettings
from hwp_bench.methods.request import open_request, write_request
from hwp_bench.metrics.score import mean_scores
from hwp_bench.run.worker import load_entry, render_checked
from hwp_bench.sim.produce.capture import ensure_suite, suite

#: The fits that were made, a JSON object a line.
LOG = Path(__file__).with_name("tuning.jsonl")


def read_trials() -> dict[str, dict[str, Any]]:
    """Captures, and texts of settings, by the name of a baseline."""
    return tomllib.loads(Path(__file__).with_name("trials.toml").read_text(encoding="utf-8"))


def tried_settings(
    preset: Mapping[str, Any], listed: Mapping[str, Any], trial: str
) -> dict[str, Any]:
    """Return the settings of a trial: a preset, what it had before tuning, and the trial's."""
    texts = [*listed.get("before", "").split(","), *trial.split(",")]
    return merged(preset, overrides([text for text in texts if text]))


class _Quiet:
    """A report that keeps nothing; its clock counts processor seconds."""

    def __init__(self) -> None:
        self._begun = time.process_time()

    @property
    def elapsed(self) -> float:
        """Processor seconds since it was made."""
        return time.process_time() - self._begun

    def __call__(self, step: int, avatar: Avatar) -> None:
        """Do nothing."""

    def progress(self, done: int, total: int) -> None:
        """Do nothing."""


def score_fit(
    method: str,
    capture: Path,
    settings: Mapping[str, Any],
    budget: Budget,
    seed: int,
    *,
    test: bool = False,
) -> float:
    """Fit a method to the training frames of a capture, and score its validation frames.

    Args:
        method: its folder, or its name.
        capture: a capture folder.
        settings: all that differ from the defaults.
        budget: in optimizer steps or processor seconds.
        seed: of everything random.
        test: score the test frames in place of these.

    Returns:
        mean PSNR over the frames, dB, by the protocol's mask.
    """
    folder = find_method(method)
    opened = open_capture(capture)
    split = contiguous_split(opened.info.id, opened.info.frame_count)
    with tempfile.TemporaryDirectory() as place:
        run = RunSettings(settings, seed, budget)
        training = open_request(write_request(Path(place) / "request", opened, split, run))
        entry = load_entry(folder, str(read_manifest(folder).entry.python))
        avatar = entry(training.run.settings, seed).fit(training, budget, _Quiet())
        frames = (split.test if test else split.validation).tolist()
        made = []
        for frame in frames:
            hands, camera = training.hand_poses(frame), training.camera(frame)
            image = render_checked(avatar, hands, camera, f"frame {frame}")
            made.append(Prediction(frame, image, None))
    scored = score_predictions(read_targets(opened, frames), made)
    return mean_scores(frame.scores for frame in scored)["psnr"]


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    text = "method directories, or names of baselines"
    parser.add_argument("methods", nargs="*", metavar="METHOD", help=f"{text} (default: all)")
    parser.add_argument("--suite", default="wild-dev", help="where the captures are from")
    parser.add_argument("--captures", nargs="+", help="their names (default: those of trials.toml)")
    parser.add_argument("--preset", default="smoke")
    parser.add_argument("--steps", type=int, default=400)
    parser.add_argument("--seconds", type=float, help="processor seconds of a fit, without --steps")
    parser.add_argument("--test", action="store_true", help="score test frames; never tune by it")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--log", type=Path, default=LOG, help="what is kept of each fit")
    parser.add_argument(
        "--set",
        action="append",
        help="NAME=VALUE,...: one row of the table, in place of the trials",
    )
    arguments = parser.parse_args()
    if arguments.seconds is not None:
        # Processor seconds are those of one core: a second thread would use up the budget.
        os.environ["OMP_NUM_THREADS"] = "1"
        torch.set_num_threads(1)
    for method in arguments.methods or read_trials():
        print_table(method, arguments)


def print_table(method: str, arguments: argparse.Namespace) -> None:
    """Print one row for the preset and for each trial of a method."""
    manifest = read_manifest(find_method(method))
    listed = read_trials().get(manifest.name, {"captures": [], "trials": []})
    names = arguments.captures or listed["captures"]
    trials = listed["trials"] if arguments.set is None else arguments.set
    items = [item for item in suite(arguments.suite) if item.scene.id in names]
    captures = ensure_suite(items, free_view=False)
    budget, limit = Budget(steps=arguments.steps), f"{arguments.steps} steps"
    if arguments.seconds is not None:
        budget = make_budget(arguments.seconds, None)
        limit = f"{arguments.seconds:g} processor seconds"
    preset = manifest.presets[arguments.preset]
    print(f"\n| {manifest.name} |", " | ".join(item.scene.id for item in items), "| mean |")
    print("| --- |" + " ---: |" * (len(items) + 1), flush=True)
    for text in ["", *trials]:
        # Rows of one's own differ from today's preset.
        before = listed if arguments.set is None else {}
        settings = tried_settings(preset, before, text)
        scores = []
        for path in captures:
            given = method, path, settings, budget, arguments.seed
            # A row of one's own starts from today's preset and is no trial of the study.
            if arguments.test or arguments.set is not None:
                scores.append(score_fit(*given, test=arguments.test))
                continue
            capture = open_capture(path)
            fit = {"method": manifest.name, "digest": manifest.digest, "trial": text}
            fit |= {"capture": capture.info.id, "data": capture.digest, "limit": limit}
            fit |= {"preset": arguments.preset, "seed": arguments.seed}
            scores.append(kept_score(arguments.log, fit, partial(score_fit, *given)))
        cells = " | ".join(f"{score:.2f}" for score in (*scores, float(np.mean(scores))))
        print(f"| {text.replace(',', ' ') or 'preset'} | {cells} |", flush=True)


def kept_score(log: Path, fit: Mapping[str, Any], make: Callable[[], float]) -> float:
    """Return the score of a fit from the log; one that is not there is made and kept."""
    for line in read_log(log):
        if fit.items() <= line.items():
            return float(line["score"])
    score = make()
    made = {"score": round(score, 4), **origin()}
    with log.open("a", encoding="utf-8") as stream:
        stream.write(json.dumps({**fit, **made}) + "\n")
    return score


def read_log(log: Path) -> list[dict[str, Any]]:
    """Return the fits of a log, the oldest first; none where there is no log."""
    lines = log.read_text("utf-8").splitlines() if log.is_file() else []
    try:
        return [json.loads(line) for line in lines]
    except json.JSONDecodeError as error:
        remedy = "Remove the line; its fit is made again."
        raise BadInput("holds a line that is not JSON", where=log, remedy=remedy) from error


if __name__ == "__main__":
    main()
