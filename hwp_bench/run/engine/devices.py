"""Which GPUs a job may use when several run on one machine."""

from __future__ import annotations

import math
import os
from pathlib import Path

from hwp_bench.base.errors import UsageError
from hwp_bench.run.engine.job import Needs

#: Variable that says which GPUs a process sees.
VISIBLE = "CUDA_VISIBLE_DEVICES"


def visible_gpus() -> list[str]:
    """Return the GPUs that this process may use, as `CUDA_VISIBLE_DEVICES` names them."""
    if VISIBLE in os.environ:
        return [name.strip() for name in os.environ[VISIBLE].split(",") if name.strip()]
    # The driver's own list; asking it costs no import of a GPU library.
    cards = Path("/proc/driver/nvidia/gpus")
    return [str(number) for number, _ in enumerate(cards.iterdir())] if cards.is_dir() else []


def shares(jobs: int, needs: Needs, gpus: list[str]) -> list[dict[str, str]]:
    """Divide GPUs among jobs that run at once.

    Args:
        jobs: how many run at once.
        needs: of each; below one GPU several share one, above one it is rounded up.
        gpus: what there is.

    Returns:
        Environment variables for each place in the row of jobs; empty where no GPU is asked for,
        and the job then sees what this process sees.

    Raises:
        UsageError: there are too few.
    """
    if needs.gpus == 0:
        return [{} for _ in range(jobs)]
    each = 1 if needs.gpus <= 1 else math.ceil(needs.gpus)
    sharing = max(1, int(1 / needs.gpus + 1e-9))
    wanted = math.ceil(jobs / sharing) * each
    if wanted > len(gpus):
        raise UsageError(
            f"{jobs} jobs of {needs.gpus:g} GPUs at once need {wanted} GPUs, and there are "
            f"{len(gpus)}",
            field="--jobs",
            remedy="Run fewer at once, or give each a fraction of a GPU with --job-gpus.",
        )
    first = [slot // sharing * each for slot in range(jobs)]
    return [{VISIBLE: ",".join(gpus[start : start + each])} for start in first]
