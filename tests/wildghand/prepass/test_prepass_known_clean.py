"""Frames that are known to be clean say what is ordinary in a clip. Oracle: what was injected."""

from __future__ import annotations

from dataclasses import fields

import numpy as np
import pytest
from lit_hand import FRAMES, HIT, SIZE, Lit, as_input, check_ranges, developed, only

from hwp_bench.base.errors import BadInput
from wildghand.prepass import FrameAssessment, PrepassInput, judge_frames

#: Frames whose verdict is known, amid and after the others.
KNOWN = np.array([3, 5, 18, 19, 21, 23])


def darkened(lit_frames: Lit, known: np.ndarray = KNOWN[:0]) -> PrepassInput:
    """Dark frames, and some of those whose verdict is known much darker."""
    linear = lit_frames[0].copy()
    linear[HIT] *= np.exp(-0.6)
    linear[known] *= np.exp(-1.4)
    return as_input(developed(linear), lit_frames[1])


def test_frames_that_are_known_to_be_clean_say_what_is_ordinary_in_a_clip(
    lit_frames: Lit, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Where clean frames are dark too, darkness does not tell that a frame is perturbed."""
    given = darkened(lit_frames, KNOWN[1:])
    rest = np.setdiff1d(np.arange(FRAMES), KNOWN)
    alone = judge_frames(only(given, rest))
    known = judge_frames(only(given, rest), known_clean=only(given, KNOWN))
    check_ranges(known, len(rest))
    assert known.indices.tolist() == rest.tolist()
    hit = np.isin(rest, HIT)
    assert alone.clean[hit].max() < 0.5
    assert known.clean[hit].min() > 0.5
    # It is what is known of them that tells, and not that they are compared with the rest.
    assert judge_frames(given).clean[HIT].max() < 0.5
    # At a lower resolution too.
    monkeypatch.setattr("wildghand.prepass.judge.PIXEL_BUDGET", len(rest) * SIZE * SIZE // 3)
    assert judge_frames(only(given, rest)).clean[hit].max() < 0.5
    known = judge_frames(only(given, rest), known_clean=only(given, KNOWN))
    assert known.clean[hit].min() > 0.5


@pytest.mark.parametrize("dark", [0, 3])
def test_known_frames_change_nothing_where_most_look_clean_or_they_are_few(
    lit_frames: Lit, dark: int
) -> None:
    # Oracle: the frames judged alone; of those that are known none is dark, or all three.
    given = darkened(lit_frames, KNOWN[:dark])
    rest = np.setdiff1d(np.arange(FRAMES), KNOWN)
    alone = judge_frames(only(given, rest))
    known = judge_frames(
        only(given, rest), known_clean=only(given, KNOWN[:dark] if dark else KNOWN)
    )
    for field in fields(FrameAssessment):
        values = getattr(alone, field.name)
        np.testing.assert_array_equal(getattr(known, field.name), values, err_msg=field.name)
    assert known.clean[np.isin(rest, HIT)].max() < 0.5


def test_known_frames_do_not_stand_in_for_frames_without_a_hand(lit_frames: Lit) -> None:
    given = as_input(developed(lit_frames[0]), lit_frames[1])
    rest = np.setdiff1d(np.arange(FRAMES), KNOWN)
    given.images[rest] = 0
    with pytest.raises(BadInput, match=r"none of 18 training frames .* 18 of them are black"):
        judge_frames(only(given, rest), known_clean=only(given, KNOWN))


def test_known_frames_without_a_hand_say_nothing(lit_frames: Lit) -> None:
    given = as_input(developed(lit_frames[0]), lit_frames[1])
    rest = np.setdiff1d(np.arange(FRAMES), KNOWN)
    alone = judge_frames(only(given, rest))
    given.images[KNOWN] = 0
    known = judge_frames(only(given, rest), known_clean=only(given, KNOWN))
    np.testing.assert_array_equal(known.clean, alone.clean)
