"""`hwp-bench`: its commands."""

from __future__ import annotations

import sys
from collections.abc import Sequence

from hwp_bench.cli.program import Command, make_tree, run_program

#: Every command below its heading in `--help`: its module in `hwp_bench/cli` (none for a group),
#: and what it does. The help of a group lists what has no heading.
_COMMANDS = {
    "": {
        "data": ("", "make, check and show captures"),
        "data import": ("", "make captures of other data"),
        "leaderboard": ("", "show a board, submit to it"),
        "challenge": ("", "make, publish, reveal and check sealed suites"),
        "challenge make": ("challenge", "draw a secret and render a sealed suite from it"),
        "challenge publish": ("challenge", "divide captures into a public and a sealed part"),
        "challenge reveal": ("challenge", "write the file that reveals a suite's secret"),
        "challenge check": ("challenge", "make a revealed suite again and compare"),
        "sim": ("", "simulate captures"),
        "dev": ("", "commands for maintainers"),
        "dev leaderboard": ("", "keep a board"),
        "data import video": ("imports", "make a capture of a video"),
        "data import wildghand": ("imports", "make captures of the official release"),
        "data import interhand26m": ("imports", "make a capture of InterHand2.6M"),
        "data import rendered": ("imports", "make predictions of pictures by the authors' code"),
        "data import second-view": ("imports", "make a free-view clip of a second camera"),
        "dev stability": ("toolkit", "run the numerical hard cases"),
        "dev plan": ("sim", "print what the frames of a scene need and will cost"),
        "dev calibrate": ("sim", "solve strengths of effects for stated losses"),
        "dev card": ("data", "print the data card of a suite"),
        "dev docs-results": ("dev", "write the results in pages of the documentation"),
        "dev leaderboard add": ("leaderboard", "write entries of results into the folder"),
        "dev leaderboard confirm": ("leaderboard", "score an entry again, or compare a second run"),
        "dev leaderboard contest": ("leaderboard", "put a second run next to an entry"),
        "dev leaderboard register": ("leaderboard", "allow entries the names of shipped methods"),
    },
    "start": {
        "demo": ("evaluate", "simulate two captures, fit two methods, score them"),
        "new": ("methods", "write a method of your own that runs"),
        "check-method": ("methods", "run a method on a toy capture, say what is wrong"),
        "evaluate": ("evaluate", "run methods on captures and score them"),
        "table": ("results", "print tables of results"),
        "compare": ("results", "test differences for significance"),
        "report": ("results", "write one HTML page about results"),
        "verify": ("results", "recompute digests and scores of results"),
        "list": ("toolkit", "list suites, captures, methods, metrics, scenes"),
    },
    "data": {
        "data get": ("data", "download a public data set"),
        "data import": ("", "make captures of other data"),
        "data track": ("data", "track the hands of a video"),
        "data check": ("data", "check captures and their splits"),
        "data show": ("data", "draw a contact sheet of a capture"),
        "data inputs": ("data", "write the inputs of a program of your own"),
        "data convert": ("data", "express a capture's hands in another hand model"),
        "data export": ("data", "write the hands of a frame as a mesh"),
    },
    "study": {
        "ablate": ("evaluate", "measure gain and cost of components"),
        "error-budget": ("evaluate", "measure what each estimated input costs a method"),
        "curves": ("results", "draw scores against the seconds of a fit"),
    },
    "board": {
        "leaderboard show": ("leaderboard", "print ranks with intervals, levels, badges"),
        "leaderboard submit": ("leaderboard", "make the folder of a pull request"),
        "leaderboard check": ("leaderboard", "check that entries are whole and unchanged"),
        "leaderboard build": ("leaderboard", "write the static site"),
        "challenge": ("", "make, publish, reveal and check sealed suites"),
    },
    "simulator": {
        "sim render": ("sim", "render captures of scenes"),
        "sim preview": ("sim", "draw a contact sheet and an animation of a scene"),
    },
    "other": {
        "info": ("toolkit", "print facts of this machine, check the rasterizer"),
        "completion": ("toolkit", "print completion for a shell"),
        "dev": ("", "commands for maintainers"),
    },
}


def command_tree() -> Command:
    """Return every command of `hwp-bench`."""
    summary = "benchmark for hand avatars from perturbed in-the-wild video"
    return make_tree(summary, "hwp_bench.cli", _COMMANDS)


def main(arguments: Sequence[str] | None = None) -> int:
    """Run `hwp-bench`; returns the exit status."""
    return run_program("hwp-bench", command_tree(), arguments)


if __name__ == "__main__":
    sys.exit(main())
