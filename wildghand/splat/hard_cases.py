"""Scenes at the limits of arithmetic, and the result of drawing one."""

from __future__ import annotations

import functools
import math
import warnings
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, replace
from typing import Any

import torch

from hwp_bench.stability import Case, Context, Measured, largest
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
        return replace(self, arguments={**self.arguments, **arguments})

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


def _draw(
    scene: HardScene,
    context: Context,
    weights: torch.Tensor | None = None,
    dtype: torch.dtype | None = None,
) -> DrawnScene:
    own = torch.float64 if context.backend == "reference" else torch.float32
    return draw(scene, context.backend, dtype or own, weights)


def _beside_float64(
    scene: HardScene, context: Context, tolerance: float, dtype: torch.dtype | None = None
) -> Measured:
    """How far a drawing, and its gradients, are from the reference in the pixels that are clear."""
    clear = clear_pixels(scene)
    truth = draw(scene, "reference", torch.float64, clear)
    drawing = _draw(scene, context, clear, dtype)
    mask = clear.unsqueeze(-1)
    image = largest([
        difference(drawing.image * mask, truth.image * mask),
        difference(drawing.alpha * mask, truth.alpha * mask),
    ])  # fmt: skip
    gradients = gradient_differences(drawing.gradients, truth)
    worst = max(gradients, key=lambda name: (math.isnan(gradients[name]), gradients[name]))
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
    own = largest(float(drawing.gradients[name][VICTIM].abs().max()) for name in PER_GAUSSIAN)
    others = {
        name: value[keep] if name in PER_GAUSSIAN else value
        for name, value in drawing.gradients.items()
    }
    change = largest([
        difference(drawing.image, without.image),
        difference(drawing.alpha, without.alpha),
        *gradient_differences(others, without).values(),
    ])  # fmt: skip
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
    away = largest(gradient_differences(other.gradients, plain).values())
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
    off = largest([difference(two.alpha, expected), difference(two.image, expected * colors)])
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
        off = largest([off, difference(first, second)])
    passed = made[0].finite and made[1].finite and off <= GRADIENT_TOLERANCE
    return Measured(passed, f"off by {off:.0e}")


def run_finite(scene: HardScene, context: Context) -> Measured:
    """All numbers are finite."""
    drawing = _draw(scene, context)
    sizes = [float(drawing.gradients[name].abs().max()) for name in DIFFERENTIABLE
             if drawing.gradients[name].numel()]  # fmt: skip
    return Measured(drawing.finite, f"largest gradient {largest(sizes):.0e}")


_LARGEST = torch.finfo(torch.float32).max
_SUBNORMAL = 1e-42
_BAD = {"NaN": math.nan, "+inf": math.inf, "-inf": -math.inf}
#: The second number of the spoilt Gaussian's row, its third, and the whole row.
_ONE, _DEPTH, _ROW = (VICTIM, 1), (VICTIM, 2), (VICTIM,)
#: Every Gaussian.
_ALL = ()


#: The case without a difficulty.
_ORDINARY = "a hand"


def cases() -> list[Case]:
    """Every hard case of the rasterizer, for the backends that this machine has."""
    backends = ("numba", "reference", *(["gsplat"] if _has_gsplat() else []))
    entries = (*_no_effects(), *_bad_views(), *_exact_scenes(), *_finite_scenes(), *_calls())
    return [
        Case(name, "splat", must_hold, run, backends, quick=name == _ORDINARY)
        for name, must_hold, run in entries
    ]


def _has_gsplat() -> bool:
    import importlib.util

    return torch.cuda.is_available() and importlib.util.find_spec("gsplat") is not None


_Entry = tuple[str, str, Callable[[Context], Measured]]


def _spoilt(argument: str, value: float, place: tuple[int, ...] = _ONE) -> HardScene:
    """A hand with some numbers of an argument replaced."""
    scene = hand_scene()
    tensor = scene.arguments[argument].clone()
    tensor[place[: tensor.ndim]] = value
    return scene.changed(**{argument: tensor})


def _no_effects() -> Iterator[_Entry]:
    """A Gaussian that is not drawn: bad numbers, and where none is seen."""
    everything = hand_scene()
    for argument in PER_GAUSSIAN:
        bad = _spoilt(argument, math.nan).arguments[argument]
        everything = everything.changed(**{argument: bad})
    scenes = {
        f"{kind} in {argument}": _spoilt(argument, value)
        for argument in PER_GAUSSIAN
        for kind, value in _BAD.items()
    } | {
        "NaN in every argument of a Gaussian": everything,
        "quaternion of zeros": _spoilt("quats", 0.0, _ROW),
        "centre behind the camera": _spoilt("means", -0.6, _DEPTH),
        "centre on the camera plane": _spoilt("means", -0.4, _DEPTH),
        "centre nearer than the near plane": _spoilt("means", -0.395, _DEPTH),
        "centre far behind": _spoilt("means", -1e6, _DEPTH),
        "centre beyond the far plane": _spoilt("means", 2e10, _DEPTH),
        "opacity 0": _spoilt("opacities", 0.0),
        "opacity 0.001": _spoilt("opacities", 1e-3),
        "opacity -0.5": _spoilt("opacities", -0.5),
        f"opacity {-_LARGEST:g}": _spoilt("opacities", -_LARGEST),
        "centre at the largest float32": _spoilt("means", _LARGEST),
        "colour at the largest float32": _spoilt("colors", _LARGEST),
        "scale at the largest float32": _spoilt("scales", _LARGEST),
    }
    for name, scene in scenes.items():
        run = functools.partial(run_no_effect, scene)
        yield name, "finite; its gradient is zero; all else as without it", run


def _bad_views() -> Iterator[_Entry]:
    """Bad values in the arguments of one camera: the other camera's image must not change."""
    values = [
        (f"{kind} in {argument} of one camera", argument, value)
        for argument in ("viewmats", "Ks", "backgrounds")
        for kind, value in _BAD.items()
    ]
    for name, argument, value in (*values, ("focal length 0 in one camera", "Ks", 0.0)):
        scene = hand_scene(cameras=2)
        tensor = scene.arguments[argument].clone()
        tensor.view(2, -1)[1, 0] = value
        yield (
            name,
            "finite; its image shows the background, black if that is bad; the other as ever",
            functools.partial(run_bad_view, scene.changed(**{argument: tensor})),
        )


def _exact_scenes() -> Iterator[_Entry]:
    """Scenes that are drawn as in float64.

    A number is for gsplat's gradients where its float32 does not hold the tolerance; infinite: the
    image is beyond it too, and its numbers must be finite, no more.
    """
    scene = hand_scene()
    means, scales = scene.arguments["means"], scene.arguments["scales"]
    aside = {name: scene.arguments["viewmats"].clone() for name in ("half", "whole")}
    aside["half"][:, 0, 3], aside["whole"][:, 0, 3] = -0.4 * 20 / 60, 50.0
    needles = hand_scene(count=20, width=150, height=150, focal=150.0, seed=1)
    pixel = 0.4 / 150.0
    thin = torch.tensor([[300.0, 1e-3, 1e-3]], dtype=torch.float64).repeat(20, 1) * pixel
    layers = hand_scene(count=10_000, width=9, height=7, seed=3)
    layers = layers.changed(means=layers.arguments["means"] * torch.tensor([0.0, 0.0, 1.0]))
    faint = torch.full_like(layers.arguments["opacities"], 0.0045)
    edges = ((1, 1), (1, 50), (50, 1), (17, 33), (16, 16), (1, 4096), (4096, 1))
    points = scene.changed(scales=torch.zeros_like(scales))
    scenes: dict[str, tuple[HardScene, float | None]] = {
        _ORDINARY: (scene, None),
        "opacity 1": (_spoilt("opacities", 1.0), None),
        "opacity 1 + 1e-7": (_spoilt("opacities", 1.0 + 1.2e-7), None),
        "opacity at the largest float32": (_spoilt("opacities", _LARGEST), math.inf),
        "scale 0": (_spoilt("scales", 0.0, _ROW), None),
        "scale 1e-12": (_spoilt("scales", 1e-12, _ROW), None),
        "scale subnormal": (_spoilt("scales", _SUBNORMAL, _ROW), None),
        "scale -0.01": (_spoilt("scales", -0.01, _ROW), None),
        "scale 0 along one axis (a disc)": (_spoilt("scales", 0.0), None),
        "scale 1e18": (_spoilt("scales", 1e18, _ROW), math.inf),
        "scale 1 km along one axis": (_spoilt("scales", 1e3), math.inf),
        "quaternion of norm 1e-30": (_rescaled(1e-30), None),
        "quaternion of norm 1e30": (_rescaled(1e30), None),
        "subnormal centre": (_spoilt("means", _SUBNORMAL), None),
        "subnormal colour": (_spoilt("colors", _SUBNORMAL), None),
        "colour 1e6": (_spoilt("colors", 1e6), None),
        "needles of 1e-3 x 300 px": (needles.changed(scales=thin), math.inf),
        "all Gaussians at one point": (
            scene.changed(means=means[:1].expand_as(means)),
            GSPLAT_TOLERANCE,
        ),
        "identical depths (blended in order of index)": (
            scene.changed(means=means * torch.tensor([1.0, 1.0, 0.0])),
            None,
        ),
        "alpha saturated everywhere": (
            scene.changed(opacities=torch.ones(len(means)).double(), scales=5.0 * scales),
            GSPLAT_TOLERANCE,
        ),
        "10,000 layers on one pixel": (layers, GSPLAT_TOLERANCE),
        "10,000 faint layers, none saturating": (layers.changed(opacities=faint), GSPLAT_TOLERANCE),
        "focal length 1e6 px from 6 km": (hand_scene(focal=1e6, distance=6e3, seed=2), None),
        "focal length 1e-3 px": (hand_scene(focal=1e-3), GSPLAT_TOLERANCE),
        "hand half off screen": (scene.changed(viewmats=aside["half"]), None),
        "hand 3 cm in front of the camera": (hand_scene(distance=0.03), None),
        "no Gaussian on screen": (scene.changed(viewmats=aside["whole"]), None),
        "zero Gaussians": (
            scene.changed(**{name: scene.arguments[name][:0] for name in PER_GAUSSIAN}),
            None,
        ),
        **{f"image of {w} x {h}": (hand_scene(width=w, height=h), None) for w, h in edges},
        "no low-pass filter": (HardScene(scene.arguments, near_plane=0.0, eps2d=0.0), None),
        "no low-pass filter and scale 0": (HardScene(points.arguments, eps2d=0.0), None),
    }
    for name, (made, gsplat) in scenes.items():
        own = NEEDLE_TOLERANCE if "needles" in name else GRADIENT_TOLERANCE
        must_hold = f"image to {IMAGE_TOLERANCE:g}, gradients to {own:g} of float64, all finite"
        if gsplat is not None:
            must_hold += "; gsplat finite only" if math.isinf(gsplat) else f"; gsplat to {gsplat:g}"
        allowed = own if gsplat is None else gsplat
        yield name, must_hold, functools.partial(run_exact, made, own, allowed)


def _rescaled(norm: float) -> HardScene:
    scene = hand_scene()
    quats = scene.arguments["quats"].clone()
    quats[VICTIM] *= norm / quats[VICTIM].norm()
    return scene.changed(quats=quats.float().double())


def _finite_scenes() -> Iterator[_Entry]:
    """Scenes beyond the reference, whose numbers must be finite."""
    scenes = {
        # An aspect of 1e20 leaves float64 no digit for the reference's gradient.
        "scale 1e18 along one axis": _spoilt("scales", 1e18),
        "subnormal quaternion": _rescaled(_SUBNORMAL),
        "focal length 1e-30 px": hand_scene(focal=1e-30),
        "focal length 1e30 px": hand_scene(focal=1e30),
    } | {
        f"all of {argument} {name}": _spoilt(argument, value, _ALL)
        for argument in PER_GAUSSIAN
        for name, value in (
            ("the largest float32", _LARGEST),
            ("subnormal", _SUBNORMAL),
            ("NaN", math.nan),
        )
    }
    for name, scene in scenes.items():
        yield name, "image and gradients finite", functools.partial(run_finite, scene)


def _calls() -> Iterator[_Entry]:
    """Calls that are unlike others in form."""
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
