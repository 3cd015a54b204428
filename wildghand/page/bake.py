"""Content of a page: a hand's surface, its Gaussians, and the layers of the model that see a pose.

Most of a compact network sees no pose: for each Gaussian it comes down to 14 numbers. The rest (the
geometry branch and the heads on it) is a few small layers, which the page evaluates at each
Gaussian. How the network corrects the pose follows from the mean of the geometry branch, which the
page finds at some Gaussians (`refinement_content`).

A network that is too large for that is evaluated in many poses instead. Its outputs become a mean
and principal components, whose coefficients, as the corrections, are regressed on the rotations of
the joints (`PoseBasis`).
"""

from __future__ import annotations

import base64
import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from torch import Tensor, nn

from hwp_bench.base.arrays import evenly
from hwp_bench.hands.articulation import axis_angle_to_matrix
from wildghand.avatar import WildGHandAvatar
from wildghand.gaussians.attributes import CHANNELS, RawAttributes
from wildghand.gaussians.quaternions import quat_third_axis
from wildghand.model.wrist import DEPTH, OPAQUE, SPACING, THIN, WIDE, WristWall
from wildghand.network import HandFeatures
from wildghand.network.branches import CompactGeometry
from wildghand.network.surface import Chart
from wildghand.splat.threads import denormals_flushed
from wildghand.visibility import Visibility

# Weights of the ridge that are tried, per sample, and parts that are left out in turn.
_RIDGES, _FOLDS = (1e-3, 1e-2, 1e-1, 1.0), 4
# Harmonics of the normal, padded to fours, and vectors of four weights that every browser takes
# in two blocks.
_HARMONICS, _MOST_WEIGHTS = 16, 2048
# Components of a hand model's pose correctives that are kept, their bytes, and joints of a vertex.
_CORRECTIVES, _MOST_CORRECTIVES, _JOINTS = 32, 1_000_000, 4
# Poses that are asked for together.
_CHUNK = 8
# Gaussians whose weighted mean is that of all, poses in which their weights are found, and the
# ridge that keeps these near to each other, in the mean size of the normal matrix's diagonal.
_HEARD, _WEIGHED, _EVEN = 256, 16, 0.1


def pack(array: np.ndarray) -> str:
    """Base64 of an array's bytes."""
    return base64.b64encode(np.ascontiguousarray(array).tobytes()).decode()


def pack_whole(values: np.ndarray) -> dict[str, Any]:
    """(N, C) numbers in 16 bits each: `low` + `step` * whole, by column."""
    low = values.min(axis=0).astype(np.float64)
    step = np.maximum(values.max(axis=0) - low, 1e-12) / 65535.0
    whole = np.rint((values - low) / step).clip(0, 65535).astype("<u2")
    return {"low": low.tolist(), "step": step.tolist(), "whole": pack(whole)}


@torch.no_grad()
def network_content(avatar: WildGHandAvatar) -> dict[str, Any] | None:
    """The layers that see a pose, as the page's shader reads them; None where they are too large.

    Vectors of four outputs follow one another, input by input; missing inputs and outputs are 0.
    """
    network = avatar.model.network
    branch, head, dark = network.geometry_branch, network.attribute_head, network.shadow_head
    if not isinstance(branch, CompactGeometry) or network.settings.head_layers != 1:
        return None
    width, heads = branch.mix.out_features, network.settings.head_width
    points, hidden = -(-width // 4), -(-heads // 4)
    harmonics = branch.channels - width
    of_hidden = _first(head.geometry), _first(dark.detail)
    last = dark.detail[-1]
    assert isinstance(last, nn.Linear)

    def geometry(weight: Tensor) -> Tensor:
        """Columns of harmonics and hidden features, each padded."""
        light, rest = weight.split([harmonics, width], dim=1)
        return torch.cat([_wider(light, _HARMONICS), _wider(rest, 4 * points)], dim=1)

    def rows(*weights: Tensor, quads: int) -> Tensor:
        """(inputs, 4 quads) of (outputs, inputs) weights."""
        return torch.cat([_wider(weight.T, 4 * quads) for weight in weights], dim=1)

    several = [
        rows(branch.place.weight, quads=points),
        rows(_wider(branch.normal.weight, _HARMONICS), quads=points),
        rows(branch.mix.bias[:, None], quads=points),
        rows(_wider(branch.mix.weight, 4 * points), quads=points),
        rows(*(layer.bias[:, None] for layer in of_hidden), quads=hidden),
        rows(*(geometry(layer.weight) for layer in of_hidden), quads=hidden),
        rows(_wider(head.frame_weights(), 4 * hidden), quads=4),
        _wider((last.bias + dark.start)[None], 4),
        _wider(last.weight, 4 * hidden),
        geometry(dark.light.weight),
    ]
    weights = torch.cat([part.reshape(-1, 4) for part in several])
    if len(weights) > _MOST_WEIGHTS:
        return None
    return {
        "points": points,
        "hidden": hidden,
        "weights": _real(weights),
        "frequencies": branch.frequencies,
        "posture": _linear(
            _wider(branch.pose.weight.T, 4 * points), _wider(branch.place.bias[None], 4 * points)
        ),
    }


def _first(layers: nn.Sequential) -> nn.Linear:
    layer = layers[0]
    assert isinstance(layer, nn.Linear)
    return layer


def _wider(matrix: Tensor, columns: int) -> Tensor:
    return nn.functional.pad(matrix, (0, columns - matrix.shape[1]))


def _real(values: Tensor | np.ndarray) -> str:
    array = values.detach().cpu().numpy() if isinstance(values, Tensor) else values
    return pack(array.astype("<f4"))


def _linear(weights: Tensor | np.ndarray, bias: Tensor | np.ndarray) -> dict[str, str]:
    """A linear layer: (inputs, outputs) weights and a bias."""
    return {"weights": _real(weights), "bias": _real(bias)}


@torch.no_grad()
def refinement_content(
    avatar: WildGHandAvatar, side: str, poses: np.ndarray, features: HandFeatures
) -> dict[str, Any]:
    """How a network whose layers the page holds corrects a pose (head iv).

    The head reads the mean of the geometry features of all Gaussians. The page takes a weighted
    mean of M of them. In the given poses, (P, 16, 3) rad, it is nearly that of all: ridge
    regression of the P means, from equal weights.
    """
    network, rig = avatar.model.network, avatar.model.rigs[side]
    branch, settings = network.geometry_branch, network.settings
    assert isinstance(branch, CompactGeometry)
    chosen = evenly(len(rig), _HEARD)
    seen, means = [], []
    for part in poses[evenly(len(poses), _WEIGHED)]:
        pose = torch.as_tensor(part[None], dtype=torch.float32).to(features.betas)
        betas = torch.as_tensor(avatar.betas[side], dtype=torch.float32).to(pose)
        normals = quat_third_axis(rig.pose(pose, betas, pose.new_zeros(1, 3)).orientations)
        found = network.geometry(side, normals, pose)[0].double().cpu().numpy()
        seen.append(found[chosen].T)
        means.append(found.mean(axis=0))
    matrix, mean = np.concatenate(seen), np.concatenate(means)
    normal, equal = matrix.T @ matrix, np.full(len(chosen), 1.0 / len(chosen))
    ridge = _EVEN * np.trace(normal) / len(normal) * np.eye(len(normal))
    weights = equal + np.linalg.solve(normal + ridge, matrix.T @ (mean - matrix @ equal))
    first, last = _first(network.refinement_head.frame), network.refinement_head.frame[-1]
    assert isinstance(last, nn.Linear)
    of_hand, of_pose = first.weight.split([len(features.mean), branch.channels], dim=1)
    chart = network.charts[side]
    assert isinstance(chart, Chart)
    return {
        "chosen": chosen.tolist(),
        "shares": weights.tolist(),
        "light": branch.normal.in_features,
        "places": _real(chart.coordinates[chosen] @ branch.place.weight.T),
        "normal": _linear(branch.normal.weight.T, torch.zeros(branch.mix.in_features)),
        "mix": _linear(branch.mix.weight.T, branch.mix.bias),
        "first": _linear(of_pose.T, first.bias + of_hand @ features.mean),
        "last": _linear(last.weight.T, last.bias),
        "bounds": [settings.max_pose, settings.max_transl],
    }


def light_content(avatar: WildGHandAvatar) -> dict[str, Any]:
    """The light that casts shadows, and the one by which unknown normals are drawn."""
    model = avatar.model
    cast = None if model.shadows is None else model.shadows.light
    known = model.light
    content: dict[str, Any] = {"cast": None, "known": None}
    if cast is not None and len(cast.strengths):
        lamps = np.column_stack([cast.directions, cast.strengths])
        content["cast"] = {"lamps": lamps.tolist(), "ambient": cast.ambient}
    if known is not None:
        lamps = torch.column_stack([known.directions, known.strengths]).cpu().numpy()
        content["known"] = {
            "lamps": lamps.tolist(),
            "ambient": float(known.ambient),
            "cap": [*known.axis.tolist(), float(known.cosine)],
        }
    return content


@denormals_flushed()
@torch.no_grad()
def hand_content(
    avatar: WildGHandAvatar, side: str, poses: np.ndarray, *, tabled: bool, rank: int
) -> dict[str, Any]:
    """One hand; lengths in m. The discs that close the open end of its wrist come last.

    Args:
        poses: (P, 16, 3) rad, in which the network is asked.
        tabled: the network is too large for the page.
        rank: number of principal components of such a network's outputs.
    """
    model, settings = avatar.model, avatar.settings
    rig, network, wall = model.rigs[side], model.network, model.wall(side)
    features, behind = network.features(side), _unseen(avatar, side)
    betas = torch.as_tensor(avatar.betas[side], dtype=torch.float32).to(features.betas)
    steps, said = None, None
    if tabled:
        steps, said = _sample(avatar, side, poses, features, behind)
    shape = betas + features.betas if settings.heads else betas
    template = rig.template
    rest = template.vertices + template.shape_basis @ shape
    faces = template.faces.cpu().numpy()
    corners = faces[torch.as_tensor(rig.anchors.face_index).cpu().numpy()]
    mix = torch.as_tensor(rig.anchors.barycentric).cpu().numpy()
    count = len(rig)
    if said is not None:
        base = said.mean(axis=0)[:, :CHANNELS]
    else:
        raw = network.attributes_of_texture(side, features)
        if model.color_changes is not None:
            raw = model.color_changes.color(side, raw, behind)
        base = raw.concatenate().cpu().numpy()
    # What the skin of Gaussians that no frame shows changes where it faces the camera.
    changes = np.zeros((count, 3))
    if model.color_changes is not None:
        changes = (model.color_changes.changes[side] * behind[:, None]).cpu().numpy()
    shifts = np.zeros((count, 3))
    if settings.heads:
        shifts = features.template_offsets.cpu().numpy()
    kept = np.ones((count, 2))
    if model.visibility is not None:
        both = model.visibility.offsets[side], model.visibility.shapes[side]
        kept = torch.stack(both, dim=1).cpu().numpy()
    chart = network.charts[side]
    assert isinstance(chart, Chart)
    coded = chart.coordinates.double().cpu().numpy()
    # uv, and the angle of the lowest frequency of each coordinate (`encode_positions`).
    places = np.concatenate([coded[:, :2], np.arctan2(coded[:, 2:11:3], coded[:, 11:20:3])], axis=1)
    if wall is not None:
        discs = _wall_rows(wall, len(rest), network.activation.log_scale_bias)
        corners = np.concatenate([corners, discs.corners])
        mix = np.concatenate([mix, discs.mix])
        base = np.concatenate([base, discs.base])
        shifts = np.concatenate([shifts, discs.shifts])
        changes = np.concatenate([changes, np.zeros((len(wall), 3))])
        # These are as they are: no frame is asked.
        kept = np.concatenate([kept, np.ones((len(wall), 2))])
    order = torch.argsort(template.weights, dim=1, descending=True)[:, :_JOINTS].cpu().numpy()
    weights = np.take_along_axis(template.weights.cpu().numpy(), order, axis=1)
    return {
        "side": side,
        "skin": count,
        "count": len(base),
        "joints": (template.joints + template.joint_basis @ shape).tolist(),
        "rest": _real(rest),
        "bones": pack(order.astype(np.uint8)),
        "weights": _real(weights / weights.sum(axis=1, keepdims=True)),
        "faces": pack(faces.astype("<u4")),
        "correctives": pack_correctives(template.pose_basis),
        "border": [] if wall is None else wall.border.tolist(),
        "lenders": [] if wall is None else wall.skin.tolist(),
        "corners": pack(corners.astype("<u2")),
        "mix": pack(np.rint(mix[:, :2] * 65535.0).astype("<u2")),
        "base": pack_whole(base),
        "places": pack_whole(places),
        "shifts": pack_whole(shifts),
        "changes": pack_whole(changes),
        # 0 is of skin that no frame shows.
        "kept": pack(np.where(kept > 0.0, np.rint(kept * 255.0).clip(min=1.0), 0.0).astype("u1")),
        "disc": _disc(avatar, side),
        "activation": [
            network.activation.max_offset,
            network.activation.log_scale_bias,
            math.log(network.activation.min_scale),
            math.log(network.activation.max_scale),
        ],
        "refined": None
        if tabled or not settings.heads
        else refinement_content(avatar, side, poses, features),
        "steps": None if steps is None else _regression(poses, steps),
        "table": None if said is None else pose_basis(said, poses, rank).content(),
    }


def _regression(poses: np.ndarray, targets: np.ndarray) -> dict[str, str]:
    found = _ridge(pose_features(poses), targets)
    return _linear(found[:-1], found[-1])


def _sample(
    avatar: WildGHandAvatar,
    side: str,
    poses: np.ndarray,
    features: HandFeatures,
    behind: torch.Tensor,
) -> tuple[np.ndarray | None, np.ndarray]:
    """In P poses: (P, 51) corrections of pose and translation, None without; and what is tabled.

    That is (P, N, 15): the attributes before their activation, and the log of the shadow.
    """
    model, rig = avatar.model, avatar.model.rigs[side]
    betas = torch.as_tensor(avatar.betas[side], dtype=torch.float32).to(features.betas)
    steps, said = [], []
    for part in torch.as_tensor(poses, dtype=torch.float32).to(betas).split(_CHUNK):
        anchors = rig.pose(part, betas, part.new_zeros(len(part), 3))
        made = model.predict(side, anchors, part, features)
        steps.append(torch.cat([made.refinement.pose.flatten(1), made.refinement.transl], dim=1))
        raw = made.raw
        if model.color_changes is not None:
            raw = model.color_changes.color(side, raw, behind)
        log = made.shadow.clamp(min=1e-4).log()
        said.append(torch.cat([raw.concatenate(), log], dim=-1).cpu().numpy())
    found = torch.cat(steps).cpu().numpy() if avatar.settings.heads else None
    return found, np.concatenate(said)


def _unseen(avatar: WildGHandAvatar, side: str) -> torch.Tensor:
    """(N,) 1 for Gaussians of skin that no frame shows, else 0; the page asks how they face."""
    model = avatar.model
    zeros = torch.zeros(len(model.rigs[side])).to(model.log_gains)
    return zeros if model.visibility is None else model.visibility.behind(side, zeros)


def _disc(avatar: WildGHandAvatar, side: str) -> list[float]:
    """(14,) attributes of a Gaussian that no frame shows."""
    rig, none = avatar.model.rigs[side], {side: torch.zeros(1)}
    blank = RawAttributes.split(torch.zeros(1, CHANNELS))
    bias = avatar.model.network.activation.log_scale_bias
    return Visibility(none, none).settle(side, blank, rig.spacing, bias).concatenate()[0].tolist()


@dataclass(frozen=True, eq=False)
class _WallRows:
    """The M discs of a wrist's cap as anchors on triangles of its middle and two of its border."""

    #: (M, 3) numbers of vertices: the middle follows those of the hand, and then the border.
    corners: np.ndarray
    #: (M, 3).
    mix: np.ndarray
    #: (M, 14) attributes before their activation.
    base: np.ndarray
    #: (M, 3) m in the frame of the triangle, whose normal points into the hand.
    shifts: np.ndarray


def _wall_rows(wall: WristWall, vertices: int, log_scale_bias: float) -> _WallRows:
    shares = wall.shares.double().cpu().numpy()
    least = shares.min(axis=1, keepdims=True)
    pair = np.argsort(shares, axis=1)[:, -2:]
    rest = np.take_along_axis(shares - least, pair, axis=1)
    corners = np.concatenate([np.full((len(wall), 1), vertices), vertices + 1 + pair], axis=1)
    size = [math.log(SPACING * each) - log_scale_bias for each in (WIDE, WIDE, THIN)]
    opacity = math.log(OPAQUE / (1.0 - OPAQUE))
    row = [0.0, 0.0, 0.0, *size, 1.0, 0.0, 0.0, 0.0, opacity, 0.0, 0.0, 0.0]
    return _WallRows(
        corners,
        np.concatenate([least * shares.shape[1], rest], axis=1),
        np.tile(row, (len(wall), 1)),
        np.tile([0.0, 0.0, DEPTH], (len(wall), 1)),
    )


def pack_correctives(basis: Tensor | None) -> dict[str, Any] | None:
    """Principal components of (V, 3, 135) pose correctives; a page needs no more of them."""
    if basis is None:
        return None
    flat = basis.flatten(0, 1).double().cpu().numpy()
    left, sizes, right = np.linalg.svd(flat, full_matrices=False)
    count = min(_CORRECTIVES, max(8, _MOST_CORRECTIVES // len(flat)))
    left, sizes, right = left[:, :count].T, sizes[:count, None], right[:count]
    peaks = np.abs(left).max(axis=1, keepdims=True)
    return {
        "basis": pack(np.rint(left / peaks * 127.0).astype(np.int8)),
        "map": _real(peaks / 127.0 * sizes * right),
    }


@dataclass(frozen=True, eq=False)
class PoseBasis:
    """N vectors of C numbers that depend on a pose: mean + sum over k of c_k basis_k."""

    #: (N, C).
    mean: np.ndarray
    #: (K, N, C) int8.
    basis: np.ndarray
    #: (K, C) by which the basis is multiplied.
    steps: np.ndarray
    #: (145, K): rotations of 16 joints, row by row, and a constant, to coefficients.
    regression: np.ndarray
    #: (2, K) least and largest coefficient of any sample; others are cut to these.
    bounds: np.ndarray

    def content(self) -> dict[str, Any]:
        """As the page reads it."""
        return {
            "mean": _real(self.mean),
            "basis": pack(self.basis),
            "steps": self.steps.tolist(),
            "regression": _linear(self.regression[:-1], self.regression[-1]),
            "bounds": self.bounds.tolist(),
        }


def pose_basis(values: np.ndarray, poses: np.ndarray, rank: int) -> PoseBasis:
    """Principal components of (P, N, C) values in P poses, and their regression on these."""
    mean = values.mean(axis=0, dtype=np.float64)
    flat = (values - mean).reshape(len(values), -1)
    # The Gram matrix is small: there are fewer poses than Gaussians.
    power, vectors = np.linalg.eigh(flat @ flat.T)
    order = np.argsort(power)[::-1][: min(rank, len(values) - 1)]
    order = order[power[order] > 1e-9 * max(float(power.max()), 1e-30)]
    roots = np.sqrt(power[order])
    components = (flat.T @ (vectors[:, order] / roots)).T.reshape(len(order), *mean.shape)
    coefficients = vectors[:, order] * roots
    peaks = np.abs(components).max(axis=1, initial=1e-30)
    whole = np.rint(components / peaks[:, None] * 127.0).astype(np.int8)
    bounds = np.stack([coefficients.min(axis=0), coefficients.max(axis=0)])
    return PoseBasis(mean, whole, peaks / 127.0, _ridge(pose_features(poses), coefficients), bounds)


def pose_features(poses: np.ndarray) -> np.ndarray:
    """(P, 145) rotations of the joints of (P, 16, 3) rad, row by row, and a one."""
    vectors = torch.as_tensor(np.array(poses, dtype=np.float64)).reshape(-1, 3)
    turns = axis_angle_to_matrix(vectors).numpy().reshape(len(poses), -1)
    return np.concatenate([turns, np.ones((len(poses), 1))], axis=1)


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


@torch.no_grad()
def biases_content(
    avatar: WildGHandAvatar, side: str, frames: Sequence[int]
) -> dict[str, Any] | None:
    """What DPD adds to the attributes g in F frames: omega (A g + shift + field), and the gain.

    None where the avatar has no biases. The field is linear in how far each bone moves a place and
    in the harmonics of its normal (`wildghand.dpd.BiasField`).
    """
    model = avatar.model
    if side not in model.perturbation or not frames:
        return None
    known = {frame: row for row, frame in enumerate(avatar.record.frames)}
    rows = torch.tensor([known[frame] for frame in frames], device=model.log_gains.device)
    module = model.biases_of(side)
    temporal = module.temporal(rows)
    mixing, shifts = module.layer(temporal.z)
    content: dict[str, Any] = {
        "mixing": _real(_wider(mixing.T, 16)),
        "shifts": _real(_wider(shifts, 16)),
        "omega": temporal.omega.tolist(),
        "gains": model.log_gains[rows].exp().tolist(),
        "codes": [[] for _ in frames],
        "maps": "",
    }
    if module.field is not None:
        content["codes"] = module.field.codes(temporal.z).tolist()
        content["maps"] = _real(nn.functional.pad(module.field.maps, (0, 2)))
    return content
