"""Inputs of a method in place of the truth: hands and masks as estimators deliver them."""

from __future__ import annotations

import numpy as np

from hwp_bench.hands.skeleton import HandParameters
from hwp_bench.sim.effects import EFFECTS, FramePlan
from hwp_bench.sim.geometry.noise import fractal_noise, generator
from hwp_bench.sim.produce.tracker import tracked
from hwp_bench.sim.props.backdrops import plane_names
from hwp_bench.sim.props.behind import NOTHING
from hwp_bench.sim.scene.motion import viewmat
from hwp_bench.sim.scene.scene import Scene

#: How far errors reach, in pixels of an image of 256: background taken for hand, hand given up,
#: and patches apart from the hand.
LEAK, BITE, ISLAND = 12.0, 7.0, 45.0
#: How often they happen where the colours are the same: an error is there where a field of unit
#: variance, times the slope, plus this, passes 0.5.
OFTEN, SLOPE = {"leak": 0.30, "bite": 0.15, "island": -0.25}, 0.45
#: Size of the errors, share of the image, and how fast they change, 1/s.
PATCH, PACE = 0.07, 0.8
# Least spread of a hand's colour in CIELAB, and how much farther than that still looks alike.
_SPREAD, _ALIKE = np.array([14.0, 5.0, 5.0]), 1.6
# Hand pixels below which no colour is known.
_LEAST = 40


def confusable(scene: Scene) -> bool:
    """Whether something in a scene can be taken for a hand: backdrop, passers-by or a bare arm."""
    bare = scene.subject.looks.arm == "bare"
    return bare or scene.background in plane_names() or scene.behind != NOTHING


def confused_mask(
    scene: Scene, plan: FramePlan, mask: np.ndarray, coverage: np.ndarray, rgb: np.ndarray
) -> np.ndarray:
    """Add to an estimated mask what colours like skin do to it.

    Takes `mask` (S, S) uint8, `coverage` (S, S) exact share of visible hand, `rgb` (S, S, 3) uint8
    sRGB. Returns (S, S) uint8, 255 = hand.
    """
    from scipy.ndimage import distance_transform_edt, gaussian_filter

    hand = coverage > 0.5
    if not confusable(scene) or hand.sum() < _LEAST or hand.all():
        return mask
    unit = len(mask) / 256.0
    alike = likeness(rgb, coverage)
    outside = distance_transform_edt(~hand) / unit
    inside = distance_transform_edt(hand) / unit
    leak = _errs("leak", scene, plan, alike * np.exp(-((outside / LEAK) ** 2)))
    island = _errs("island", scene, plan, alike * np.exp(-((outside / ISLAND) ** 2)))
    # What lies across the border decides whether hand is given up.
    free = gaussian_filter((~hand).astype(np.float64), 5.0 * unit)
    across = gaussian_filter(alike * ~hand, 5.0 * unit) / np.maximum(free, 1e-3)
    bite = _errs("bite", scene, plan, across * np.exp(-((inside / BITE) ** 2)))
    share = np.where(hand, 0.0, np.maximum(leak, island))
    changed = np.maximum(mask / 255.0, share) * (1.0 - np.where(hand, bite, 0.0))
    return np.round(255.0 * changed).astype(np.uint8)


def likeness(rgb: np.ndarray, coverage: np.ndarray) -> np.ndarray:
    """How much every pixel looks like the hand of its frame: (S, S), 0-1.

    Takes `rgb` (S, S, 3) uint8 sRGB, `coverage` (S, S) share of hand.
    """
    import cv2

    smooth = cv2.GaussianBlur(rgb, (0, 0), max(len(rgb) / 256.0, 0.3))
    lab = cv2.cvtColor((smooth / 255.0).astype(np.float32), cv2.COLOR_RGB2LAB)
    own = lab[coverage > 0.5]
    middle = np.median(own, axis=0)
    # 1.4826: from the median of distances to the standard deviation of a normal distribution.
    spread = np.maximum(1.4826 * np.median(np.abs(own - middle), axis=0), _SPREAD)
    distance = (((lab - middle) / (_ALIKE * spread)) ** 2).sum(axis=2)
    return np.asarray(np.exp(-0.5 * distance), dtype=np.float64)


def _errs(name: str, scene: Scene, plan: FramePlan, chance: np.ndarray) -> np.ndarray:
    """Where one kind of error is: (S, S), 0-1. It wanders over the seconds.

    Takes `chance` (S, S) 0-1.
    """
    size = len(chance)
    ticks = (np.arange(size) + 0.5) / size
    x, y = np.meshgrid(ticks, ticks)
    moment = np.full(x.size, PATCH * PACE * plan.seconds)
    points = np.stack([x.ravel(), y.ravel(), moment], axis=1)
    field = fractal_noise(points, PATCH, generator(scene.seed, "lookalike", name), octaves=2)
    level = chance * np.clip(OFTEN[name] + SLOPE * field.reshape(x.shape), 0.0, 1.0)
    return np.clip((level - 0.5) / 0.12 + 0.5, 0.0, 1.0)


#: Error of a good estimator on an easy frame: rad and m.
EASY_ERROR = (0.003, 0.00025)
#: How much of a frame's error is the last frame's.
CORRELATION = 0.85
#: Share of the error's variance that is the estimator's habit: the same in every hard frame of a
#: capture, as a regressor leans towards the poses it knows.
HABIT = 0.5
#: Chance of a gross failure in a frame of severity 4 or 5 of an effect that moves the hand.
FAILURE_CHANCE = 0.06
#: Least and largest share of an occluder over the hand that a segmenter takes for hand.
OCCLUDER_TAKEN = (0.35, 1.0)
#: Share of hand from which a segmenter takes a pixel for hand: in sharp images, and where the
#: shutter smears hand and background into each other.
TAKEN_FROM = (0.5, 0.2)
_MOVING = ("complex_poses", "motion_blur")


def estimate_hands(
    scene: Scene, truth: dict[str, HandParameters], plans: list[FramePlan]
) -> dict[str, HandParameters]:
    """Hand parameters as an estimator gives them.

    The error grows with the effects that act. One part of it wanders in time, the other is the
    estimator's habit, which no averaging over frames removes. A gross failure keeps finite
    parameters, far off, and is flagged by `valid`. Where the scene names an estimator, its errors
    come on top.
    """
    angle, length = np.array([_errors(plan) for plan in plans]).T
    hard = np.array(
        [any(plan.severity.get(kind, 0) >= 4 for kind in _MOVING) for plan in plans], dtype=bool
    )
    estimates = {}
    for side, exact in truth.items():
        rng = generator(scene.seed, "estimator", side, len(plans))
        wander = _correlated(rng.normal(size=(len(plans), 17, 3)))
        habit = generator(scene.seed, "habit", side).normal(size=(17, 3))
        noise = np.sqrt(1.0 - HABIT) * wander + np.sqrt(HABIT) * habit
        failed = hard & (rng.uniform(size=len(plans)) < FAILURE_CHANCE)
        gross = np.where(failed, 5.0, 1.0)
        turn = (angle * gross)[:, None, None] * noise[:, :16]
        # The wrist is found more easily than the finger joints, depth worse than place.
        turn[:, 0] *= 0.6
        shift = (length * gross)[:, None] * noise[:, 16] * np.array([1.0, 1.0, 2.0])
        estimates[side] = HandParameters(
            pose=exact.pose + turn,
            betas=exact.betas + 0.05 * rng.normal(size=10),
            transl=exact.transl + shift,
            valid=~failed,
        )
    if scene.estimator is not None:
        times = np.array([plan.seconds for plan in plans])
        views = np.stack([viewmat(scene, seconds) for seconds in times])
        for side, estimate in estimates.items():
            estimates[side] = tracked(scene, scene.estimator, side, estimate, times, views)
    return estimates


def estimate_mask(
    scene: Scene, plan: FramePlan, coverage: np.ndarray, clean_coverage: np.ndarray
) -> np.ndarray:
    """Visible-hand mask as a segmenter gives it.

    Soft and slightly displaced borders, bites around occluders, parts of occluders taken for
    hand, smeared borders taken for hand, and sometimes a missed part.

    Takes `coverage` (S, S) exact share of visible hand, `clean_coverage` (S, S) the same without
    the occluders. Returns (S, S) uint8, 255 = hand.
    """
    from scipy.ndimage import gaussian_filter

    size = len(coverage)
    rng = generator(scene.seed, "segmenter", plan.frame, size)
    unit = size / 256.0
    soft = gaussian_filter(coverage, 0.9 * max(unit, 0.5))
    # A smooth random threshold moves the border in and out by about a pixel.
    wobble = gaussian_filter(rng.normal(size=(size, size)), 6.0 * unit)
    wobble *= 0.10 / max(float(wobble.std()), 1e-9)
    covered = np.clip(clean_coverage - coverage, 0.0, 1.0)
    if "objects" in plan.passes and covered.max() > 0.5:
        bite = gaussian_filter(covered, 2.5 * unit)
        bites = gaussian_filter(rng.normal(size=(size, size)), 4.0 * unit)
        bites /= max(float(bites.std()), 1e-9)
        soft = soft - 0.9 * bite * np.clip(bites + 0.3, 0.0, 1.0)
        soft = np.maximum(soft, gaussian_filter(covered * _taken(covered, rng), unit))
    if rng.uniform() < (0.10 if plan.strength else 0.02) and coverage.sum() > 10:
        soft = soft * _missed_part(coverage, rng)
    taken_from = TAKEN_FROM["shutter" in plan.passes]
    # Borders wander, background stays background: the threshold moves only where there is hand.
    wobble *= np.clip(soft / taken_from, 0.0, 1.0)
    mask = np.clip((soft - taken_from + wobble) / 0.35 + 0.5, 0.0, 1.0)
    return np.round(255.0 * mask).astype(np.uint8)


def _errors(plan: FramePlan) -> tuple[float, float]:
    angle, length = (error**2 for error in EASY_ERROR)
    for kind, strength in plan.strength.items():
        more = EFFECTS[kind].estimate_error(strength)
        angle += more[0] ** 2
        length += more[1] ** 2
    return float(np.sqrt(angle)), float(np.sqrt(length))


def _correlated(noise: np.ndarray) -> np.ndarray:
    """A first-order autoregressive walk of unit variance along the first axis."""
    keep, add = CORRELATION, np.sqrt(1.0 - CORRELATION**2)
    walk = noise.copy()
    for frame in range(1, len(walk)):
        walk[frame] = keep * walk[frame - 1] + add * noise[frame]
    return walk


def _taken(covered: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """Blobs of the occluder that a segmenter takes for hand: (S, S), 0 or 1."""
    from scipy.ndimage import gaussian_filter

    field = gaussian_filter(rng.normal(size=covered.shape), len(covered) / 20.0)
    share = rng.uniform(*OCCLUDER_TAKEN)
    return field > np.quantile(field[covered > 0.5], 1.0 - share)


def _missed_part(coverage: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """A soft disc of zeros somewhere on the hand, about a finger tip in size."""
    size = len(coverage)
    rows, columns = np.nonzero(coverage > 0.5)
    pick = int(rng.integers(max(len(rows), 1)))
    y, x = (rows[pick], columns[pick]) if len(rows) else (0, 0)
    radius = size * rng.uniform(0.03, 0.06)
    grid_y, grid_x = np.mgrid[0:size, 0:size]
    distance = np.hypot(grid_y - y, grid_x - x)
    return np.clip((distance - radius) / 3.0 + 0.5, 0.0, 1.0)
