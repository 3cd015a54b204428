"""`wildghand completion`."""

from __future__ import annotations

import argparse

from hwp_bench.cli.program import add_shell_argument


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the arguments of the command."""
    add_shell_argument(parser, "wildghand")


def run(args: argparse.Namespace) -> int:
    """Run the command."""
    from hwp_bench.cli.program import completion_script
    from wildghand.cli.main import command_tree

    print(completion_script("wildghand", command_tree(), args.shell))
    return 0
