"""A program of commands: finds one, builds its parser, runs it, prints an error as one line.

A running program imports the module of its command alone. Completion looks at all of them.
"""

from __future__ import annotations

import argparse
import errno
import importlib
import os
import signal
import sys
import threading
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, TypeAlias

from hwp_bench.base.console import in_utf8_mode, settle, standard_streams, tell
from hwp_bench.base.errors import HwpError, check_name, nearest
from hwp_bench.base.numerics import check_thread_variables, flushed_process, share_processors
from hwp_bench.base.packages import __version__

#: What adds the arguments of a command to its parser, and what runs it and returns the status.
AddArguments: TypeAlias = Callable[[argparse.ArgumentParser], None]
Run: TypeAlias = Callable[[argparse.Namespace], int]


@dataclass(frozen=True)
class Command:
    """A command, or a group of commands."""

    #: One line for `--help`.
    summary: str
    #: Module with `add_arguments(parser)` and `run(args)`, or `MODULE:NAME` where it holds both in
    #: `COMMANDS[NAME]`; empty for a group.
    module: str = ""
    #: Commands of a group, by name.
    commands: dict[str, Command] = field(default_factory=dict)
    #: Headings of a program's help, each with the commands below it, such as `data get`.
    parts: Mapping[str, Sequence[str]] = field(default_factory=dict)

    def load(self) -> tuple[AddArguments, Run]:
        """Import what adds the arguments of the command, and what runs it."""
        place, _, name = self.module.partition(":")
        module = importlib.import_module(place)
        return module.COMMANDS[name] if name else (module.add_arguments, module.run)


def make_tree(
    summary: str, package: str, parts: Mapping[str, Mapping[str, tuple[str, str]]]
) -> Command:
    """Return the commands of a program.

    `parts` has, below each heading of its help, the paths of commands such as `data get`, each with
    its module in the package and its summary. A group has no module, and comes before what is in it
    or below the heading "", which the help leaves out.
    """
    root = Command(summary, parts={head: tuple(rows) for head, rows in parts.items() if head})
    for rows in parts.values():
        for path, (module, text) in rows.items():
            *above, name = path.split()
            group = _find(root, " ".join(above))
            made = Command(text, f"{package}.{module}:{name}" if module else "")
            group.commands.setdefault(name, made)
    return root


#: Exit status where nobody reads standard output any more, as that of a program which SIGPIPE ends.
_READER_GONE = 128 + 13


def run_program(program: str, tree: Command, arguments: Sequence[str] | None = None) -> int:
    """Run one command of a program."""
    if arguments is None:
        in_utf8_mode(program)
    words = list(sys.argv[1:] if arguments is None else arguments)
    if threading.current_thread() is threading.main_thread():
        # As by Ctrl-C, so that child processes are stopped and temporary files removed.
        signal.signal(signal.SIGTERM, signal.default_int_handler)
    with standard_streams():
        return _guarded(program, tree, words)


@flushed_process()
def _guarded(program: str, tree: Command, words: list[str]) -> int:
    """Run a command; an error is one line, and an exit status."""
    try:
        try:
            for word in words:
                check_name(word)
            check_thread_variables(os.environ)
            share_processors()
            status = _dispatch(program, tree, words)
        except SystemExit:
            # Help, or a wrong option, which argparse has printed.
            sys.stdout.flush()
            raise
        sys.stdout.flush()
        return status
    except HwpError as error:
        return _failed(program, str(error), error.exit_status)
    except KeyboardInterrupt:
        return _failed(program, "stopped", 130, head="")
    except OSError as error:
        unwritten = settle(sys.stdout)
        if isinstance(unwritten, BrokenPipeError):
            # Whoever read our output (such as `head`) has what they wanted.
            return _READER_GONE
        # A full disc or a read-only folder: the message names the place.
        place = error.filename2 or error.filename or ("standard output" if unwritten else "")
        where = f"{place}: " if place else ""
        return _failed(program, f"{where}{error.strerror or error}{_remedy(error.errno)}", 1)
    except RuntimeError as error:
        # Python's own words where the system refuses a thread; there is no class for it.
        if "can't start new thread" not in str(error):
            raise
        return _failed(program, f"the system starts no more threads{_remedy(errno.EAGAIN)}", 1)


def _remedy(number: int | None) -> str:
    """What to do where the system has run out of something, by the number of its error."""
    if number in (errno.ENOSPC, errno.EDQUOT):
        return ". Make room and start again with the same arguments."
    if number == errno.EAGAIN:
        return ". Allow this user more processes and threads (`ulimit -u`, limit of the container)."
    if number in (errno.EMFILE, errno.ENFILE):
        return ". Allow more open files (`ulimit -n`)."
    return ""


def _failed(program: str, text: str, status: int, head: str = "error: ") -> int:
    """Say why a command has failed, after what it has printed; returns the status."""
    settle(sys.stdout)
    tell(f"{program}: {head}{_one_line(text)}")
    return status


def _one_line(text: str) -> str:
    """Return a message without line breaks and control characters, which may come from files."""
    return "".join(char if char.isprintable() else " " for char in text)


def _dispatch(program: str, group: Command, words: list[str]) -> int:
    parser = _group_parser(program, group)
    if not words or words[0].startswith("-"):
        if not words:
            parser.print_help(sys.stderr)
            return 2
        parser.parse_args(words)
        parser.error("name a command")
    name, rest = words[0], words[1:]
    if name not in group.commands:
        near = nearest(name, group.commands)
        hint = f"; did you mean {near[0]!r}?" if near else ""
        parser.error(f"there is no command {name!r}{hint}")
    command = group.commands[name]
    if command.commands:
        return _dispatch(f"{program} {name}", command, rest)
    add_arguments, run = command.load()
    leaf = argparse.ArgumentParser(**_describe_leaf(f"{program} {name}", command))
    add_arguments(leaf)
    return run(leaf.parse_args(rest))


def _describe_leaf(program: str, command: Command) -> dict[str, Any]:
    """Return the keyword arguments of a command's parser."""
    return {
        "prog": program,
        "description": command.summary[0].upper() + command.summary[1:] + ".",
        "formatter_class": argparse.RawDescriptionHelpFormatter,
    }


def _describe_group(program: str, group: Command) -> dict[str, Any]:
    """Return the keyword arguments of the parser of a group of commands."""
    parts = group.parts or {"commands": tuple(group.commands)}
    width = max(len(name) for names in parts.values() for name in names)
    blocks = [f"{group.summary[0].upper()}{group.summary[1:]}."]
    for heading, names in parts.items():
        lines = [f"  {name:<{width}}  {_find(group, name).summary}" for name in names]
        blocks.append("\n".join([f"{heading}:", *lines]))
    return {
        "prog": program,
        "usage": f"{program} [-h] [--version] COMMAND ...",
        "description": "\n\n".join(blocks),
        "epilog": f"`{program} COMMAND --help` explains a command, with examples.",
        "formatter_class": argparse.RawDescriptionHelpFormatter,
    }


def _find(group: Command, path: str) -> Command:
    """Return the command of a path such as `data get`."""
    for name in path.split():
        group = group.commands[name]
    return group


def _group_parser(program: str, group: Command) -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(**_describe_group(program, group), add_help=False)
    # The usage names both; a list of them would take six lines of the screen.
    parser.add_argument("-h", "--help", action="help", help=argparse.SUPPRESS)
    version, text = f"%(prog)s {__version__}", argparse.SUPPRESS
    parser.add_argument("--version", action="version", version=version, help=text)
    return parser


# Values of these types are not names of files.
_NUMBERS = (int, float)


def whole_parser(program: str, tree: Command) -> argparse.ArgumentParser:
    """Return one parser with every command; a running program builds only the one it needs."""
    parser = argparse.ArgumentParser(**_describe_group(program, tree))
    _fill(parser, program, tree)
    return parser


#: Shells that there is a script for.
SHELLS = ("bash", "zsh", "fish")

_COMPLETION_EXAMPLES = """examples:
  source <({program} completion bash)                              # in this shell
  {program} completion bash >> ~/.local/share/bash-completion/completions/{program}
  {program} completion zsh > ~/.zfunc/_{program}                   # with ~/.zfunc in fpath
  {program} completion fish > ~/.config/fish/completions/{program}.fish

The script holds every command and option of this version; print it again after an update.
"""


def complete(program: str, package: str) -> tuple[AddArguments, Run]:
    """Return the command `completion` of a program, whose commands are those of `package.main`."""

    def add_arguments(parser: argparse.ArgumentParser) -> None:
        parser.epilog = _COMPLETION_EXAMPLES.replace("{program}", program)
        parser.add_argument("shell", choices=SHELLS, metavar="SHELL", help=f"{', '.join(SHELLS)}")

    def run(args: argparse.Namespace) -> int:
        import shtab

        tree = importlib.import_module(f"{package}.main").command_tree()
        parser = whole_parser(program, tree)
        _complete_files(parser)
        print(shtab.complete(parser, shell=args.shell))
        return 0

    return add_arguments, run


def _fill(parser: argparse.ArgumentParser, program: str, group: Command) -> None:
    actions = parser.add_subparsers(dest="command", metavar="COMMAND", help="what to do")
    for name, command in group.commands.items():
        if command.commands:
            described = _describe_group(f"{program} {name}", command)
            below = actions.add_parser(name, help=command.summary, **described)
            _fill(below, f"{program} {name}", command)
            continue
        leaf = actions.add_parser(
            name, help=command.summary, **_describe_leaf(f"{program} {name}", command)
        )
        command.load()[0](leaf)


def _complete_files(parser: argparse.ArgumentParser) -> None:
    """Let the values of arguments be completed as files, as a shell does by itself."""
    import shtab

    for action in parser._actions:
        if isinstance(action, argparse._SubParsersAction):
            for below in action.choices.values():
                _complete_files(below)
        elif action.nargs != 0 and not action.choices and action.type not in _NUMBERS:
            action.complete = shtab.FILE  # type: ignore[attr-defined]
