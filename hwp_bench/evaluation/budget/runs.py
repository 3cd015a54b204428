"""The evaluations that an error budget is made of: a method with one truth after another."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

from hwp_bench.base.errors import UsageError
from hwp_bench.capture import Capture, open_capture
from hwp_bench.capture.splits import Split
from hwp_bench.evaluation.evaluate import EvaluationSettings, OnCapture, evaluate
from hwp_bench.methods.contract import FRAME_CHOICES
from hwp_bench.methods.material import TRUTHS, frames_with, known_truths
from hwp_bench.results import Results
from hwp_bench.run.engine import Engine, Needs
from hwp_bench.sim.produce.truth import add_subject_mesh

#: Name of the evaluation in which nothing is replaced, and of that in which everything is.
GIVEN, ALL = "as given", "all of them"


@dataclass(frozen=True, eq=False)
class BudgetRuns:
    """The evaluations of an error budget."""

    #: The captures, in order.
    captures: tuple[Capture, ...]
    #: Results by what the truth replaced: `GIVEN`, names in `TRUTHS`, `ALL`.
    results: Mapping[str, Results]
    #: Their folders by the same names.
    folders: Mapping[str, Path]


def run_budget(
    method: str,
    captures: Sequence[Path],
    out: Path,
    settings: EvaluationSettings,
    truths: Sequence[str] = tuple(TRUTHS),
    *,
    splits: Mapping[str, Split] | None = None,
    on_run: Callable[[int, int, str], OnCapture | None] | None = None,
    engine: Engine | None = None,
    needs: Needs | None = None,
    overwrite: bool = False,
    rehearse: bool = False,
) -> BudgetRuns:
    """Evaluate a method as it is, with each truth in place of an estimate, and with all of them.

    What is on disk from an earlier start is taken as it is.

    Args:
        method: method directory, or the name of one that ships with the toolkit.
        captures: capture folders.
        out: folder of the budget; each evaluation has one inside.
        settings: of every evaluation; its `run.frames` must be the first of `FRAME_CHOICES`.
        truths: names in `TRUTHS`. Those that a capture does not know are left out.
        splits: splits by capture id; None applies the 80/10/10 rule.
        on_run: called when an evaluation begins, with (index, count, what is replaced); returns
            the hook for its captures.
        engine: where captures are evaluated; one after another in this process if None.
        needs: the share of a machine that one capture takes.
        overwrite: results of other settings in `out` may be replaced, evaluation by evaluation.
        rehearse: make the method once before the first capture.

    Raises:
        UsageError: a truth has no such name, or the settings ask for other frames.
        BadMethod, BadCapture, BadInput, BadImage, BadSplit: as `evaluate`.
    """
    check_truths(truths, settings)
    opened = tuple(open_capture(path) for path in captures)
    if "mesh" in truths:
        # Captures that were rendered before it was stored get it from their scene.
        for capture in opened:
            add_subject_mesh(capture)
    variants = variants_of([known_truths(capture) for capture in opened], truths)
    results, folders = {}, {}
    for index, (name, replaced) in enumerate(variants.items()):
        folders[name] = out / "runs" / name.replace(" ", "-")
        results[name] = evaluate(
            method,
            captures,
            folders[name],
            replace(settings, run=replace(settings.run, frames=frames_with(replaced))),
            splits=splits,
            on_capture=on_run(index, len(variants), name) if on_run else None,
            engine=engine,
            needs=needs,
            overwrite=overwrite,
            rehearse=rehearse and index == 0,
        )
    return BudgetRuns(opened, results, folders)


def check_truths(truths: Sequence[str], settings: EvaluationSettings) -> None:
    """Refuse what no error budget is made of.

    Raises:
        UsageError: a truth has no such name, or the settings ask for other frames.
    """
    if settings.run.frames != FRAME_CHOICES[0]:
        raise UsageError(
            f"{settings.run.frames!r} is an oracle itself", field="--frames", remedy="Leave it out."
        )
    unknown = sorted(set(truths) - set(TRUTHS))
    if unknown:
        raise UsageError(
            f"{unknown[0]!r} is not an estimate",
            field="--truths",
            remedy=f"Known: {', '.join(TRUTHS)}.",
        )


def variants_of(
    known: Sequence[Sequence[str]], truths: Sequence[str]
) -> dict[str, tuple[str, ...]]:
    """The estimates that the truth replaces in each evaluation, by its name.

    Args:
        known: the truths that each capture knows.
        truths: those that are asked for.
    """
    common = [
        name for name in TRUTHS if name in truths and all(name in capture for capture in known)
    ]
    variants: dict[str, tuple[str, ...]] = {GIVEN: ()}
    variants |= {name: (name,) for name in common}
    if len(common) > 1:
        variants[ALL] = tuple(common)
    return variants
