"""Hand parameters as a fit to a tracker's landmarks gives them.

Landmarks err as measured (`tracker_noise`), and the fit answers to first order: the parameters move
by what explains the wrong landmarks best, next to a prior. So errors are large where the landmarks
say little, such as in fists and along the line of sight, and the joints of a finger make up for
each other as they do in a real fit, which keeps the hand on its image.
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
from hwp_bench.hands.skeleton import HandParameters
from hwp_bench.sim.geometry.noise import generator
from hwp_bench.sim.produce.tracker_geometry import curl, edge_on
from hwp_bench.sim.produce.tracker_noise import (
    IMAGE_SPREAD,
    WORLD_AXES,
    WORLD_SPREAD,
    growth,
    landmark_noise,
)
from hwp_bench.sim.scene.schema import Scene
from hwp_bench.sim.scene.tracking import Estimator
from hwp_bench.sim.subject.hand import scene_hands

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

    Args:
        scene: the scene.
        settings: of its estimator.
        side: which hand.
        estimate: parameters with the errors of the effects.
        times: (F,) of the frames, s.
        views: (F, 4, 4) world to camera.
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

    Args:
        rest: the hand at rest.
        pose: (F, 16, 3) axis-angle rad.
        transl: (F, 3) m.
        views: (F, 4, 4) world to camera.
        noise: (F, 21, 5) unit noise of the landmarks, as `landmark_noise` gives it.
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
