"""Results of a whole suite made of numbers, fit for the leaderboard."""

from __future__ import annotations

import json
from collections.abc import Callable, Sequence
from dataclasses import replace

from small_captures import results_example

from hwp_bench.capture.splits import split_for
from hwp_bench.evaluation.capture_evaluation import key_of
from hwp_bench.leaderboard.entries import Check, Entry
from hwp_bench.leaderboard.site import board_page, shown_rows
from hwp_bench.leaderboard.suite_data import read_suite_data, suite_origins
from hwp_bench.metrics import PROTOCOLS, metric_names
from hwp_bench.results import FrameResult, Results
from hwp_bench.suites.suite import suite

#: Scores of the metrics that tests say nothing about.
OTHER_SCORES = dict.fromkeys(metric_names(), 0.5)


def complete_results(
    name: str = "plain",
    score: float | Callable[[int, int], float] = 20.0,
    *,
    suite_name: str = "smoke",
    **changes: object,
) -> Results:
    """An evaluation of a method on every capture and test frame of a suite.

    Args:
        name: of the method.
        score: PSNR of every frame, or a function of capture and frame number.
        suite_name: the suite.
        changes: fields of the results to replace.
    """
    base = results_example(name)
    captures = []
    known = read_suite_data().suites.get(suite_name)
    origins = suite_origins(suite_name)
    for number, item in enumerate(suite(suite_name)):
        split = split_for(item.id, item.frame_count)
        frames = [
            FrameResult(
                frame,
                {
                    **OTHER_SCORES,
                    "psnr": score(number, frame) if callable(score) else score,
                    "ssim": 0.5,
                    "oriented_distance": 0.01,
                },
                None,
            )
            for frame in split.test.tolist()
        ]
        captures.append(
            replace(
                base.captures[0],
                id=item.id,
                digest=known[item.id].versions[0].digest if known else "e" * 64,
                origin=origins.get(item.id),
                exact_masks=item.exact_masks,
                hands=item.hands,
                perturbations=list(item.perturbations),
                split_digest=split.digest,
                frames=frames,
            )
        )
    protocols = json.loads(json.dumps({p.name: p.as_dict() for p in PROTOCOLS}))
    given = {"suite": suite_name, "captures": captures, "protocols": protocols, **changes}
    return with_keys(replace(base, **given))


def with_keys(results: Results) -> Results:
    """Results whose captures have the keys that an evaluation would have given them."""
    captures = [replace(c, key=key_of(results, c, None)) for c in results.captures]
    return replace(results, captures=captures)


def check_of(entry: Entry, kind: str = "rescored", verdict: str = "reproduces") -> Check:
    """A check of an entry, as `dev leaderboard confirm` would make it."""
    second = kind == "re-run"
    return Check(
        entry=entry.name,
        entry_digest=entry.digest,
        kind=kind,  # type: ignore[arg-type]
        verdict=verdict,  # type: ignore[arg-type]
        date="2026-01-01T00:00:00+00:00",
        by="us",
        toolkit="0.1.0",
        code="c",
        machine="m",
        frames=1,
        cross_checked=1,
        differences=0 if second or verdict == "reproduces" else 1,
        rerun="0" * 64 if second else None,
        scores=rerun_scores(entry, verdict) if second else {},
        tolerance=0.1 if second else 0.0,
    )


def rerun_scores(entry: Entry, verdict: str) -> dict[str, float]:
    """Scores of a second run that reproduces an entry, or differs by 1 dB."""
    psnr = entry.results.scores["psnr"]
    return {"psnr": psnr if verdict == "reproduces" else psnr + 1}


def page_of(entries: Sequence[Entry]) -> str:
    """The page of the board alone: without pictures, and its rows lead to reports."""
    return board_page(shown_rows(entries), pictures=False, pages={})
