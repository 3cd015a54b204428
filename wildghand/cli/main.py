"""`wildghand`: its commands."""

from __future__ import annotations

import sys
from collections.abc import Sequence

from hwp_bench.cli.program import Command, make_tree, run_program

#: Every command below its heading in `--help`: its module in `wildghand/cli`, and what it does.
_COMMANDS = {
    "avatar": {
        "fit": ("fit", "fit an avatar to a capture or a video"),
        "view": ("show", "pose an avatar in the browser"),
        "page": ("show", "write an avatar as a page for browsers, one file"),
        "render": ("show", "draw an avatar along the poses of a capture"),
        "export": ("show", "write an avatar as Gaussians for viewers"),
    },
    "study": {
        "judge": ("study", "judge the frames of a capture: clean or perturbed"),
        "explain": ("study", "show what the biases took out of training frames"),
        "stage": ("show", "draw an avatar and its cameras in 3D"),
        "network": ("study", "list the layers and parameters of the network"),
        "pretrain": ("fit", "fit one network to several captures, as a prior for fits"),
    },
    "other": {
        "completion": ("study", "print completion for a shell"),
    },
}


def command_tree() -> Command:
    """Return every command of `wildghand`."""
    return make_tree("anti-perturbation Gaussian hand avatars", "wildghand.cli", _COMMANDS)


def main(arguments: Sequence[str] | None = None) -> int:
    """Run `wildghand`; returns the exit status."""
    return run_program("wildghand", command_tree(), arguments)


if __name__ == "__main__":
    sys.exit(main())
