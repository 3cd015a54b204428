"""The contract of `rasterize` on the CPU: shapes, sharing, errors, autograd manners, threads."""

from __future__ import annotations

import concurrent.futures
import subprocess
import sys
import textwrap
from pathlib import Path

import pytest
import torch

from hwp_bench.base.errors import HwpError, ShapeMismatch, UsageError
from wildghand.splat import rasterize
from wildghand.splat.hard_cases import hand_scene

SIZE = {"width": 40, "height": 30}
LEAVES = ("means", "quats", "scales", "opacities", "colors", "viewmats", "backgrounds")


def arguments(
    cameras: int = 1, count: int = 60, **changed: torch.Tensor
) -> dict[str, torch.Tensor]:
    scene = hand_scene(count=count, cameras=cameras).arguments
    return {**{name: value.float() for name, value in scene.items()}, **changed}


def gradients(tensors: dict[str, torch.Tensor], **options: object) -> list[torch.Tensor]:
    """Image, alpha, and gradients of the sum of squares of the image."""
    leaves = {name: value.detach().clone().requires_grad_() for name, value in tensors.items()}
    image, alpha, _ = rasterize(**leaves, **SIZE, **options)
    image.square().sum().backward()
    given = [leaves[name].grad for name in LEAVES if name in leaves]
    return [image.detach(), alpha.detach(), *given]


def test_gsplat_shapes() -> None:
    one = arguments(cameras=3)
    image, alpha, info = rasterize(**one, **SIZE)
    assert image.shape == (3, 30, 40, 3)
    assert alpha.shape == (3, 30, 40, 1)
    assert image.is_contiguous()
    assert image.dtype == alpha.dtype == torch.float32
    assert info["means2d"].shape == (3, 60, 2)
    assert info["depths"].shape == (3, 60)
    assert info["radii"].shape == (3, 60, 2)
    assert info["radii"].dtype == torch.int32
    assert info["visible"].shape == (3,)
    assert (info["width"], info["height"], info["n_cameras"]) == (40, 30, 3)
    batch = {name: torch.stack([value, value, value, value]) for name, value in one.items()}
    image4, alpha4, info4 = rasterize(**batch, **SIZE)
    assert image4.shape == (4, 3, 30, 40, 3)
    assert alpha4.shape == (4, 3, 30, 40, 1)
    assert info4["means2d"].shape == (4, 3, 60, 2)
    assert info4["n_batches"] == 4
    for group in image4:
        assert torch.equal(group, image)


def test_a_camera_each_with_its_own_gaussians() -> None:
    """Posed hands: means and quats of every frame, the rest shared. Oracle: one call a frame."""
    both = arguments(cameras=2)
    both["means"] = torch.stack([both["means"], both["means"] + 0.01])
    both["quats"] = torch.stack([both["quats"], both["quats"].flip(0)])
    together = gradients(both)
    apart = []
    for i in range(2):
        own = {"means", "quats"}
        cameras = {"viewmats", "Ks", "backgrounds"}
        apart.append(gradients({
            name: value[i] if name in own else value[i : i + 1] if name in cameras else value
            for name, value in both.items()
        }))  # fmt: skip
    names = ["image", "alpha", *LEAVES]
    for k, name in enumerate(names):
        a, b = apart[0][k], apart[1][k]
        if name in ("means", "quats"):
            expected = torch.stack([a, b])
        elif name in ("scales", "opacities", "colors"):
            expected = a + b
        else:
            expected = torch.cat([a, b])
        torch.testing.assert_close(together[k], expected, rtol=1e-5, atol=1e-5, msg=name)


def test_means2d_gradient_is_there_for_densification() -> None:
    """As gsplat's users take it. Oracle: the reference. Tolerance 1e-4."""
    kept = []
    for backend, dtype in (("numba", torch.float32), ("reference", torch.float64)):
        tensors = {name: value.to(dtype) for name, value in arguments(cameras=2).items()}
        tensors["means"].requires_grad_()
        image, _, info = rasterize(**tensors, **SIZE, backend=backend)
        info["means2d"].retain_grad()
        image.square().sum().backward()
        kept.append(info["means2d"].grad)
    assert kept[0].abs().max() > 0
    torch.testing.assert_close(kept[0].double(), kept[1], rtol=1e-4, atol=1e-4)


def test_pairs_are_counted_when_asked() -> None:
    tensors = arguments(cameras=2)
    *_, info = rasterize(**tensors, **SIZE, count_pairs=True)
    *_, truth = rasterize(**tensors, **SIZE, count_pairs=True, backend="reference")
    assert info["pairs"].tolist() == pytest.approx(truth["pairs"].tolist(), abs=2)
    assert "pairs" not in rasterize(**tensors, **SIZE)[2]


def test_two_forwards_before_the_backwards() -> None:
    first, second = arguments(), arguments(count=45)
    alone = [gradients(first), gradients(second)]
    leaves = [
        {name: value.clone().requires_grad_() for name, value in tensors.items()}
        for tensors in (first, second)
    ]
    images = [rasterize(**tensors, **SIZE)[0] for tensors in leaves]
    for image in images:
        image.square().sum().backward()
    for tensors, expected in zip(leaves, alone, strict=True):
        for name, gradient in zip(LEAVES, expected[2:], strict=True):
            assert torch.equal(tensors[name].grad, gradient)


def test_backward_twice_with_retain_graph() -> None:
    tensors = {name: value.requires_grad_() for name, value in arguments().items()}
    loss = rasterize(**tensors, **SIZE)[0].square().sum()
    loss.backward(retain_graph=True)
    once = tensors["means"].grad.clone()
    loss.backward()
    assert torch.equal(tensors["means"].grad, 2 * once)


def test_double_backward_says_that_it_is_not_there() -> None:
    tensors = {name: value.requires_grad_() for name, value in arguments().items()}
    loss = rasterize(**tensors, **SIZE)[0].square().sum()
    with pytest.raises(HwpError, match="first derivatives only"):
        torch.autograd.grad(loss, tensors["means"], create_graph=True)


def test_changing_an_input_before_the_backward_is_refused() -> None:
    tensors = arguments()
    tensors["means"].requires_grad_()
    scales = tensors["scales"].requires_grad_()
    loss = rasterize(**tensors, **SIZE)[0].sum()
    with torch.no_grad():
        scales.mul_(2)
    with pytest.raises(RuntimeError, match="modified by an inplace operation"):
        loss.backward()


def test_no_grad_and_inference_mode() -> None:
    tensors = arguments()
    expected, _, _ = rasterize(**tensors, **SIZE)
    for mode in (torch.no_grad, torch.inference_mode):
        with mode():
            image, _, _ = rasterize(**tensors, **SIZE)
            assert not image.requires_grad
            assert torch.equal(image, expected)


def test_alpha_alone_has_gradients() -> None:
    tensors = {name: value.requires_grad_() for name, value in arguments().items()}
    rasterize(**tensors, **SIZE)[1].sum().backward()
    assert tensors["opacities"].grad.abs().max() > 0
    assert tensors["colors"].grad.abs().max() == 0


def test_same_bits_for_any_number_of_threads_and_on_every_run() -> None:
    tensors = arguments(cameras=2, count=30_000)
    before = torch.get_num_threads()
    results = []
    try:
        for threads in (1, 2, 3, 7, 1):
            torch.set_num_threads(threads)
            results.append(gradients(tensors))
    finally:
        torch.set_num_threads(before)
    for result in results[1:]:
        for got, want in zip(result, results[0], strict=True):
            assert torch.equal(got, want)


def test_many_callers_at_once() -> None:
    scenes = [arguments(count=12_000 * (k % 2) + 50 + 10 * k) for k in range(8)]
    expected = [gradients(scene) for scene in scenes]
    with concurrent.futures.ThreadPoolExecutor(8) as pool:
        for _ in range(3):
            for got, want in zip(pool.map(gradients, scenes), expected, strict=True):
                assert all(torch.equal(a, b) for a, b in zip(got, want, strict=True))


def test_a_forked_child_can_draw() -> None:
    """DataLoader workers fork after the parent has drawn; numba's own threads would abort."""
    code = """
        import multiprocessing, sys
        import torch
        sys.path.insert(0, sys.argv[1])
        from test_splat_rasterize import SIZE, arguments, rasterize
        torch.set_num_threads(2)
        tensors = arguments(cameras=2, count=30_000)
        expected = rasterize(**tensors, **SIZE)[0]
        def child():
            sys.exit(0 if torch.equal(rasterize(**tensors, **SIZE)[0], expected) else 3)
        process = multiprocessing.get_context("fork").Process(target=child)
        process.start()
        process.join(60)
        sys.exit(9 if process.exitcode is None else process.exitcode)
    """
    done = subprocess.run(
        [sys.executable, "-c", textwrap.dedent(code), str(Path(__file__).parent)],
        cwd=Path(__file__).resolve().parents[3],
        check=False,
    )
    assert done.returncode == 0


@pytest.mark.parametrize(
    ("name", "shape"),
    [
        ("means", (60, 4)), ("means", (3,)), ("quats", (60, 3)), ("quats", (59, 4)),
        ("scales", (60,)), ("opacities", (60, 1)), ("colors", (61, 3)), ("colors", (60, 0)),
        ("colors", (2, 60, 3)), ("viewmats", (4, 4)), ("viewmats", (1, 3, 4)),
        ("viewmats", (0, 4, 4)), ("Ks", (2, 3, 3)), ("Ks", (1, 4, 4)), ("backgrounds", (2, 3)),
        ("backgrounds", (1, 4)), ("backgrounds", (4,)),
    ],
)  # fmt: skip
def test_a_wrong_shape_is_named(name: str, shape: tuple[int, ...]) -> None:
    with pytest.raises(ShapeMismatch, match=f"^{name}: "):
        rasterize(**arguments(**{name: torch.zeros(shape)}), **SIZE)


@pytest.mark.parametrize(
    ("options", "field"),
    [
        ({"backend": "cuda"}, "backend"),
        ({"backend": "gsplat"}, "backend"),
        ({"render_mode": "depth"}, "render_mode"),
        ({"rasterize_mode": "mip"}, "rasterize_mode"),
        ({"width": 0}, "width"),
        ({"height": 2.5}, "height"),
        ({"near_plane": -1.0}, "near_plane"),
        ({"near_plane": float("nan")}, "near_plane"),
        ({"eps2d": -0.1}, "eps2d"),
        ({"eps2d": float("inf")}, "eps2d"),
        ({"means": torch.zeros(60, 3, dtype=torch.int64)}, "means"),
        ({"colors": [[0.0]]}, "colors"),
        ({"scales": torch.zeros(60, 3, device="meta")}, "scales"),
    ],
)
def test_what_makes_no_sense_is_named(options: dict[str, object], field: str) -> None:
    with pytest.raises(UsageError, match=f"^{field}: "):
        rasterize(**{**arguments(), **SIZE, **options})


def test_a_bad_camera_or_background_is_warned_of() -> None:
    with pytest.warns(UserWarning, match="camera is not finite"):
        rasterize(**arguments(Ks=torch.full((1, 3, 3), torch.nan)), **SIZE)
    with pytest.warns(UserWarning, match="no positive focal length"):
        rasterize(**arguments(Ks=torch.zeros(1, 3, 3)), **SIZE)
    with pytest.warns(UserWarning, match="background is not finite"):
        rasterize(**arguments(backgrounds=torch.full((1, 3), torch.inf)), **SIZE)
