"""`hwp-bench completion`."""

from __future__ import annotations

import argparse

#: Shells that there is a script for.
SHELLS = ("bash", "zsh", "fish")

_EXAMPLES = """examples:
  source <({program} completion bash)                              # in this shell
  {program} completion bash >> ~/.local/share/bash-completion/completions/{program}
  {program} completion zsh > ~/.zfunc/_{program}                   # with ~/.zfunc in fpath
  {program} completion fish > ~/.config/fish/completions/{program}.fish

The script holds every command and option of this version; print it again after an update.
"""


def add_shell_argument(parser: argparse.ArgumentParser, program: str) -> None:
    """Add the arguments of the command to a program's parser."""
    parser.epilog = _EXAMPLES.replace("{program}", program)
    parser.add_argument("shell", choices=SHELLS, metavar="SHELL", help=f"{', '.join(SHELLS)}")


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the arguments of the command."""
    add_shell_argument(parser, "hwp-bench")


def run(args: argparse.Namespace) -> int:
    """Run the command."""
    from hwp_bench.cli.main import command_tree
    from hwp_bench.cli.whole_parser import completion_script

    print(completion_script("hwp-bench", command_tree(), args.shell))
    return 0
