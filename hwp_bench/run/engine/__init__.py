"""Where jobs run: in this process, in processes beside it, or on a Ray cluster."""

from hwp_bench.run.engine.job import Engine, Folder, Job, Needs
from hwp_bench.run.engine.local import LocalEngine

__all__ = ["Engine", "Folder", "Job", "LocalEngine", "Needs"]
