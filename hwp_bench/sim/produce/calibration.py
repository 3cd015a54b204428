"""Severity calibrated: which strength of an effect costs a scene's frames how much.

Severity 1 to 5 means a stated loss between a frame and its clean version over the hand
(`TARGETS`). For illumination and motion blur that is the PSNR of the two images; for complex
poses the PSNR between the hand and the same hand as the estimator believes it; for hand-object
interaction the share of the hand that is covered. Skin is smooth, so blur costs few decibels
inside the hand long before it ruins a fit: its scale is finer.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from types import MappingProxyType

import numpy as np

from hwp_bench.base.colors import linear_to_srgb
from hwp_bench.base.console import track
from hwp_bench.base.errors import BadInput, UsageError
from hwp_bench.base.files import atomic_write
from hwp_bench.sim.effects import EFFECTS, hands_at, plan_frame
from hwp_bench.sim.geometry.noise import generator
from hwp_bench.sim.geometry.surface import RenderCost
from hwp_bench.sim.light.lights import steady_light
from hwp_bench.sim.render.frame import carry_out
from hwp_bench.sim.render.stage import Lens, RenderStage, render_instant
from hwp_bench.sim.scene.scene import EffectCall, Scene, intrinsics, viewmat, with_effects
from hwp_bench.sim.scene_files import parse_scene
from hwp_bench.sim.sensor import Sensor
from hwp_bench.sim.subject.hand import MOVING

#: What severity 1 to 5 means: mean PSNR over the hand in dB, or its covered share.
TARGETS: Mapping[str, tuple[float, ...]] = MappingProxyType(
    {
        "hand_object_interaction": (0.05, 0.10, 0.17, 0.26, 0.36),
        "complex_poses": (29.0, 26.0, 24.0, 22.5, 21.5),
        "illumination": (32.0, 28.0, 24.0, 20.0, 17.0),
        "motion_blur": (36.0, 32.0, 29.5, 27.5, 26.0),
    }
)
#: Edge of the images that are compared.
SIZE = 112
# Strengths that are tried, as a share of the largest.
_TRIED = np.array([0.01, 0.03, 0.06, 0.11, 0.18, 0.28, 0.42, 0.66, 1.0])
_TRIED_LINEAR = np.linspace(0.0, 1.0, 9)


@dataclass(frozen=True)
class Calibration:
    """One effect of one scene, calibrated."""

    #: Name of the effect.
    kind: str
    #: `psnr` (dB) or `share` (of the hand).
    measure: str
    #: Strengths at severity 1 to 5.
    strengths: tuple[float, ...]
    #: What was measured with them.
    measured: tuple[float, ...]
    #: The losses that were aimed at.
    targets: tuple[float, ...]


def calibrate(scene: Scene, call: EffectCall, size: int = SIZE) -> Calibration:
    """Solve an effect's strengths for the stated losses."""
    covering = call.kind == "hand_object_interaction"
    top = EFFECTS[call.kind].max_strength
    tried = top * (_TRIED_LINEAR if covering else _TRIED)
    # The middle of every episode.
    frames = [round(0.5 * (part.start + part.end) * scene.frame_count) for part in call.episodes]
    measure = _measure(scene, call, frames, size)
    losses = [measure(float(strength)) for strength in track(tried, f"{scene.id} {call.kind}")]
    targets = TARGETS[call.kind]
    if covering:
        strengths = np.interp(targets, np.maximum.accumulate(losses), tried)
    else:
        falling = np.minimum.accumulate(losses)
        strengths = np.exp(np.interp(-np.array(targets), -falling, np.log(tried)))
    rounded = tuple(float(f"{value:.4g}") for value in np.maximum.accumulate(strengths))
    return Calibration(
        kind=call.kind,
        measure="share" if covering else "psnr",
        strengths=rounded,
        measured=tuple(round(measure(strength), 3) for strength in rounded),
        targets=targets,
    )


def write_strengths(path: Path, calibrations: list[Calibration]) -> None:
    """Write strengths into a scene file; the rest of it stays as it is."""
    if not path.is_file():
        raise UsageError("does not exist", where=path)
    text = path.read_text(encoding="utf-8")
    for item in calibrations:
        text = _with_strengths(text, item, str(path))
    parse_scene(text, where=str(path))
    atomic_write(path, text)


def _with_strengths(text: str, item: Calibration, where: str) -> str:
    line = f"strengths = [{', '.join(repr(value) for value in item.strengths)}]"
    # A table begins at a bracket at the start of a line; rows of an array are indented.
    tables = re.split(r"^(?=\[)", text, flags=re.MULTILINE)
    kind = re.compile(rf'^kind = "{item.kind}"\n', re.MULTILINE)
    own = [number for number, table in enumerate(tables) for _ in kind.findall(table)]
    if len(own) != 1:
        problem = f"names {item.kind} {len(own)} times as a line of its own"
        raise BadInput(problem, where=where, field="effects")
    before = re.compile(r"^strengths\s*=\s*\[[^\]]*\][^\n]*\n?", re.MULTILINE)
    rest = before.sub("", tables[own[0]])
    tables[own[0]] = kind.sub(lambda found: f"{found[0]}{line}\n", rest)
    return "".join(tables)


def _measure(
    scene: Scene, call: EffectCall, frames: list[int], size: int
) -> Callable[[float], float]:
    alone = replace(with_effects(scene, [call.kind]), sensor=Sensor(noise=0.0))
    if call.kind == "complex_poses":
        return lambda strength: float(
            np.mean([_pose_loss(alone, frame, size, strength) for frame in frames])
        )

    def loss(strength: float) -> float:
        values = []
        for frame in frames:
            recipe = plan_frame(alone, frame, alone.frame_count, size, {call.kind: strength})
            result = carry_out(alone, recipe, size)
            hand = result.clean_coverage > 0.999
            if call.kind == "hand_object_interaction":
                values.append(1.0 - float(result.coverage[hand].mean()))
            else:
                values.append(psnr(result.rgb[hand] / 255.0, result.clean[hand] / 255.0))
        return float(np.mean(values))

    return loss


def _pose_loss(scene: Scene, frame: int, size: int, strength: float) -> float:
    """PSNR between a hand and the same hand in an erroneous pose, over the true hand."""
    cost = RenderCost()
    stage = RenderStage(scene, cost)
    seconds = plan_frame(scene, frame, scene.frame_count, size).seconds
    hands = hands_at(scene, seconds)
    angle, length = EFFECTS["complex_poses"].estimate_error(strength)
    rng = generator(scene.seed, "calibration", frame)
    wrong = {}
    for side, (pose, transl) in stage.parameters(hands).items():
        turn = angle * rng.normal(size=(16, 3))
        turn[0] *= 0.6
        wrong[side] = (pose + turn, transl + length * rng.normal(size=3) * [1.0, 1.0, 2.0])
    lens = Lens(intrinsics(scene, size), viewmat(scene, seconds), size, 1, seconds=seconds)
    lights = steady_light(scene.light)
    images = []
    for parameters in (stage.parameters(hands), wrong):
        body = stage.traced(stage.surface(hands, MOVING, parameters))
        images.append(render_instant(scene, lens, body, None, lights, cost))
    hand = images[0].coverage > 0.999
    true, believed = (linear_to_srgb(image.color[hand]) for image in images)
    return psnr(believed, true)


def psnr(image: np.ndarray, target: np.ndarray) -> float:
    """PSNR of two images in [0, 1], dB; at most 100."""
    return float(-10.0 * np.log10(max(float(np.mean((image - target) ** 2)), 1e-10)))
