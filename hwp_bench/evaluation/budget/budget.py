"""The error budget: what each truth and each correction would gain, in dB; runs and pictures."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any, Unpack

import numpy as np

from hwp_bench.analysis.columns import Filled, block_breaks, table_of
from hwp_bench.base.drawing import PAPER, error_map, fitted, labelled, sheet
from hwp_bench.base.errors import UsageError
from hwp_bench.base.images import as_uint8
from hwp_bench.base.tables import Column, Table
from hwp_bench.capture import Capture, open_capture
from hwp_bench.capture.splits import Split
from hwp_bench.evaluation.budget.corrections import CORRECTIONS
from hwp_bench.evaluation.budget.surface import NAME as CEILING
from hwp_bench.evaluation.budget.surface import TEXT as CEILING_TEXT
from hwp_bench.evaluation.budget.surface import Ceiling, Pair, error_of, pairs_of
from hwp_bench.evaluation.capture_evaluation import EvaluationSettings
from hwp_bench.evaluation.evaluate import How, OnCapture, check_call, evaluate
from hwp_bench.methods.contract import FRAME_CHOICES
from hwp_bench.methods.manifest import find_method, read_manifest
from hwp_bench.methods.request import ORACLE_INPUTS, frame_choice, known_oracle_inputs
from hwp_bench.metrics.pixels import decibels
from hwp_bench.metrics.protocol import PSNR_CAP
from hwp_bench.results import CaptureResult, Results
from hwp_bench.sim.produce.truth import add_subject_mesh

#: Name of the evaluation in which nothing is replaced, and of that in which everything is.
GIVEN, ALL = "as given", "all of them"
#: Version of the budget file.
SCHEMA = "hwp-budget/1"
# Rows that contain others.
_SUMS = (ALL, "motion+light", "gain map")
# Larger side of a tile, px, and pixels around the hand.
_EDGE, _MARGIN = 176, 4


@dataclass(frozen=True, eq=False)
class BudgetRuns:
    """The evaluations of an error budget."""

    captures: tuple[Capture, ...]
    #: Results by what the truth replaced: `GIVEN`, names in `ORACLE_INPUTS`, `ALL`.
    results: Mapping[str, Results]
    folders: Mapping[str, Path]


def run_budget(
    method: str,
    captures: Sequence[Path],
    out: Path,
    settings: EvaluationSettings,
    truths: Sequence[str] = tuple(ORACLE_INPUTS),
    *,
    splits: Mapping[str, Split] | None = None,
    on_run: Callable[[int, int, str], OnCapture | None] | None = None,
    **how: Unpack[How],
) -> BudgetRuns:
    """Evaluate a method as it is, with each truth in place of an estimate, and with all of them.

    What is on disk from an earlier start is taken as it is.
    """
    check_oracle_inputs(truths, settings)
    opened = tuple(open_capture(path) for path in captures)
    if "mesh" in truths:
        # Captures that were rendered before it was stored get it from their scene.
        for capture in opened:
            add_subject_mesh(capture)
    variants = plan_variants([known_oracle_inputs(capture) for capture in opened], truths)
    calls = {
        name: replace(settings, run=replace(settings.run, frames=frame_choice(replaced)))
        for name, replaced in variants.items()
    }
    folders = {name: out / "runs" / name.replace(" ", "-") for name in variants}
    manifest = read_manifest(find_method(method))
    for name, call in calls.items():
        # Before the first fit: what the last variant would be refused for.
        check_call(manifest, call, folders[name], overwrite=how.get("overwrite", False))
    results = {}
    for index, (name, call) in enumerate(calls.items()):
        results[name] = evaluate(
            method,
            captures,
            folders[name],
            call,
            splits=splits,
            on_capture=on_run(index, len(variants), name) if on_run else None,
            **how,
        )
        # The method is made once, before the first capture of the first run.
        how["rehearse"] = False
    return BudgetRuns(opened, results, folders)


def check_oracle_inputs(truths: Sequence[str], settings: EvaluationSettings) -> None:
    """Refuse what no error budget is made of."""
    if settings.run.frames != FRAME_CHOICES[0]:
        raise UsageError(
            f"{settings.run.frames!r} is an oracle itself",
            field="--train-on",
            remedy="Leave it out.",
        )
    unknown = sorted(set(truths) - set(ORACLE_INPUTS))
    if unknown:
        raise UsageError(
            f"{unknown[0]!r} is not an estimate",
            field="--truths",
            remedy=f"Known: {', '.join(ORACLE_INPUTS)}.",
        )


def plan_variants(
    known: Sequence[Sequence[str]], truths: Sequence[str]
) -> dict[str, tuple[str, ...]]:
    """The estimates that the truth replaces in each evaluation, by its name."""
    common = [
        name for name in ORACLE_INPUTS if name in truths and all(name in one for one in known)
    ]
    variants: dict[str, tuple[str, ...]] = {GIVEN: ()}
    variants |= {name: (name,) for name in common}
    if len(common) > 1:
        variants[ALL] = tuple(common)
    return variants


# --- the budget


@dataclass(frozen=True)
class BudgetRow:
    """One thing that was replaced or corrected."""

    #: `truth` (before fitting), `correction` (of the rendered test frames) or `ceiling` (an avatar
    #: without an error of its own).
    kind: str
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
class ErrorBudget:
    """An error budget."""

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


def make_budget(runs: BudgetRuns) -> ErrorBudget:
    """Compute the budget of finished evaluations.

    Frames that the method left out keep the protocol's penalty in every row.
    """
    psnr = {
        variant: {capture.id: _psnr(capture) for capture in result.captures}
        for variant, result in runs.results.items()
    }
    base, given = psnr.pop(GIVEN), runs.results[GIVEN]
    corrected: dict[str, dict[str, float]] = {name: {} for name in CORRECTIONS}
    shown, ceilings = {}, {}
    for capture, found in zip(runs.captures, given.captures, strict=True):
        scores = {frame.frame: frame.scores["psnr"] for frame in found.frames}
        gains: dict[str, list[float]] = {name: [] for name in CORRECTIONS}
        folder = runs.folders[GIVEN] / "captures" / found.id / "predictions"
        ceiling, most = Ceiling.of(capture), []
        for frame, pair in pairs_of(capture, folder, list(scores)):
            for name, (correct, _) in CORRECTIONS.items():
                better = 0.0 if pair is None else measure_gain(correct(pair), pair)
                gains[name].append(scores[frame] + better)
            if ceiling is not None:
                most.append(ceiling.psnr(frame, pair, scores[frame]))
        for name, values in gains.items():
            corrected[name][found.id] = float(np.mean(values))
        if ceiling is not None:
            ceilings[found.id] = float(np.mean(most))
        order = sorted(scores, key=lambda frame: (scores[frame], frame))
        shown[found.id] = order[len(order) // 2]
    parts = [
        ("truth", name, ORACLE_INPUTS.get(name, "all truths above"), psnr[name]) for name in psnr
    ]
    parts += [("correction", n, text, corrected[n]) for n, (_, text) in CORRECTIONS.items()]
    if len(ceilings) == len(base):
        parts.append(("ceiling", CEILING, CEILING_TEXT, ceilings))
    rows = [
        BudgetRow(kind, name, text, table, {key: table[key] - base[key] for key in table})
        for kind, name, text, table in parts
    ]
    return ErrorBudget(given.method.title, base, tuple(rows), shown)


def measure_gain(image: np.ndarray, pair: Pair) -> float:
    """Gain of an image (H, W, 3) in place of the prediction, dB; 0 where it is not better."""
    return max(0.0, decibels(error_of(image, pair)) - decibels(pair.error))


def next_work(budget: ErrorBudget) -> str:
    """One sentence for people: the truth and the correction that would gain most."""
    parts = []
    for kind, text in (("truth", "before fitting"), ("correction", "in the rendered frames")):
        rows = [row for row in budget.rows if row.kind == kind and row.name not in _SUMS]
        if rows:
            most = max(rows, key=lambda row: row.mean_gain)
            parts.append(f"{text}: {most.name} ({most.mean_gain:+.2f} dB)")
    return f"Most is lost {'; '.join(parts)}."


# --- tables


def budget_tables(budget: ErrorBudget) -> dict[str, Table]:
    """The tables `budget` (means over captures) and `captures` (gain on each)."""
    count, rows = len(budget.psnr), budget.rows
    gains = [list(row.gain.values()) for row in rows]
    base = float(np.mean(list(budget.psnr.values())))
    columns: list[Filled] = [
        (Column("Replaced or corrected"), [GIVEN, *(row.name for row in rows)]),
        (Column("By"), ["", *(row.text for row in rows)]),
        (Column("PSNR [dB]", 2), [base, *(float(np.mean([*row.psnr.values()])) for row in rows)]),
        (Column("Gain [dB]", 2), [None, *(row.mean_gain for row in rows)]),
    ]
    if count > 1:
        columns += [
            (Column("Least", 2), [None, *map(min, gains)]),
            (Column("Most", 2), [None, *map(max, gains)]),
        ]
    notes = [
        "Truths replace what the method is given before it fits; corrections are fitted to each "
        "rendered test frame and bound what that kind of error costs. Rows do not add up.",
        f"Means over {count} capture{'' if count == 1 else 's'}; least and most: of one capture.",
    ]
    if any(row.kind == "ceiling" for row in rows):
        text = "what is left then are errors of the given test poses alone."
        notes.insert(1, f"{CEILING.capitalize()}: {text}")
    title = f"Error budget of {budget.method}"
    breaks = block_breaks(["given", *(row.kind for row in rows)])
    by_capture: list[Filled] = [
        (Column("Capture"), list(budget.psnr)),
        (Column("PSNR [dB]", 2), list(budget.psnr.values())),
        *(
            (Column(row.name, 2, group="Gain [dB]"), [row.gain[name] for name in budget.psnr])
            for row in rows
        ),
    ]
    return {
        "budget": table_of(title, columns, notes, ranked=False, breaks=breaks),
        "captures": table_of(f"{title}, by capture", by_capture, ranked=False),
    }


def _psnr(capture: CaptureResult) -> float:
    return float(np.mean([min(frame.scores["psnr"], PSNR_CAP) for frame in capture.frames]))


# --- the picture: a test frame of each capture with every truth and correction


def budget_sheet(runs: BudgetRuns, budget: ErrorBudget) -> np.ndarray:
    """Draw two rows for each capture, with PSNR over the tiles.

    The first has the truth, the method as it is, and the method with each truth; the second the
    error of the method as it is, and its corrections.
    """
    columns = 1 + max(len(runs.results), len(CORRECTIONS))
    tiles: list[np.ndarray] = []
    for capture in runs.captures:
        name = capture.info.id
        frame = budget.shown[name]
        pairs = {
            variant: next(pairs_of(capture, folder / "captures" / name / "predictions", [frame]))[1]
            for variant, folder in runs.folders.items()
        }
        for row in _rows(f"{name} {frame}", pairs):
            tiles += [*row, *[_blank("")] * (columns - len(row))]
    return sheet(tiles, columns)


def _rows(title: str, pairs: Mapping[str, Pair | None]) -> list[list[np.ndarray]]:
    sound = next((pair for pair in pairs.values() if pair is not None), None)
    first = [_blank(f"{title} failed") if sound is None else _tile(sound.target, sound, title)]
    for name, pair in pairs.items():
        first.append(_blank(f"{name} failed") if pair is None else _scored(name, pair, None))
    given = pairs[GIVEN]
    if given is None:
        return [first, [_blank(f"{GIVEN} failed")]]
    wrong = error_map(as_uint8(given.prediction), as_uint8(given.target), given.region)
    second = [_tile(wrong / 255.0, given, f"error {GIVEN}")]
    second += [_scored(name, given, correct(given)) for name, (correct, _) in CORRECTIONS.items()]
    return [first, second]


def _scored(name: str, pair: Pair, image: np.ndarray | None) -> np.ndarray:
    shown = pair.prediction if image is None else image
    return _tile(shown, pair, f"{name} {decibels(error_of(shown, pair)):.1f}")


def _tile(image: np.ndarray, pair: Pair, text: str) -> np.ndarray:
    """The hand's square of an image (H, W, 3) in [0, 1], black around the scored pixels."""
    shown = as_uint8(np.clip(image, 0.0, 1.0) * pair.region[..., None])
    rows, columns = np.nonzero(pair.region)
    half = int(max(np.ptp(rows), np.ptp(columns))) // 2 + _MARGIN
    top, left = int(rows.min() + rows.max()) // 2, int(columns.min() + columns.max()) // 2
    padded = np.pad(shown, ((half, half), (half, half), (0, 0)))
    return labelled(fitted(padded[top : top + 2 * half, left : left + 2 * half], _EDGE), text)


def _blank(text: str) -> np.ndarray:
    return labelled(np.full((_EDGE, _EDGE, 3), PAPER, dtype=np.uint8), text)
