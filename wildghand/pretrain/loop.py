"""The loop of a joint fit."""

from __future__ import annotations

from collections.abc import Callable

from hwp_bench.base.progress import notice
from wildghand.fit.optimise import Watchers
from wildghand.pretrain.joint import JointFit


def take_steps(
    joint: JointFit,
    steps: int,
    watchers: Watchers,
    *,
    start: int = 0,
    after_step: Callable[[int], None] | None = None,
) -> int:
    """Take steps until all are taken, the loss stands still, or the fit diverges.

    Args:
        joint: what is fitted.
        steps: how many, those before `start` included.
        watchers: of the loss, so far.
        start: steps that `joint` has behind it.
        after_step: called with the number of steps after each; saves, for instance.

    Returns:
        Steps behind the state of `joint`: the last one, or the best one if the fit diverged.

    Raises:
        DidNotConverge: the fit diverged without ever having been better than its start.
    """
    joint.skip(start)
    for step in range(start, steps):
        loss = joint.step(step / steps)
        if not watchers.guard.watch(step, loss, joint):
            joint.restore(watchers.guard.best())
            kept = watchers.guard.step
            notice(f"The fit diverged at step {step}; the state of step {kept} is kept.")
            return kept
        if after_step is not None:
            after_step(step + 1)
        if watchers.plateau.reached(loss):
            notice(f"The loss stands still after {step + 1} steps; finished early.")
            return step + 1
    return steps
