"""Command-line arguments that say where jobs run. Imports nothing heavy."""

from __future__ import annotations

import argparse

from hwp_bench.base.errors import UsageError
from hwp_bench.run.engine.job import Engine, LocalEngine, Needs


def add_engine_arguments(parser: argparse.ArgumentParser) -> None:
    """Add `--engine`, `--jobs`, `--job-cpus` and `--job-gpus`."""
    group = parser.add_argument_group("where jobs run")
    group.add_argument(
        "--engine",
        default="local",
        metavar="local|ray[://HOST:PORT]",
        help="this machine (default), or a Ray cluster (docs/cluster.md)",
    )
    group.add_argument(
        "--jobs",
        type=int,
        default=1,
        metavar="N",
        help="jobs at once on this machine (default 1: each has all of it); Ray counts itself",
    )
    group.add_argument(
        "--job-cpus",
        type=float,
        default=1.0,
        metavar="N",
        help="processors, and threads, of a job where several run at once (default 1)",
    )
    group.add_argument(
        "--job-gpus",
        type=float,
        default=0.0,
        metavar="N",
        help="GPUs of a job where several run at once; a fraction shares one (default 0)",
    )


def engine_for(args: argparse.Namespace) -> Engine:
    """Return the engine that was asked for; nothing is started yet."""
    kind, separator, address = args.engine.partition("://")
    if kind not in ("local", "ray") or (separator and (kind == "local" or not address)):
        raise UsageError(
            f"{args.engine!r} is not an engine",
            field="--engine",
            remedy="Use local, ray, or ray://HOST:PORT.",
        )
    if not 1 <= args.jobs <= 1024:
        raise UsageError(f"{args.jobs} is not between 1 and 1024", field="--jobs")
    if not 0 < args.job_cpus <= 1024:
        raise UsageError(f"{args.job_cpus} is not above 0 and up to 1024", field="--job-cpus")
    if not 0 <= args.job_gpus <= 64:
        raise UsageError(f"{args.job_gpus} is not between 0 and 64", field="--job-gpus")
    if kind == "ray":
        if args.jobs != 1:
            raise UsageError(
                "works only with --engine local",
                field="--jobs",
                remedy="On a cluster --job-cpus and --job-gpus say how many jobs a node takes.",
            )
        from hwp_bench.run.engine.ray import import_ray

        import_ray()
        from hwp_bench.base.console import JobsView
        from hwp_bench.run.engine.ray import RayEngine

        return RayEngine(address or None, JobsView())
    if args.jobs > 1:
        from hwp_bench.base.console import JobsView
        from hwp_bench.run.engine.processes import ParallelEngine

        return ParallelEngine(args.jobs, JobsView())
    return LocalEngine()


def needs_of(args: argparse.Namespace) -> Needs:
    """Return the share of a machine that one job takes."""
    return Needs(args.job_cpus, args.job_gpus)
