"""Errors of an import against truth. Oracle: errors that were put in."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from benchmarks.importer_errors import changed, hand_errors
from benchmarks.tracker_clips import KINDS, scene_text
from hwp_bench.hands import load_template
from hwp_bench.hands.skeleton import HandParameters
from hwp_bench.importers.video import SolveSettings
from hwp_bench.sim.hand.anatomy import SubjectAnatomy
from hwp_bench.sim.scene_files import parse_scene


def test_a_shift_is_found_in_space_and_in_the_image() -> None:
    template = load_template("anny", "right")
    pose = 0.2 * np.random.default_rng(0).normal(size=(3, 16, 3))
    valid = np.ones(3, dtype=bool)
    truth = HandParameters(pose, np.zeros(10), np.tile([0.0, 0.0, 50.0], (3, 1)), valid)
    moved = HandParameters(pose, np.zeros(10), truth.transl + np.array([0.01, 0, 0]), valid)
    found = hand_errors(moved, truth, 5000.0, template, template)
    assert found.joints == pytest.approx(10.0)
    assert found.shape == pytest.approx(0.0, abs=1e-9)
    # 10 mm at 50 m: the hand's own depth changes it by less than 0.5 %.
    assert found.image == pytest.approx(1.0, rel=0.005)
    assert found.parts == pytest.approx([1.0] * 6, rel=0.005)
    assert found.wrist == pytest.approx(0.0, abs=1e-6)


def test_another_mesh_is_an_error_of_its_own() -> None:
    """Oracle: a hand that is larger by a tenth, at rest, is off by a tenth of each distance."""
    template = load_template("anny", "right")
    at_rest, joints = template.vertices, template.joints
    larger = replace(template, vertices=1.1 * at_rest, joints=1.1 * joints)
    transl = np.tile([0.0, 0.0, 0.5], (2, 1))
    hand = HandParameters(np.zeros((2, 16, 3)), np.zeros(10), transl, np.ones(2, dtype=bool))
    found = hand_errors(hand, hand, 500.0, template, larger)
    assert found.joints == pytest.approx(100.0 * np.linalg.norm(joints, axis=1).mean())
    from_wrist = np.linalg.norm(at_rest - joints[0], axis=1)
    assert found.shape == pytest.approx(100.0 * from_wrist.mean())
    assert found.wrist == pytest.approx(0.0, abs=1e-6)


def test_harder_clips_show_what_their_names_say() -> None:
    easy, hard, off = (
        parse_scene(scene_text("clip", 1, KINDS[kind]), where="clip")
        for kind in ("", "hard-light", "off-model")
    )
    assert hard.light.key / hard.light.sky > 3.0 * easy.light.key / easy.light.sky
    assert easy.subject.anatomy == hard.subject.anatomy == SubjectAnatomy()
    assert off.subject.anatomy.joint_shift == 4.0
    assert off.light == easy.light


def test_settings_keep_their_types() -> None:
    settings = changed(SolveSettings(), ["texture=false", "contour_rounds=2"])
    assert settings.texture is False
    assert settings.contour_rounds == 2
    assert isinstance(settings.contour_rounds, int)
