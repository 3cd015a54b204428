"""Gaussians of one hand without its network: skinned, plus what depends linearly on the pose.

The network's offsets and colours depend on the pose, and a page cannot run the network. In many
poses the Gaussians are therefore drawn by the avatar and taken back into the rest pose by linear
blend skinning. There remain a mean, and deviations. Of these the principal components are kept,
and their coefficients are regressed on the rotations of the 16 joints.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch

from hwp_bench.hands import anchor_normals, pose_hand
from hwp_bench.hands.articulation import axis_angle_to_matrix
from hwp_bench.hands.skeleton import PARENTS
from hwp_bench.methods.contract import HandPose
from wildghand.avatar import PosedGaussians, WildGHandAvatar
from wildghand.gaussians.rig import HandRig
from wildghand.model.dress import Gaussians
from wildghand.model.wrist import WristWall
from wildghand.splat.threads import denormals_flushed

#: Joints that move one Gaussian at most.
INFLUENCES = 4
# Weights of the ridge that are tried, per sample, and parts that are left out in turn.
_RIDGES, _FOLDS = (1e-3, 1e-2, 1e-1, 1.0), 4


@dataclass(frozen=True, eq=False)
class PoseBasis:
    """N vectors that depend on a pose: mean + sum over k of c_k basis_k."""

    #: (N, 3).
    mean: np.ndarray
    #: (K, N, 3) int8.
    basis: np.ndarray
    #: (K,) by which the basis is multiplied.
    steps: np.ndarray
    #: (145, K): rotations of 16 joints, row by row, and a constant, to coefficients.
    regression: np.ndarray
    #: (2, K) least and largest coefficient of any sample; others are cut to these.
    bounds: np.ndarray

    def at(self, pose: np.ndarray) -> np.ndarray:
        """(N, 3) in a pose, (16, 3) rad."""
        found = pose_features(pose[None]) @ self.regression
        coefficients = np.clip(found[0], *self.bounds) * self.steps
        return self.mean + np.einsum("k,knc->nc", coefficients, self.basis)


@dataclass(frozen=True, eq=False)
class BakedHand:
    """One hand with N Gaussians, as a page knows it; lengths in m, colours in sRGB.

    Those of the wall that closes the open end of the wrist come last.
    """

    #: (16, 3) rest joints of this person.
    joints: np.ndarray
    #: (N, 4) uint8 joints that move a Gaussian, and (N, 4) their weights, of sum 1.
    influences: np.ndarray
    weights: np.ndarray
    #: Places in the rest pose.
    means: PoseBasis
    #: Colours as drawn, with the light of the clip.
    colors: PoseBasis
    #: (N, 6) covariance in the rest pose: xx, xy, xz, yy, yz, zz.
    covariances: np.ndarray
    #: (N,) in (0, 1).
    opacities: np.ndarray
    #: (N, 3) unit, in the rest pose.
    normals: np.ndarray

    def __len__(self) -> int:
        return len(self.opacities)

    def posed(self, pose: np.ndarray, transl: np.ndarray) -> tuple[np.ndarray, ...]:
        """Do in NumPy as the page does: means (N, 3), covariances (N, 3, 3), colours (N, 3)."""
        linear, shifts = self.motions(pose, transl)
        means = np.einsum("nij,nj->ni", linear, self.means.at(pose)) + shifts
        xx, xy, xz, yy, yz, zz = self.covariances.T
        rest = np.stack([xx, xy, xz, xy, yy, yz, xz, yz, zz], axis=1).reshape(-1, 3, 3)
        return means, linear @ rest @ linear.swapaxes(1, 2), self.colors.at(pose)

    def motions(self, pose: np.ndarray, transl: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Blended motions of the Gaussians: (N, 3, 3) and (N, 3) m."""
        return blended_motions(self.joints, self.influences, self.weights, pose, transl)


def blended_motions(
    joints: np.ndarray,
    influences: np.ndarray,
    weights: np.ndarray,
    pose: np.ndarray,
    transl: np.ndarray,
) -> tuple[np.ndarray, np.ndarray]:
    """Linear blend skinning of points by the joints that move them; see `BakedHand.motions`."""
    turns, shifts = joint_motions(joints, pose, transl)
    linear = np.einsum("nk,nkij->nij", weights, turns[influences])
    return linear, np.einsum("nk,nki->ni", weights, shifts[influences])


def joint_motions(
    joints: np.ndarray, pose: np.ndarray, transl: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Rotations (16, 3, 3) and shifts (16, 3) m of the joints, as `hwp_bench.hands.pose_hand`."""
    turns = _rotations(pose)
    places = joints.copy()
    for joint, parent in enumerate(PARENTS):
        if parent >= 0:
            places[joint] = places[parent] + turns[parent] @ (joints[joint] - joints[parent])
            turns[joint] = turns[parent] @ turns[joint]
    return turns, places + transl - np.einsum("jik,jk->ji", turns, joints)


def pose_features(poses: np.ndarray) -> np.ndarray:
    """(P, 145) rotations of the joints of (P, 16, 3) rad, row by row, and a one."""
    turns = _rotations(poses.reshape(-1, 3)).reshape(len(poses), -1)
    return np.concatenate([turns, np.ones((len(poses), 1))], axis=1)


@denormals_flushed()
@torch.no_grad()
def bake_hand(
    avatar: WildGHandAvatar, side: str, poses: np.ndarray, *, geometry_rank: int, color_rank: int
) -> BakedHand:
    """Bake one hand from its Gaussians in poses (P, 16, 3); covariances are of the first."""
    rig, betas = avatar.model.rigs[side], avatar.betas[side]
    shape = torch.as_tensor(betas, dtype=torch.float32, device=rig.template.joints.device)
    joints = (rig.template.joints + rig.template.joint_basis @ shape).double().cpu().numpy()
    wall = avatar.model.wall(side)
    influences, weights = _skin(rig, wall)
    gaussians = []
    for pose in poses:
        hand = HandPose(side, pose, betas, np.zeros(3))
        gaussians.append(avatar.pose({side: hand}, closed=True))
        gaussians[-1].require_finite()
    rest = np.empty((len(poses), len(influences), 3), dtype=np.float32)
    for row, (pose, drawn) in enumerate(zip(poses, gaussians, strict=True)):
        linear, shifts = blended_motions(joints, influences, weights, pose, np.zeros(3))
        rest[row] = np.linalg.solve(linear, (drawn.means - shifts)[..., None])[..., 0]
    linear, _ = blended_motions(joints, influences, weights, poses[0], np.zeros(3))
    inverse = np.linalg.inv(linear)
    covariance = inverse @ _covariances(gaussians[0]) @ inverse.swapaxes(1, 2)
    rows, columns = np.triu_indices(3)
    colors = np.stack([drawn.colors for drawn in gaussians])
    return BakedHand(
        joints=joints,
        influences=influences,
        weights=weights,
        means=_basis(rest, poses, geometry_rank),
        colors=_basis(colors, poses, color_rank),
        covariances=covariance[:, rows, columns],
        opacities=np.mean([drawn.opacities for drawn in gaussians], axis=0),
        normals=_rest_normals(rig, wall, shape),
    )


def _rotations(vectors: np.ndarray) -> np.ndarray:
    return axis_angle_to_matrix(torch.as_tensor(np.array(vectors, dtype=np.float64))).numpy()


def _skin(rig: HandRig, wall: WristWall | None) -> tuple[np.ndarray, np.ndarray]:
    faces, anchors = rig.template.faces.cpu(), rig.anchors
    corners = faces[torch.as_tensor(anchors.face_index).cpu()]
    mix = torch.as_tensor(anchors.barycentric).cpu()
    by_vertex = rig.template.weights.cpu()
    weights = (by_vertex[corners] * mix[..., None]).sum(dim=1)
    if wall is not None:
        border = wall.shares.cpu() @ by_vertex[wall.border.cpu()]
        weights = torch.cat([weights, border.to(weights)])
    kept, joints = weights.topk(INFLUENCES, dim=1)
    kept = kept / kept.sum(dim=1, keepdim=True)
    # As the page stores them, so that both compute the same.
    whole = np.rint(kept.double().numpy() * 65535.0)
    return joints.numpy().astype(np.uint8), whole / whole.sum(axis=1, keepdims=True)


def _rest_normals(rig: HandRig, wall: WristWall | None, shape: torch.Tensor) -> np.ndarray:
    zeros = shape.new_zeros(1, 16, 3), shape, shape.new_zeros(1, 3)
    vertices = pose_hand(rig.template, *zeros).vertices
    normals = anchor_normals(vertices, rig.template.faces, rig.anchors)[0].cpu().numpy()
    if wall is None:
        return normals
    _, inwards = wall.plane(vertices)
    outwards = -inwards.cpu().numpy().repeat(len(wall), axis=0)
    return np.concatenate([normals, outwards])


def _covariances(gaussians: PosedGaussians) -> np.ndarray:
    w, x, y, z = gaussians.quats.astype(np.float64).T
    turn = np.stack(
        [
            *(1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)),
            *(2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)),
            *(2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)),
        ],
        axis=1,
    ).reshape(-1, 3, 3)
    scales = np.broadcast_to(gaussians.scales, gaussians.means.shape).astype(np.float64)
    half = turn * scales[:, None]
    return half @ half.swapaxes(1, 2)


def _basis(values: np.ndarray, poses: np.ndarray, rank: int) -> PoseBasis:
    """Principal components of (P, N, 3) values in P poses, and their regression on these."""
    count = len(values)
    mean = values.mean(axis=0, dtype=np.float64)
    components, coefficients = _principal(values - mean, min(rank, count - 1))
    peaks = np.abs(components).max(axis=(1, 2), initial=1e-30)
    regression = _ridge(pose_features(poses), coefficients)
    bounds = np.stack([coefficients.min(axis=0), coefficients.max(axis=0)])
    whole = np.rint(components / peaks[:, None, None] * 127.0).astype(np.int8)
    return PoseBasis(mean, whole, peaks / 127.0, regression, bounds)


def _ridge(features: np.ndarray, targets: np.ndarray) -> np.ndarray:
    """Ridge regression; its weight is the one that predicts parts that were left out best."""
    count, width = features.shape

    def solve(x: np.ndarray, y: np.ndarray, ridge: float) -> np.ndarray:
        centre, level = x[:, :-1].mean(axis=0), y.mean(axis=0)
        inner = x[:, :-1] - centre
        gram = inner.T @ inner + ridge * len(x) * 0.1 * np.eye(width - 1)
        slopes = np.linalg.solve(gram, inner.T @ (y - level))
        return np.concatenate([slopes, (level - centre @ slopes)[None]])

    def missed(ridge: float) -> float:
        total = 0.0
        for fold in range(_FOLDS):
            out = np.arange(count) % _FOLDS == fold
            guess = features[out] @ solve(features[~out], targets[~out], ridge)
            total += float(np.square(guess - targets[out]).sum())
        return total

    best = min(_RIDGES, key=missed) if count >= 2 * _FOLDS else _RIDGES[-1]
    return solve(features, targets, best)


#: Numbers of a Gaussian: place at rest (3, m), colour (3, sRGB), opacity, log of the scale.
WIDTH = 8
# How much of each number the eye takes for about as much: 4 mm, a quarter of the colours.
_UNITS = np.array([0.004] * 3 + [0.25] * 3 + [0.25, 0.5])
# Frames that are posed together.
_CHUNK = 8


@dataclass(frozen=True, eq=False)
class FrameBiases:
    """Additions of F frames to the N Gaussians of a hand: the sum over k of c_fk basis_k."""

    #: (K, N, 8) int8.
    basis: np.ndarray
    #: (K, 8) by which the basis is multiplied.
    steps: np.ndarray
    #: (F, K).
    coefficients: np.ndarray

    def at(self, row: int) -> np.ndarray:
        """(N, 8) that frame number `row` of F adds."""
        scaled = self.coefficients[row][:, None] * self.steps
        return np.einsum("kc,knc->nc", scaled, self.basis)


@denormals_flushed()
@torch.no_grad()
def bake_biases(
    avatar: WildGHandAvatar,
    side: str,
    hand: BakedHand,
    frames: Sequence[int],
    motion: np.ndarray,
    rank: int,
) -> FrameBiases | None:
    """Bake the biases of F training frames, with their poses and translations (F, 51).

    None where the avatar has none.
    """
    model = avatar.model
    if side not in model.perturbation or not len(frames) or rank < 1:
        return None
    known = {frame: row for row, frame in enumerate(avatar.record.frames)}
    # The wall of the wrist, which comes last, is not fitted.
    found = np.zeros((len(frames), len(hand), WIDTH), dtype=np.float32)
    count = len(model.rigs[side])
    for start in range(0, len(frames), _CHUNK):
        part = slice(start, start + _CHUNK)
        given = torch.as_tensor(motion[part], dtype=torch.float32, device=model.log_gains.device)
        rows = torch.tensor([known[frame] for frame in frames[part]], device=given.device)
        pose, transl = given[:, :48].reshape(-1, 16, 3), given[:, 48:]
        betas = torch.as_tensor(avatar.betas[side], dtype=torch.float32, device=given.device)
        refine = avatar.settings.heads
        clean, _ = model.gaussians(side, pose, betas, transl, refine=refine)
        biased, _ = model.gaussians(side, pose, betas, transl, refine=refine, rows=rows)
        found[part, :count] = _differences(clean, biased, len(pose))
        for row in range(len(pose)):
            linear, _ = hand.motions(pose[row].double().cpu().numpy(), np.zeros(3))
            places = found[start + row, :, :3, None]
            found[start + row, :, :3] = np.linalg.solve(linear, places)[..., 0]
    return _components(found / _UNITS.astype(np.float32), rank)


def _differences(clean: Gaussians, biased: Gaussians, count: int) -> np.ndarray:
    """(B, N, 8) of B frames; places in the world."""

    def number(a: torch.Tensor, b: torch.Tensor) -> torch.Tensor:
        return (b - a).expand(count, *torch.broadcast_shapes(a.shape, b.shape)[-2:])

    scales = [each.scales.log().mean(dim=-1, keepdim=True) for each in (clean, biased)]
    parts = [
        number(clean.means, biased.means),
        number(clean.colors, biased.colors),
        number(clean.opacities[..., None], biased.opacities[..., None]),
        number(*scales),
    ]
    return torch.cat(parts, dim=-1).cpu().numpy()


def _components(values: np.ndarray, rank: int) -> FrameBiases:
    """Principal components, about zero, of (F, N, 8) values in units of `_UNITS`."""
    components, coefficients = _principal(values, rank)
    peaks = np.abs(components).max(axis=1, initial=1e-30)
    whole = np.rint(components / peaks[:, None] * 127.0).astype(np.int8)
    return FrameBiases(whole, peaks / 127.0 * _UNITS, coefficients)


def _principal(values: np.ndarray, rank: int) -> tuple[np.ndarray, np.ndarray]:
    """Components (K, N, C) of length 1 and coefficients (P, K) of (P, N, C) values."""
    flat = values.reshape(len(values), -1)
    # The Gram matrix is small: there are fewer poses than Gaussians.
    power, vectors = np.linalg.eigh((flat @ flat.T).astype(np.float64))
    order = np.argsort(power)[::-1][:rank]
    order = order[power[order] > 1e-9 * max(float(power.max()), 1e-30)]
    roots = np.sqrt(power[order])
    components = (flat.T @ (vectors[:, order] / roots)).T
    return components.reshape(len(order), *values.shape[1:]), vectors[:, order] * roots
