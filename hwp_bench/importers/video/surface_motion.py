"""How the vertices of a posed clip move in the image when the variables of their frame change."""

from __future__ import annotations

import numpy as np
import torch

from hwp_bench.hands.articulation import cross_matrix, right_jacobian
from hwp_bench.hands.skeleton import moved_joints
from hwp_bench.importers.video.clip_model import ANCHOR_UNIT, ClipModel, ClipVariables

#: Variables of one frame: turn 3, fingers 45, anchor 2, log depth 1.
FRAME_VARIABLES = 51


def frame_variables(variables: ClipVariables) -> torch.Tensor:
    """Join what differs from frame to frame: (F, 51), differentiable."""
    parts = (variables.turn, variables.fingers.flatten(1), variables.anchor, variables.log_depth)
    return torch.cat(parts, dim=1)


class SurfaceMotion:
    """Derivatives of the vertices' pixels by the variables of their frame, in closed form.

    Automatic differentiation would need one pass for each of thousands of pixels. Correctives
    count as they are and not in how they change, as in `ClipModel.choose`.

    Args:
        model: the clip; read once, as it is now.
    """

    def __init__(self, model: ClipModel) -> None:
        free, tensors = model.variables, model.tensors

        def array(tensor: torch.Tensor) -> np.ndarray:
            return np.asarray(tensor.detach().double().numpy())

        with torch.no_grad():
            posed = model.posed()
            shaped = array(tensors.vertices + tensors.shape_basis @ free.betas)
            self._joints = array(tensors.joints + tensors.joint_basis @ free.betas)
        self._shaped = shaped
        self._correctives = None if tensors.pose_basis is None else array(tensors.pose_basis)
        self._transforms = array(posed.transforms)
        self._rotation, self._place = array(posed.rotation), array(posed.place)
        self._focal = float(model.focal.detach())
        self._depth = np.exp(array(free.log_depth))[:, 0]
        self._fingers = array(free.fingers)
        self._turn_rates = right_jacobian(array(free.turn))
        self._finger_rates = right_jacobian(self._fingers)
        self._weights = array(tensors.weights)
        self._below = moved_joints()

    def by_variables(self, frame: int, vertices: np.ndarray) -> np.ndarray:
        """Differentiate vertices' pixels of the whole frame.

        Args:
            frame: which frame.
            vertices: (P,) which vertices.

        Returns:
            (P, 2, 51) px per unit of each of the `frame_variables`.
        """
        rotation, wrist = self._rotation[frame], self._joints[0]
        motion = self._transforms[frame, :, :3]
        weights = self._weights[vertices]
        rest = np.append(self._rest(frame, vertices), np.ones((len(vertices), 1)), axis=1)
        # (P, 16, 3): each joint's share of the vertex, then the share of all joints below each.
        shares = weights[:, :, None] * np.einsum("kab,vb->vka", motion, rest)
        below = np.einsum("jk,vka->vja", self._below, shares)
        centres = np.einsum("kab,kb->ka", motion[:, :, :3], self._joints) + motion[:, :, 3]
        arms = below - (weights @ self._below.T)[:, :, None] * centres
        own = below[:, 0]
        moved = np.zeros((len(vertices), 3, FRAME_VARIABLES))
        moved[:, :, :3] = -rotation @ _cross(own - wrist) @ self._turn_rates[frame]
        # The cross product of each of a joint's three axes with the arm from the joint.
        x, y, z = np.moveaxis(rotation @ motion[1:, :, :3] @ self._finger_rates[frame], 1, 0)
        u, v, w = np.einsum("ab,njb->anj", rotation, arms[:, 1:])[..., None]
        fingers = np.stack([y * w - z * v, z * u - x * w, x * v - y * u], axis=1)
        moved[:, :, 3:48] = fingers.reshape(len(vertices), 3, 45)
        moved[:, 0, 48] = moved[:, 1, 49] = ANCHOR_UNIT / self._focal * self._depth[frame]
        moved[:, :, 50] = self._place[frame] + rotation @ wrist
        place = own @ rotation.T + self._place[frame]
        depth = np.maximum(place[:, 2:], 1e-3)
        slope = place[:, :2] / depth
        return np.asarray(
            (moved[:, :2] - slope[..., None] * moved[:, 2:]) * (self._focal / depth[..., None])
        )

    def _rest(self, frame: int, vertices: np.ndarray) -> np.ndarray:
        rest = self._shaped[vertices]
        if self._correctives is not None:
            from scipy.spatial.transform import Rotation

            turns = Rotation.from_rotvec(self._fingers[frame]).as_matrix() - np.eye(3)
            rest = rest + self._correctives[vertices] @ turns.ravel()
        return np.asarray(rest)


def _cross(vectors: np.ndarray) -> np.ndarray:
    return np.asarray(cross_matrix(torch.from_numpy(vectors)).numpy())
