"""The parser of a whole program, for what looks at all commands at once: completion, tests."""

from __future__ import annotations

import argparse
import importlib

from hwp_bench.cli.program import Command, describe_group, describe_leaf

# Values of these types are not names of files.
_NUMBERS = (int, float)


def whole_parser(program: str, tree: Command) -> argparse.ArgumentParser:
    """Return one parser with every command; a running program builds only the one it needs."""
    parser = argparse.ArgumentParser(**describe_group(program, tree))
    _fill(parser, program, tree)
    return parser


def completion_script(program: str, tree: Command, shell: str) -> str:
    """Return the script that completes a program's command line in a shell.

    Args:
        program: its name.
        tree: its commands.
        shell: one of `SHELLS`.
    """
    import shtab

    parser = whole_parser(program, tree)
    _complete_files(parser)
    return shtab.complete(parser, shell=shell)


def _fill(parser: argparse.ArgumentParser, program: str, group: Command) -> None:
    actions = parser.add_subparsers(dest="command", metavar="COMMAND", help="what to do")
    for name, command in group.commands.items():
        if command.commands:
            described = describe_group(f"{program} {name}", command)
            below = actions.add_parser(name, help=command.summary, **described)
            _fill(below, f"{program} {name}", command)
            continue
        leaf = actions.add_parser(
            name, help=command.summary, **describe_leaf(f"{program} {name}", command)
        )
        importlib.import_module(command.module).add_arguments(leaf)


def _complete_files(parser: argparse.ArgumentParser) -> None:
    """Let the values of arguments be completed as files, as a shell does by itself."""
    import shtab

    for action in parser._actions:
        if isinstance(action, argparse._SubParsersAction):
            for below in action.choices.values():
                _complete_files(below)
        elif action.nargs != 0 and not action.choices and action.type not in _NUMBERS:
            action.complete = shtab.FILE  # type: ignore[attr-defined]
