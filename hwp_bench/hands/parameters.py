"""Hand parameters over a clip, the pose of a hand in one frame, and the camera that sees it."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from hwp_bench.base.errors import BadInput
from hwp_bench.hands.template import JOINT_COUNT, SHAPE_COUNT


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
            if field == "valid":
                if array.dtype != np.bool_:
                    raise BadInput(f"type is {array.dtype}, expected bool", field=field)
                continue
            if array.dtype.kind not in "fiu":
                raise BadInput(f"type is {array.dtype}, expected numbers", field=field)
            object.__setattr__(self, field, array.astype(np.float64))
        valid = np.array(self.valid)
        object.__setattr__(self, "valid", valid)
        for field in ("pose", "transl"):
            array = getattr(self, field)
            array[~valid] = np.nan_to_num(array[~valid], nan=0.0, posinf=0.0, neginf=0.0)
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
