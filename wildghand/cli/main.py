"""`wildghand`: its commands."""

from __future__ import annotations

import sys
from collections.abc import Sequence

from hwp_bench.cli.program import Command, run_program


def command_tree() -> Command:
    """Return every command of `wildghand`."""
    fit, show, study = (f"wildghand.cli.{topic}" for topic in ("fit", "show", "study"))
    return Command(
        "anti-perturbation Gaussian hand avatars",
        commands={
            "fit": Command("fit an avatar to a capture or a video", f"{fit}:fit"),
            "pretrain": Command(
                "fit one network to several captures, as a prior for fits", f"{fit}:pretrain"
            ),
            "render": Command("draw an avatar along the poses of a capture", f"{show}:render"),
            "view": Command("pose an avatar in the browser", f"{show}:view"),
            "export": Command("write an avatar as Gaussians for viewers", f"{show}:export"),
            "page": Command("write an avatar as a page for browsers, one file", f"{show}:page"),
            "stage": Command("draw an avatar and its cameras in 3D", f"{show}:stage"),
            "judge": Command("judge the frames of a capture: clean or perturbed", f"{study}:judge"),
            "explain": Command(
                "show what the biases took out of training frames", f"{study}:explain"
            ),
            "completion": Command("print completion for a shell", f"{study}:completion"),
            "info": Command("print versions and check what draws on this machine", f"{study}:info"),
        },
        parts={
            "avatar": ("fit", "view", "page", "render", "export"),
            "study": ("judge", "explain", "stage", "pretrain"),
            "other": ("info", "completion"),
        },
    )


def main(arguments: Sequence[str] | None = None) -> int:
    """Run `wildghand`; returns the exit status."""
    return run_program("wildghand", command_tree(), arguments)


if __name__ == "__main__":
    sys.exit(main())
