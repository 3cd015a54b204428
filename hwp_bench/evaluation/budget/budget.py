"""The error budget: what each truth and each correction would gain, in dB."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np

from hwp_bench.base.tables import Column, Table
from hwp_bench.evaluation.budget.ceiling import NAME as CEILING
from hwp_bench.evaluation.budget.ceiling import TEXT as CEILING_TEXT
from hwp_bench.evaluation.budget.ceiling import Ceiling
from hwp_bench.evaluation.budget.corrections import CORRECTIONS
from hwp_bench.evaluation.budget.frames import pairs_of
from hwp_bench.evaluation.budget.pair import Pair, error_of
from hwp_bench.evaluation.budget.runs import ALL, GIVEN, BudgetRuns
from hwp_bench.methods.material import TRUTHS
from hwp_bench.metrics.pixels import decibels
from hwp_bench.metrics.protocol import PSNR_CAP
from hwp_bench.results import CaptureResult

#: Version of the budget file.
SCHEMA = "hwp-budget/1"


@dataclass(frozen=True)
class BudgetRow:
    """One thing that was replaced or corrected."""

    #: `truth` (before fitting), `correction` (of the rendered test frames) or `ceiling` (an avatar
    #: without an error of its own).
    kind: str
    #: Its name.
    name: str
    #: What that means, for people.
    text: str
    #: PSNR by capture, dB: mean over its test frames.
    psnr: Mapping[str, float]
    #: The same less that of the method as it is.
    gain: Mapping[str, float]

    @property
    def mean_gain(self) -> float:
        """Mean of the gain over captures, dB."""
        return float(np.mean(list(self.gain.values())))


@dataclass(frozen=True)
class Budget:
    """An error budget."""

    #: Title of the method.
    method: str
    #: PSNR of the method as it is by capture, dB.
    psnr: Mapping[str, float]
    #: Truths first, then corrections.
    rows: tuple[BudgetRow, ...]
    #: Test frame by capture that a picture shows: the one of the median error.
    shown: Mapping[str, int]

    def to_json(self) -> dict[str, Any]:
        """The content as JSON values."""
        return {"schema": SCHEMA, **asdict(self)}


def make_budget(runs: BudgetRuns) -> Budget:
    """Compute the budget of finished evaluations.

    Frames that the method left out keep the protocol's penalty in every row.
    """
    given = runs.results[GIVEN]
    base = {capture.id: _psnr(capture) for capture in given.captures}
    rows = []
    for name, result in runs.results.items():
        if name != GIVEN:
            psnr = {capture.id: _psnr(capture) for capture in result.captures}
            rows.append(_row("truth", name, TRUTHS.get(name, "all truths above"), psnr, base))
    corrected: dict[str, dict[str, float]] = {name: {} for name in CORRECTIONS}
    shown, ceilings = {}, {}
    for capture, found in zip(runs.captures, given.captures, strict=True):
        scores = {frame.frame: frame.scores["psnr"] for frame in found.frames}
        gains: dict[str, list[float]] = {name: [] for name in CORRECTIONS}
        folder = runs.folders[GIVEN] / "captures" / found.id / "predictions"
        ceiling, most = Ceiling.of(capture), []
        for frame, pair in pairs_of(capture, folder, list(scores)):
            for name, (correct, _) in CORRECTIONS.items():
                better = 0.0 if pair is None else gained(correct(pair), pair)
                gains[name].append(scores[frame] + better)
            if ceiling is not None:
                most.append(ceiling.psnr(frame, pair, scores[frame]))
        for name, values in gains.items():
            corrected[name][found.id] = float(np.mean(values))
        if ceiling is not None:
            ceilings[found.id] = float(np.mean(most))
        order = sorted(scores, key=lambda frame: (scores[frame], frame))
        shown[found.id] = order[len(order) // 2]
    rows += [
        _row("correction", name, text, corrected[name], base)
        for name, (_, text) in CORRECTIONS.items()
    ]
    if len(ceilings) == len(base):
        rows.append(_row("ceiling", CEILING, CEILING_TEXT, ceilings, base))
    return Budget(given.method.title, base, tuple(rows), shown)


def gained(image: np.ndarray, pair: Pair) -> float:
    """Gain of an image (H, W, 3) in place of the prediction, dB; 0 where it is not better."""
    return max(0.0, decibels(error_of(image, pair)) - decibels(pair.error))


def next_work(budget: Budget) -> str:
    """One sentence for people: the truth and the correction that would gain most."""
    parts = []
    for kind, text in (("truth", "before fitting"), ("correction", "in the rendered frames")):
        rows = [row for row in budget.rows if row.kind == kind and row.name not in _SUMS]
        if rows:
            most = max(rows, key=lambda row: row.mean_gain)
            parts.append(f"{text}: {most.name} ({most.mean_gain:+.2f} dB)")
    return f"Most is lost {'; '.join(parts)}."


# Rows that contain others.
_SUMS = (ALL, "motion+light", "gain map")


def budget_tables(budget: Budget) -> dict[str, Table]:
    """The tables `budget` (means over captures) and `captures` (gain on each)."""
    count = len(budget.psnr)
    columns = [
        Column("Replaced or corrected"),
        Column("By"),
        Column("PSNR [dB]", 2),
        Column("Gain [dB]", 2),
        *([Column("Least", 2), Column("Most", 2)] if count > 1 else []),
    ]
    means = [float(np.mean(list(budget.psnr.values())))]
    rows: list[tuple[Any, ...]] = [
        (GIVEN, "", means[0], None, *((None, None) if count > 1 else ()))
    ]
    breaks = []
    for index, row in enumerate(budget.rows):
        if index == 0 or budget.rows[index - 1].kind != row.kind:
            breaks.append(len(rows))
        gains = list(row.gain.values())
        spread = (min(gains), max(gains)) if count > 1 else ()
        psnr = float(np.mean(list(row.psnr.values())))
        rows.append((row.name, row.text, psnr, row.mean_gain, *spread))
    notes = (
        "Truths replace what the method is given before it fits; corrections are fitted to each "
        "rendered test frame and bound what that kind of error costs. Rows do not add up.",
        *(
            [f"{CEILING.capitalize()}: what is left then are errors of the given test poses alone."]
            if any(row.kind == "ceiling" for row in budget.rows)
            else []
        ),
        f"Means over {count} capture{'' if count == 1 else 's'}; least and most: of one capture.",
    )
    names = [row.name for row in budget.rows]
    captures: list[tuple[Any, ...]] = [
        (capture, value, *(row.gain[capture] for row in budget.rows))
        for capture, value in budget.psnr.items()
    ]
    by_capture = (
        Column("Capture"),
        Column("PSNR [dB]", 2),
        *(Column(name, 2, group="Gain [dB]") for name in names),
    )
    title = f"Error budget of {budget.method}"
    return {
        "budget": Table(title, tuple(columns), tuple(rows), notes, False, tuple(breaks)),
        "captures": Table(f"{title}, by capture", by_capture, tuple(captures), ranked=False),
    }


def _row(
    kind: str, name: str, text: str, psnr: Mapping[str, float], base: Mapping[str, float]
) -> BudgetRow:
    return BudgetRow(kind, name, text, psnr, {key: psnr[key] - base[key] for key in psnr})


def _psnr(capture: CaptureResult) -> float:
    return float(np.mean([min(frame.scores["psnr"], PSNR_CAP) for frame in capture.frames]))
