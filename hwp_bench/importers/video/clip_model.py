"""A hand over a whole clip as the fit sees it: its variables, and the hand posed with them."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch

from hwp_bench.hands import HandParameters, HandTemplate, pose_hand
from hwp_bench.hands.articulation import axis_angle_to_matrix
from hwp_bench.hands.skinning import only_fingertips
from hwp_bench.importers.video.rigid_start import RigidStart

# The joint whose frame a landmark is fixed in: joints in their own, tips in the last joint's.
_FRAME_OF = (0, 13, 14, 15, 15, 1, 2, 3, 3, 4, 5, 6, 6, 10, 11, 12, 12, 7, 8, 9, 9)
#: Pixels in a unit of the anchor: Adam's step is about its learning rate, which this makes sane.
ANCHOR_UNIT = 100.0


@dataclass(frozen=True, eq=False)
class ClipVariables:
    """The variables of the fit; float32 leaf tensors.

    The wrist is held as a place in the image and a log depth, because the image fixes the
    first tightly and the second loosely.
    """

    #: (F, 3) rad, turns the hand further than its start, about the template's axes.
    turn: torch.Tensor
    #: (F, 15, 3) rad, finger joints.
    fingers: torch.Tensor
    #: (F, 2) the wrist in the image, from the principal point, in hundreds of px.
    anchor: torch.Tensor
    #: (F, 1) log of the wrist's depth in m.
    log_depth: torch.Tensor
    #: (10,) shape, the same in all frames.
    betas: torch.Tensor
    #: (21, 3) m, where the tracker puts a landmark, in the frame of its joint; constant.
    offsets: torch.Tensor
    #: () log of (hand in metres / world landmarks in metres); constant.
    log_size: torch.Tensor
    #: () log of the focal length in px.
    log_focal: torch.Tensor


@dataclass(frozen=True, eq=False)
class PosedClip:
    """The hand in every frame, camera axes, metres."""

    #: (F, 3, 3) template rest frame to camera.
    rotation: torch.Tensor
    #: (F, 3) where the rest frame's origin lies.
    place: torch.Tensor
    #: (F, 16, 4, 4) motion of each joint before `rotation` and `place`.
    transforms: torch.Tensor
    #: (F, 21, 3) landmarks, the tracker's offsets included.
    landmarks: torch.Tensor
    #: (F, 16, 3) pose with a root of zero, rad.
    pose: torch.Tensor


@dataclass(frozen=True, eq=False)
class SomeVertices:
    """Vertices chosen in every frame, with what posing them needs; read once for many steps."""

    #: (F, P) int64.
    index: torch.Tensor
    #: (F, P, 3) m, rest place without the shape: template and correctives.
    rest: torch.Tensor
    #: (F, P, 3, 10) m per unit of shape.
    shape_basis: torch.Tensor
    #: (F, P, 16) skinning weights.
    weights: torch.Tensor


class ClipModel:
    """Poses a clip from its variables.

    Args:
        template: the hand.
        start: rigid motion that the variables are relative to.
        focal: px, the start of the focal length.
        centre: (2,) principal point, px.
    """

    def __init__(
        self, template: HandTemplate, start: RigidStart, focal: float, centre: np.ndarray
    ) -> None:
        self.template = template
        self.tensors = template.to_torch(torch.float32)
        self.start_rotation = torch.as_tensor(start.rotation, dtype=torch.float32)
        self.world = torch.as_tensor(start.world, dtype=torch.float32)
        self.centre = torch.as_tensor(centre, dtype=torch.float32)
        self._tips = only_fingertips(self.tensors)
        anchor = start.wrist[:, :2] / start.wrist[:, 2:] * focal / ANCHOR_UNIT
        frames = len(start.wrist)

        def leaf(value: object) -> torch.Tensor:
            return torch.as_tensor(value, dtype=torch.float32).clone().requires_grad_(True)

        self.variables = ClipVariables(
            turn=leaf(np.zeros((frames, 3))),
            fingers=leaf(np.zeros((frames, 15, 3))),
            anchor=leaf(anchor),
            log_depth=leaf(np.log(start.wrist[:, 2:])),
            betas=leaf(np.zeros(10)),
            offsets=leaf(np.zeros((21, 3))),
            log_size=leaf(0.0),
            log_focal=leaf(np.log(focal)),
        )

    @property
    def focal(self) -> torch.Tensor:
        """() focal length, px."""
        return self.variables.log_focal.exp()

    def posed(self) -> PosedClip:
        """Pose every frame; differentiable."""
        free = self.variables
        frames = len(free.turn)
        pose = torch.cat([torch.zeros_like(free.fingers[:, :1]), free.fingers], dim=1)
        rest = pose_hand(self._tips, pose, free.betas, pose.new_zeros(frames, 3))
        rotation = self.start_rotation @ axis_angle_to_matrix(free.turn)
        depth = free.log_depth.exp()
        wrist = torch.cat([free.anchor * (ANCHOR_UNIT / self.focal) * depth, depth], dim=1)
        place = wrist - (rotation @ rest.joints[:, 0, :, None])[..., 0]
        turned = rest.transforms[:, list(_FRAME_OF), :3, :3] @ free.offsets[..., None]
        return PosedClip(
            rotation=rotation,
            place=place,
            transforms=rest.transforms,
            landmarks=_moved(rest.landmarks + turned[..., 0], rotation, place),
            pose=pose,
        )

    def choose(self, index: torch.Tensor) -> SomeVertices:
        """Choose vertices (F, P) int64 of each frame; correctives stay as they are now."""
        rest = self.tensors.vertices[index]
        basis = self.tensors.pose_basis
        if basis is not None:
            with torch.no_grad():
                turns = axis_angle_to_matrix(self.variables.fingers)
                feature = (turns - torch.eye(3)).flatten(1)
                rest = rest + torch.stack(
                    [basis[some] @ row for some, row in zip(index, feature, strict=True)]
                )
        return SomeVertices(
            index, rest, self.tensors.shape_basis[index], self.tensors.weights[index]
        )

    def vertices(self, posed: PosedClip, some: SomeVertices) -> torch.Tensor:
        """Pose some vertices of each frame.

        Args:
            posed: this clip.
            some: which.

        Returns:
            (F, P, 3) m, camera axes.
        """
        shaped = some.rest + some.shape_basis @ self.variables.betas
        motion = posed.transforms[:, :, :3].flatten(start_dim=2)
        blended = (some.weights @ motion).unflatten(-1, (3, 4))
        skinned = (blended[..., :3] @ shaped[..., None])[..., 0] + blended[..., 3]
        return _moved(skinned, posed.rotation, posed.place)

    def pixels(self, points: torch.Tensor) -> torch.Tensor:
        """Project (F, P, 3) m to (F, P, 2) px; points at the camera's plane stay finite."""
        return points[..., :2] / points[..., 2:].clamp(min=1e-3) * self.focal + self.centre

    def parameters(self, valid: np.ndarray) -> HandParameters:
        """Return the clip as hand parameters, the root rotation continuous in time."""
        with torch.no_grad():
            posed = self.posed()
            wrist = self.tensors.joints[0] + self.tensors.joint_basis[0] @ self.variables.betas
            # `pose_hand` turns about the rest wrist, `posed` about the origin.
            transl = posed.place + (posed.rotation @ wrist) - wrist
        root = continuous_rotation_vectors(posed.rotation.double().numpy())
        pose = posed.pose.double().numpy().copy()
        pose[:, 0] = root
        return HandParameters(
            pose=pose,
            betas=self.variables.betas.detach().double().numpy().copy(),
            transl=transl.double().numpy(),
            valid=np.asarray(valid, dtype=bool),
        )


#: Frames posed at once, to bound memory with fine templates.
_CHUNK = 64


def posed_vertices(model: ClipModel, chunk: int = _CHUNK) -> np.ndarray:
    """Return the vertices of every frame in the camera frame, (F, V, 3) float32 m."""
    parameters = model.parameters(np.ones(len(model.variables.turn), dtype=bool))
    betas = torch.as_tensor(parameters.betas, dtype=torch.float32)
    pieces = []
    with torch.no_grad():
        for first in range(0, parameters.frame_count, chunk):
            rows = slice(first, first + chunk)
            pose = torch.as_tensor(parameters.pose[rows], dtype=torch.float32)
            transl = torch.as_tensor(parameters.transl[rows], dtype=torch.float32)
            pieces.append(pose_hand(model.tensors, pose, betas, transl).vertices)
    return torch.cat(pieces).numpy()


def continuous_rotation_vectors(rotations: np.ndarray) -> np.ndarray:
    """Axis-angle vectors (F, 3) rad of (F, 3, 3), without jumps by a full turn between frames."""
    from scipy.spatial.transform import Rotation

    vectors = Rotation.from_matrix(rotations).as_rotvec()
    for frame in range(1, len(vectors)):
        angle = np.linalg.norm(vectors[frame])
        if angle < 1e-6:
            continue
        other = vectors[frame] * (1.0 - 2.0 * np.pi / angle)
        before = vectors[frame - 1]
        if np.linalg.norm(other - before) < np.linalg.norm(vectors[frame] - before):
            vectors[frame] = other
    return vectors


def _moved(points: torch.Tensor, rotation: torch.Tensor, place: torch.Tensor) -> torch.Tensor:
    return points @ rotation.mT + place[:, None]
