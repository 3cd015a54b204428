"""`hwp-bench`: its commands."""

from __future__ import annotations

import sys
from collections.abc import Sequence

from hwp_bench.cli.program import Command, run_program

#: What `--help` lists, in the order of a person's work.
_PARTS = {
    "start": (
        *("demo", "new", "check-method", "evaluate", "table", "compare", "report", "verify"),
        "list",
    ),
    "data": (
        *("data get", "data import", "data track", "data check", "data show", "data inputs"),
        *("data convert", "data export"),
    ),
    "study": ("ablate", "error-budget", "curves"),
    "board": (
        *("leaderboard show", "leaderboard submit", "leaderboard check", "leaderboard confirm"),
        *("leaderboard build", "challenge make", "challenge publish", "challenge reveal"),
        "challenge check",
    ),
    "simulator": ("sim render", "sim preview"),
    "other": ("completion", "dev"),
}


def _leaves(module: str, summaries: dict[str, str]) -> dict[str, Command]:
    """Return the commands of a module in `hwp_bench/cli`, by name."""
    return {
        name: Command(text, f"hwp_bench.cli.{module}:{name}") for name, text in summaries.items()
    }


def command_tree() -> Command:
    """Return every command of `hwp-bench`."""
    methods = {
        "new": "write a method of your own that runs",
        "check-method": "run a method on a toy capture, say what is wrong",
    }
    runs = {
        "demo": "simulate two captures, fit two methods, score them",
        "evaluate": "run methods on captures and score them",
        "ablate": "measure gain and cost of components",
        "error-budget": "measure what each estimated input costs a method",
    }
    results = {
        "table": "print tables of results",
        "compare": "test differences for significance",
        "report": "write one HTML page about results",
        "verify": "recompute digests and scores of results",
        "curves": "draw scores against the seconds of a fit",
    }
    imports = {
        "video": "make a capture of a video",
        "wildghand": "make captures of the official release",
        "interhand26m": "make a capture of InterHand2.6M",
        "rendered": "make predictions of what the authors' code has drawn",
        "second-view": "make a free-view clip of a second camera",
    }
    data = {
        "get": Command("download a public data set", "hwp_bench.cli.data:get"),
        "import": Command("make captures of other data", commands=_leaves("imports", imports)),
        **_leaves(
            "data",
            {
                "track": "track the hands of a video",
                "check": "check captures and their splits",
                "show": "draw a contact sheet of a capture",
                "inputs": "write the inputs of a program of your own",
                "convert": "express a capture's hands in another hand model",
                "export": "write the hands of a frame as a mesh",
            },
        ),
    }
    board = {
        "show": "print the board: ranks with intervals, levels, badges",
        "submit": "make the folder of a pull request",
        "check": "check digests, protocol version, completeness of entries",
        "confirm": "score an entry again, or compare a second run",
        "build": "write the static site",
    }
    keeping = {
        "add": "write entries of results into the folder of entries",
        "contest": "put a second run next to an entry, or withdraw one of them",
        "register": "allow entries the names of methods that ship",
    }
    challenge = {
        "make": "draw a secret and render a sealed suite from it",
        "publish": "divide captures into a public and a sealed part",
        "reveal": "write the file that reveals a suite's secret",
        "check": "make a revealed suite again and compare",
    }
    simulator = {
        "render": "render captures of scenes",
        "preview": "draw a contact sheet and an animation of a scene",
    }
    dev = {
        **_leaves("toolkit", {"stability": "run the numerical hard cases"}),
        **_leaves(
            "sim",
            {
                "plan": "print what the frames of a scene need and will cost",
                "calibrate": "solve strengths of effects for stated losses",
            },
        ),
        **_leaves("data", {"card": "print the data card of a suite"}),
        **_leaves("dev", {"docs-results": "write the results in pages of the documentation"}),
        "leaderboard": Command("keep a board", commands=_leaves("leaderboard", keeping)),
    }
    return Command(
        "benchmark for hand avatars from perturbed in-the-wild video",
        commands={
            **_leaves("evaluate", runs),
            **_leaves("methods", methods),
            **_leaves("results", results),
            "list": Command(
                "list suites, captures, methods, metrics, scenes", "hwp_bench.cli.toolkit:list"
            ),
            "data": Command("make, check and show captures", commands=data),
            "leaderboard": Command(
                "show a board and submit", commands=_leaves("leaderboard", board)
            ),
            "challenge": Command(
                "make, reveal and check sealed suites", commands=_leaves("challenge", challenge)
            ),
            "sim": Command("simulate captures", commands=_leaves("sim", simulator)),
            **_leaves("toolkit", {"completion": "print completion for a shell"}),
            "dev": Command("commands for maintainers", commands=dev),
        },
        parts=_PARTS,
    )


def main(arguments: Sequence[str] | None = None) -> int:
    """Run `hwp-bench`; returns the exit status."""
    return run_program("hwp-bench", command_tree(), arguments)


if __name__ == "__main__":
    sys.exit(main())
