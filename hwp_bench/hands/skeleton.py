"""The skeleton of every hand: joints, landmarks, directions of the palm, parameters."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from hwp_bench.base.errors import BadHandModel, BadInput
from hwp_bench.hands.raster import fixed_point

#: Joint names in MANO's order, which every template here uses.
JOINT_NAMES = (
    "wrist",
    *(f"{finger}{k}" for finger in ("index", "middle", "little", "ring", "thumb") for k in "123"),
)
#: Parent of each joint; the wrist is the root (-1).
PARENTS = (-1, 0, 1, 2, 0, 4, 5, 0, 7, 8, 0, 10, 11, 0, 13, 14)
#: Number of joints of every template, the wrist included.
JOINT_COUNT = len(PARENTS)
#: Number of shape parameters of every template.
SHAPE_COUNT = 10
#: Fingers in the order of `HandTemplate.fingertips`.
FINGERS = ("thumb", "index", "middle", "ring", "little")
#: Side names; the right hand is the one that templates are built from.
SIDES = ("right", "left")


#: Pairs of landmarks that a drawing connects.
LANDMARK_EDGES = (
    *((0, 4 * finger + 1) for finger in range(5)),
    *((4 * finger + k, 4 * finger + k + 1) for finger in range(5) for k in (1, 2, 3)),
)


def landmark_order() -> tuple[int, ...]:
    """Rows of [16 joints, 5 finger tips] that make the 21 landmarks of OpenPose and MediaPipe.

    `concatenate([joints, tips])[landmark_order()]` is the wrist, then thumb, index, middle, ring
    and little finger, each from its base to its tip.
    """
    return (0, 13, 14, 15, 16, 1, 2, 3, 17, 4, 5, 6, 18, 10, 11, 12, 19, 7, 8, 9, 20)


def finger_joints(finger: str) -> tuple[int, int, int]:
    """The three joints of a finger, base to tip."""
    first = JOINT_NAMES.index(f"{finger}1")
    return first, first + 1, first + 2


def moved_joints() -> np.ndarray:
    """(16, 16) float64: 1 where the second joint is the first one or moves with it, else 0."""
    below = np.eye(len(PARENTS))
    for joint in range(len(PARENTS) - 1, 0, -1):
        below[PARENTS[joint]] = np.maximum(below[PARENTS[joint]], below[joint])
    return below


@dataclass(frozen=True, eq=False)
class PalmDirections:
    """Three unit vectors (3,), perpendicular to each other."""

    #: From the wrist to the knuckles.
    forward: np.ndarray
    #: Out of the palm, the way the fingers close.
    palmar: np.ndarray
    #: From the little finger's side to the thumb's.
    thumbward: np.ndarray


def palm_directions(joints: np.ndarray, side: str) -> PalmDirections:
    """Find the directions of the palm of a hand with rest joints (16, 3)."""
    index, middle, little = (
        JOINT_NAMES.index(f"{name}1") for name in ("index", "middle", "little")
    )
    ahead, across = joints[middle] - joints[0], joints[index] - joints[little]
    # Less than 0.1 mm x 0.1 mm of palm has no usable direction.
    if np.linalg.norm(np.cross(ahead, across)) < 1e-8:
        raise BadHandModel("the wrist and the knuckles lie on one line", field="joints")
    forward = unit(ahead)
    thumbward = unit(across - (across @ forward) * forward)
    palmar = np.cross(forward, thumbward)
    return PalmDirections(forward, -palmar if side == "right" else palmar, thumbward)


def unit(vectors: np.ndarray) -> np.ndarray:
    """(..., 3) vectors scaled to length one."""
    length = np.linalg.norm(vectors, axis=-1, keepdims=True)
    if length.min() < 1e-9:
        said = "two joints, or a finger and the palm's normal, coincide"
        raise BadHandModel(said, field="joints")
    return vectors / length


@dataclass(frozen=True, eq=False)
class HandParameters:
    """Pose, shape and translation of one hand in F frames; checked when made, and copied.

    In a frame without this hand the values have no meaning. NaN there (as estimators write it)
    becomes zero, so that computations on whole arrays work.

    Raises:
        BadInput: a field has the wrong shape or type, or is not finite in a valid frame; the
            error names the field.
    """

    #: (F, 16, 3) axis-angle rad: global rotation about the wrist, then the 15 finger joints.
    pose: np.ndarray
    #: (10,) shape, in standard deviations; one for the whole clip.
    betas: np.ndarray
    #: (F, 3) m, added after posing.
    transl: np.ndarray
    #: (F,) bool, false where the frame does not show this hand.
    valid: np.ndarray

    def __post_init__(self) -> None:
        frames = np.shape(self.pose)[0] if np.ndim(self.pose) else 0
        shapes = {
            "pose": (frames, JOINT_COUNT, 3),
            "betas": (SHAPE_COUNT,),
            "transl": (frames, 3),
            "valid": (frames,),
        }
        for field, shape in shapes.items():
            array = np.asarray(getattr(self, field))
            if array.shape != shape:
                raise BadInput(f"shape is {array.shape}, expected {shape}", field=field)
            kinds, wanted = ("b", "bool") if field == "valid" else ("fiu", "numbers")
            if array.dtype.kind not in kinds:
                raise BadInput(f"type is {array.dtype}, expected {wanted}", field=field)
            # Both copy.
            array = np.array(array) if field == "valid" else array.astype(np.float64)
            object.__setattr__(self, field, array)
        hidden = ~self.valid
        for field in ("pose", "transl"):
            array = getattr(self, field)
            array[hidden] = np.nan_to_num(array[hidden], nan=0.0, posinf=0.0, neginf=0.0)
        for field in ("pose", "betas", "transl"):
            bad = ~np.isfinite(getattr(self, field))
            if bad.any():
                place = "" if field == "betas" else f" in frame {np.argwhere(bad)[0, 0]}"
                raise BadInput(f"holds NaN or infinity{place}", field=field)

    @property
    def frame_count(self) -> int:
        """Number of frames F."""
        return len(self.valid)

    def at(self, frame: int, side: str) -> HandPose:
        """Return the parameters in one frame, as those of a `right` or `left` hand."""
        return HandPose(side, self.pose[frame], self.betas, self.transl[frame])


def hand_poses(hands: Mapping[str, HandParameters], frame: int) -> dict[str, HandPose]:
    """Return the parameters of every hand in one frame, by side, whether it is valid or not."""
    return {side: hand.at(frame, side) for side, hand in hands.items()}


@dataclass(frozen=True, eq=False)
class HandPose:
    """The parameters of one hand in one frame."""

    #: `right` or `left`.
    side: str
    #: (16, 3) axis-angle, rad.
    pose: np.ndarray
    #: (10,) shape.
    betas: np.ndarray
    #: (3,) m.
    transl: np.ndarray


@dataclass(frozen=True, eq=False)
class Camera:
    """One pinhole camera, OpenCV axes."""

    #: (3, 3) intrinsics, px; pixel centres lie at +0.5.
    K: np.ndarray
    #: (4, 4) world to camera, m.
    viewmat: np.ndarray
    #: Image width, px.
    width: int
    #: Image height, px.
    height: int


def draw_bones(canvas: np.ndarray, landmarks: np.ndarray, colour: tuple[int, int, int]) -> None:
    """Draw the bones between 21 landmarks, (21, 2) px, into an image (H, W, 3) uint8."""
    import cv2

    places, shift = fixed_point(landmarks)
    for first, last in LANDMARK_EDGES:
        cv2.line(canvas, places[first], places[last], colour, 1, cv2.LINE_AA, shift)
