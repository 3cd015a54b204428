"""What sets of scenes share: subjects, looks, rooms, lights, objects and gesture tracks.

`wild-dev`, `wild-test`, the paper's eleven captures and the scenes of the prior must share none of
it; `tests/test_wild_scenes.py` reads the scene files through this module.
"""

from __future__ import annotations

import json
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import asdict

from hwp_bench.sim.effects import ComplexPoses, ObjectInteraction, read_effect
from hwp_bench.sim.hand.rigs import FROM_FILE, SHIPPED
from hwp_bench.sim.scene.scene import HandKey, Scene
from hwp_bench.sim.subject.subject import Subject, without_defaults

#: What a scene is made of, and what of it two sets may not share.
KINDS = ("subject", "looks", "room", "light", "object", "gestures")
# Fewer gestures in a row than these are no track that one could know again.
_ROW = 3


def parts(scene: Scene) -> set[tuple[str, str]]:
    """What a scene is made of: pairs of a kind and a text that says which one.

    A *subject* is a seed or the file of a rig; seeds of an anatomy and of the scene count as
    seeds of a subject. *Looks* are tone and age together, and each tattoo, ring, glove and so on,
    whichever hand has it. A *room* is a backdrop or what is behind the hands. A *light* is the
    key light with the sky, a lamp, or the colours of the walls. *Gestures* are a row of gestures
    (wherever it begins), and each key as the hand is held in it.
    """
    found = {
        ("room", scene.background),
        *(("room", f"{name} {text}") for name, text in _things(asdict(scene.behind))),
        *(("subject", text) for text in _identity(scene.subject, scene.seed)),
        *(("looks", text) for text in _looks(scene.subject)),
        *(("light", text) for text in _lights(scene)),
    }
    for call in scene.effects:
        effect = read_effect(call, scene.id)
        if isinstance(effect, ObjectInteraction):
            found |= {("object", item.object) for item in effect.items}
    for row in _rows(scene):
        found |= {("gestures", json.dumps(asdict(key))) for key in row}
        if len(row) >= _ROW:
            found.add(("gestures", _known_again([key.gesture for key in row])))
    return found


def shared(first: Iterable[Scene], second: Iterable[Scene]) -> list[str]:
    """What two sets of scenes have in common, a line each; empty where they are disjoint."""
    ours, theirs = _made_of(first), _made_of(second)
    return [
        f"{kind} {text}: {ours[kind, text]} and {theirs[kind, text]}"
        for kind, text in sorted(ours.keys() & theirs.keys())
    ]


def counts(scenes: Sequence[Scene]) -> dict[str, int]:
    """How many different parts of each kind a set of scenes has."""
    made = _made_of(scenes)
    return {kind: sum(one == kind for one, _ in made) for kind in KINDS}


def _made_of(scenes: Iterable[Scene]) -> dict[tuple[str, str], str]:
    """Each part with the first scene that has it."""
    made: dict[tuple[str, str], str] = {}
    for scene in scenes:
        for part in parts(scene):
            made.setdefault(part, scene.id)
    return made


def _identity(subject: Subject, scene_seed: int) -> Iterator[str]:
    yield f"seed {subject.seed}"
    yield f"seed {scene_seed}"
    if subject.anatomy is not None and subject.anatomy.seed is not None:
        yield f"seed {subject.anatomy.seed}"
    if subject.model.startswith((FROM_FILE, SHIPPED)):
        yield f"rig {subject.model}"


def _looks(subject: Subject) -> Iterator[str]:
    yield f"tone {subject.tone:g} at {subject.age:g} years"
    for name, value in without_defaults(subject.looks).items():
        for item in value if isinstance(value, (list, tuple)) else ():
            if isinstance(item, dict):
                item = {key: part for key, part in item.items() if key != "side"}
                yield f"{name} {json.dumps(item, sort_keys=True)}"


def _lights(scene: Scene) -> Iterator[str]:
    light = scene.light
    yield f"key {light.direction} {light.key:g} {light.kelvin:g} sky {light.sky:g}"
    yield from (f"lamp {json.dumps(asdict(lamp))}" for lamp in light.lamps)
    if light.room is not None:
        yield f"walls {json.dumps(asdict(light.room))}"


def _things(table: dict[str, object]) -> Iterator[tuple[str, str]]:
    for name, value in table.items():
        if value is not None:
            yield name, json.dumps(value, sort_keys=True)


def _rows(scene: Scene) -> Iterator[tuple[HandKey, ...]]:
    yield from scene.track.keys.values()
    for call in scene.effects:
        effect = read_effect(call, scene.id)
        if isinstance(effect, ComplexPoses):
            yield from (row for row in (effect.right, effect.left) if row)
        if isinstance(effect, ObjectInteraction):
            held = (effect.stage.right, effect.stage.left)
            yield from ((key,) for key in held if key is not None)


def _known_again(gestures: list[str]) -> str:
    """A row of gestures in the rotation that comes first: the same wherever it begins."""
    turns = [gestures[start:] + gestures[:start] for start in range(len(gestures))]
    return " ".join(min(turns))
