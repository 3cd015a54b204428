"""A hand over a whole clip as the fit sees it: its start, its variables, and how they move it."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, fields

import numpy as np
import torch

from hwp_bench.base.kernels import compiled
from hwp_bench.hands import HandParameters, HandTemplate, pose_hand
from hwp_bench.hands.articulation import axis_angle_to_matrix, right_jacobian
from hwp_bench.hands.poses import interpolate, interpolate_turns
from hwp_bench.hands.skeleton import moved_joints
from hwp_bench.hands.skinning import only_fingertips
from hwp_bench.importers.shared.landmarks import PALM, Landmarks

#: The joint whose frame a landmark is fixed in: joints in their own, tips in the last joint's.
FRAME_OF = (0, 13, 14, 15, 15, 1, 2, 3, 3, 4, 5, 6, 6, 10, 11, 12, 12, 7, 8, 9, 9)
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

    def read(self) -> dict[str, np.ndarray]:
        """Return all by their names, float64."""
        return {
            field.name: getattr(self, field.name).detach().double().numpy()
            for field in fields(self)
        }


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


class ClipModel:
    """Poses a clip from its variables, which are relative to a start.

    `focal`, px, is where the focal length starts; `centre` (2,) the principal point, px.
    """

    def __init__(
        self, template: HandTemplate, start: RigidStart, focal: float, centre: np.ndarray
    ) -> None:
        self.template = template
        self.tensors = template.to_torch(torch.float32)
        #: (F, 3, 3) float64, the start's rotations.
        self.start = np.ascontiguousarray(start.rotation, np.float64)
        self._start = torch.as_tensor(start.rotation, dtype=torch.float32)
        #: (F, 21, 3) m, the start's world landmarks.
        self.world = start.world
        #: (2,) px.
        self.centre = np.asarray(centre, np.float64)
        self._centre = torch.as_tensor(centre, dtype=torch.float32)
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

    def pose(self) -> PosedClip:
        """Pose every frame; differentiable."""
        free = self.variables
        frames = len(free.turn)
        pose = torch.cat([torch.zeros_like(free.fingers[:, :1]), free.fingers], dim=1)
        rest = pose_hand(self._tips, pose, free.betas, pose.new_zeros(frames, 3))
        rotation = self._start @ axis_angle_to_matrix(free.turn)
        depth = free.log_depth.exp()
        wrist = torch.cat([free.anchor * (ANCHOR_UNIT / self.focal) * depth, depth], dim=1)
        place = wrist - (rotation @ rest.joints[:, 0, :, None])[..., 0]
        turned = rest.transforms[:, list(FRAME_OF), :3, :3] @ free.offsets[..., None]
        return PosedClip(
            rotation=rotation,
            place=place,
            transforms=rest.transforms,
            landmarks=(rest.landmarks + turned[..., 0]) @ rotation.mT + place[:, None],
            pose=pose,
        )

    def pixels(self, points: torch.Tensor) -> torch.Tensor:
        """Project (F, P, 3) m to (F, P, 2) px; points at the camera's plane stay finite."""
        return points[..., :2] / points[..., 2:].clamp(min=1e-3) * self.focal + self._centre

    def parameters(self, valid: np.ndarray) -> HandParameters:
        """Return the clip as hand parameters, the root rotation continuous in time."""
        with torch.no_grad():
            posed = self.pose()
            wrist = self.tensors.joints[0] + self.tensors.joint_basis[0] @ self.variables.betas
            # `pose_hand` turns about the rest wrist, `posed` about the origin.
            transl = posed.place + (posed.rotation @ wrist) - wrist
        root = unwrap_rotations(posed.rotation.double().numpy())
        pose = posed.pose.double().numpy().copy()
        pose[:, 0] = root
        return HandParameters(
            pose=pose,
            betas=self.variables.betas.detach().double().numpy().copy(),
            transl=transl.double().numpy(),
            valid=np.asarray(valid, dtype=bool),
        )


# Frames posed at once, to bound memory with fine templates.
_CHUNK = 64


def pose_vertices(model: ClipModel) -> np.ndarray:
    """Return the vertices of every frame in the camera frame, (F, V, 3) float32 m."""
    betas = model.variables.betas
    with torch.no_grad():
        posed = model.pose()
        pieces = [
            pose_hand(model.tensors, part, betas, torch.zeros(len(part), 3)).vertices @ rotation.mT
            + place[:, None]
            for part, rotation, place in zip(
                *(whole.split(_CHUNK) for whole in (posed.pose, posed.rotation, posed.place)),
                strict=True,
            )
        ]
    return torch.cat(pieces).numpy()


def unwrap_rotations(rotations: np.ndarray) -> np.ndarray:
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


# --- The start: one rigid pose for each frame, in closed form


@dataclass(frozen=True)
class RigidStart:
    """Rigid motion of a hand in F frames."""

    #: (F, 3, 3) template rest frame to camera.
    rotation: np.ndarray
    #: (F, 3) m, the wrist joint in the camera frame.
    wrist: np.ndarray
    #: (F, 21, 3) m, the tracker's world landmarks turned into the camera frame.
    world: np.ndarray


def rigid_start(
    landmarks: Landmarks, rest: np.ndarray, focal: float, centre: np.ndarray
) -> RigidStart:
    """Estimate the rigid pose of every frame from its world and image landmarks.

    The tracker sees a crop around the hand and assumes that the camera looks straight at it,
    so its world landmarks are first turned by the angle between the optical axis and the ray
    through the hand. The rotation is the orthogonal Procrustes solution on the palm, the place
    the least-squares solution of the pinhole equations, which are linear in it. Frames without
    a detection are interpolated. `rest` (21, 3) m are the template's landmarks.
    """
    from scipy.spatial.transform import Rotation

    count, seen = landmarks.score.size, np.flatnonzero(landmarks.detected)
    pixels = landmarks.image[seen]
    turn = _ray_rotation(pixels.mean(axis=1), focal, centre)
    world = np.einsum("fij,fkj->fki", turn, landmarks.world[seen])
    palm = list(PALM)
    rotation = _procrustes(rest[palm], world[:, palm])
    wrist = _place(world - world[:, :1], (pixels - centre) / focal)
    return RigidStart(
        rotation=interpolate_turns(Rotation.from_matrix(rotation), seen, count).as_matrix(),
        wrist=interpolate(wrist, seen, count),
        world=interpolate(world, seen, count),
    )


def _ray_rotation(pixels: np.ndarray, focal: float, centre: np.ndarray) -> np.ndarray:
    """The smallest rotation that turns the optical axis to the ray through each pixel."""
    from scipy.spatial.transform import Rotation

    slope = (pixels - centre) / focal
    angle = np.arctan(np.linalg.norm(slope, axis=1, keepdims=True))
    axis = np.stack([-slope[:, 1], slope[:, 0], np.zeros(len(slope))], axis=1)
    length = np.maximum(np.linalg.norm(axis, axis=1, keepdims=True), 1e-12)
    return Rotation.from_rotvec(axis / length * angle).as_matrix()


def _procrustes(rest: np.ndarray, observed: np.ndarray) -> np.ndarray:
    """Rotations (F, 3, 3) that take centred `rest` (P, 3) closest to `observed` (F, P, 3)."""
    source = rest - rest.mean(axis=0)
    target = observed - observed.mean(axis=1, keepdims=True)
    left, _, right = np.linalg.svd(np.einsum("fpi,pj->fij", target, source))
    left[:, :, 2] *= np.sign(np.linalg.det(left @ right))[:, None]
    return left @ right


def _place(shape: np.ndarray, rays: np.ndarray) -> np.ndarray:
    """Translations (F, 3) with (shape + t) on the rays: x (Z + tz) = X + tx, and so for y."""
    one, zero = np.ones_like(rays[..., 0]), np.zeros_like(rays[..., 0])
    rows_x = np.stack([one, zero, -rays[..., 0]], axis=-1)
    rows_y = np.stack([zero, one, -rays[..., 1]], axis=-1)
    matrix = np.concatenate([rows_x, rows_y], axis=1)
    right = np.concatenate(
        [
            rays[..., 0] * shape[..., 2] - shape[..., 0],
            rays[..., 1] * shape[..., 2] - shape[..., 1],
        ],
        axis=1,
    )
    place = np.einsum("fij,fj->fi", np.linalg.pinv(matrix), right)
    # A flat or noisy frame may land at or behind the camera; the fit needs it in front.
    extent = np.linalg.norm(shape, axis=-1).max(axis=1)
    place[:, 2] = np.maximum(place[:, 2], np.maximum(1.5 * extent, 0.01))
    return place


# --- How vertices move in the image when the variables of their frame change

#: Variables of one frame: turn 3, fingers 45, anchor 2, log depth 1.
FRAME_VARIABLES = 51


# Where they lie in a row.
_COLUMNS = {
    "turn": slice(0, 3),
    "fingers": slice(3, 48),
    "anchor": slice(48, 50),
    "log_depth": slice(50, 51),
}


def join_frames(values: Mapping[str, np.ndarray]) -> np.ndarray:
    """Join what differs from frame to frame, of values by the name of their variable: (F, 51)."""
    return np.concatenate([values[name].reshape(len(values[name]), -1) for name in _COLUMNS], 1)


def split_frames(rows: np.ndarray) -> dict[str, np.ndarray]:
    """Undo `join_frames`."""
    parts = {name: rows[:, columns] for name, columns in _COLUMNS.items()}
    return {**parts, "fingers": parts["fingers"].reshape(-1, 15, 3)}


class SurfaceMotion:
    """Derivatives of the vertices' pixels by the variables of their frame, in closed form.

    Automatic differentiation would need one pass for each of thousands of pixels. Correctives
    count as they are and not in how they change. The model is read once.
    """

    def __init__(self, model: ClipModel) -> None:
        free, tensors = model.variables, model.tensors

        def array(tensor: torch.Tensor) -> np.ndarray:
            return np.asarray(tensor.detach().double().numpy())

        with torch.no_grad():
            posed = model.pose()
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
        """Differentiate pixels of P vertices: (P, 2, 51) px per unit of the `frame_variables`."""
        rotation, motion = self._rotation[frame], self._transforms[frame, :, :3]
        turns = motion[:, :, :3]
        centres = (turns @ self._joints[..., None])[..., 0] + motion[:, :, 3]
        # The axes that variables turn about are columns; the whole hand turns about the wrist.
        axes = np.concatenate(
            [self._turn_rates[frame][None], turns[1:] @ self._finger_rates[frame]]
        )
        rates = np.zeros((len(vertices), 2, FRAME_VARIABLES))
        wrist = self._place[frame] + rotation @ self._joints[0]
        rest, weights = self._rest(frame, vertices), self._weights[vertices]
        hand = rotation @ axes, np.append(self._joints[:1], centres[1:], axis=0), wrist
        camera = rotation, self._place[frame], self._focal, ANCHOR_UNIT * self._depth[frame]
        _pixel_rates(rest, weights, motion, self._below, *hand, *camera, rates)
        return rates

    def _rest(self, frame: int, vertices: np.ndarray) -> np.ndarray:
        rest = self._shaped[vertices]
        if self._correctives is not None:
            from scipy.spatial.transform import Rotation

            turns = Rotation.from_rotvec(self._fingers[frame]).as_matrix() - np.eye(3)
            rest = rest + self._correctives[vertices] @ turns.ravel()
        return np.asarray(rest)


@compiled(nogil=True)
def _pixel_rates(
    rest: np.ndarray,
    weights: np.ndarray,
    motion: np.ndarray,
    below: np.ndarray,
    axes: np.ndarray,
    centres: np.ndarray,
    wrist: np.ndarray,
    rotation: np.ndarray,
    place: np.ndarray,
    focal: float,
    anchor: float,
    rates: np.ndarray,
) -> None:
    shares, arm, far = np.zeros((16, 3)), np.zeros(3), np.zeros(3)
    for p in range(len(rest)):
        far[:] = place
        for k in range(16):
            weight = weights[p, k]
            for a in range(3):
                turned = motion[k, a, 3]
                for b in range(3):
                    turned += motion[k, a, b] * rest[p, b]
                shares[k, a] = weight * turned
                for b in range(3):
                    far[b] += rotation[b, a] * shares[k, a]
        z = max(far[2], 1e-3)
        x, y, scale = far[0] / z, far[1] / z, focal / z
        for joint in range(16):
            total, arm[:] = 0.0, 0.0
            for k in range(16):
                if below[joint, k] > 0.0 and weights[p, k] > 0.0:
                    total += weights[p, k]
                    for a in range(3):
                        arm[a] += shares[k, a] - weights[p, k] * centres[joint, a]
            if total == 0.0:
                continue
            u, v, w = 0.0, 0.0, 0.0
            for a in range(3):
                u += rotation[0, a] * arm[a]
                v += rotation[1, a] * arm[a]
                w += rotation[2, a] * arm[a]
            for column in range(3):
                # The cross product of the axis and the arm.
                first, second, third = (
                    axes[joint, 0, column],
                    axes[joint, 1, column],
                    axes[joint, 2, column],
                )
                ahead = first * v - second * u
                number = 3 * joint + column
                rates[p, 0, number] = scale * (second * w - third * v - x * ahead)
                rates[p, 1, number] = scale * (third * u - first * w - y * ahead)
        rates[p, 0, 48] = rates[p, 1, 49] = anchor / z
        rates[p, 0, 50] = scale * (wrist[0] - x * wrist[2])
        rates[p, 1, 50] = scale * (wrist[1] - y * wrist[2])
