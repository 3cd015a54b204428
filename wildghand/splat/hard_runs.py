"""Draw a hard scene and say how far the result is from what must hold."""

from __future__ import annotations

import math

import torch

from hwp_bench.stability import Context, Measured
from wildghand.splat.hard_scenes import (
    DIFFERENTIABLE,
    PER_GAUSSIAN,
    DrawnScene,
    HardScene,
    clear_pixels,
    difference,
    draw,
    gradient_differences,
    hand_scene,
)

#: Largest relative L2 distance from the float64 reference: image, gradients, and gradients of
#: needles.
IMAGE_TOLERANCE = 1e-5
GRADIENT_TOLERANCE = 1e-4
NEEDLE_TOLERANCE = 1e-3
#: Gradients of gsplat in piles and at tiny focal lengths: it adds up in float32, in any order.
GSPLAT_TOLERANCE = 1e-3
#: Largest change of an image or gradient when a culled Gaussian is taken away.
NO_CHANGE = 1e-6
#: The Gaussian that is spoilt.
VICTIM = 7


def _draw(scene: HardScene, context: Context, weights: torch.Tensor | None = None) -> DrawnScene:
    dtype = torch.float64 if context.backend == "reference" else torch.float32
    return draw(scene, context.backend, dtype, weights)


def run_exact(scene: HardScene, own: float, gsplat: float, context: Context) -> Measured:
    """As float64 draws it; gradients within `own`, those of gsplat within `gsplat`."""
    tolerance = gsplat if context.backend == "gsplat" else own
    clear = clear_pixels(scene)
    truth = draw(scene, "reference", torch.float64, clear)
    drawing = _draw(scene, context, clear)
    mask = clear.unsqueeze(-1)
    image = max(
        difference(drawing.image * mask, truth.image * mask),
        difference(drawing.alpha * mask, truth.alpha * mask),
    )
    gradients = gradient_differences(drawing.gradients, truth)
    worst = max(gradients, key=lambda name: gradients[name])
    near = image <= IMAGE_TOLERANCE and gradients[worst] <= tolerance
    passed = drawing.finite and (near or math.isinf(tolerance))
    return Measured(passed, f"image {image:.0e}, gradients {gradients[worst]:.0e} ({worst})")


def run_no_effect(scene: HardScene, context: Context) -> Measured:
    """The spoilt Gaussian changes nothing and gets no gradient."""
    drawing = _draw(scene, context)
    without = _draw(scene.without(VICTIM), context)
    keep = torch.arange(len(scene.arguments["means"])) != VICTIM
    own = max(float(drawing.gradients[name][VICTIM].abs().max()) for name in PER_GAUSSIAN)
    others = {
        name: value[keep] if name in PER_GAUSSIAN else value
        for name, value in drawing.gradients.items()
    }
    change = max(
        difference(drawing.image, without.image),
        difference(drawing.alpha, without.alpha),
        *gradient_differences(others, without).values(),
    )
    passed = drawing.finite and own == 0.0 and change <= NO_CHANGE
    finite = "" if drawing.finite else "not finite, "
    return Measured(passed, f"{finite}its gradient {own:g}, change elsewhere {change:.0e}")


def run_bad_view(scene: HardScene, context: Context) -> Measured:
    """The second camera is bad and shows the background; the first one sees as ever."""
    drawing = _draw(scene, context)
    good = {
        name: scene.arguments[name][:1] if name in ("viewmats", "Ks", "backgrounds") else tensor
        for name, tensor in scene.arguments.items()
    }
    single = _draw(HardScene(good), context)
    change = difference(drawing.image[:1], single.image)
    bad = drawing.image[1]
    if scene.arguments["backgrounds"].isfinite().all():
        shown = difference(bad, scene.arguments["backgrounds"][1].float().double().expand_as(bad))
    else:
        shown = float(drawing.gradients["backgrounds"][1, 0].abs())  # black: no gradient there
    passed = drawing.finite and change <= NO_CHANGE and shown <= NO_CHANGE
    finite = "" if drawing.finite else "not finite, "
    return Measured(passed, f"{finite}off by {shown:.0e}, change of the other {change:.0e}")


def run_narrow(dtype: torch.dtype, context: Context) -> Measured:
    """Arguments of a narrow type are drawn as the same numbers in float64."""
    scene = hand_scene()
    narrow = {name: value.to(dtype) for name, value in scene.arguments.items()}
    # The same numbers, so that what the type cannot hold does not count.
    same = scene.changed(**{name: value.double() for name, value in narrow.items()})
    clear = clear_pixels(same)
    truth = draw(same, "reference", torch.float64, clear)
    drawing = draw(same, context.backend, dtype, clear)
    mask = clear.unsqueeze(-1)
    off = difference(drawing.image * mask, truth.image * mask)
    # Half an ulp of the type is added when a gradient is given back in it.
    allowed = GRADIENT_TOLERANCE + torch.finfo(dtype).eps
    gradients = gradient_differences(drawing.gradients, truth)
    worst = max(gradients, key=lambda name: gradients[name])
    passed = drawing.finite and off <= IMAGE_TOLERANCE and gradients[worst] <= allowed
    return Measured(passed, f"image {off:.0e}, gradients {gradients[worst]:.0e} ({worst})")


def run_strided(context: Context) -> Measured:
    """Arguments that are not contiguous are drawn as contiguous ones."""
    scene = hand_scene(cameras=2)
    strided = {
        name: value.movedim(-1, 0).contiguous().movedim(0, -1)
        if value.ndim > 1
        else torch.stack([value, value], dim=-1)[:, 0]
        for name, value in scene.arguments.items()
    }
    plain, other = _draw(scene, context), _draw(scene.changed(**strided), context)
    away = max(gradient_differences(other.gradients, plain).values())
    # Its gradients are sums of atomic additions, which are not the same twice.
    allowed = NO_CHANGE if context.backend == "gsplat" else 0.0
    same = torch.equal(plain.image, other.image) and away <= allowed
    image = difference(other.image, plain.image)
    return Measured(same, f"image off by {image:.0e}, gradients by {away:.0e}")


def run_doubled(context: Context) -> Measured:
    """Two equal Gaussians cover what the formula of blending says."""
    scene = hand_scene(count=1)
    single = scene.changed(
        means=torch.zeros(1, 3).double(),
        scales=torch.full((1, 3), 0.02).float().double(),
        opacities=torch.tensor([0.9]).double(),
        backgrounds=torch.zeros(1, 3).double(),
    )
    pair = {name: single.arguments[name].repeat_interleave(2, dim=0) for name in PER_GAUSSIAN}
    one, two = _draw(single, context), _draw(single.changed(**pair), context)
    expected = 1.0 - (1.0 - one.alpha).square()
    colors = single.arguments["colors"][0]
    off = max(
        difference(two.alpha, expected),
        difference(two.image, expected * colors),
    )
    passed = two.finite and off <= IMAGE_TOLERANCE and float(one.alpha.max()) > 0.8
    return Measured(passed, f"off by {off:.0e}, alpha of one up to {float(one.alpha.max()):.2f}")


def run_reordered(context: Context) -> Measured:
    """Two equal hands are drawn alike in either order."""
    scene = hand_scene()
    count = len(scene.arguments["means"])
    # Hand after hand, and pair after pair.
    apart, paired = torch.arange(count).repeat(2), torch.arange(count).repeat_interleave(2)
    made = [
        _draw(
            scene.changed(**{name: scene.arguments[name][order] for name in PER_GAUSSIAN}), context
        )
        for order in (apart, paired)
    ]
    off = difference(made[0].image, made[1].image)
    for name in PER_GAUSSIAN:
        # The nearer of two equal Gaussians is the one of lower index, in both orders.
        first = made[0].gradients[name].unflatten(0, (2, count))
        second = made[1].gradients[name].unflatten(0, (count, 2)).transpose(0, 1)
        off = max(off, difference(first, second))
    passed = made[0].finite and made[1].finite and off <= GRADIENT_TOLERANCE
    return Measured(passed, f"off by {off:.0e}")


def run_finite(scene: HardScene, context: Context) -> Measured:
    """All numbers are finite."""
    drawing = _draw(scene, context)
    sizes = [float(drawing.gradients[name].abs().max()) for name in DIFFERENTIABLE
             if drawing.gradients[name].numel()]  # fmt: skip
    return Measured(drawing.finite, f"largest gradient {max(sizes):.0e}")
