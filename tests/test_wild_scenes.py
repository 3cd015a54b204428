"""Sets of scenes are disjoint where the docs say so. Oracle: the scene files themselves."""

from __future__ import annotations

import itertools
import json
from dataclasses import replace
from functools import cache
from pathlib import Path

import pytest

import wildghand
from benchmarks.scene_overlap import KINDS, counts, parts, shared
from hwp_bench.sim.hand.anatomy import SubjectAnatomy
from hwp_bench.sim.light.lights import Lamp
from hwp_bench.sim.scene.scene import Scene
from hwp_bench.sim.scene_files import load_scene, scene_groups, scene_names
from hwp_bench.taxonomy import PERTURBATIONS

PRIORS = Path(wildghand.__file__).parent / "priors"
#: Objects that no scene of the paper's captures shows.
FURTHER = {"mug", "ball", "spoon", "banana", "remote", "bottle", "brush", "notebook"}


@cache
def sets() -> dict[str, tuple[Scene, ...]]:
    """Every set of scenes by its name; `captures` are those of smoke, mini and full."""
    found = {"captures": tuple(map(load_scene, scene_names()))}
    for group in scene_groups():
        found[group] = tuple(map(load_scene, scene_names(group)))
    files = sorted((PRIORS / "scenes").glob("*.toml"))
    found["prior"] = tuple(load_scene(str(path)) for path in files)
    assert all(found.values())
    return found


def pairs() -> list[tuple[str, str]]:
    # The shipped prior's scenes are captures 8, 9 and 10 with other people: docs/prior.md.
    known = {("captures", "prior")}
    return [pair for pair in itertools.combinations(sets(), 2) if pair not in known]


@pytest.mark.parametrize(("first", "second"), pairs())
def test_sets_of_scenes_share_nothing(first: str, second: str) -> None:
    assert shared(sets()[first], sets()[second]) == []


def test_no_subject_of_a_suite_is_one_that_the_shipped_prior_saw() -> None:
    record = json.loads((PRIORS / "compact" / "prior.json").read_text("utf-8"))
    seen = {("subject", f"seed {one['source']['seed']}") for one in record["captures"]}
    assert len(seen) == len(record["captures"])
    for group in scene_groups():
        assert not any(parts(scene) & seen for scene in sets()[group])


@pytest.mark.parametrize("group", scene_groups())
def test_each_perturbation_has_a_single_hand_and_an_interacting_capture(group: str) -> None:
    scenes = sets()[group]
    assert [scene.id for scene in scenes] == [f"{group}-{number}" for number in range(8)]
    first = sorted((scene.effects[0].kind, scene.hands == "both") for scene in scenes)
    assert first == sorted(itertools.product(PERTURBATIONS, (False, True)))


@pytest.mark.parametrize("group", ["wild-dev", "wild-test"])
def test_a_wild_suite_is_wide(group: str) -> None:
    scenes = sets()[group]
    # Every subject has an anatomy of its own, whose joint centres move by 2 to 6 mm.
    anatomies = [scene.subject.anatomy for scene in scenes]
    assert len(set(anatomies)) == len(scenes)
    assert all(one is not None and 2.0 <= one.joint_shift <= 6.0 for one in anatomies)
    tones = [scene.subject.tone for scene in scenes]
    assert min(tones) < 0.0
    assert max(tones) > 1.0
    worn = [glove.kind for scene in scenes for glove in scene.subject.looks.gloves]
    assert sorted(worn) == ["fingerless", "work"]
    assert any(scene.subject.looks.arm == "bare" for scene in scenes)
    assert any(scene.light.lamps for scene in scenes)
    assert any(scene.light.room for scene in scenes)
    assert sum(scene.estimator is not None for scene in scenes) >= 4
    shown = {text for scene in scenes for kind, text in parts(scene) if kind == "object"}
    assert shown
    assert shown <= FURTHER
    assert not any(scene.sensor.h264 for scene in scenes)
    assert min(counts(scenes).values()) > 0


def test_an_overlap_is_found_in_every_part() -> None:
    """A made-up scene that takes one part of another is caught, by name and by kind."""
    first, second = sets()["captures"][0], sets()["wild-dev"][0]
    assert shared([first], [second]) == []
    person = second.subject
    lamp = Lamp(place=(0.1, -0.5, 0.2), strength=1.0)
    lit = replace(first, light=replace(first.light, lamps=(lamp,)))
    turned = second.track.keys["right"][2:] + second.track.keys["right"][:2]
    made = {
        "subject": replace(first, subject=replace(first.subject, seed=person.seed)),
        "looks": replace(first, subject=replace(first.subject, tone=person.tone, age=person.age)),
        "room": replace(first, background=second.background),
        "light": replace(first, light=replace(first.light, lamps=second.light.lamps)),
        "object": replace(first, effects=second.effects),
        "gestures": replace(first, track=replace(first.track, right=turned)),
    }
    assert tuple(made) == KINDS
    for kind, scene in made.items():
        lines = shared([scene], [second])
        assert lines
        assert any(line.startswith(kind) for line in lines), lines
        assert all("capture0 and wild-dev-0" in line for line in lines)
    assert shared([lit], [second]) == []
    drawn = replace(first.subject, anatomy=SubjectAnatomy(seed=person.seed))
    assert shared([replace(first, subject=drawn)], [second])
    rigged = replace(first.subject, model="rig:generic-hand")
    other = replace(second, subject=replace(person, model="rig:generic-hand"))
    assert shared([replace(first, subject=rigged)], [other])
    ring = replace(person.looks.rings[0], side="left")
    ringed = replace(first.subject, looks=replace(first.subject.looks, rings=(ring,)))
    assert shared([replace(first, subject=ringed)], [second])
