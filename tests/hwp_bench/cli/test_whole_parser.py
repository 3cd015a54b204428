"""Every command and argument is explained. Oracle: a walk through all parsers of both programs."""

from __future__ import annotations

import argparse
from collections.abc import Iterator

import pytest

from hwp_bench.cli.main import command_tree as toolkit
from hwp_bench.cli.program import whole_parser
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


def test_an_option_means_one_thing_in_all_commands() -> None:
    """`--hand` is a side and `--hand-model` a model, wherever they are."""
    for parser in every_parser():
        for action in parser._actions:
            if "--hand" in action.option_strings:
                assert {"left", "right"} <= set(action.choices or ()), parser.prog
            if "--hand-model" in action.option_strings:
                assert not action.choices, parser.prog


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
