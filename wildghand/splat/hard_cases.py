"""Scenes at the limits of arithmetic, and the result of drawing one."""

from __future__ import annotations

import functools
import math
import warnings
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from typing import Any

import torch

from hwp_bench.stability import Case, Context, Measured
from wildghand.splat.api import rasterize

#: Arguments that have a gradient.
DIFFERENTIABLE = ("means", "quats", "scales", "opacities", "colors", "backgrounds", "viewmats")
#: Arguments with one row for each Gaussian.
PER_GAUSSIAN = DIFFERENTIABLE[:5]
#: A pixel that comes nearer than this to a limit (as a ratio) is not compared: float32 and
#: float64 may decide differently whether a splat that is just visible is drawn.
MARGIN = 1e-5

Arguments = dict[str, torch.Tensor]


@dataclass(frozen=True)
class HardScene:
    """The arguments of one call, float64."""

    arguments: Arguments
    width: int = 40
    height: int = 30
    near_plane: float = 0.01
    eps2d: float = 0.3

    def changed(self, **arguments: torch.Tensor) -> HardScene:
        """The same scene with other tensors."""
        return HardScene(
            {**self.arguments, **arguments}, self.width, self.height, self.near_plane, self.eps2d
        )

    def without(self, index: int) -> HardScene:
        """The same scene without one Gaussian."""
        keep = torch.arange(len(self.arguments["means"])) != index
        return self.changed(**{name: self.arguments[name][keep] for name in PER_GAUSSIAN})


@dataclass(frozen=True)
class DrawnScene:
    """The result of drawing a scene, in float64 on the CPU."""

    image: torch.Tensor  # (C, H, W, D)
    alpha: torch.Tensor  # (C, H, W, 1)
    gradients: Arguments  # of every differentiable argument

    @property
    def finite(self) -> bool:
        """Whether no number is NaN or infinite."""
        tensors = (self.image, self.alpha, *self.gradients.values())
        return all(bool(tensor.isfinite().all()) for tensor in tensors)


def hand_scene(
    count: int = 60,
    width: int = 40,
    height: int = 30,
    cameras: int = 1,
    distance: float = 0.4,
    focal: float = 60.0,
    seed: int = 0,
) -> HardScene:
    """A blob of the size of a hand (0.16 m), looked at by cameras side by side, 1 cm apart."""
    generator = torch.Generator().manual_seed(seed)

    def uniform(*shape: int) -> torch.Tensor:
        return torch.rand(shape, generator=generator, dtype=torch.float64)

    viewmats = torch.eye(4, dtype=torch.float64).repeat(cameras, 1, 1)
    viewmats[:, 0, 3] = 0.01 * torch.arange(cameras)
    viewmats[:, 2, 3] = distance
    K = torch.tensor([[focal, 0.0, width / 2], [0.0, focal, height / 2], [0.0, 0.0, 1.0]])
    arguments = {
        "means": (uniform(count, 3) - 0.5) * 0.16,
        "quats": torch.randn(count, 4, generator=generator, dtype=torch.float64),
        "scales": 0.004 + 0.012 * uniform(count, 3),
        "opacities": 0.2 + 0.75 * uniform(count),
        "colors": uniform(count, 3),
        "viewmats": viewmats,
        "Ks": K.double().repeat(cameras, 1, 1),
        "backgrounds": uniform(cameras, 3),
    }
    # Values that float32 cannot hold must not count against the backend.
    rounded = {name: tensor.float().double() for name, tensor in arguments.items()}
    return HardScene(rounded, width, height)


def draw(
    scene: HardScene, backend: str, dtype: torch.dtype, weights: torch.Tensor | None = None
) -> DrawnScene:
    """Draws a scene and takes the gradients of a fixed random linear loss.

    (C, H, W) `weights` multiply the loss of each pixel.
    """
    device = torch.device("cuda" if backend == "gsplat" else "cpu")
    arguments = {
        name: tensor.detach().to(device, dtype).requires_grad_(name in DIFFERENTIABLE)
        for name, tensor in scene.arguments.items()
    }
    image, alpha, _ = _rasterize(scene, arguments, backend)
    loss = (_noise(image.shape, 1).to(image) * image).sum(-1)
    loss = loss + (_noise(alpha.shape, 2).to(alpha) * alpha).sum(-1)
    if weights is not None:
        loss = loss * weights.to(loss)
    loss.sum().backward()
    zero = torch.zeros(())
    gradients = {
        name: (zero.expand(tensor.shape) if tensor.grad is None else tensor.grad).cpu().double()
        for name, tensor in arguments.items()
        if name in DIFFERENTIABLE
    }
    return DrawnScene(image.detach().cpu().double(), alpha.detach().cpu().double(), gradients)


def clear_pixels(scene: HardScene) -> torch.Tensor:
    """1 for every pixel that may be compared, 0 for those within `MARGIN` of a limit. (C, H, W)."""
    with torch.no_grad():
        _, _, info = _rasterize(scene, scene.arguments, "reference")
    return (info["margin"] > MARGIN).double()


def _rasterize(
    scene: HardScene, arguments: Arguments, backend: str
) -> tuple[torch.Tensor, torch.Tensor, dict[str, Any]]:
    with warnings.catch_warnings():
        warnings.filterwarnings("ignore", "rasterize: ")
        return rasterize(
            **arguments,  # type: ignore[arg-type]
            width=scene.width,
            height=scene.height,
            near_plane=scene.near_plane,
            eps2d=scene.eps2d,
            backend=backend,
        )


def difference(measured: torch.Tensor, truth: torch.Tensor) -> float:
    """Relative L2 distance; absolute where the truth is zero."""
    size = float(truth.norm())
    return float((measured - truth).norm()) / (size if size > 0 else 1.0)


def gradient_differences(
    measured: Mapping[str, torch.Tensor], truth: DrawnScene
) -> dict[str, float]:
    """`difference` of every gradient."""
    return {name: difference(measured[name], value) for name, value in truth.gradients.items()}


def _noise(shape: torch.Size, seed: int) -> torch.Tensor:
    generator = torch.Generator().manual_seed(seed)
    return torch.randn(shape, generator=generator, dtype=torch.float64)


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


def _beside_float64(
    scene: HardScene, context: Context, tolerance: float, dtype: torch.dtype | None = None
) -> Measured:
    """How far a drawing, and its gradients, are from the reference in the pixels that are clear."""
    clear = clear_pixels(scene)
    truth = draw(scene, "reference", torch.float64, clear)
    if dtype is None:
        drawing = _draw(scene, context, clear)
    else:
        drawing = draw(scene, context.backend, dtype, clear)
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


def run_exact(scene: HardScene, own: float, gsplat: float, context: Context) -> Measured:
    """As float64 draws it; gradients within `own`, those of gsplat within `gsplat`."""
    return _beside_float64(scene, context, gsplat if context.backend == "gsplat" else own)


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
    # The same numbers, so that what the type cannot hold does not count.
    narrow = {name: value.to(dtype).double() for name, value in hand_scene().arguments.items()}
    # Half an ulp of the type is added when a gradient is given back in it.
    allowed = GRADIENT_TOLERANCE + torch.finfo(dtype).eps
    return _beside_float64(HardScene(narrow), context, allowed, dtype)


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


_FLOAT32 = torch.finfo(torch.float32)
_SUBNORMAL = 1e-42
_BAD = {"NaN": math.nan, "+inf": math.inf, "-inf": -math.inf}


def cases() -> list[Case]:
    """Every hard case of the rasterizer, for the backends that this machine has."""
    backends = ("numba", "reference", *(["gsplat"] if _has_gsplat() else []))
    return [Case(name, "splat", must_hold, run, backends) for name, must_hold, run in _catalogue()]


def _has_gsplat() -> bool:
    import importlib.util

    return torch.cuda.is_available() and importlib.util.find_spec("gsplat") is not None


_Entry = tuple[str, str, Callable[[Context], Measured]]


def _catalogue() -> Iterator[_Entry]:
    for entries in (_bad_values, _culled, _views, _shapes, _piles, _cameras, _calls, _extremes):
        yield from entries()


def _bad_values() -> Iterator[_Entry]:
    for argument in PER_GAUSSIAN:
        for kind, value in _BAD.items():
            yield _no_effect(f"{kind} in {argument}", _spoilt(hand_scene(), argument, value))
    everything = hand_scene()
    for argument in PER_GAUSSIAN:
        everything = _spoilt(everything, argument, math.nan)
    yield _no_effect("NaN in every argument of a Gaussian", everything)


def _culled() -> Iterator[_Entry]:
    scene = hand_scene()
    yield _no_effect("quaternion of zeros", _spoilt(scene, "quats", 0.0, whole=True))
    at = {
        "behind the camera": -0.6,
        "on the camera plane": -0.4,
        "nearer than the near plane": -0.395,
        "far behind": -1e6,
        "beyond the far plane": 2e10,
    }
    for name, z in at.items():
        means = scene.arguments["means"].clone()
        means[VICTIM, 2] = z
        yield _no_effect(f"centre {name}", scene.changed(means=means))
    for value in (0.0, 1e-3, -0.5, -_FLOAT32.max):
        yield _no_effect(f"opacity {value:g}", _spoilt(scene, "opacities", value))
    yield _no_effect("centre at the largest float32", _spoilt(scene, "means", _FLOAT32.max))
    yield _no_effect("colour at the largest float32", _spoilt(scene, "colors", _FLOAT32.max))
    yield _no_effect("scale at the largest float32", _spoilt(scene, "scales", _FLOAT32.max))


def _views() -> Iterator[_Entry]:
    """Bad values in the arguments of one camera: the other camera's image must not change."""
    for argument in ("viewmats", "Ks", "backgrounds"):
        for kind, value in _BAD.items():
            scene = hand_scene(cameras=2)
            tensor = scene.arguments[argument].clone()
            tensor.view(2, -1)[1, 0] = value
            yield (
                f"{kind} in {argument} of one camera",
                "finite; its image shows the background, black if that is bad; the other as ever",
                functools.partial(run_bad_view, scene.changed(**{argument: tensor})),
            )
    scene = hand_scene(cameras=2)
    blind = scene.arguments["Ks"].clone()
    blind[1, 0, 0] = 0.0
    yield (
        "focal length 0 in one camera",
        "finite; its image shows the background; the other as ever",
        functools.partial(run_bad_view, scene.changed(Ks=blind)),
    )


def _shapes() -> Iterator[_Entry]:
    scene = hand_scene()
    yield _exact("opacity 1", _spoilt(scene, "opacities", 1.0))
    yield _exact("opacity 1 + 1e-7", _spoilt(scene, "opacities", 1.0 + 1.2e-7))
    yield _exact(
        "opacity at the largest float32",
        _spoilt(scene, "opacities", _FLOAT32.max),
        gsplat=math.inf,
    )
    for value in (0.0, 1e-12, _SUBNORMAL, -0.01):
        name = "subnormal" if value == _SUBNORMAL else f"{value:g}"
        yield _exact(f"scale {name}", _spoilt(scene, "scales", value, whole=True))
    yield _exact("scale 0 along one axis (a disc)", _spoilt(scene, "scales", 0.0))
    yield _exact("scale 1e18", _spoilt(scene, "scales", 1e18, whole=True), gsplat=math.inf)
    # An aspect of 1e20 leaves float64 no digit for the reference's gradient.
    yield _finite("scale 1e18 along one axis", _spoilt(scene, "scales", 1e18))
    yield _exact("scale 1 km along one axis", _spoilt(scene, "scales", 1e3), gsplat=math.inf)
    yield _exact("quaternion of norm 1e-30", _rescaled(scene, 1e-30))
    yield _exact("quaternion of norm 1e30", _rescaled(scene, 1e30))
    yield _exact("subnormal centre", _spoilt(scene, "means", _SUBNORMAL))
    yield _exact("subnormal colour", _spoilt(scene, "colors", _SUBNORMAL))
    yield _finite("subnormal quaternion", _rescaled(scene, _SUBNORMAL))
    yield _exact("colour 1e6", _spoilt(scene, "colors", 1e6))
    needles = hand_scene(count=20, width=150, height=150, focal=150.0, seed=1)
    thin = needles.arguments["scales"].clone()
    pixel = 0.4 / 150.0
    thin[:] = 1e-3 * pixel
    thin[:, 0] = 300.0 * pixel
    yield _exact(
        "needles of 1e-3 x 300 px",
        needles.changed(scales=thin),
        NEEDLE_TOLERANCE,
        gsplat=math.inf,
    )


def _piles() -> Iterator[_Entry]:
    scene = hand_scene()
    one_point = scene.arguments["means"].clone()
    one_point[:] = one_point[0]
    yield _exact(
        "all Gaussians at one point", scene.changed(means=one_point), gsplat=GSPLAT_TOLERANCE
    )
    flat = scene.arguments["means"].clone()
    flat[:, 2] = 0.0
    yield _exact("identical depths (blended in order of index)", scene.changed(means=flat))
    opaque = torch.ones_like(scene.arguments["opacities"])
    big = 5.0 * scene.arguments["scales"]
    yield _exact(
        "alpha saturated everywhere",
        scene.changed(opacities=opaque, scales=big),
        gsplat=GSPLAT_TOLERANCE,
    )
    layers = hand_scene(count=10_000, width=9, height=7, seed=3)
    means = layers.arguments["means"].clone()
    means[:, :2] = 0.0
    yield _exact("10,000 layers on one pixel", layers.changed(means=means), gsplat=GSPLAT_TOLERANCE)
    faint = torch.full_like(layers.arguments["opacities"], 0.0045)
    yield _exact(
        "10,000 faint layers, none saturating",
        layers.changed(means=means, opacities=faint),
        gsplat=GSPLAT_TOLERANCE,
    )


def _cameras() -> Iterator[_Entry]:
    far = hand_scene(focal=1e6, distance=6e3, seed=2)
    yield _exact("focal length 1e6 px from 6 km", far)
    yield _exact("focal length 1e-3 px", hand_scene(focal=1e-3), gsplat=GSPLAT_TOLERANCE)
    yield _finite("focal length 1e-30 px", hand_scene(focal=1e-30))
    yield _finite("focal length 1e30 px", hand_scene(focal=1e30))
    half_off = hand_scene()
    moved = half_off.arguments["viewmats"].clone()
    moved[:, 0, 3] = -0.4 * 20 / 60
    yield _exact("hand half off screen", half_off.changed(viewmats=moved))
    yield _exact("hand 3 cm in front of the camera", hand_scene(distance=0.03))
    aside = half_off.arguments["viewmats"].clone()
    aside[:, 0, 3] = 50.0
    yield _exact("no Gaussian on screen", half_off.changed(viewmats=aside))
    empty = {name: half_off.arguments[name][:0] for name in PER_GAUSSIAN}
    yield _exact("zero Gaussians", half_off.changed(**empty))
    for width, height in ((1, 1), (1, 50), (50, 1), (17, 33), (16, 16), (1, 4096), (4096, 1)):
        yield _exact(f"image of {width} x {height}", hand_scene(width=width, height=height))
    unfiltered = hand_scene()
    yield _exact("no low-pass filter", HardScene(unfiltered.arguments, near_plane=0.0, eps2d=0.0))
    points = unfiltered.changed(scales=torch.zeros_like(unfiltered.arguments["scales"]))
    yield _exact("no low-pass filter and scale 0", HardScene(points.arguments, eps2d=0.0))


def _calls() -> Iterator[_Entry]:
    for dtype in (torch.float16, torch.bfloat16):
        yield (
            f"arguments in {str(dtype).removeprefix('torch.')}",
            f"image to {IMAGE_TOLERANCE:g} of float64 of the same numbers; gradients to "
            f"{GRADIENT_TOLERANCE:g} and the type's spacing",
            functools.partial(run_narrow, dtype),
        )
    yield (
        "arguments that are not contiguous",
        f"the bits of contiguous ones; gradients of gsplat to {NO_CHANGE:g}",
        run_strided,
    )
    yield (
        "two equal Gaussians in one place",
        f"alpha 1 - (1 - a)^2 with that of one Gaussian, to {IMAGE_TOLERANCE:g}",
        run_doubled,
    )
    yield (
        "two equal hands in one place, in either order",
        f"finite; image and gradients to {GRADIENT_TOLERANCE:g} of the other order",
        run_reordered,
    )


def _extremes() -> Iterator[_Entry]:
    scene = hand_scene()
    for argument in PER_GAUSSIAN:
        for name, value in (("the largest float32", _FLOAT32.max), ("subnormal", _SUBNORMAL)):
            whole = torch.full_like(scene.arguments[argument], value)
            yield _finite(f"all of {argument} {name}", scene.changed(**{argument: whole}))
        nothing = torch.full_like(scene.arguments[argument], math.nan)
        yield _finite(f"all of {argument} NaN", scene.changed(**{argument: nothing}))


def _spoilt(scene: HardScene, argument: str, value: float, whole: bool = False) -> HardScene:
    """The scene with one number, or one whole row, of one Gaussian replaced."""
    tensor = scene.arguments[argument].clone()
    if whole or tensor.ndim == 1:
        tensor[VICTIM] = value
    else:
        tensor[VICTIM, 1] = value
    return scene.changed(**{argument: tensor})


def _rescaled(scene: HardScene, norm: float) -> HardScene:
    quats = scene.arguments["quats"].clone()
    quats[VICTIM] *= norm / quats[VICTIM].norm()
    return scene.changed(quats=quats.float().double())


def _exact(
    name: str,
    scene: HardScene,
    tolerance: float = GRADIENT_TOLERANCE,
    gsplat: float | None = None,
) -> _Entry:
    """A scene that is drawn as in float64, gradients within `tolerance`.

    `gsplat` is for its gradients where its float32 does not hold that; infinite: the image is
    beyond it too, and its numbers must be finite, no more.
    """
    must_hold = f"image to {IMAGE_TOLERANCE:g}, gradients to {tolerance:g} of float64, all finite"
    if gsplat is not None:
        must_hold += "; gsplat finite only" if math.isinf(gsplat) else f"; gsplat to {gsplat:g}"
    own = tolerance if gsplat is None else gsplat
    return name, must_hold, functools.partial(run_exact, scene, tolerance, own)


def _no_effect(name: str, scene: HardScene) -> _Entry:
    return (
        name,
        "finite; its gradient is zero; all else as without it",
        functools.partial(run_no_effect, scene),
    )


def _finite(name: str, scene: HardScene) -> _Entry:
    return name, "image and gradients finite", functools.partial(run_finite, scene)
