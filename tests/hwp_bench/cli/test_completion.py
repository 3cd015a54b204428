"""Completion by the shell itself. Oracle: bash, with the words that a person would have typed."""

from __future__ import annotations

import shutil
import subprocess
from pathlib import Path

import pytest

from hwp_bench.cli.main import command_tree, main
from hwp_bench.cli.program import SHELLS
from wildghand.cli.main import main as method

_ASK = r"""
source "$1"
words=("${@:2}")
COMP_WORDS=("${words[@]}")
COMP_CWORD=$((${#words[@]} - 1))
COMP_LINE="${words[*]}"
COMP_POINT=${#COMP_LINE}
COMPREPLY=()
function=$(complete -p "${words[0]}" | sed -E 's/.*-F ([^ ]+).*/\1/')
"$function" "${words[0]}" "${words[-1]}" "${words[-2]}"
printf '%s\n' "${COMPREPLY[@]}"
"""


def completed(script: Path, folder: Path, *words: str) -> set[str]:
    """What bash offers for the last word."""
    command = ["bash", "--norc", "-c", _ASK, "bash", str(script), *words]
    done = subprocess.run(command, capture_output=True, text=True, check=True, cwd=folder)
    return {line.strip().rstrip("/") for line in done.stdout.splitlines() if line.strip()}


@pytest.fixture(scope="module")
def scripts(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The scripts of both programs for bash."""
    import contextlib
    import io

    folder = tmp_path_factory.mktemp("completion")
    for name, run in (("hwp-bench", main), ("wildghand", method)):
        said = io.StringIO()
        with contextlib.redirect_stdout(said):
            assert run(["completion", "bash"]) == 0
        (folder / name).write_text(said.getvalue())
    return folder


@pytest.mark.skipif(shutil.which("bash") is None, reason="there is no bash")
def test_bash_completes_commands_options_values_and_files(scripts: Path, tmp_path: Path) -> None:
    (tmp_path / "my_method").mkdir()

    def ask(*words: str) -> set[str]:
        return completed(scripts / words[0], tmp_path, *words)

    assert ask("hwp-bench", "ev") == {"evaluate"}
    assert ask("hwp-bench", "") >= set(command_tree().commands)
    assert ask("hwp-bench", "data", "in") == {"inputs"}
    assert ask("hwp-bench", "evaluate", "--sui") == {"--suite"}
    assert ask("hwp-bench", "evaluate", "--suite", "mi") == {"mini"}
    assert ask("hwp-bench", "evaluate", "my_m") == {"my_method"}
    assert ask("hwp-bench", "leaderboard", "su") == {"submit"}
    assert ask("wildghand", "re") == {"render"}
    assert ask("wildghand", "render", "--over") == {"--overwrite"}


@pytest.mark.parametrize("shell", SHELLS)
def test_every_shell_has_a_script_that_names_the_commands(shell: str, capsys) -> None:
    assert main(["completion", shell]) == 0
    text = capsys.readouterr().out
    assert all(name in text for name in command_tree().commands)
    program = shutil.which(shell)
    if program is not None:
        checked = subprocess.run([program, "-n"], input=text, text=True, capture_output=True)
        assert checked.returncode == 0, checked.stderr
