"""`hwp-bench`: its commands."""

from __future__ import annotations

import sys
from collections.abc import Sequence

from hwp_bench.cli.program import Command, run_program


def command_tree() -> Command:
    """Return every command of `hwp-bench`."""
    here = "hwp_bench.cli"
    evaluate, results = f"{here}.evaluate", f"{here}.results"
    imports = {
        "wildghand": Command("make captures of the official release", f"{here}.imports:wildghand"),
        "interhand26m": Command("make a capture of InterHand2.6M", f"{here}.imports:interhand26m"),
        "video": Command("make a capture of a video", f"{here}.imports:video"),
        "rendered": Command(
            "make predictions of what the authors' code has drawn", f"{here}.imports:rendered"
        ),
    }
    hands = {
        "convert": Command("express hands in another hand model", f"{here}.data:convert"),
        "export": Command("write the hands of a frame as a mesh", f"{here}.data:export"),
    }
    data = {
        "check": Command("check a capture and say what is wrong", f"{here}.data:check"),
        "show": Command("draw a contact sheet of a capture", f"{here}.data:show"),
        "audit": Command("check that a capture's split is fair", f"{here}.data:audit"),
        "get": Command("download a public data set", f"{here}.data:get"),
        "import": Command("make captures or predictions of other data", commands=imports),
        "import-video": Command("make a capture of a video", f"{here}.imports:video"),
        "second-view": Command(
            "make a free-view clip of a second camera", f"{here}.data:second_view"
        ),
        "track": Command("track the hands of a video", f"{here}.data:track"),
        "inputs": Command("write the inputs of a program of your own", f"{here}.data:inputs"),
        "card": Command("print the data card of a suite", f"{here}.data:card"),
        "publish": Command(
            "divide captures into a public and a sealed part", f"{here}.data:publish"
        ),
    }
    dev = {
        "docs-results": Command(
            "write the results in pages of the documentation", f"{here}.dev:docs-results"
        ),
    }
    return Command(
        "benchmark for hand avatars from perturbed in-the-wild video",
        commands={
            "demo": Command("simulate a capture, fit a baseline, score it", f"{evaluate}:demo"),
            "evaluate": Command("run a method on captures and score it", f"{evaluate}:evaluate"),
            "ablate": Command("measure gain and cost of components", f"{evaluate}:ablate"),
            "budget": Command("measure what each estimate costs a method", f"{evaluate}:budget"),
            "cost": Command("show accuracy against time", f"{results}:cost"),
            "verify": Command("recompute digests and scores of results", f"{results}:verify"),
            "compare": Command("test differences for significance", f"{results}:compare"),
            "table": Command("print tables of results", f"{results}:table"),
            "report": Command("write one HTML page about results", f"{results}:report"),
            "leaderboard": Command("make, check and show leaderboards", f"{here}.leaderboard"),
            "sealed": Command("make, reveal and check sealed suites", f"{here}.sealed"),
            "list": Command("list captures, suites, methods, metrics", f"{here}.toolkit:list"),
            "data": Command("make, check and show captures", commands=data),
            "hands": Command("hand models", commands=hands),
            "sim": Command("simulate captures", f"{here}.sim"),
            "completion": Command("print completion for a shell", f"{here}.toolkit:completion"),
            "stability": Command("run the numerical hard cases", f"{here}.toolkit:stability"),
            "dev": Command("keep this repository as it should be", commands=dev),
        },
    )


def main(arguments: Sequence[str] | None = None) -> int:
    """Run `hwp-bench`; returns the exit status."""
    return run_program("hwp-bench", command_tree(), arguments)


if __name__ == "__main__":
    sys.exit(main())
