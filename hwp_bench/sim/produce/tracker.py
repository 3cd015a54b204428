"""Hand parameters as a fit to a tracker's landmarks gives them.

Landmarks err as measured, and the fit answers to first order: the parameters move by what
explains the wrong landmarks best, next to a prior. So errors are large where the landmarks say
little, such as in fists and along the line of sight, and the joints of a finger make up for each
other as they do in a real fit, which keeps the hand on its image.

All numbers of the noise are printed by `python -m benchmarks.tracker_errors --video VIDEO
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
from hwp_bench.sim.geometry.noise import generator
from hwp_bench.sim.scene.motion import scene_hands
from hwp_bench.sim.scene.scene import Estimator, Scene

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
HABIT = 0.18
# Numbers of one landmark: two in the image and three in the world.
_NUMBERS = 5


def growth(curl: np.ndarray, edge_on: np.ndarray) -> np.ndarray:
    """Size of the errors against the clip's mean: (F,), of curl (F,) and edge-on view (F,)."""
    still, bent, turned = GROWTH
    return np.asarray(still + bent * curl + turned * edge_on)


def landmark_noise(
    rng: np.random.Generator, frames: int, step: float, habit: float = HABIT
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
    """How far the four fingers are bent: (F,), 0 straight to 1 fist.

    Takes `pose` (F, 16, 3) axis-angle rad.
    """
    four = [
        row
        for row, name in enumerate(JOINT_NAMES)
        if name != "wrist" and not name.startswith("thumb")
    ]
    bends = np.linalg.norm(pose[:, four], axis=2).mean(axis=1)
    return np.asarray(np.clip(bends / FIST, 0.0, 1.0))


def edge_on(landmarks: np.ndarray) -> np.ndarray:
    """How far a palm is turned from the camera: (F,), 0 facing it or away, 1 seen from its edge.

    Takes `landmarks` (F, 21, 3) m.
    """
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
    """Add a tracker's errors to an estimate.

    Takes `times` (F,) of the frames, `views` (F, 4, 4) world to camera.
    """
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
    """Answer of a fit to wrong landmarks, to first order.

    Takes `pose` (F, 16, 3) axis-angle rad, `transl` (F, 3) m, `views` (F, 4, 4) world to camera,
    `noise` (F, 21, 5) unit noise of the landmarks.
    """
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
