"""Text that could steer a terminal. Oracle: the Unicode categories of the characters."""

from __future__ import annotations

import unicodedata
from dataclasses import dataclass
from typing import Any

import pytest

from hwp_bench.base.console import notice
from hwp_bench.base.errors import BadResult, HwpError, bounded, has_odd_characters, shown
from hwp_bench.base.records import parse_record


def test_exactly_controls_direction_marks_and_surrogates_are_odd() -> None:
    directions = {"LRE", "RLE", "PDF", "LRO", "RLO", "LRI", "RLI", "FSI", "PDI"}
    for code in [*range(0x3000), *range(0xD700, 0xE100)]:
        char = chr(code)
        control = unicodedata.category(char) == "Cc" and char not in "\t\n"
        surrogate = unicodedata.category(char) == "Cs"
        odd = control or surrogate or unicodedata.bidirectional(char) in directions
        assert has_odd_characters(f"a{char}b") == odd, hex(code)
        assert shown(char) == ("?" if odd else char)


@pytest.mark.parametrize(
    ("count", "text"), [(0, ""), (1, "0"), (3, "0, 1, 2"), (4, "0, 1, 2 and 1 more")]
)
def test_lists_are_bounded_and_counted(count: int, text: str) -> None:
    assert bounded(range(count), most=3) == text


def test_notices_do_not_steer_the_terminal(capsys: pytest.CaptureFixture[str]) -> None:
    notice("failed: \x1b[2J\x1b]0;title\x07 gone\x9b31m")
    assert capsys.readouterr().err == "failed: ?[2J?]0;title? gone?31m\n"


@dataclass(frozen=True)
class _Named:
    title: str
    scores: dict[str, float]
    extra: Any = None


@pytest.mark.parametrize(
    "value",
    [
        {"title": "\x1b[31mred", "scores": {}},
        {"title": "me\u202ethod", "scores": {}},
        {"title": "plain", "scores": {"ps\x00nr": 1.0}},
    ],
)
def test_records_with_control_characters_are_refused(value: dict) -> None:
    with pytest.raises(BadResult, match="control character") as caught:
        parse_record(_Named, value, where="file.json")
    assert "\x1b" not in str(caught.value)


def test_records_keep_any_ordinary_text() -> None:
    value = {"title": "<b>Hände</b>\n手", "scores": {"psnr": 1.0}}
    assert parse_record(_Named, value, where="file.json").title == value["title"]


def test_a_problem_that_ends_with_a_full_stop_has_one_before_the_remedy() -> None:
    assert str(HwpError("It broke.", remedy="Mend it.")) == "It broke. Mend it."
    assert str(HwpError("it broke", remedy="Mend it.")) == "it broke. Mend it."
