"""A small network that says from an image's features which pixels are inliers."""

from __future__ import annotations

import math

import cv2
import numpy as np
import torch

#: Hidden units.
HIDDEN = 16
#: Frequencies of the positional encoding; each gives a sine and a cosine for x and for y.
FREQUENCIES = 20
#: Wavelengths of the oriented energies, px, and the number of their directions.
WAVELENGTHS, DIRECTIONS = (4.0, 8.0), 4
#: Features of a pixel's look (CIELAB and energies), and all, with the encodings of its place.
LOOK = 3 + len(WAVELENGTHS) * DIRECTIONS
FEATURES = LOOK + 4 * FREQUENCIES


def look_features(image: np.ndarray) -> np.ndarray:
    """Describe the look of each pixel of an image.

    Args:
        image: (H, W, 3) uint8 sRGB.

    Returns:
        (H, W, LOOK) float32: CIELAB divided by 100; the energies of even and odd Gabor filters of
        the lightness, by wavelength and direction.
    """
    lab = cv2.cvtColor(image.astype(np.float32) / 255.0, cv2.COLOR_RGB2LAB) / 100.0
    return np.concatenate((lab, oriented_energies(lab[..., 0])), axis=-1)


def oriented_energies(lightness: np.ndarray) -> np.ndarray:
    """Root of the summed squares of an even and an odd filter: (H, W, 8) of an (H, W) image.

    Source: Adelson and Bergen, "Spatiotemporal energy models", in two dimensions of space.
    """
    found = []
    for wavelength in WAVELENGTHS:
        sigma = 0.5 * wavelength
        half = math.ceil(2.5 * sigma)
        y, x = np.mgrid[-half : half + 1, -half : half + 1].astype(np.float32)
        window = np.exp(-0.5 * (x * x + y * y) / sigma**2)
        window /= window.sum()
        for k in range(DIRECTIONS):
            angle = math.pi * k / DIRECTIONS
            phase = 2.0 * math.pi / wavelength * (x * math.cos(angle) + y * math.sin(angle))
            even = np.cos(phase) - (window * np.cos(phase)).sum()
            pair = [
                cv2.filter2D(lightness, -1, window * wave, borderType=cv2.BORDER_REFLECT)
                for wave in (even, np.sin(phase))
            ]
            found.append(np.hypot(*pair))
    return np.stack(found, axis=-1).astype(np.float32)


def encodings(height: int, width: int) -> np.ndarray:
    """Sines and cosines of 20 octaves of the place in the image: (H, W, 80) float32.

    Source: the code of SpotLessSplats; octaves finer than a pixel alias there too.
    """
    frequencies = math.pi * 2.0 ** np.arange(FREQUENCIES)
    waves = []
    for count in (height, width):
        phase = np.arange(count)[:, None] / max(count - 1, 1) * frequencies
        waves.append(np.concatenate((np.sin(phase), np.cos(phase)), axis=-1))
    rows = np.broadcast_to(waves[0][:, None], (height, width, 2 * FREQUENCIES))
    columns = np.broadcast_to(waves[1][None], (height, width, 2 * FREQUENCIES))
    return np.concatenate((rows, columns), axis=-1).astype(np.float32)


def make_network(seed: int, device: torch.device) -> dict[str, torch.Tensor]:
    """The tensors of a network with one hidden layer.

    Args:
        seed: of the weights.
        device: where they live.

    Returns:
        by name, for `chances`; weights uniform like those of torch's linear layers, biases 0.
    """
    random = torch.Generator().manual_seed(seed)

    def uniform(*shape: int) -> torch.Tensor:
        values = 2.0 * torch.rand(*shape, generator=random) - 1.0
        return (values / math.sqrt(shape[-1])).to(device)

    return {
        "vote_in": uniform(HIDDEN, FEATURES),
        "vote_in_bias": torch.zeros(HIDDEN, device=device),
        "vote_out": uniform(1, HIDDEN),
        "vote_out_bias": torch.zeros(1, device=device),
    }


def chances(features: torch.Tensor, network: dict[str, torch.Tensor]) -> torch.Tensor:
    """The chance of each pixel to be an inlier: (...) of features (..., FEATURES)."""
    hidden = features @ network["vote_in"].T + network["vote_in_bias"]
    return (hidden.relu() @ network["vote_out"].T + network["vote_out_bias"]).sigmoid()[..., 0]


def vote_loss(
    chance: torch.Tensor,
    surely_in: torch.Tensor,
    maybe_in: torch.Tensor,
    network: dict[str, torch.Tensor],
    smoothness: float,
) -> torch.Tensor:
    """Penalty of chances that contradict what the errors say, and of a network that is steep.

    Args:
        chance: (P,) in [0, 1].
        surely_in: (P,) 1 where the lower threshold says inlier, else 0.
        maybe_in: (P,) 1 where the upper threshold says inlier, else 0.
        network: whose weights are held down.
        smoothness: the weight of max |W1| max |W2|.

    Source: Sabour et al., "SpotLessSplats", and its code.
    """
    wrong = (chance - maybe_in).relu() + (surely_in - chance).relu()
    steepness = network["vote_in"].abs().amax() * network["vote_out"].abs().amax()
    return wrong.mean() + smoothness * steepness
