"""Scenes: the catalogue is their oracle, and a damaged scene is refused by file and field."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from tiny_scene import SINGLE, SceneMaker

from hwp_bench.base.errors import BadInput, UsageError
from hwp_bench.capture.splits import contiguous_split
from hwp_bench.sim.produce.capture import SuiteItem, suite, suite_names
from hwp_bench.sim.scene.scene import (
    CLEAN_FROM,
    MIN_CLEAN_SHARE,
    clean_share,
    level,
    moments,
    severity,
    with_clean_share,
    with_effects,
    with_severity,
    with_subject,
)
from hwp_bench.sim.scene_files import (
    load_scene,
    meant_scenes,
    parse_scene,
    scene_groups,
    scene_names,
)
from hwp_bench.taxonomy import catalogue


def test_every_catalogue_capture_has_its_scene() -> None:
    assert set(scene_names()) == set(catalogue())


@pytest.mark.parametrize("name", sorted(catalogue()))
def test_scene_says_what_the_catalogue_says(name: str) -> None:
    scene, entry = load_scene(name), catalogue()[name]
    assert scene.id == name
    assert (scene.action, scene.device) == (entry.action, entry.device)
    assert scene.frame_count == entry.frame_count
    assert (scene.hands == "both") == (entry.hands == "interacting")
    assert {call.kind for call in scene.effects} == set(entry.perturbations)
    assert scene.camera.handheld == (entry.device == "Mobile phone")
    assert clean_share(scene) >= MIN_CLEAN_SHARE


def clean_frames(item: SuiteItem, frames: np.ndarray) -> int:
    """How many of some frames nothing perturbs."""
    when = moments(item.frame_count)[frames]
    return sum(not any(level(call, moment) for call in item.scene.effects) for moment in when)


@pytest.mark.parametrize("name", [name for name in suite_names() if "persistent" not in name])
def test_enough_training_frames_of_every_suite_are_clean(name: str) -> None:
    # Frames are few in small suites, so that a share of the time is not yet one of the frames.
    for item in suite(name):
        train = contiguous_split(item.scene.id, item.frame_count).train
        clean = clean_frames(item, train)
        assert clean >= MIN_CLEAN_SHARE * len(train), (item.scene.id, clean, len(train))


@pytest.mark.parametrize(
    ("name", "share", "clean"),
    [
        ("persistent", 0.1, 5),
        ("persistent-clean0", 0.0, 0),
        ("persistent-clean20", 0.2, 10),
        ("persistent-clean35", 0.35, 17),
        ("persistent-clean60", 0.6, 29),
    ],
)
def test_a_persistent_suite_has_its_share_of_clean_frames(
    name: str, share: float, clean: int
) -> None:
    # Oracle: so many of 48 training frames, to the nearest frame; validation and test are clean.
    items = suite(name)
    assert [item.scene.id for item in items] == [f"persistent-{number}" for number in range(8)]
    for item in items:
        split = contiguous_split(item.scene.id, item.frame_count)
        assert item.scene.clean_share == share
        assert len(split.train) == 48
        assert clean_frames(item, split.train) == clean == round(48 * share)
        later = np.concatenate([split.validation, split.test])
        assert clean_frames(item, later) == len(later)


def test_another_clean_share_stretches_every_gap_alike(make_scene: SceneMaker) -> None:
    # Oracle: 0.35 of 0.8 is perturbed, in episodes of 0.15, 0.1 and 0.1 with gaps of 0.05, 0.1,
    # 0.1 and 0.2; the factors are those of the two sums.
    scene = make_scene()
    changed = with_clean_share(scene, 0.1)
    episodes = [part for call in changed.effects for part in call.episodes]
    starts, ends = [part.start for part in episodes], [part.end for part in episodes]
    busy, idle = 0.72 / 0.35, 0.08 / 0.45
    assert ends == pytest.approx(
        [0.05 * idle + 0.15 * busy, 0.15 * idle + 0.25 * busy, 0.25 * idle + 0.35 * busy], abs=1e-6
    )
    assert starts == pytest.approx(
        [0.05 * idle, 0.15 * idle + 0.15 * busy, 0.25 * idle + 0.25 * busy], abs=1e-6
    )
    assert [part.severity for part in episodes] == [4, 3, 3]
    assert clean_share(changed) == pytest.approx(0.1, abs=0.01)
    # At its own share a scene stays what it is, but for the field.
    again = with_clean_share(changed, 0.1)
    assert [call.episodes[0].start for call in again.effects] == pytest.approx(starts, abs=1e-6)
    assert scene.digest != changed.digest
    assert "clean_share" not in scene.to_json()
    assert changed.to_json()["clean_share"] == 0.1


@pytest.mark.parametrize("share", [-0.1, 0.95, float("nan")])
def test_a_clean_share_out_of_range_is_refused(make_scene: SceneMaker, share: float) -> None:
    with pytest.raises(UsageError, match=r"clean_share: .* is not in 0\.\.0\.9"):
        with_clean_share(make_scene(), share)


def test_a_clean_share_that_episodes_cannot_have_is_refused(make_scene: SceneMaker) -> None:
    # No effect, none that always acts, and one whose ends are too mild to count as perturbed.
    with pytest.raises(UsageError, match="leave 100% of the training part unperturbed"):
        with_clean_share(with_effects(make_scene(), ()), 0.1)
    always = with_clean_share(make_scene(), 0.0)
    assert clean_share(always) == pytest.approx(0.0, abs=1e-3)
    with pytest.raises(UsageError, match="leave 0% of the training part unperturbed instead of 3"):
        with_clean_share(always, 0.3)
    with pytest.raises(UsageError, match=r"severity from 1\.5 on"):
        with_clean_share(with_severity(make_scene(), 1), 0.1)


def test_a_changed_scene_states_no_clean_share_that_is_false() -> None:
    # Oracle: the share as it is measured. Ends of episodes of severity 1 are clean.
    scene = load_scene("persistent-2")
    assert with_severity(scene, 3).clean_share == scene.clean_share == 0.1
    mild = with_severity(scene, 1)
    assert clean_share(mild) > 0.15
    assert mild.clean_share is None
    assert with_effects(scene, ()).clean_share is None


def test_a_scene_file_says_its_clean_share(make_scene: SceneMaker) -> None:
    text = ("seed = 5", "seed = 5\nclean_share = 0.2")
    assert make_scene(text) == with_clean_share(make_scene(), 0.2)
    # Fewer clean frames than other scenes must have are refused without the field.
    longer = ("[[0.5, 0.6, 3]]", "[[0.41, 0.79, 3]]")
    with pytest.raises(BadInput, match="at least 35% must be"):
        make_scene(longer)
    assert clean_share(make_scene(text, longer)) == pytest.approx(0.2, abs=0.01)
    with pytest.raises(BadInput, match=r"tiny\.toml: clean_share"):
        make_scene(("seed = 5", "seed = 5\nclean_share = 1.0"))
    with pytest.raises(BadInput, match=r"tiny\.toml: clean_share: the episodes leave"):
        make_scene(text, ("episodes = [[0.05, 0.2, 4]]", "episodes = [[0.05, 0.2, 1]]"))


@pytest.mark.parametrize("name", sorted(catalogue()))
def test_nothing_acts_in_validation_and_test(name: str) -> None:
    scene = load_scene(name)
    for call in scene.effects:
        assert all(level(call, m / 1000) == 0.0 for m in range(int(1000 * CLEAN_FROM) + 1, 1001))


@pytest.mark.parametrize(
    ("old", "new", "field"),
    [
        ('title = "A small scene"\n', "", "title"),
        ('id = "tiny"', 'id = "my hand"', "id"),
        ('id = "tiny"', 'id = "../tiny"', "id"),
        ("seed = 5", "seed = -5", "seed"),
        ("fps = 20.0", "fps = nan", "fps"),
        ("tone = 0.22", "tone = 1.5", "subject.tone"),
        ("tone = 0.22", "tone = true", "subject.tone"),
        ("handheld = true", "handheld = 1", "camera.handheld"),
        ("kelvin = 5200.0", "kelvin = 5200.0\nglow = 1", "light.glow"),
        ("direction = [-0.5, -0.9, -0.8]", "direction = [0, 0, 0]", "light.direction"),
        ("direction = [-0.5, -0.9, -0.8]", "direction = [0, 0]", "light.direction"),
        ('gesture = "fist"', 'gesture = "fits"', "track.right[1].gesture"),
        ('kind = "illumination"', 'kind = "earthquake"', "effects[1].kind"),
        ("[[0.3, 0.4, 3]]", "[[0.3, 0.4, 7]]", "effects[1].episodes"),
        ("[[0.3, 0.4, 3]]", "[[0.4, 0.3, 3]]", "effects[1].episodes"),
        ("[[0.3, 0.4, 3]]", "[[0.3, 0.9, 3]]", "effects[1].episodes"),
        ("[[0.3, 0.4, 3]]", "[[0.7, 0.8, 3]]", "effects[1].episodes"),
        ("[[0.3, 0.4, 3]]", "[[0.35, 0.4, 3], [0.3, 0.36, 2]]", "effects[1].episodes"),
        ("age = 31.0", 'age = 31.0\nmodel = "gtlf:hand.glb"', "subject.model"),
        ("age = 31.0", 'age = 31.0\nmodel = "gltf:"', "subject.model"),
        ("age = 31.0", 'age = 31.0\nmodel = "rig:nobody"', "subject.model"),
        ("age = 31.0", "age = 31.0\nsleeve = [-1.0, 0.5, 0.4]", "subject.sleeve[0]"),
        ("[[0.3, 0.4, 3]]", "[[0.21, 0.79, 3]]", "effects"),
        ('object = "block"', 'object = "brick"', "object"),
        ('anchor = "right"', 'anchor = "left"', "anchor"),
        ('background = "studio"', 'background = "moon"', "background"),
        ('[[effects]]\nkind = "illumination"', '[[effects]]\nkind = "motion_blur"', "effects"),
    ],
)
def test_damage_is_named(make_scene: SceneMaker, old: str, new: str, field: str) -> None:
    with pytest.raises(BadInput) as caught:
        make_scene((old, new))
    assert caught.value.where == "tiny.toml"
    assert field in str(caught.value)


def test_a_light_that_does_nothing_is_refused(make_scene: SceneMaker) -> None:
    # Neither key light nor lamps: of the default modes, move comes third.
    dark = ("key = 0.6", "key = 0.0")
    two, three = (
        ("[[0.3, 0.4, 3]]", f"[[0.3, 0.33, 3], [0.35, 0.37, 3]{more}]")
        for more in ("", ", [0.38, 0.4, 3]")
    )
    make_scene(dark, two)
    with pytest.raises(BadInput, match=r"effects\(illumination\)\.modes: 'move' changes the key"):
        make_scene(dark, three)
    lamp = "[[light.lamps]]\nplace = [1.0, 0.0, 0.0]\nstrength = 1.0\n[track]"
    make_scene(dark, three, ("[track]", lamp))


def test_a_clean_share_just_too_small_is_shown_as_such(make_scene: SceneMaker) -> None:
    # 700 of the 2,001 moments at which it is measured: 34.98 %, less than 35 %.
    with pytest.raises(BadInput, match=r"only 34\.98% of the training part"):
        make_scene(("[[0.3, 0.4, 3]]", "[[0.2502, 0.62, 3]]"))


#: Tables with a field at fault: what stands before `[track]`, and the field.
WRONG = (
    ("[sensor]\njpeg_quality = 50", "sensor.noise"),
    ("[sensor]\nnoise = 0.3", "sensor.noise"),
    ("[sensor]\nnoise = 0.01\njpeg_quality = 1.5", "sensor.jpeg_quality"),
    ("[sensor]\nnoise = 0.01\njpeg_quality = 101", "sensor.jpeg_quality"),
    ("[sensor]\nnoise = 0.01\nrolling_shutter = 0.2", "sensor.rolling_shutter"),
    ("[sensor]\nnoise = 0.01\nrolling_shutter = -0.01", "sensor.rolling_shutter"),
    ("[sensor]\nnoise = 0.01\nlens = 1", "sensor.lens"),
    ("[sensor]\nnoise = 0.01\nsharpening = -0.1", "sensor.sharpening"),
    ("[sensor]\nnoise = 0.01\n[sensor.auto]\nlevel = 0.0", "sensor.auto.level"),
    ("[sensor]\nnoise = 0.01\n[sensor.auto]\nlag = 0.0", "sensor.auto.lag"),
    ("[sensor]\nnoise = 0.01\n[sensor.auto]\niso = 100", "sensor.auto.iso"),
    ("[[light.lamps]]\nplace = [0.1, 0.0, 0.0]\nstrength = 1.0", "light.lamps[0].place"),
    ("[[light.lamps]]\nplace = [1.0, 0.0, 0.0]", "light.lamps[0].strength"),
    ("[light.room]\nleft = [2.0, 0.0, 0.0]", "light.room.left[0]"),
    ("[light.room]\nnorth = [1.0, 0.0, 0.0]", "light.room.north"),
    ('[estimator]\nkind = "oracle"', "estimator.kind"),
    ('[estimator]\nkind = "tracker"\nscale = -1.0', "estimator.scale"),
    ('[estimator]\nkind = "tracker"\nfailures = 0.9', "estimator.failures"),
    ("[estimator]\nscale = 1.0", "estimator.kind"),
    ("[subject.anatomy]\njoint_shift = 9.0", "subject.anatomy.joint_shift"),
    ("[subject.anatomy]\nfinger_lengths = [1.0, 1.0, 1.0, 1.0, 2.0]", "finger_lengths[4]"),
    ("[subject.anatomy]\npalm = [1.0, 1.0]", "subject.anatomy.palm"),
    ("[subject.anatomy]\nnail_lenght = 2.0", "subject.anatomy.nail_lenght"),
    ("[behind]\nghost = 1", "behind.ghost"),
    ("[behind.face]\nsize = 9.0", "behind.face.size"),
    ('[behind.arm]\nside = "top"', "behind.arm.side"),
    ("[behind.clutter]\ncount = 0", "behind.clutter.count"),
    ("[subject.looks]\nhair = 2.0", "subject.looks.hair"),
    ('[subject.looks]\narm = "wooden"', "subject.looks.arm"),
    ("[subject.looks]\nbeard = 1.0", "subject.looks.beard"),
    ('[subject.looks]\nrings = [{ finger = "toe" }]', "looks.rings[0].finger"),
    ("[subject.looks]\npolish = [{ colors = [[1, 0, 0], [0, 0, 1]] }]", "polish[0].colors"),
    (
        '[subject.looks]\ngloves = [{ kind = "work" }, { kind = "work", side = "left" }]',
        "subject.looks.gloves",
    ),
    (
        '[subject.looks]\ntattoos = [{ motif = "vine", ink = [0.1, 0.2, 3.0] }]',
        "looks.tattoos[0].ink",
    ),
)


@pytest.mark.parametrize(("table", "field"), WRONG)
def test_a_wrong_field_of_a_table_is_named(make_scene: SceneMaker, table: str, field: str) -> None:
    noise = ("noise = 0.01\n", "") if table.startswith("[sensor]") else ("seed = 5", "seed = 5")
    with pytest.raises(BadInput) as caught:
        make_scene(noise, ("[track]", f"{table}\n[track]"))
    assert field in str(caught.value)


def test_unknown_scene_lists_the_known_ones() -> None:
    with pytest.raises(UsageError, match="capture10"):
        load_scene("capture11")
    with pytest.raises(UsageError, match="wild-dev-7"):
        load_scene("wild-dev-8")


def test_groups_of_scenes_are_apart_from_the_eleven() -> None:
    assert scene_groups() == ("persistent", "wild-dev", "wild-test")
    assert not set(scene_names()) & {name for group in scene_groups() for name in known(group)}
    assert meant_scenes(["all"]) == scene_names()
    assert meant_scenes(["wild-dev", "a.toml"]) == (*known("wild-dev"), "a.toml")
    assert [item.scene.id for item in suite("wild-dev")] == list(known("wild-dev"))
    assert [item.scene.id for item in suite("full")] == list(scene_names())


def known(group: str) -> tuple[str, ...]:
    return tuple(f"{group}-{number}" for number in range(8))


@settings(max_examples=60, deadline=None)
@given(st.data())
def test_any_damaged_text_is_bad_input_or_a_scene(data: st.DataObject) -> None:
    start = data.draw(st.integers(0, len(SINGLE) - 1))
    length = data.draw(st.integers(0, 30))
    middle = data.draw(st.text(st.characters(codec="utf-8"), max_size=12))
    try:
        scene = parse_scene(SINGLE[:start] + middle + SINGLE[start + length :], where="tiny.toml")
    except BadInput:
        return
    assert clean_share(scene) >= MIN_CLEAN_SHARE


def test_severity_rises_and_falls_within_an_episode(make_scene: SceneMaker) -> None:
    call = make_scene().effects[0]
    inside = [severity(call, 0.05 + 0.15 * step / 40) for step in range(1, 40)]
    peak = inside.index(max(inside))
    assert max(inside) == 4
    assert inside[: peak + 1] == sorted(inside[: peak + 1])
    assert min(inside) >= 1


def test_variants_change_what_they_say(make_scene: SceneMaker) -> None:
    scene = make_scene()
    mild = with_severity(scene, 2)
    assert {part.severity for call in mild.effects for part in call.episodes} == {2.0}
    other = with_subject(scene, 9)
    assert other.subject != scene.subject
    assert with_subject(scene, 9) == other
    assert [call.kind for call in with_effects(scene, ["motion_blur"]).effects] == ["motion_blur"]
    assert len({scene.digest, mild.digest, other.digest}) == 3
    with pytest.raises(UsageError):
        with_severity(scene, 6)
