"""The network of the preset `vote`. Oracles: gratings, formulas by hand, a separable case."""

from __future__ import annotations

import math

import numpy as np
import pytest
import torch

from trimmed_fit.method import (
    DIRECTIONS,
    FEATURES,
    LOOK,
    WAVELENGTHS,
    chances,
    encodings,
    look_features,
    make_network,
    oriented_energies,
    vote_loss,
)


@pytest.mark.parametrize("direction", range(DIRECTIONS))
@pytest.mark.parametrize("scale", range(len(WAVELENGTHS)))
def test_a_grating_moves_the_filter_of_its_direction_and_wavelength(
    direction: int, scale: int
) -> None:
    y, x = np.mgrid[:48, :48]
    angle = math.pi * direction / DIRECTIONS
    along = x * math.cos(angle) + y * math.sin(angle)
    grating = 0.5 + 0.4 * np.sin(2.0 * math.pi / WAVELENGTHS[scale] * along + 0.7)
    energies = oriented_energies(grating.astype(np.float32))[12:36, 12:36].mean(axis=(0, 1))
    assert np.argmax(energies) == scale * DIRECTIONS + direction


def test_an_even_surface_has_no_energy_and_the_colour_of_cielab() -> None:
    """White has L* = 100 and no colour; tolerance 1e-3 for OpenCV's tables and filters."""
    features = look_features(np.full((20, 24, 3), 255, dtype=np.uint8))
    assert features.shape == (20, 24, LOOK)
    np.testing.assert_allclose(features[..., 0], 1.0, atol=1e-3)
    np.testing.assert_allclose(features[..., 1:], 0.0, atol=1e-3)


def test_places_are_encoded_by_octaves() -> None:
    made = encodings(5, 3)
    assert made.shape == (5, 3, FEATURES - LOOK)
    row, column = 1 / 4, 2 / 2
    assert made[1, 2, 0] == pytest.approx(math.sin(math.pi * row), abs=1e-6)
    assert made[1, 2, 1] == pytest.approx(math.sin(2 * math.pi * row), abs=1e-6)
    assert made[1, 2, 20] == pytest.approx(math.cos(math.pi * row), abs=1e-6)
    assert made[1, 2, 40] == pytest.approx(math.sin(math.pi * column), abs=1e-6)
    assert made[1, 2, 60] == pytest.approx(math.cos(math.pi * column), abs=1e-6)


def test_the_loss_is_that_of_the_formula() -> None:
    network = make_network(3, torch.device("cpu"))
    chance = torch.tensor([0.9, 0.8, 0.3, 0.6])
    surely, maybe = torch.tensor([1.0, 0.0, 1.0, 0.0]), torch.tensor([1.0, 1.0, 1.0, 0.0])
    steep = network["vote.in"].abs().max() * network["vote.out"].abs().max()
    expected = (0.1 + 0.0 + 0.7 + 0.6) / 4 + 0.5 * float(steep)
    assert float(vote_loss(chance, surely, maybe, network, 0.5)) == pytest.approx(expected)


def test_the_network_learns_a_colour_that_fits_badly() -> None:
    """At first it knows nothing; after 150 steps of Adam a colour tells the outliers."""
    network = make_network(0, torch.device("cpu"))
    features = torch.zeros(400, FEATURES)
    outlier = torch.arange(400) % 4 == 0
    features[:, 0], features[:, 1] = 0.6, torch.where(outlier, -0.5, 0.2)
    assert (chances(features, network) - 0.5).abs().max() < 0.1
    optimizer = torch.optim.Adam([value.requires_grad_() for value in network.values()], lr=2e-2)
    inlier = (~outlier).float()
    for _ in range(150):
        loss = vote_loss(chances(features, network), inlier, inlier, network, 0.01)
        optimizer.zero_grad()
        loss.backward()
        optimizer.step()
    found = chances(features, network).detach()
    assert found[outlier].max() < 0.2 < 0.8 < found[~outlier].min()
