"""The weight-free perceptual distance: its properties, and the order the documentation claims."""

from __future__ import annotations

import importlib.util
import itertools
import sys
from pathlib import Path
from types import ModuleType

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from hwp_bench.base.errors import EmptyMask
from hwp_bench.metrics.pixels import ORIENTATIONS, filter_bank, oriented_distance, oriented_energies

BENCHMARK = Path(__file__).parents[3] / "benchmarks" / "perceptual_order.py"


@pytest.fixture(scope="module")
def order() -> ModuleType:
    """The benchmark behind the table in `docs/protocol.md`."""
    spec = importlib.util.spec_from_file_location("perceptual_order", BENCHMARK)
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    sys.modules[spec.name] = module
    spec.loader.exec_module(module)
    return module


@pytest.mark.parametrize("photograph", ["cat", "cup", "astronaut"])
@pytest.mark.parametrize("kind", ["gamma", "shift", "noise", "JPEG", "blur"])
def test_stronger_degradations_are_farther(order, kind, photograph):
    target = order.photographs()[photograph]
    chosen = order.KINDS[kind]
    scores = [order.score(chosen.apply(target, level), target) for level in chosen.levels]
    distances = [score["oriented_distance"] for score in scores]
    assert distances[0] > 0.0
    assert all(far > 1.5 * near for near, far in itertools.pairwise(distances))


def test_at_equal_psnr_the_kinds_are_ordered_as_documented(order):
    target = order.photographs()["cup"]
    distance = {
        name: order.score(order.at_equal_psnr(kind, target)[1], target)["oriented_distance"]
        for name, kind in order.KINDS.items()
    }
    assert distance["gamma"] < distance["shift"]
    assert 1.5 * distance["shift"] < min(distance["noise"], distance["JPEG"], distance["blur"])


@pytest.mark.parametrize("direction", range(ORIENTATIONS))
def test_a_wave_answers_in_its_own_direction_with_its_own_amplitude(direction):
    """By hand: at the preferred frequency the energy is the amplitude, within 4 %, anywhere."""
    angle = np.pi * direction / ORIENTATIONS
    rows, columns = np.mgrid[:64, :64]
    phase = 1.37 * (columns * np.cos(angle) - rows * np.sin(angle))
    energies = oriented_energies((0.3 * np.sin(phase)).astype(np.float32))[12:-12, 12:-12]
    np.testing.assert_allclose(energies[..., direction], 0.3, rtol=0.04)
    assert energies.mean(axis=(0, 1)).argmax() == direction
    across = energies[..., (direction + ORIENTATIONS // 2) % ORIENTATIONS]
    assert across.max() < 0.02


def test_a_constant_image_has_no_energy():
    energies = oriented_energies(np.full((40, 40), 0.7, np.float32))[8:-8, 8:-8]
    np.testing.assert_allclose(energies, 0.0, atol=1e-6)
    bank = filter_bank()
    assert bank.even_steering.shape == (ORIENTATIONS, 3)
    assert bank.odd_steering.shape == (ORIENTATIONS, 4)


@given(st.integers(0, 2**32 - 1), st.integers(1, 48), st.integers(1, 48))
@settings(max_examples=50, deadline=None)
def test_zero_for_identical_symmetric_and_in_range(seed, height, width):
    rng = np.random.default_rng(seed)
    x, y = rng.integers(0, 256, (2, height, width, 3)) / 255.0
    mask = rng.random((height, width)) > rng.random()
    mask[-1, -1] = True
    assert oriented_distance(x, x.copy(), mask) == 0.0
    distance = oriented_distance(x, y, mask)
    assert 0.0 < distance <= 1.0
    assert distance == pytest.approx(oriented_distance(y, x, mask), rel=1e-6)


def test_black_against_white_is_nearly_the_maximum():
    black = np.zeros((200, 200, 3))
    distance = oriented_distance(black, black + 1.0, np.ones((200, 200), bool))
    assert 0.95 < distance <= 1.0


def test_a_flat_hand_is_farther_than_a_blurred_one():
    """Lost texture must cost: the failure that PSNR forgives."""
    rng = np.random.default_rng(0)
    waves = np.sin(np.arange(64) / 1.5)[:, None, None]
    target = np.clip(0.6 + 0.15 * waves + rng.normal(0, 0.03, (64, 64, 3)), 0, 1)
    flat = np.broadcast_to(target.mean(axis=(0, 1)), target.shape)
    half = 0.5 * (target + flat)
    mask = np.ones((64, 64), bool)
    assert oriented_distance(flat, target, mask) > 2 * oriented_distance(half, target, mask)


def test_an_empty_mask_is_refused():
    image, mask = np.zeros((8, 8, 3)), np.ones((8, 8), bool)
    with pytest.raises(EmptyMask):
        oriented_distance(image, image, ~mask)
