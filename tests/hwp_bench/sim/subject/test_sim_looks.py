"""Looks: what they change and what they leave alone.

Oracles: plain skin bit for bit where nothing is asked for, the hand's own geometry, rigid motion,
and luminance (Rec. 709) for the order of tones.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from tiny_scene import SceneMaker

from hwp_bench.hands.poses import FIRST_JOINT
from hwp_bench.sim.effects import hands_at, plan_frame
from hwp_bench.sim.geometry.surface import RenderCost
from hwp_bench.sim.hand.anatomy import Anatomy
from hwp_bench.sim.render.frame import render_frame
from hwp_bench.sim.render.stage import RenderStage
from hwp_bench.sim.subject.arms import ring_mounts, wrist_loop
from hwp_bench.sim.subject.hand import MOVING, of_side, painted, sample_skin, subject_hand
from hwp_bench.sim.subject.subject import PLAIN, Looks, Subject
from hwp_bench.sim.subject.wear import Glove, Polish, Ring, Tattoo, WristWear

PERSON = Subject(seed=11, tone=0.22, age=31.0)
RED = (0.8, 0.05, 0.1)


@pytest.fixture(scope="module")
def places() -> Anatomy:
    """The vertices of a rest hand, 2.8 mm apart."""
    hand = subject_hand(PERSON, "right", MOVING)
    return hand.anatomy(hand.rest, hand.rest_normals, hand.lift @ hand.template.weights)


def wearing(**looks: object) -> Subject:
    return replace(PERSON, looks=Looks(**looks))  # type: ignore[arg-type]


def changed(places: Anatomy, subject: Subject) -> np.ndarray:
    """Where the paint differs from plain skin: (N,) bool."""
    skin = painted(places, subject, fine=True)
    return np.abs(skin.albedo - sample_skin(places, PERSON).albedo).max(axis=1) > 1e-3


def test_plain_looks_are_plain_skin_and_leave_no_trace(
    make_scene: SceneMaker, places: Anatomy
) -> None:
    for fine in (False, True):
        skin, plain = painted(places, PERSON, fine=fine), sample_skin(places, PERSON)
        np.testing.assert_array_equal(skin.albedo, plain.albedo)
        np.testing.assert_array_equal(skin.height, plain.height)
    scene = make_scene()
    assert scene.subject.looks == Looks() == PLAIN
    assert "looks" not in scene.to_json()["subject"]
    table = ("age = 31.0\n", "age = 31.0\n[subject.looks]\nhair = 0.0\n")
    assert make_scene(table).digest == scene.digest
    hairy = make_scene((table[0], table[1].replace("hair = 0.0", "hair = 0.5")))
    assert hairy.to_json()["subject"]["looks"] == {"hair": 0.5}
    assert hairy.digest != scene.digest


def test_paint_stays_in_its_place(places: Anatomy) -> None:
    nail = places.nails()[0] > 0.0
    polish = changed(places, wearing(polish=(Polish((RED,)),)))
    assert polish.any()
    assert not (polish & ~nail).any()
    tattoo = changed(places, wearing(tattoos=(Tattoo("mandala"),)))
    assert 0.005 < tattoo.mean() < 0.3
    assert places.back[tattoo].min() > 0.3
    beyond = places.weights[:, [FIRST_JOINT["index"] + 2, FIRST_JOINT["ring"] + 2]].sum(axis=1)
    glove = changed(places, wearing(gloves=(Glove("fingerless"),)))
    assert not glove[beyond > 0.9].any()
    assert glove[places.weights[:, 0] > 0.9].mean() > 0.99
    assert changed(places, wearing(gloves=(Glove("work"),))).mean() > 0.99


@settings(max_examples=3, deadline=None)
@given(hair=st.floats(0.05, 1.0), freckles=st.floats(0.2, 1.0), wrinkles=st.floats(0.1, 1.0))
def test_marks_keep_reflectance_in_range_and_repeat(
    places: Anatomy, hair: float, freckles: float, wrinkles: float
) -> None:
    subject = wearing(hair=hair, freckles=freckles, wrinkles=wrinkles)
    first, second = (painted(places, subject, fine=True) for _ in range(2))
    np.testing.assert_array_equal(first.albedo, second.albedo)
    assert 0.0 < first.albedo.min() <= first.albedo.max() <= 0.95
    assert np.isfinite(first.height).all()
    # They darken, on the back of the hand only.
    plain = sample_skin(places, PERSON).albedo
    assert first.albedo.mean() < plain.mean()
    palm = places.back == 0.0
    np.testing.assert_allclose(first.albedo[palm], plain[palm], atol=1e-9)


def test_tones_get_darker_over_the_whole_range(places: Anatomy) -> None:
    luminance = [
        float((sample_skin(places, replace(PERSON, tone=float(tone))).albedo @ WEIGHTS).mean())
        for tone in np.linspace(-0.4, 1.4, 10)
    ]
    assert np.all(np.diff(luminance) < 0.0)
    # The old range, 0 to 1, ends well inside.
    assert luminance[0] > 1.15 * luminance[2]
    assert luminance[-1] < 0.75 * luminance[-3]


WEIGHTS = np.array([0.2126, 0.7152, 0.0722])


def test_each_hand_wears_its_own() -> None:
    looks = Looks(rings=(Ring("ring", side="left"),), polish=(Polish((RED,)),), hair=0.3)
    subject = replace(PERSON, looks=looks)
    assert of_side(subject, "right").looks == Looks(polish=(Polish((RED,)),), hair=0.3)
    assert len(ring_mounts(subject, "left")) == 1
    assert ring_mounts(subject, "right") == ()
    same = replace(PERSON, looks=Looks(gloves=(Glove("work"),)))
    assert of_side(same, "right") == of_side(same, "left")


@pytest.mark.parametrize("side", ["right", "left"])
def test_a_ring_lies_on_its_finger_and_keeps_its_shape(make_scene: SceneMaker, side: str) -> None:
    from scipy.spatial import cKDTree

    subject = wearing(rings=(Ring("ring"), Ring("thumb", "silver", stone=0.005)))
    scene = replace(
        make_scene(('"right"', f'"{side}"'), ("right = [", f"{side} = [")), subject=subject
    )
    for seconds in (0.0, 1.0):
        hands = hands_at(scene, seconds)
        skin, normals = subject_hand(subject, side).pose(
            *RenderStage(scene, RenderCost()).parameters(hands)[side]
        )
        for mount in ring_mounts(subject, side):
            ring = mount.carried(skin)
            spans = [np.linalg.norm(at.vertices[0] - at.vertices[-1]) for at in (ring, mount.thing)]
            assert spans[0] == pytest.approx(spans[1], abs=1e-9)
            # Inner and outer side: from a little inside the flesh to 2.5 mm above it.
            near = cKDTree(skin).query(ring.vertices)[1]
            above = np.einsum("ni,ni->n", ring.vertices - skin[near], normals[near])
            assert np.quantile(above, 0.05) > -0.0025
            assert np.median(above) < 0.0025
            assert ring.hand.all()


@pytest.mark.usefixtures("small_paintings")
def test_a_bare_arm_begins_with_the_rim_of_the_hand(make_scene: SceneMaker) -> None:
    subject = wearing(arm="bare", wrist=(WristWear("watch", side="both"),))
    scene = replace(make_scene(), subject=subject)
    stage = RenderStage(scene, RenderCost())
    hands = hands_at(scene, 0.7)
    body = stage.surface(hands)
    rim = wrist_loop(subject, "right").loop
    start = len(subject_hand(subject, "right").relief)
    arm = slice(start, start + len(rim))
    np.testing.assert_array_equal(body.vertices[rim], body.vertices[arm])
    np.testing.assert_array_equal(body.normals[rim], body.normals[arm])
    sky = stage.under_sky(body, stage.seen_sky(stage.traced(body))).openness
    assert sky is not None
    np.testing.assert_allclose(sky[rim], sky[arm], atol=1e-12)
    owners = stage.owners(hands)
    np.testing.assert_array_equal(owners == 1, body.hand)
    assert (owners == 3).sum() > 500


@pytest.mark.usefixtures("small_paintings")
def test_worn_things_are_in_frame_and_mask_as_documented(make_scene: SceneMaker) -> None:
    plain = render_frame(make_scene(), 36, 40, 48)
    subject = wearing(
        gloves=(Glove("work", thickness=0.002),), rings=(Ring("index", "black"),), arm="bare"
    )
    scene = replace(make_scene(), subject=subject)
    worn = render_frame(scene, 36, 40, 48)
    assert plan_frame(scene, 36, 40, 48).passes[4:6] == ("bare_arm", "rings")
    np.testing.assert_array_equal(worn.rgb, worn.clean)
    # A glove makes the hand thicker and counts as hand.
    assert 1.0 < worn.coverage.sum() / plain.coverage.sum() < 1.3
    assert np.abs(worn.rgb.astype(int) - plain.rgb)[plain.coverage == 1.0].mean() > 15.0
