"""Inputs of a method in place of the truth: hands and masks as estimators deliver them.

Hands of a tracker are those that a fit to its landmarks gives. Landmarks err as measured, and the
fit answers to first order: the parameters move by what explains the wrong landmarks best, next to
a prior. So errors are large where the landmarks constrain little, such as in fists and along the
line of sight, and the joints of a finger make up for each other as they do in a real fit, which
keeps the hand on its image.

All numbers of that noise are printed by `python -m benchmarks.tracker_errors --video VIDEO
--landmarks NPZ` on a video of 621 frames with MediaPipe's landmarks. There is no truth in it: what
counts as an error of a landmark is its distance from the whole clip's fit, less the mean of the
clip. The fit was that of version 1 of the importer; later versions give other numbers, and scenes
keep these.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from hwp_bench.hands.poses import (
    DEGREES,
    PosedSkeleton,
    RestSkeleton,
    hand_extent,
    landmark_rows,
    posed_skeleton,
    rest_skeleton,
    turned,
)
from hwp_bench.hands.skeleton import JOINT_NAMES, HandParameters
from hwp_bench.sim.effects import EFFECTS, FramePlan
from hwp_bench.sim.geometry.noise import fractal_noise, generator
from hwp_bench.sim.props.behind import NOTHING, plane_names
from hwp_bench.sim.scene.scene import Estimator, Scene, scene_hands, viewmat

# fmt: off
#: Standard deviation of each landmark in the image, shares of the hand's extent, one axis.
IMAGE_SPREAD: tuple[float, ...] = (
    0.0120,
    0.0111, 0.0073, 0.0065, 0.0085,
    0.0087, 0.0081, 0.0057, 0.0126,
    0.0075, 0.0084, 0.0065, 0.0092,
    0.0071, 0.0105, 0.0099, 0.0098,
    0.0060, 0.0101, 0.0099, 0.0097,
)
#: Standard deviation of each world landmark against the hand's centre, m, mean of the axes.
WORLD_SPREAD: tuple[float, ...] = (
    0.0072,
    0.0052, 0.0055, 0.0072, 0.0112,
    0.0043, 0.0044, 0.0046, 0.0055,
    0.0033, 0.0033, 0.0047, 0.0063,
    0.0037, 0.0034, 0.0041, 0.0060,
    0.0055, 0.0044, 0.0045, 0.0060,
)
# fmt: on
#: Share of each camera axis in it: a tracker errs most along the line of sight.
WORLD_AXES: tuple[float, float, float] = (0.68, 0.48, 1.52)
#: Growth of both: at rest facing the camera, more at a full curl, more seen from the edge; 1 is the
#: mean of the clip.
GROWTH: tuple[float, float, float] = (0.41, 1.64, 1.28)
#: Time scale of the errors that a fit keeps, s: its smoothness removes what is faster.
MEMORY = 0.14
#: Share of the variance that never changes in a capture.
TRACKER_HABIT = 0.18
# Numbers of one landmark: two in the image and three in the world.
_NUMBERS = 5


def growth(curl: np.ndarray, edge_on: np.ndarray) -> np.ndarray:
    """Size of the errors against the clip's mean: (F,), of curl (F,) and edge-on view (F,)."""
    still, bent, turned = GROWTH
    return np.asarray(still + bent * curl + turned * edge_on)


def landmark_noise(
    rng: np.random.Generator, frames: int, step: float, habit: float = TRACKER_HABIT
) -> np.ndarray:
    """Unit noise of 21 landmarks: (F, 21, 5), x and y in the image, then x, y, z in the world."""
    size = (21, _NUMBERS)
    constant = rng.normal(size=size)
    moving = wandering(rng, frames, step, 21 * _NUMBERS).reshape(frames, *size)
    return np.asarray(np.sqrt(1.0 - habit) * moving + np.sqrt(habit) * constant)


def wandering(rng: np.random.Generator, frames: int, step: float, width: int) -> np.ndarray:
    """Smooth noise of unit variance: (F, width), correlated by (1 + t / m) exp(-t / m).

    Source: the Matern process of order 3/2 as a linear state of value and slope, sampled exactly
    (Hartikainen and Sarkka, 2010), with m = `MEMORY`.
    """
    rate = 1.0 / MEMORY
    turn = np.exp(-rate * step) * np.array(
        [[1.0 + rate * step, step], [-rate * rate * step, 1.0 - rate * step]]
    )
    steady = np.diag([1.0, rate * rate])
    values, vectors = np.linalg.eigh(steady - turn @ steady @ turn.T)
    spread = vectors * np.sqrt(np.maximum(values, 0.0))
    state = np.sqrt(steady) @ rng.normal(size=(2, width))
    walk = np.empty((frames, width))
    for frame in range(frames):
        if frame:
            state = turn @ state + spread @ rng.normal(size=(2, width))
        walk[frame] = state[0]
    return walk


#: Mean bend of a finger joint in a fist, rad: a curl of 1.
FIST = 1.3
# Landmarks of the wrist and of the knuckles of index, middle and little finger.
_WRIST, _INDEX, _MIDDLE, _LITTLE = 0, 5, 9, 17


def curl(pose: np.ndarray) -> np.ndarray:
    """How far the four fingers of poses (F, 16, 3) are bent: (F,), 0 straight to 1 fist."""
    four = [
        row
        for row, name in enumerate(JOINT_NAMES)
        if name != "wrist" and not name.startswith("thumb")
    ]
    bends = np.linalg.norm(pose[:, four], axis=2).mean(axis=1)
    return np.asarray(np.clip(bends / FIST, 0.0, 1.0))


def edge_on(landmarks: np.ndarray) -> np.ndarray:
    """How far a palm is turned from the camera: (F,), 0 facing it or away, 1 seen from its edge."""
    wrist = landmarks[:, _WRIST]
    normal = np.cross(landmarks[:, _INDEX] - wrist, landmarks[:, _LITTLE] - wrist)
    sight = landmarks[:, _MIDDLE]
    length = np.linalg.norm(normal, axis=1) * np.linalg.norm(sight, axis=1)
    return np.asarray(1.0 - np.abs((normal * sight).sum(axis=1)) / np.maximum(length, 1e-12))


#: Factor on the measured landmark errors with which parameters err as those of a fit whose truth
#: is known; the last table of `python -m benchmarks.tracker_errors --video VIDEO --landmarks NPZ`.
GAIN = 1.25
#: Standard deviation that the fit expects of a joint, rad, and of the translation, m.
EXPECTED = (0.5, 0.01)
#: Error of each shape parameter, standard deviations; from the same table.
SHAPE_ERROR = 0.55
#: Factor on the error of a gross failure.
GROSS = 5.0
# Frames that are solved at once, which bounds the memory.
_CHUNK = 256


@dataclass(frozen=True, eq=False)
class ParameterErrors:
    """How far estimated parameters of a hand are off."""

    #: (F, 16, 3) rad, after each joint's own rotation.
    turn: np.ndarray
    #: (F, 3) m, camera axes.
    shift: np.ndarray


def tracked(
    scene: Scene,
    settings: Estimator,
    side: str,
    estimate: HandParameters,
    times: np.ndarray,
    views: np.ndarray,
) -> HandParameters:
    """Add a tracker's errors to an estimate."""
    rng = generator(scene.seed, "tracker", side)
    failed = rng.uniform(size=len(times)) < settings.failures
    hand = scene_hands(scene)[side]
    rest = rest_skeleton(hand.model, hand.betas)
    step = float(times[1] - times[0]) if len(times) > 1 else 1.0
    noise = GAIN * settings.scale * landmark_noise(rng, len(times), step)
    noise *= np.where(failed, GROSS, 1.0)[:, None, None]
    errors = parameter_errors(rest, estimate.pose, estimate.transl, views, noise)
    shift = np.einsum("fba,fb->fa", views[:, :3, :3], errors.shift)
    shape = settings.scale * SHAPE_ERROR * rng.normal(size=10)
    return HandParameters(
        pose=turned(estimate.pose, errors.turn),
        betas=estimate.betas + _of_equal_size(shape, hand.model.joint_basis, rest.joints),
        transl=estimate.transl + shift,
        valid=estimate.valid & ~failed,
    )


def parameter_errors(
    rest: RestSkeleton,
    pose: np.ndarray,
    transl: np.ndarray,
    views: np.ndarray,
    noise: np.ndarray,
) -> ParameterErrors:
    """Answer of a fit to wrong landmarks, unit noise (F, 21, 5), to first order."""
    posed = posed_skeleton(rest, pose, transl).seen_by(views)
    grown = growth(curl(pose), edge_on(posed.landmarks))
    extent = hand_extent(posed.landmarks)
    found = np.empty((len(pose), DEGREES))
    for start in range(0, len(pose), _CHUNK):
        rows = slice(start, start + _CHUNK)
        some = PosedSkeleton(posed.turns[rows], posed.joints[rows], posed.landmarks[rows])
        found[rows] = _solved(some, grown[rows], extent, noise[rows])
    return ParameterErrors(found[:, :48].reshape(-1, 16, 3), found[:, 48:])


def _solved(
    posed: PosedSkeleton, grown: np.ndarray, extent: float, noise: np.ndarray
) -> np.ndarray:
    """Parameters that explain the landmarks' errors best: (F, 51)."""
    image_spread = extent * grown[:, None] * np.array(IMAGE_SPREAD)
    world_spread = grown[:, None, None] * np.outer(WORLD_SPREAD, WORLD_AXES)
    rows = landmark_rows(posed, image_spread, world_spread)
    # Divided by its spread every error is the unit noise itself.
    seen = noise.reshape(len(rows), -1)
    turn, shift = EXPECTED
    held = np.diag(np.repeat([turn, shift], [48, 3]) ** -2.0)
    normal = np.einsum("fnk,fnl->fkl", rows, rows) + held
    return np.linalg.solve(normal, np.einsum("fnk,fn->fk", rows, seen)[..., None])[..., 0]


def _of_equal_size(shape: np.ndarray, basis: np.ndarray, joints: np.ndarray) -> np.ndarray:
    """The part of a change of shape (10,) that leaves the hand as large as it is.

    A fit takes a hand's size from its image: what is wrong with it is wrong with the distance too,
    which the translation already is.
    """
    centred = joints - joints.mean(axis=0)
    larger = np.einsum("jk,jkb->b", centred, basis - basis.mean(axis=0))
    length = float(larger @ larger)
    return shape - (shape @ larger) / length * larger if length > 0.0 else shape


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
    """Add to an estimated mask, (S, S) uint8, what colours like skin do to it."""
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
    """How much every pixel looks like the hand of its frame: (S, S), 0-1."""
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
    """Where one kind of error is: (S, S), 0-1. It wanders over the seconds."""
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
    """Visible-hand mask as a segmenter gives it: (S, S) uint8, 255 = hand.

    Soft and slightly displaced borders, bites around occluders, parts of occluders taken for
    hand, smeared borders taken for hand, and sometimes a missed part.
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
