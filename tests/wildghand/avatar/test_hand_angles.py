"""Named angles and the studio. Oracles: the inverse, the limits of the hands' room, projections."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp

from hwp_bench.base.errors import UsageError
from hwp_bench.hands import anatomical_limits, joint_limit_penalty, load_template, pose_hand
from wildghand.avatar.avatar import WildGHandAvatar
from wildghand.avatar.studio import ANGLE_NAMES, REST, HandAngles, Pose, Studio

SIDES = ("right", "left")
HANDS = {side: HandAngles.of("anny", side) for side in SIDES}


def posed_vertices(studio: Studio, side: str, turn: float = 0.0, pose: Pose = REST) -> np.ndarray:
    """(V, 3) m of the free hand where the studio puts it."""
    hand = studio.posed(pose, turn)[side]
    arrays = (hand.pose[None], hand.betas, hand.transl[None])
    template = load_template("anny", side).to_torch(torch.float64)
    return pose_hand(template, *map(torch.from_numpy, arrays)).vertices[0].numpy()


def free_studio(*sides: str) -> Studio:
    templates = {side: load_template("anny", side).to_torch(torch.float64) for side in sides}
    return Studio("anny", templates, {side: np.zeros(10) for side in sides})


@pytest.mark.parametrize("side", SIDES)
@settings(max_examples=25)
@given(shares=hnp.arrays(np.float64, (16, 3), elements=st.floats(0.0, 0.98)))
def test_angles_come_back_from_the_pose(side: str, shares: np.ndarray) -> None:
    hand = HANDS[side]
    angles = hand.lower + (hand.upper - hand.lower) * (0.01 + shares)
    np.testing.assert_allclose(hand.angles(hand.pose(angles)), angles, atol=1e-6)


@pytest.mark.parametrize("side", SIDES)
def test_the_ranges_are_whole_degrees_within_those_of_the_anatomy(side: str) -> None:
    hand, limits = HANDS[side], anatomical_limits(load_template("anny", side))
    lower, upper = np.degrees(limits.lower), np.degrees(limits.upper)
    assert ((hand.lower[1:] >= lower) & (hand.lower[1:] < lower + 1)).all()
    assert ((hand.upper[1:] <= upper) & (hand.upper[1:] > upper - 1)).all()
    assert (hand.lower <= 0).all()
    assert (hand.upper >= 0).all()


@pytest.mark.parametrize("side", SIDES)
def test_named_poses_differ_and_keep_to_the_ranges(side: str) -> None:
    poses = HANDS[side].named_poses()
    assert {REST, "fist", "open", "point"} <= set(poses)
    stacked = torch.from_numpy(np.stack([HANDS[side].pose(angles) for angles in poses.values()]))
    penalty = joint_limit_penalty(stacked, load_template("anny", side))
    assert float(penalty.max()) < 1e-12
    assert len({angles.tobytes() for angles in poses.values()}) == len(poses)


@pytest.mark.parametrize("side", SIDES)
def test_a_hand_at_rest_shows_its_palm_with_its_fingers_up(side: str) -> None:
    studio = free_studio(side)
    rest = posed_vertices(studio, side)
    bases = {f"{finger}1 flexion": 45.0 for finger in ("index", "middle", "ring", "little")}
    bent = posed_vertices(studio, side, pose=bases)
    tips = list(load_template("anny", side).fingertips)[1:]
    # y points down, and a camera at the origin looks along z: fingers close towards it.
    assert rest[tips, 1].max() < rest[:, 1].mean()
    assert (bent[tips, 2] < rest[tips, 2] - 0.03).all()


@pytest.mark.parametrize("sides", [("right",), ("left",), SIDES], ids="-".join)
@pytest.mark.parametrize("turn", [0.0, 75.0, 180.0])
def test_the_camera_sees_all_of_every_hand(sides: tuple[str, ...], turn: float) -> None:
    studio = free_studio(*sides)
    camera = studio.camera(200, 150)
    points = [posed_vertices(studio, side, turn) for side in sides]
    pixels = np.concatenate(points) @ camera.K.T
    pixels = pixels[:, :2] / pixels[:, 2:]
    assert (pixels > 0).all()
    assert (pixels < [200, 150]).all()
    assert np.ptp(pixels[:, 1]) > 0.4 * 150
    if len(sides) == 2 and turn == 0.0:
        assert points[0][:, 0].min() > points[1][:, 0].max()


def test_a_turn_keeps_the_hand_where_it_is_and_shows_its_back() -> None:
    studio = free_studio("right")
    front, back = (posed_vertices(studio, "right", turn) for turn in (0.0, 180.0))
    mirrored = 2 * studio.centre - front
    mirrored[:, 1] = front[:, 1]
    np.testing.assert_allclose(back, mirrored, atol=1e-9)


def test_what_is_no_pose_is_refused_by_name() -> None:
    studio = free_studio("right")
    for pose, message in (
        ("fits", r"'fits'.*fist"),
        ({"index1 flexoin": 3.0}, "Did you mean 'index1 flexion'"),
        ({"index1 flexion": 95.0}, r"index1 flexion is 95 degrees.*-47 to 82"),
        ({"index1 flexion": float("nan")}, "nan degrees"),
        (np.zeros((3, 3)), r"shape \(3, 3\)"),
        (np.full((16, 3), np.inf), "infinity"),
    ):
        with pytest.raises(UsageError, match=message):
            studio.posed(pose)
    with pytest.raises(UsageError, match="0x5"):
        studio.camera(0, 5)
    assert len(ANGLE_NAMES) == len(set(ANGLE_NAMES)) == 48


def test_an_avatar_draws_a_pose_in_every_form_alike(tiny_avatar: WildGHandAvatar) -> None:
    studio = tiny_avatar.studio
    hand, camera = studio.angles["right"], studio.camera(48, 48)
    angles = np.zeros((16, 3))
    angles[1, 0] = 60.0
    expected = tiny_avatar.render(studio.posed(hand.pose(angles)), camera)
    assert expected[..., 3].max() > 0.5
    for pose in ({"index1 flexion": 60.0}, hand.pose(angles), hand.pose(angles)[1:]):
        np.testing.assert_array_equal(tiny_avatar.render(pose, size=48), expected)
    rest = tiny_avatar.render(size=48)
    np.testing.assert_array_equal(rest, tiny_avatar.render("rest", camera))
    assert np.abs(rest - expected).max() > 0.2
    with pytest.raises(UsageError, match="size"):
        tiny_avatar.render("rest", size=100_000)
