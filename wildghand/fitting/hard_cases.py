"""Hard cases of DPD, PAO, the robust weights and the terms, for `hwp-bench dev stability`.

Each is the smallest scene that has the difficulty; all numbers must stay finite, weights must not
be negative, and what the case is about must come out as its line says.
"""

from __future__ import annotations

import functools
import math
from collections.abc import Callable, Iterator

import numpy as np
import torch
from torch import Tensor

from hwp_bench.stability import Case, Context, Measured, largest
from wildghand.dpd.dpd import DynamicPerturbation, FramePerturbation, draw_kept
from wildghand.dpd.temporal import TemporalTarget
from wildghand.gaussians.attributes import CHANNELS, RawAttributes
from wildghand.gaussians.perceptual import FilterBankLoss
from wildghand.model import terms
from wildghand.pao.pao import CONSTANTS, PerturbationAwareWeights, Weights
from wildghand.pao.regions import FrameRegions, overlapping, partition, stack_regions

#: Largest relative L2 distance of a float32 gradient from that of float64.
GRADIENT_TOLERANCE = 1e-4

_SIZE = 16
_GAUSSIANS = 24
_Entry = tuple[str, str, Callable[[Context], Measured]]


def cases() -> list[Case]:
    """Every hard case of the method's parts outside the rasterizer."""
    return [
        Case(name, "method", must_hold, run)
        for entries in (_perturbation, _weights, _frames, _gradients)
        for name, must_hold, run in entries()
    ]


def _perturbation() -> Iterator[_Entry]:
    yield "DPD at its start", "every bias is 0; psi has a gradient", _run_start
    for sign in (1.0, -1.0):
        yield (
            f"DPD with omega at {sign:+g}",
            "omega does not leave [-1, 1]; biases and gradients finite",
            functools.partial(_run_saturated, sign),
        )
    yield "DPD of one frame (L = 1)", "biases and gradients finite", _run_one_frame
    yield "DPD with every omega dropped", "every bias and every gradient is 0", _run_dropped
    for name, clean in (
        ("one perturbed frame (L = 1)", [0.0]),
        ("no clean frame", [0.0, 0.0, 0.0]),
        ("clean frames alone", [1.0, 1.0, 1.0]),
    ):
        yield (
            f"DPD begun at the judgement of {name}",
            "every bias is 0; omega within a fifth of its scale from its target; gradients finite",
            functools.partial(_run_begun, clean),
        )


def _weights() -> Iterator[_Entry]:
    beta = CONSTANTS["printed"].beta
    for name, omega in (
        ("1", 1.0),
        ("-1", -1.0),
        ("-1 / beta", -1.0 / beta),
        ("-2 / beta", -2.0 / beta),
    ):
        yield (
            f"PAO with omega at {name}",
            "weights of regions shrink by 1 / (1 + beta |omega|), in (0, 1]",
            functools.partial(_run_omega, omega),
        )
    whole = np.zeros((_SIZE, _SIZE), int)
    ones = np.ones((1, _SIZE, _SIZE), bool)
    regions: dict[str, FrameRegions] = {
        "the whole image as one region": partition(whole),
        "a region without pixels": overlapping(~ones),
        "no region at all": overlapping(ones[:0]),
        "every pixel a region": partition(np.arange(_SIZE**2).reshape(_SIZE, _SIZE)),
    }
    for name, frame in regions.items():
        for hand in (_hand(), torch.zeros_like(_hand()), torch.ones_like(_hand())):
            share = f"hand on {float(hand.float().mean()):.0%}"
            yield (
                f"PAO with {name}, {share}",
                "weights finite and not negative",
                functools.partial(_run_regions, frame, hand),
            )
    yield "released PAO on equal residuals everywhere", "E is 0, not 0 / 0", _run_constant
    yield "PAO with every weight 0", "loss 0, gradients finite and 0", _run_no_weight


def _frames() -> Iterator[_Entry]:
    black = torch.zeros(1, _SIZE, _SIZE, 3)
    spoiled = _noise(1, _SIZE, _SIZE, 3)
    spoiled[0, 5, 6, 1] = math.nan
    frames = {
        "a black frame": black,
        "a saturated frame": black + 1.0,
        "a frame of NaN": black + math.nan,
        "a frame of infinities": black + math.inf,
        "a frame with one NaN": spoiled,
    }
    for name, frame in frames.items():
        for mask, hand in (("", _hand()), (" and a mask of no pixel", torch.zeros_like(_hand()))):
            yield (
                f"one step on {name}{mask}",
                "weights and gradients finite; pixels that are not finite count 0",
                functools.partial(_run_frame, frame, hand),
            )


def _gradients() -> Iterator[_Entry]:
    target = _noise(2, _SIZE, _SIZE, 3, seed=1).double()
    weights = _noise(2, _SIZE, _SIZE, seed=2).double()
    hand = target[..., 0] > 0.5
    image, features = _noise(2, _SIZE, _SIZE, 3).double(), _noise(9, 4).double()
    bank = FilterBankLoss()
    functions: dict[str, tuple[Callable[[Tensor], Tensor], Tensor]] = {
        "reconstruction": (
            lambda x: terms.reconstruction(x, target.to(x), weights.to(x)),
            image,
        ),
        "reconstruction with D-SSIM": (
            lambda x: terms.reconstruction(x, target.to(x), weights.to(x), 0.2),
            image,
        ),
        "perceptual distance": (lambda x: bank(x, target.to(x), weights.to(x)), image),
        "bias": (
            lambda x: terms.bias_size(RawAttributes.split(x)),
            _noise(2, _GAUSSIANS, CHANNELS).double() - 0.5,
        ),
        "shadow and opacity": (terms.distance_to_one, features),
        "silhouette": (lambda x: terms.silhouette(x, hand), image[..., 0]),
        "reward of weights": (terms.weight_reward, weights),
        "cross-hand texture": (lambda x: terms.cross_hand(x, x.detach().flip(0)), features),
        "PAO's thresholds": (_loss_of_thresholds, torch.tensor([0.9, 0.2, 1.5]).double()),
        "DPD": (_loss_of_perturbation, _noise(2, _GAUSSIANS, CHANNELS).double()),
    }
    for name, (function, value) in functions.items():
        yield (
            f"gradient of {name} in float32",
            f"to {GRADIENT_TOLERANCE:g} of float64",
            functools.partial(_run_gradient, function, value),
        )


def _run_start(context: Context) -> Measured:
    module = _module(3)
    biases = _biases(module, 3)
    biases.sum().backward()
    gradient = _gradient(module.psi.weight)
    return Measured(
        bool((biases == 0.0).all()) and gradient > 0.0, f"gradient of psi {gradient:.0e}"
    )


def _run_saturated(sign: float, context: Context) -> Measured:
    module = _module(2)
    with torch.no_grad():
        module.psi.bias.fill_(sign * 1e4)
    biases = _biases(module, 2)
    biases.square().sum().backward()
    omega = module.temporal(torch.arange(2)).omega
    finite = _finite(biases, *(p.grad for p in module.parameters()))
    return Measured(finite and bool((omega == sign).all()), f"omega {omega[0].item():g}")


def _run_one_frame(context: Context) -> Measured:
    module = _module(1)
    biases = _biases(module, 1)
    biases.sum().backward()
    return Measured(
        _finite(biases, *(p.grad for p in module.parameters())), f"{biases.numel()} biases"
    )


def _run_begun(clean: list[float], context: Context) -> Measured:
    module, scale, floor = _module(len(clean)), 0.5, 0.02
    weights = floor + (1.0 - floor) * torch.tensor(clean)
    target = TemporalTarget.judged(weights, scale, floor)
    target.begin([module])
    biases = _biases(module, len(clean))
    (biases.square().sum() + target.temporal_loss([module], 0)).backward()
    omega = module.temporal(torch.arange(len(clean))).omega.detach()
    off = float((omega - target.omega).abs().max())
    finite = _finite(*(p.grad for p in module.parameters()))
    sound = finite and bool((biases == 0.0).all()) and off <= 0.2 * scale
    return Measured(sound, f"omega off by {off:.0e}")


def _run_dropped(context: Context) -> Measured:
    module = _module(2)
    torch.nn.init.ones_(module.psi.weight)
    kept = draw_kept(torch.ones(2), torch.Generator().manual_seed(0))
    frames = FramePerturbation(module, module.temporal(torch.arange(2)), kept)
    biases = frames.biases(_attributes(2)).concatenate()
    biases.sum().backward()
    size = largest(_gradient(p) for p in module.parameters())
    return Measured(bool((biases == 0.0).all()) and size == 0.0, f"largest {size:g}")


def _run_omega(omega: float, context: Context) -> Measured:
    error = torch.full((1, _SIZE, _SIZE), 0.1)
    made, calm = (_weigh(error, _halves(), _hand(), value) for value in (omega, 0.0))
    factor = float((made.lambdas.sum() / calm.lambdas.sum()).detach())
    expected = 1.0 / (1.0 + CONSTANTS["printed"].beta * abs(omega))
    sound = _finite(made.weights) and bool((made.weights >= 0.0).all())
    return Measured(sound and math.isclose(factor, expected, rel_tol=1e-5), f"factor {factor:.3g}")


def _run_regions(regions: FrameRegions, hand: Tensor, context: Context) -> Measured:
    made = _weigh(_noise(1, _SIZE, _SIZE), regions, hand, 0.0)
    sound = _finite(made.weights) and bool((made.weights >= 0.0).all())
    return Measured(sound, f"largest weight {float(made.weights.detach().max()):.3g}")


def _run_constant(context: Context) -> Measured:
    residual = torch.full((1, _SIZE, _SIZE, 3), 0.4, requires_grad=True)
    module, regions = PerturbationAwareWeights("released"), stack_regions([_halves()])
    made = module.released(residual, regions, _hand(), _hand(), residual[..., 0].detach())
    made.weights.sum().backward()
    passed = _finite(made.weights, residual.grad) and bool((made.errors == 0.0).all())
    return Measured(passed, f"largest E {float(made.errors.detach().max()):g}")


def _run_no_weight(context: Context) -> Measured:
    module = PerturbationAwareWeights("printed", share_of="hand")
    module.T_E.data.zero_()
    module.T_b.data.zero_()
    image = _noise(1, _SIZE, _SIZE, 3).requires_grad_(True)
    error = image.detach().mean(dim=-1)
    made = module(error, stack_regions([_halves()]), _hand(), torch.zeros(1))
    loss = terms.reconstruction(image, torch.zeros_like(image), made.weights, 0.2)
    loss = loss + FilterBankLoss()(image, torch.zeros_like(image), made.weights)
    loss.backward()
    passed = float(loss.detach()) == 0.0 and _gradient(image) == 0.0
    return Measured(
        passed and _finite(*(p.grad for p in module.parameters())), f"loss {loss.item():g}"
    )


def _run_frame(frame: Tensor, hand: Tensor, context: Context) -> Measured:
    leaf = _noise(1, _SIZE, _SIZE, 3, seed=4).requires_grad_(True)
    regions = stack_regions([_halves()])
    error = (leaf.detach() - frame).abs().mean(dim=-1)
    modules = [PerturbationAwareWeights(), PerturbationAwareWeights("printed", share_of="hand")]
    made = [module(error, regions, hand, torch.zeros(1)) for module in modules]
    weights = torch.cat([found.weights for found in made])
    image, frame = leaf.expand(2, -1, -1, -1), frame.expand(2, -1, -1, -1)
    loss = terms.reconstruction(image, frame, weights, 0.2)
    loss = loss - weights.mean() + FilterBankLoss()(image, frame, weights)
    loss.backward()
    bad = ~frame.isfinite().all(dim=-1)
    learnt = [value.grad for module in modules for value in module.parameters()]
    passed = (
        _finite(loss, weights, leaf.grad, *(grad for grad in learnt if grad is not None))
        and bool((weights >= 0.0).all())
        and not bool(weights[bad].any())
    )
    return Measured(passed, f"loss {loss.item():.3g}, gradient {_gradient(leaf):.0e}")


def _run_gradient(
    function: Callable[[Tensor], Tensor], value: Tensor, context: Context
) -> Measured:
    # What float32 cannot hold is not a fault of the term.
    value = value.detach().float()
    made = []
    for dtype in (torch.float32, torch.float64):
        leaf = value.to(dtype, copy=True).requires_grad_(True)
        made.append(torch.autograd.grad(function(leaf), leaf)[0].double())
    size = float(made[1].norm())
    off = float((made[0] - made[1]).norm()) / size
    return Measured(off <= GRADIENT_TOLERANCE and size > 0.0, f"off by {off:.0e}")


def _loss_of_thresholds(thresholds: Tensor) -> Tensor:
    module = PerturbationAwareWeights("printed", share_of="hand")
    error = 0.6 * _noise(1, _SIZE, _SIZE).to(thresholds)
    named = dict(zip(("T_E", "T_mu", "T_b"), thresholds.unbind(), strict=True))
    arguments = (error, stack_regions([_halves()]), _hand(), torch.zeros(1).to(error))
    made = torch.func.functional_call(module, named, arguments)
    return (made.weights * error).mean()


def _loss_of_perturbation(channels: Tensor) -> Tensor:
    module = _module(2)
    torch.nn.init.constant_(module.psi.weight, 0.1)
    module = module.to(channels.dtype)
    temporal = module.temporal(torch.arange(2))
    made = module.biases(RawAttributes.split(channels), temporal.z, temporal.omega)
    return made.concatenate().square().mean()


def _module(frames: int) -> DynamicPerturbation:
    """Initial weights from a seed, whatever the global generator has given before."""
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(0)
        return DynamicPerturbation(frames, 16)


def _biases(module: DynamicPerturbation, frames: int) -> Tensor:
    temporal = module.temporal(torch.arange(frames))
    return module.biases(_attributes(frames), temporal.z, temporal.omega).concatenate()


def _attributes(frames: int) -> RawAttributes:
    return RawAttributes.split(_noise(frames, _GAUSSIANS, CHANNELS))


def _weigh(error: Tensor, regions: FrameRegions, hand: Tensor, omega: float) -> Weights:
    module = PerturbationAwareWeights("printed", share_of="hand")
    return module(error, stack_regions([regions]), hand, torch.tensor([omega]))


def _halves() -> FrameRegions:
    left = np.arange(_SIZE)[None] < _SIZE // 2
    return partition(np.broadcast_to(left, (_SIZE, _SIZE)).astype(int))


def _hand() -> Tensor:
    hand = torch.zeros(1, _SIZE, _SIZE, dtype=torch.bool)
    hand[:, 4:12, 3:14] = True
    return hand


def _noise(*shape: int, seed: int = 0) -> Tensor:
    return torch.rand(shape, generator=torch.Generator().manual_seed(seed))


def _finite(*tensors: Tensor | None) -> bool:
    """Whether every number is finite; None (a tensor without gradient) counts as finite."""
    return all(bool(tensor.isfinite().all()) for tensor in tensors if tensor is not None)


def _gradient(tensor: Tensor) -> float:
    return 0.0 if tensor.grad is None else float(tensor.grad.abs().max())
