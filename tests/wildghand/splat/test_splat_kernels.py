"""The compiled kernels: that they are vectors in the machine code, their arithmetic, their cache.

Oracles: the machine code itself, numpy in float64, the same call without a cache.
"""

from __future__ import annotations

import functools
import logging
import platform
import re
from typing import Any

import numba
import numpy as np
import pytest

from hwp_bench.base.kernels import on_disk
from wildghand.splat import numba_backend
from wildghand.splat.kernels import jit, project, tiles, vectors
from wildghand.splat.kernels.blend import blend, blend_backward
from wildghand.splat.kernels.project import project as project_kernel
from wildghand.splat.kernels.project import project_backward

X86 = platform.machine().lower() in ("x86_64", "amd64")


@functools.cache
def recompiled(kernel: Any) -> tuple[Any, Any]:
    """A kernel's first version, unrolled as RGB uses it, compiled anew; and its signature."""
    numba_backend.warm_up()
    fresh = numba.njit(nogil=True, boundscheck=False, error_model="numpy")(kernel.py_func)
    fresh.compile(kernel.signatures[0])
    return fresh, kernel.signatures[0]


def machine_code(kernel: Any) -> str:
    """Its assembly."""
    fresh, signature = recompiled(kernel)
    return fresh.inspect_asm(signature)


def innermost_block(assembly: str, marker: str) -> str:
    """The straight run of instructions, between labels and jumps back, that holds the marker."""
    blocks = re.split(r"\n\.?\w+:\n", assembly)
    held = [block for block in blocks if re.search(marker, block)]
    assert held, f"no {marker} in the machine code"
    return max(held, key=len)


@pytest.mark.skipif(not X86, reason="reads x86 assembly")
@pytest.mark.parametrize(("kernel", "products"), [(blend, 10), (blend_backward, 18)])
def test_the_inner_loop_over_pixels_is_vectorised(kernel: Any, products: int) -> None:
    """2^n is made by shifting integers by 23 bits: that marks the loop."""
    loop = innermost_block(machine_code(kernel), r"v?pslld\s+\$23")
    packed = re.findall(r"\bv?f?n?m(?:add|sub|ul)\w*ps\b|\bvfn?m(?:add|sub)\w*ps\b", loop)
    scalar = re.findall(r"\bv?(?:add|sub|mul|div|fn?m\w+)ss\b", loop)
    assert len(packed) >= products
    assert scalar == []
    widest = "zmm" if tiles.LANES == 16 else "ymm"
    assert widest in loop


@pytest.mark.skipif(not X86, reason="reads x86 assembly")
@pytest.mark.parametrize("kernel", [project_kernel, project_backward])
def test_the_projection_is_vectorised(kernel: Any) -> None:
    assembly = machine_code(kernel)
    packed = re.findall(r"\bv?(?:mul|fn?m(?:add|sub)\w+)pd\b", assembly)
    scalar = re.findall(r"\bv?(?:mul|fn?m(?:add|sub)\w+)sd\b", assembly)
    assert len(packed) > 100
    assert len(packed) > 10 * len(scalar)


def test_no_fast_math_in_the_intermediate_code() -> None:
    """`nnan`, `ninf` and `fast` would let the compiler drop the tests that cull."""
    fresh, signature = recompiled(project_kernel)
    assert not re.search(r"\b(fast|nnan|ninf)\b", fresh.inspect_llvm(signature))


@numba.njit
def _exp2(values, out):
    for k in range(0, values.size, tiles.LANES):
        vectors.store(out, k, tiles.exp2(tiles.load_pixels(values, k)))


@numba.njit
def _log2(values, out):
    (x,) = project.load1(values, 0)
    project.store_columns(out, 0, (project.log2(x),))


@numba.njit
def _sums(values, out):
    a = tiles.load_pixels(values, 0)
    vectors.store_sums(out, 0, (a, a * a, a + a))


@numba.njit
def _columns(values, out, total):
    x, y, z = project.load3(values, 0)
    project.add_columns(out, 0, (x, y * 10.0, z * 1e300))
    total[0] = project.total(x)


@numba.njit
def _rows(values, out):
    (v,) = project.load1(values, 0)
    project.store_rows(
        out, 0,
        (v, v + 10.0, v + 20.0, v + 30.0, v + 40.0, v + 50.0, v + 60.0, v + 70.0,
         v + 80.0, v + 90.0, v + 100.0, v + 110.0, v + 120.0, v + 130.0, v + 140.0, v + 150.0),
    )  # fmt: skip


def test_exp2_to_3e_7() -> None:
    x = np.linspace(-12, 0.5, 64 * tiles.LANES).astype(np.float32)
    out = np.empty_like(x)
    _exp2(x, out)
    np.testing.assert_allclose(out, np.exp2(x.astype(np.float64)), rtol=3e-7)


def test_log2_to_float32() -> None:
    x = np.array([1.0, 0.75, 1 / 255, 0.99, 1.5, 1e-3, 3e38, 1.0000001], np.float32)
    out = np.empty_like(x)
    _log2(x, out)
    np.testing.assert_allclose(out, np.log2(x.astype(np.float64)), rtol=1e-7, atol=1e-12)


def test_sums_over_lanes() -> None:
    x = np.random.default_rng(0).normal(size=tiles.LANES).astype(np.float32)
    out = np.zeros(tiles.LANES, np.float32)
    _sums(x, out)
    np.testing.assert_allclose(out[:3], [x.sum(), (x * x).sum(), 2 * x.sum()], rtol=1e-5)


def test_columns_and_rows_change_places() -> None:
    values = np.arange(24, dtype=np.float32)
    out, total = np.ones(24, np.float32), np.zeros(1)
    _columns(values, out, total)
    largest = np.finfo(np.float32).max
    by_row = values.reshape(8, 3)
    expected = np.stack([by_row[:, 0] + 1, 10 * by_row[:, 1] + 1, np.full(8, largest)], 1)
    assert np.array_equal(out.reshape(8, 3), expected)
    assert total[0] == by_row[:, 0].sum()
    big = np.zeros(128, np.float32)
    _rows(values[:8], big)
    assert np.array_equal(big.reshape(8, 16), values[:8, None] + 10 * np.arange(16))


def test_tiles_are_made_of_blocks_that_fill_a_vector() -> None:
    assert tiles.BLOCK_WIDTH * tiles.BLOCK_HEIGHT == tiles.LANES
    assert tiles.TILE_WIDTH * tiles.TILE_HEIGHT == tiles.BLOCKS * tiles.LANES
    places = {
        tiles.place_of.py_func(x, y)
        for y in range(tiles.TILE_HEIGHT)
        for x in range(tiles.TILE_WIDTH)
    }
    assert places == {(b, lane) for b in range(tiles.BLOCKS) for lane in range(tiles.LANES)}


def test_sort_is_by_depth_and_stable() -> None:
    numba_backend.warm_up()
    generator = np.random.default_rng(0)
    depths = generator.choice([0.0, 0.5, 1.0, 1.5, 1e-38, 3e38], size=(3, 1000)).astype(np.float32)
    visible = np.array([(row > 0).sum() for row in depths])
    order = np.empty((3, 1000), np.int32)
    found, chunk_rows = np.empty(3, np.int64), np.empty((3, 3), np.int64)
    numba_backend.sort_by_depth(
        0, np.zeros(8, np.int64), np.array([0, 3]), depths, np.ones((3, 1000), np.int32), order,
        np.empty((3, 1000), np.int32), found, chunk_rows,
    )  # fmt: skip
    assert found.tolist() == visible.tolist()
    for row, places, count in zip(depths, order, visible, strict=True):
        expected = np.argsort(np.where(row > 0, row, np.inf), kind="stable")[:count]
        assert np.array_equal(places[:count], expected)
    assert chunk_rows[:, -1].tolist() == visible.tolist()


def test_the_first_call_says_that_it_compiles(
    monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    drawn: list[int] = []
    monkeypatch.setattr(numba_backend, "on_disk", lambda kernel: False)
    monkeypatch.setattr(numba_backend, "_compiled_here", lambda: len(drawn))
    monkeypatch.setattr(numba_backend, "_draw_nothing", drawn.append)
    numba_backend._warm_up.cache_clear()
    with caplog.at_level(logging.WARNING):
        numba_backend.warm_up()
        numba_backend.warm_up()
    assert re.match(r"compiling the CPU rasterizer, once", caplog.messages[0])
    assert re.match(r"compiled the CPU rasterizer in \d+\.\d s", caplog.messages[1])
    assert len(caplog.messages) == 2
    # Any number of channels that is not unrolled is one more version, made when it is asked for.
    numba_backend.warm_up(4)
    numba_backend.warm_up(17)
    assert drawn == [3, 4]
    numba_backend._warm_up.cache_clear()


def test_all_kernels_are_made_ready() -> None:
    numba_backend.warm_up()
    assert all(kernel.signatures for kernel in numba_backend.KERNELS)
    names = {kernel.py_func.__name__ for kernel in numba_backend.KERNELS}
    called = {name for name, value in vars(numba_backend).items() if hasattr(value, "py_func")}
    assert names == called


def test_a_kernel_of_another_package_is_not_kept_on_disk() -> None:
    @jit.kernel
    def double(x):
        return 2 * x

    assert double(21) == 42
    assert not on_disk(double)
