"""Where jobs run: in this process, in several processes, or on a Ray cluster."""

from hwp_bench.run.engine.job import Engine, Folder, Job, LocalEngine, Needs

__all__ = ["Engine", "Folder", "Job", "LocalEngine", "Needs"]
