"""Hard cases of posing and projection, for `hwp-bench dev stability` and for the tests.

Each compares with what must be the same by symmetry or arithmetic: the pose without its whole
turns, float64, another memory layout, one frame at a time, the mirrored hand.
"""

from __future__ import annotations

import functools
import math
from dataclasses import replace

import torch
from torch import Tensor

from hwp_bench.base.errors import BadInput
from hwp_bench.hands.articulation import axis_angle_to_matrix
from hwp_bench.hands.skinning import PosedHand, pose_hand, project
from hwp_bench.hands.sources import load_template
from hwp_bench.hands.template import TemplateTensors
from hwp_bench.stability import CaseGroup, Measured, largest

#: Largest distance of a vertex from its oracle, m, in float64 and in float32.
EXACT, ROUNDED = 1e-12, 2e-6
#: Largest relative L2 distance of a float32 gradient from that of float64.
GRADIENT_TOLERANCE = 1e-4
#: Narrow types, and what a result may be off as a share: 8 times half an ulp at 1.
_NARROW = (("float16", 8 * 2.0**-11), ("bfloat16", 8 * 2.0**-8))
_ROTATIONS = "vertices and gradients finite, every joint's motion a rotation"

_Arguments = tuple[Tensor, Tensor, Tensor]

#: Every hard case of the hand model.
cases = CaseGroup("hands")


@cases.case(
    "joints turned by {} x 360 degrees more",
    f"vertices to {EXACT:g} m of those without the turns",
    1,
    2,
    100,
)
def _run_turns(turns: int) -> Measured:
    template, (pose, betas, transl) = _template(), _arguments()
    angles = pose.norm(dim=-1, keepdim=True)
    turned = pose * ((angles + 2.0 * math.pi * turns) / angles)
    off = _distance(
        pose_hand(template, turned, betas, transl), pose_hand(template, pose, betas, transl)
    )
    return Measured(off <= EXACT, f"off by {off:.0e} m")


@cases.case("a wrist turned by exactly 360 degrees", "the mesh of pose 0")
def _run_whole_turn() -> Measured:
    template, (pose, betas, transl) = _template(), _arguments()
    none = torch.zeros_like(pose)
    whole = none.clone()
    whole[:, 0] = 2.0 * math.pi * torch.nn.functional.normalize(pose[:, 0], dim=-1)
    off = _distance(
        pose_hand(template, whole, betas, transl), pose_hand(template, none, betas, transl)
    )
    return Measured(off <= EXACT, f"off by {off:.0e} m")


@cases.case(
    "pose of {:g} rad", _ROTATIONS, *((size, "float32") for size in (1e6, 1e19, 1e25, 3e38))
)
@cases.case(
    "pose of {:g} rad in float64", _ROTATIONS, *((size, "float64") for size in (1e154, 1e300))
)
def _run_huge_pose(size: float, name: str) -> Measured:
    dtype = getattr(torch, name)
    pose, betas, transl = (value.to(dtype) for value in _arguments())
    # Largest entry `size`, so that it can be the type's largest number.
    pose = (pose / pose.abs().amax(dim=-1, keepdim=True) * size).requires_grad_()
    posed = pose_hand(_template(dtype), pose, betas, transl)
    (gradient,) = torch.autograd.grad(posed.vertices.square().sum(), pose)
    turns = axis_angle_to_matrix(pose.detach())
    error = float((turns @ turns.mT - torch.eye(3, dtype=dtype)).abs().amax())
    error = largest([error, float((torch.linalg.det(turns) - 1.0).abs().amax())])
    finite = bool(posed.vertices.isfinite().all() and gradient.isfinite().all())
    passed = finite and error <= 16.0 * torch.finfo(dtype).eps
    return Measured(passed, f"{'' if finite else 'not finite, '}R R^T off by {error:.0e}")


@cases.case(
    "every beta at {:+g}",
    f"to {ROUNDED:g} m, gradients to {GRADIENT_TOLERANCE:g} of float64",
    20.0,
    -20.0,
)
def _run_against_float64(beta: float) -> Measured:
    made = []
    for dtype in (torch.float32, torch.float64):
        pose, betas, transl = (value.float().to(dtype) for value in _arguments())
        leaves = [pose, torch.full_like(betas, beta), transl]
        for leaf in leaves:
            leaf.requires_grad_()
        posed = pose_hand(_template(dtype), *leaves)
        weights = torch.sin(torch.arange(posed.vertices.numel(), dtype=torch.float64)).to(dtype)
        loss = (posed.vertices.flatten() * weights).sum()
        made.append((posed, torch.autograd.grad(loss, leaves)))
    off = _distance(made[0][0], made[1][0])
    gradient = largest(
        float((ours.double() - truth).norm() / truth.norm())
        for ours, truth in zip(made[0][1], made[1][1], strict=True)
    )
    passed = off <= ROUNDED and gradient <= GRADIENT_TOLERANCE
    return Measured(passed, f"off by {off:.0e} m, gradients {gradient:.0e}")


@cases.case("one beta at {:+g}", "vertices at rest move {:g} times those with 1", 20.0, -20.0)
def _run_linear(beta: float) -> Measured:
    template = _template()
    pose, transl = torch.zeros(1, 16, 3).double(), torch.zeros(1, 3).double()
    worst = 0.0
    for one in torch.eye(10, dtype=torch.float64):
        rest, small, large = (
            pose_hand(template, pose, share * one, transl).vertices for share in (0.0, 1.0, beta)
        )
        off = (large - rest - beta * (small - rest)).abs()
        worst = largest([worst, float(off.max())])
    return Measured(worst <= EXACT, f"off by {worst:.0e} m")


@cases.case("transposed, strided and expanded arguments", "the same bits")
def _run_strided() -> Measured:
    template, (pose, betas, transl) = _template(), _arguments()
    plain = pose_hand(template, pose, betas.expand(len(pose), -1).contiguous(), transl)
    strided = pose_hand(
        template,
        pose.permute(2, 1, 0).contiguous().permute(2, 1, 0),
        betas.expand(len(pose), -1),
        torch.stack([transl, transl], dim=-1)[..., 1],
    )
    same = torch.equal(plain.vertices, strided.vertices)
    return Measured(same, f"off by {_distance(plain, strided):g} m")


@cases.case("no frame", "empty arrays of the right shapes, gradients 0")
def _run_no_frame() -> Measured:
    pose, betas, transl = (value.clone() for value in _arguments())
    leaves = [pose[:0].requires_grad_(), betas.requires_grad_(), transl[:0].requires_grad_()]
    posed = pose_hand(_template(), *leaves)
    gradients = torch.autograd.grad(posed.vertices.sum(), leaves)
    shapes = (tuple(posed.landmarks.shape), tuple(posed.transforms.shape))
    passed = shapes == ((0, 21, 3), (0, 16, 4, 4)) and not gradients[1].any()
    return Measured(passed, f"landmarks {shapes[0]}, motions {shapes[1]}")


@cases.case("one frame of many", f"to {EXACT:g} m of the frame in a batch")
def _run_single() -> Measured:
    template, (pose, betas, transl) = _template(), _arguments()
    many = pose_hand(template, pose, betas, transl).vertices
    one = torch.cat([
        pose_hand(template, pose[f : f + 1], betas, transl[f : f + 1]).vertices
        for f in range(len(pose))
    ])  # fmt: skip
    off = float((many - one).abs().max())
    return Measured(off <= EXACT, f"off by {off:.0e} m")


@cases.case("a template in {}", "to {1:g} of the extent of float64's result", *_NARROW)
def _run_narrow(name: str, share: float) -> Measured:
    dtype = getattr(torch, name)
    given = tuple(value.to(dtype) for value in _arguments())
    posed = pose_hand(_template(dtype), *given)
    # The same numbers, so that what the type cannot hold does not count.
    pose, betas, transl = (value.double() for value in given)
    narrow = _template(dtype)
    tensors = {name: value for name, value in vars(narrow).items() if torch.is_tensor(value)}
    wide = {name: value.double() for name, value in tensors.items() if value.is_floating_point()}
    truth = pose_hand(replace(narrow, **wide), pose, betas, transl)
    off = _distance(posed, truth) / float(truth.vertices.abs().max())
    passed = posed.vertices.dtype == dtype and off <= share
    return Measured(passed, f"off by {off:.0e} of the extent")


@cases.case(
    "{} arguments on a float32 template",
    "one message that names the argument, both types and the remedy",
    *(name for name, _ in _NARROW),
)
def _run_mixed(name: str) -> Measured:
    dtype = getattr(torch, name)
    pose, betas, transl = (value.float() for value in _arguments())
    try:
        pose_hand(_template(torch.float32), pose.to(dtype), betas, transl)
    except BadInput as error:
        said = str(error)
        return Measured(all(x in said for x in ("pose", str(dtype), "float32", "to_torch")), said)
    return Measured(False, "no message")


@cases.case(
    "a hand behind the camera",
    "depths negative; the pixels of the hand reflected through the camera's centre",
)
def _run_behind() -> Measured:
    pose, betas, transl = _arguments()
    transl = transl + torch.tensor([0.05, -0.02, 0.6])
    vertices = pose_hand(_template(), pose, betas, transl).vertices
    viewmats, Ks = _looking(len(pose))
    front, depth = project(vertices, viewmats, Ks)
    back, behind = project(-vertices, viewmats, Ks)
    off = float((front - back).abs().max())
    passed = bool((depth > 0.0).all() and (behind < 0.0).all()) and off <= 1e-9
    return Measured(passed, f"off by {off:.0e} px, depth {float(behind.max()):.2g} m")


@cases.case("a hand around the camera's centre", "pixels and gradients finite")
def _run_around() -> Measured:
    pose, betas, transl = _arguments()
    vertices = pose_hand(_template(), pose, betas, transl).vertices
    # One vertex exactly in the camera's plane, others on both sides of it.
    centred = (vertices - vertices[:, :1]).float().requires_grad_()
    viewmats, Ks = _looking(len(pose))
    pixels, depth = project(centred, viewmats.float(), Ks.float())
    (gradient,) = torch.autograd.grad(pixels.sum(), centred)
    both = bool((depth > 0.0).any() and (depth < 0.0).any() and (depth == 0.0).any())
    passed = both and bool(pixels.isfinite().all() and gradient.isfinite().all())
    return Measured(passed, f"largest pixel {float(pixels.detach().abs().max()):.0e}")


@cases.case("left and right hand in one place", f"each other's mirror image to {EXACT:g} m")
def _run_pair() -> Measured:
    pose, betas, transl = _arguments()
    flip = torch.tensor([-1.0, 1.0, 1.0], dtype=torch.float64)
    right = pose_hand(_template(), pose, betas, transl)
    left = pose_hand(_template(side="left"), pose * -flip, betas, transl * flip)
    mirrored = float((left.vertices * flip - right.vertices).abs().max())
    return Measured(mirrored <= EXACT, f"off by {mirrored:.0e} m")


@functools.lru_cache(maxsize=8)
def _template(dtype: torch.dtype = torch.float64, side: str = "right") -> TemplateTensors:
    return load_template(side=side).to_torch(dtype)


def _arguments(frames: int = 3) -> _Arguments:
    """Pose (F, 16, 3), betas (10,) and transl (F, 3), float64, no joint at angle 0."""
    generator = torch.Generator().manual_seed(0)

    def noise(*shape: int) -> Tensor:
        return torch.randn(shape, generator=generator, dtype=torch.float64)

    return 0.4 * noise(frames, 16, 3), noise(10), 0.05 * noise(frames, 3)


def _looking(frames: int) -> tuple[Tensor, Tensor]:
    """Cameras at the origin that look along z."""
    K = torch.tensor([[60.0, 0.0, 20.0], [0.0, 60.0, 15.0], [0.0, 0.0, 1.0]], dtype=torch.float64)
    viewmats = torch.eye(4, dtype=torch.float64).expand(frames, -1, -1)
    return viewmats, K.expand(frames, -1, -1)


def _distance(posed: PosedHand, truth: PosedHand) -> float:
    """Largest distance in any coordinate of any vertex or landmark, m."""
    return largest(
        float((ours.double() - theirs.double()).detach().abs().max())
        for ours, theirs in (
            (posed.vertices, truth.vertices),
            (posed.landmarks, truth.landmarks),
        )
    )
