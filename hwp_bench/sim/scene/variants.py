"""Changed scenes: another subject, one severity throughout, fewer effects."""

from __future__ import annotations

from collections.abc import Collection
from dataclasses import replace

from hwp_bench.base.errors import UsageError
from hwp_bench.sim.geometry.noise import generator
from hwp_bench.sim.scene.schema import Scene, Subject
from hwp_bench.taxonomy import MAX_SEVERITY


def with_severity(scene: Scene, severity: float) -> Scene:
    """The scene with every episode at one severity.

    Raises:
        UsageError: the severity is not in 1 to 5.
    """
    if not 1 <= severity <= MAX_SEVERITY:
        raise UsageError(f"{severity} is not in 1..{MAX_SEVERITY}", field="severity")
    effects = tuple(
        replace(
            call,
            episodes=tuple(replace(part, severity=float(severity)) for part in call.episodes),
        )
        for call in scene.effects
    )
    return replace(scene, effects=effects)


def with_subject(scene: Scene, seed: int) -> Scene:
    """The scene with another person: shape, tone, age and sleeve follow from the seed.

    Raises:
        UsageError: the seed is negative.
    """
    if seed < 0:
        raise UsageError(f"{seed} is no seed", field="subject")
    rng = generator(seed, "person")
    red, green, blue = (round(float(channel), 3) for channel in rng.uniform(0.12, 0.8, 3))
    person = Subject(
        seed=seed,
        tone=round(float(rng.uniform(0.0, 1.0)), 3),
        age=round(float(rng.uniform(18.0, 75.0)), 1),
        sleeve=(red, green, blue),
        model=scene.subject.model,
    )
    return replace(scene, subject=person)


def with_effects(scene: Scene, kinds: Collection[str]) -> Scene:
    """The scene with only some of its effects."""
    return replace(scene, effects=tuple(call for call in scene.effects if call.kind in kinds))
