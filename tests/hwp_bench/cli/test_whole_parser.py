"""Every command and argument is explained. Oracle: a walk through all parsers of both programs."""

from __future__ import annotations

import argparse
from collections.abc import Iterator

import pytest

from hwp_bench.cli.main import command_tree as toolkit
from hwp_bench.cli.program import run_program, whole_parser
from wildghand.cli.main import command_tree as method

PROGRAMS = {"hwp-bench": toolkit, "wildghand": method}


def parsers(parser: argparse.ArgumentParser) -> Iterator[argparse.ArgumentParser]:
    yield parser
    for action in parser._actions:
        if isinstance(action, argparse._SubParsersAction):
            for below in action.choices.values():
                yield from parsers(below)


def every_parser() -> list[argparse.ArgumentParser]:
    found = [p for name, tree in PROGRAMS.items() for p in parsers(whole_parser(name, tree()))]
    assert len(found) > 40
    return found


@pytest.mark.parametrize("parser", every_parser(), ids=lambda parser: parser.prog)
def test_every_command_and_argument_is_explained(parser: argparse.ArgumentParser) -> None:
    assert parser.description
    for action in parser._actions:
        assert action.help, f"{parser.prog}: {action.option_strings or action.dest}"
        if isinstance(action, argparse._SubParsersAction):
            explained = {choice.dest for choice in action._choices_actions if choice.help}
            assert explained == set(action.choices)


def with_option(option: str) -> dict[str, argparse.Action]:
    """Every command that has an option, and the option there."""
    return {
        parser.prog: action
        for parser in every_parser()
        for action in parser._actions
        if option in action.option_strings
    }


def test_there_is_one_word_for_one_thing() -> None:
    """Words that were synonyms of others, or had several meanings, have one or are gone."""
    for word in ("--force", "--hand", "--captures", "--count", "--seconds", "--min-confidence"):
        assert with_option(word) == {}
    assert set(with_option("--frames")) == {"wildghand explain"}
    assert set(with_option("--by")) == {"hwp-bench table"}
    assert set(with_option("--base")) == {"hwp-bench ablate"}
    for program, action in with_option("--frame-count").items():
        assert action.type is int, program
    for program, action in with_option("--range").items():
        assert action.metavar == "A:B", program
    for program, action in with_option("--budget").items():
        assert (action.type, action.metavar) == (float, "SECONDS"), program
    for program, action in with_option("--overwrite").items():
        assert action.nargs == 0, program
        assert str(action.help).startswith("replace "), program
    assert len(with_option("--overwrite")) > 12
    for program, action in with_option("--hand-model").items():
        assert not action.choices, program


@pytest.mark.parametrize("program", PROGRAMS)
def test_help_is_one_screen_that_names_every_command(program: str, capsys) -> None:
    """All but what keeps a board or the repository, and the kinds of a group."""
    tree = PROGRAMS[program]()
    with pytest.raises(SystemExit) as stop:
        run_program(program, tree, ["--help"])
    assert stop.value.code == 0
    lines = capsys.readouterr().out.splitlines()
    assert len(lines) <= 50
    assert max(map(len, lines)) <= 80
    named = {name for names in tree.parts.values() for name in names}
    paths = {
        parser.prog.removeprefix(f"{program} ") for parser in parsers(whole_parser(program, tree))
    }
    hidden = {path for path in paths if path.startswith(("dev ", "data import ", "challenge "))}
    groups = {"data", "leaderboard", "sim"}
    assert named == paths - hidden - groups - {program}
    assert {line.split("  ")[1] for line in lines if line.startswith("  ")} == named


def test_an_option_that_replaces_is_shown() -> None:
    (render,) = (p for p in every_parser() if p.prog == "wildghand render")
    assert "--overwrite" in render.format_help()
    assert "--overwrite" in (render.epilog or "")


def test_an_option_with_several_values_may_also_be_repeated() -> None:
    """`--capture A --capture B` had silently evaluated B alone."""
    lists = [
        (parser.prog, action)
        for parser in every_parser()
        for action in parser._actions
        if action.option_strings and action.nargs == "+" and not action.default
    ]
    assert len(lists) >= 10
    for program, action in lists:
        option, value = action.option_strings[0], "3" if action.type is int else "a"
        single = argparse.ArgumentParser()
        single._add_action(action)
        given = single.parse_args([option, value, option, value])
        assert len(getattr(given, action.dest)) == 2, f"{program} {option}"
