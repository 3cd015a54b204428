"""Hard cases of the pre-pass, for `hwp-bench dev stability` and for the tests.

Frames show a hand of one colour under one light in front of a dark wall, so that what is done to
them is known: the gains that were put in, the frames that were spoiled.
"""

from __future__ import annotations

import functools
from collections.abc import Callable
from dataclasses import fields, replace

import numpy as np

from hwp_bench.base.colors import linear_to_srgb
from hwp_bench.base.errors import BadInput
from hwp_bench.capture import Cameras
from hwp_bench.hands.anchors import HandSurfaces
from hwp_bench.hands.skeleton import HandParameters
from hwp_bench.hands.sources import load_template
from hwp_bench.stability import CaseGroup, Measured
from wildghand.prepass.assessment import (
    CLEAN_FROM,
    FrameAssessment,
    PrepassSettings,
    densest,
    excess,
    normal_value,
)
from wildghand.prepass.judge import (
    clean_probability,
    clip_tolerance,
    evidence,
    judge_frames,
)
from wildghand.prepass.measurements import PrepassInput

#: Largest error of a log gain that was put in.
GAIN_ERROR = 0.05
_FRAMES, _SIZE = 12, 64
_SOUND = "every number finite and in its range"

#: Every hard case of the pre-pass.
cases = CaseGroup("prepass")


@cases.case("frames of which none is perturbed", f"every frame is judged clean; {_SOUND}")
def _run_all_clean() -> Measured:
    found = judge_frames(_given())
    return Measured(
        _sound(found) and bool((found.clean >= CLEAN_FROM).all()),
        f"least probability {found.clean.min():.2f}",
    )


@cases.case("{} of 12 frames under another light", f"their gains to {GAIN_ERROR:g}; {_SOUND}", 1, 4)
def _run_gains(count: int) -> Measured:
    gains = np.zeros(_FRAMES)
    gains[:: _FRAMES // count] = -0.7
    found = judge_frames(_given(gains))
    off = _gain_error(found, gains)
    told = found.clean[gains < 0.0].max() < found.clean[gains == 0.0].min()
    return Measured(_sound(found) and off <= GAIN_ERROR and bool(told), f"gains off by {off:.3f}")


@cases.case("no clean frame: the light of each is another", f"gains in their order; {_SOUND}")
def _run_no_clean() -> Measured:
    gains = np.linspace(-1.2, 0.0, _FRAMES)[np.random.default_rng(0).permutation(_FRAMES)]
    found = judge_frames(_given(gains))
    off = _gain_error(found, gains)
    return Measured(_sound(found) and off <= GAIN_ERROR, f"gains off by {off:.3f}")


@cases.case("{} frames", f"too few to compare: every one is clean, weight 1; {_SOUND}", 1, 2, 3)
def _run_few(count: int) -> Measured:
    given = _given()
    few = replace(
        given, indices=np.arange(count), images=given.images[:count], masks=given.masks[:count]
    )
    found = judge_frames(few)
    kept = bool((found.clean == 1.0).all() and (found.frame_weights == 1.0).all())
    return Measured(_sound(found, count) and kept, f"{int(found.usable.sum())} usable")


def _black(given: PrepassInput) -> None:
    given.images[5] = 0


def _white(given: PrepassInput) -> None:
    given.images[5] = 255


def _unmasked(given: PrepassInput) -> None:
    given.masks[5] = 0


def _one_pixel(given: PrepassInput) -> None:
    given.masks[5] = 0
    given.masks[5, 30, 30] = 255


def _not_finite(given: PrepassInput) -> None:
    hand = given.hands["right"]
    for array in (hand.pose, hand.transl):
        array[5] = np.nan
    hand.valid[5] = False


def _behind(given: PrepassInput) -> None:
    given.hands["right"].transl[5] = [0.0, 0.0, -1.0]


def _beside(given: PrepassInput) -> None:
    given.hands["right"].transl[5] = [5.0, 0.0, 0.4]


_SPOILED: dict[str, Callable[[PrepassInput], None]] = {
    "that is black": _black,
    "that is white": _white,
    "with a mask of no pixel": _unmasked,
    "with a mask of one pixel": _one_pixel,
    "whose parameters are NaN": _not_finite,
    "with the hand behind the camera": _behind,
    "with the hand outside of the image": _beside,
}


@cases.case("a frame {}", f"it alone is set apart, weight 0.2; {_SOUND}", *_SPOILED)
def _run_spoiled(name: str) -> Measured:
    given = _given()
    _SPOILED[name](given)
    found = judge_frames(given)
    apart = np.flatnonzero(~found.usable).tolist()
    kept = float(found.frame_weights[5]) == PrepassSettings.weight_floor
    return Measured(_sound(found) and apart == [5] and kept, f"set apart: {apart}")


@cases.case("every frame {}", "one sentence that says what to look at", *_SPOILED)
def _run_all_spoiled(name: str) -> Measured:
    given = _given()
    _SPOILED[name](given)
    hand, rows = given.hands["right"], np.full(_FRAMES, 5)
    every = replace(hand, pose=hand.pose[rows], transl=hand.transl[rows], valid=hand.valid[rows])
    given = replace(
        given, images=given.images[rows], masks=given.masks[rows], hands={"right": every}
    )
    try:
        judge_frames(given)
    except BadInput as error:
        said = str(error)
        return Measured("\n" not in said and "data show" in said, said[:60])
    return Measured(False, "no message")


@cases.case("the same frame twelve times", f"every frame is judged clean; {_SOUND}")
def _run_still() -> Measured:
    given = _given()
    hand, rows = given.hands["right"], np.zeros(_FRAMES, int)
    still = replace(hand, pose=hand.pose[rows], transl=hand.transl[rows])
    found = judge_frames(
        replace(given, images=given.images[rows], masks=given.masks[rows], hands={"right": still})
    )
    clean = bool((found.clean >= CLEAN_FROM).all())
    return Measured(_sound(found) and clean, f"least probability {found.clean.min():.2f}")


@cases.case(
    "cues that are {}", "finite, not negative; a cue that is unknown counts as normal", "NaN"
)
@cases.case(
    "cues that are {}", "finite, not negative; a cue that is unknown counts as normal", "inf"
)
@cases.case(
    "cues that are {}", "finite, not negative; a cue that is unknown counts as normal", "all 0"
)
def _run_cues(name: str) -> Measured:
    value = 0.0 if name == "all 0" else float(name)
    some = np.array([1.0, 1.1, 0.9, value, 1.0, 5.0])
    every = np.full(6, value)
    made = [excess(one, 0.35, 0.1) for one in (some, every)]
    finite = all(bool(np.isfinite(one).all() and (one >= 0.0).all()) for one in made)
    passed = finite and made[0][3] == 0.0 and not made[1].any() and made[0][5] > 10.0
    normal = normal_value(every, 0.35)
    return Measured(passed and normal == (0.0, 0.0), f"excess {made[0].max():.3g}")


@cases.case(
    "evidence of {:g}", "the formula's probability in [0, 1], finite", 0.0, 1e-300, 1.2, 1e150
)
def _run_evidence(size: float) -> Measured:
    tolerance = PrepassSettings.tolerance
    with np.errstate(over="ignore"):
        found = float(clean_probability(np.array([size]), tolerance)[0])
    # 1 / (1 + r^3) by the logarithm of r.
    ratio = 3.0 * np.log(max(size, 1e-300) / tolerance)
    wanted = 0.0 if ratio > 700.0 else 1.0 / (1.0 + float(np.exp(ratio)))
    return Measured(abs(found - wanted) <= 1e-12, f"{found:.3g}")


@cases.case("{} values, of which the densest third is taken", "their mean by sorting", 1, 2, 3, 100)
def _run_densest(count: int) -> Measured:
    values = np.concatenate([np.linspace(0.0, 1e-3, -(-count // 2)), np.linspace(5, 9, count // 2)])
    mean, part = densest(values[:, None], 0.35)
    taken = min(count, max(2, round(0.35 * count)))
    ordered = np.sort(values)
    width = ordered[taken - 1 :] - ordered[: count - taken + 1]
    # Even values lie equally close everywhere: any run of the least width will do.
    found = np.sort(values[part])
    passed = part.sum() == taken and found[-1] - found[0] <= 2.0 * width.min() + 1e-12
    passed = bool(passed) and abs(float(mean[0]) - float(found.mean())) <= 1e-12
    return Measured(passed, f"{taken} of {count}, mean {float(mean[0]):.3g}")


@cases.case("neighbours of a frame without evidence", "what decides is bounded by the tolerance")
def _run_neighbours() -> Measured:
    cue = np.array([0.0, 1e9, 0.0, 0.0, 1e9])
    found = evidence([cue], np.array([0, 1, 2, 10, 11]), 1.2)
    own = np.log1p((cue / 3.0) ** 2)
    wanted = [
        0.75 * own[0] + 0.25 * min(own[1], 1.2),
        0.5 * own[1] + 0.25 * (min(own[0], 1.2) + min(own[2], 1.2)),
        0.25 * min(own[1], 1.2) + 0.75 * own[2],
        0.75 * own[3] + 0.25 * min(own[4], 1.2),
        0.75 * own[4] + 0.25 * min(own[3], 1.2),
    ]
    off = float(np.abs(found - wanted).max())
    return Measured(off <= 1e-12, f"off by {off:.0e}")


@cases.case("{} frames known to be clean", "the least tolerance, or the median above it", 0, 3, 4)
def _run_known(count: int) -> Measured:
    found = clip_tolerance(np.full(count, 7.0), 1.2)
    return Measured(found == (7.0 if count >= 4 else 1.2), f"{found:g}")


@functools.lru_cache(maxsize=1)
def _drawn() -> tuple[np.ndarray, np.ndarray]:
    """(F, H, W, 3) linear light, and (F, H, W) bool silhouettes."""
    template = load_template()
    surfaces = HandSurfaces({"right": template}, 0.004)
    random = np.random.default_rng(5)
    speckle = np.exp(0.12 * random.normal(size=(len(surfaces.cell_normals), 1)))
    albedo, light = np.array([0.45, 0.28, 0.2]) * speckle, np.array([0.3, -0.5, -0.8])
    frames = np.full((_FRAMES, _SIZE, _SIZE, 3), 0.02)
    silhouettes = np.zeros((_FRAMES, _SIZE, _SIZE), dtype=bool)
    clip, hands = _cameras(), {"right": _hand()}
    numbers = np.arange(_FRAMES)
    drawn = surfaces.footprints(hands, clip.Ks, clip.viewmats, numbers, (_SIZE, _SIZE))
    for frame, footprint in enumerate(drawn):
        shade = 0.5 + 0.5 * np.maximum(footprint.normals @ light, 0.0)
        frames[frame].reshape(-1, 3)[footprint.pixels] = albedo[footprint.cells] * shade[:, None]
        silhouettes[frame] = footprint.silhouette
    return frames, silhouettes


def _given(gains: np.ndarray | None = None) -> PrepassInput:
    """New arrays, which a case may spoil; `gains` (F,) are log gains of the light."""
    linear, silhouettes = _drawn()
    if gains is not None:
        linear = linear * np.exp(gains)[:, None, None, None]
    noise = np.random.default_rng(7).normal(0.0, 0.006, linear.shape)
    noisy = np.clip(linear + noise * np.sqrt(np.clip(linear, 0.02, 1.0)), 0.0, 1.0)
    return PrepassInput(
        indices=np.arange(_FRAMES),
        images=np.round(255.0 * linear_to_srgb(noisy)).astype(np.uint8),
        masks=silhouettes.astype(np.uint8) * 255,
        hands={"right": _hand()},
        cameras=_cameras(),
        templates={"right": load_template()},
    )


def _hand() -> HandParameters:
    """Upright before the camera; it turns and bends a little."""
    random = np.random.default_rng(3)
    phase = 2.0 * np.pi * np.arange(_FRAMES)[:, None, None] / 9.0
    pose = 0.15 * np.sin(phase * random.uniform(0.5, 1.5, (16, 3)) + random.uniform(0, 6, (16, 3)))
    pose[:, 0] += [np.pi / 2, 0.0, 0.0]
    transl = np.tile([0.09, 0.0, 0.45], (_FRAMES, 1))
    return HandParameters(pose, np.zeros(10), transl, np.ones(_FRAMES, dtype=bool))


def _cameras() -> Cameras:
    K = np.array([[1.4 * _SIZE, 0, _SIZE / 2], [0, 1.4 * _SIZE, _SIZE / 2], [0, 0, 1.0]])
    return Cameras(np.repeat(K[None], _FRAMES, 0), np.repeat(np.eye(4)[None], _FRAMES, 0))


def _gain_error(found: FrameAssessment, gains: np.ndarray) -> float:
    """Largest error of the gains, which are known up to one factor for all frames."""
    away = found.log_gains - gains[:, None]
    return float(np.abs(away - np.median(away, axis=0)).max())


def _sound(found: FrameAssessment, count: int = _FRAMES) -> bool:
    """Whether every number is finite and in its range."""
    values = [getattr(found, item.name) for item in fields(found)]
    arrays = [one for one in values if isinstance(one, np.ndarray)]
    finite = all(len(one) == count and np.isfinite(one.astype(float)).all() for one in arrays)
    floor = PrepassSettings.weight_floor
    shares = (found.clean, found.omega_dropout, (found.frame_weights - floor) / (1.0 - floor))
    return finite and all(bool((one >= 0.0).all() and (one <= 1.0).all()) for one in shares)
