"""Evaluations of captures as jobs of an engine."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path

from hwp_bench.base.errors import HwpError
from hwp_bench.base.packages import PACKAGES
from hwp_bench.capture import open_capture
from hwp_bench.capture.layout import EXTRA
from hwp_bench.evaluate.capture_run import Job, evaluate_capture, stored_result
from hwp_bench.methods.manifest import read_manifest
from hwp_bench.metrics.lpips_weights import load_available
from hwp_bench.run.engine import Folder, Needs
from hwp_bench.run.engine import Job as EngineJob
from hwp_bench.run.engine.job import OnProgress


@dataclass(frozen=True)
class EvaluateCapture:
    """Evaluates a method on a capture, in any process on any machine."""

    #: The job, with nothing in it that is of one machine.
    job: Job
    #: What its key was where it was ordered; here it must be the same.
    key: str
    #: Where a method that ships with the toolkit lies in it; None where the method is sent.
    shipped: str | None
    #: Backbones of LPIPS that are scored.
    networks: tuple[str, ...]

    def __call__(self, inputs: Mapping[str, Path], output: Path, on_progress: OnProgress) -> None:
        """Evaluate; see `hwp_bench.run.engine.job.Work`.

        Raises:
            HwpError: method, capture, weights or protocols are others here.
        """
        known = load_available() if self.networks else {}
        missing = [name for name in self.networks if name not in known]
        if missing:
            raise HwpError(
                f"the weights of LPIPS ({', '.join(missing)}) are not on this machine",
                remedy="Put them on every node, or on none.",
            )
        method = inputs["method"] if self.shipped is None else PACKAGES / self.shipped
        job = replace(
            self.job,
            manifest=read_manifest(method),
            capture=open_capture(inputs["capture"]),
            networks={name: known[name] for name in self.networks},
        )
        if job.key != self.key:
            raise HwpError(
                "method, capture or protocols are others on this machine",
                where=job.capture.info.id,
                remedy="Install the same version everywhere, and change nothing while jobs run.",
            )
        evaluate_capture(job, output, on_progress)


def evaluation_job(job: Job, folder: Path, text: str, needs: Needs) -> EngineJob:
    """Return the evaluation of one capture as a job of an engine.

    Args:
        job: the evaluation.
        folder: where its result goes.
        text: what a person is shown.
        needs: what it takes of a machine.
    """
    root = job.manifest.root.resolve()
    shipped = root.relative_to(PACKAGES).as_posix() if root.is_relative_to(PACKAGES) else None
    inputs = {"capture": Folder(job.capture.root, (EXTRA,))}
    if shipped is None:
        inputs["method"] = Folder(root)
    bare = replace(job, manifest=None, capture=None, networks={})  # type: ignore[arg-type]

    def here(on_progress: OnProgress) -> None:
        evaluate_capture(job, folder, on_progress)

    return EngineJob(
        text=text,
        here=here,
        work=EvaluateCapture(bare, job.key, shipped, tuple(sorted(job.networks))),
        output=folder,
        finished=lambda: stored_result(job, folder) is not None,
        inputs=inputs,
        needs=needs,
    )
