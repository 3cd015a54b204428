"""The rasterizer's hard cases, for `hwp-bench stability` and for the tests.

Three things can be asked of a scene: that it is drawn as the float64 reference draws it; that a bad
Gaussian in it changes nothing; that all numbers stay finite.
"""

from __future__ import annotations

import functools
import math
from collections.abc import Callable, Iterator

import torch

from hwp_bench.stability import Case, Context, Measured
from wildghand.splat.hard_runs import (
    GRADIENT_TOLERANCE,
    GSPLAT_TOLERANCE,
    IMAGE_TOLERANCE,
    NEEDLE_TOLERANCE,
    NO_CHANGE,
    VICTIM,
    run_bad_view,
    run_doubled,
    run_exact,
    run_finite,
    run_narrow,
    run_no_effect,
    run_reordered,
    run_strided,
)
from wildghand.splat.hard_scenes import PER_GAUSSIAN, HardScene, hand_scene

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
    """A scene that is drawn as in float64.

    Args:
        name: of the case.
        scene: what is drawn.
        tolerance: of gradients.
        gsplat: of its gradients, where its float32 does not hold `tolerance`; infinite: the image
            is beyond it too, and its numbers must be finite, no more.
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
