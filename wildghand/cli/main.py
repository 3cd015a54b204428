"""`wildghand`: its commands."""

from __future__ import annotations

import sys
from collections.abc import Sequence

from hwp_bench.cli.program import Command, run_program


def command_tree() -> Command:
    """Return every command of `wildghand`."""
    return Command(
        "anti-perturbation Gaussian hand avatars",
        commands={
            "fit": Command("fit an avatar to a capture or a video", "wildghand.cli.fit"),
            "pretrain": Command(
                "fit one network to several captures, as a prior for fits",
                "wildghand.cli.pretrain",
            ),
            "render": Command(
                "draw an avatar along the poses of a capture", "wildghand.cli.render"
            ),
            "export": Command("write an avatar as Gaussians for viewers", "wildghand.cli.export"),
            "page": Command(
                "write an avatar as a page for browsers, one file", "wildghand.cli.page"
            ),
            "judge": Command(
                "judge the frames of a capture: clean or perturbed", "wildghand.cli.judge"
            ),
            "explain": Command(
                "show what the biases took out of training frames", "wildghand.cli.explain"
            ),
            "info": Command("show what renders here, and check it", "wildghand.cli.info"),
        },
    )


def main(arguments: Sequence[str] | None = None) -> int:
    """Run `wildghand`; returns the exit status."""
    return run_program("wildghand", command_tree(), arguments)


if __name__ == "__main__":
    sys.exit(main())
