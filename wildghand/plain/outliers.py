"""Pixels that fit badly: their errors, rules and a network that find inliers, and what they learn.

Robust losses leave outliers out. Methods share the ways to find these pixels: a quantile
of recent errors, the neighbourhoods of a pixel, a network of its look, the likeness of patches.
"""

from __future__ import annotations

import math

import cv2
import numpy as np
import torch
from torch.nn.functional import avg_pool2d, pad

from wildghand.gaussians.training import FrameTable, upload
from wildghand.plain.recipe import Batch, FitInputs

#: Bins of the histogram over [0, 1].
BINS = 10_000
#: Edge of the neighbourhood whose majority counts, px.
BOX = 3
#: Edge of a patch, and of its inner part that the patch's majority decides, px.
PATCH, INNER = 16, 8


class ErrorHistogram:
    """A histogram of errors, of which a share stays when errors are added.

    Source: Sabour et al., "SpotLessSplats", and its code; RobustNeRF takes the
    quantile of the last batch, which is a decay of 0.
    """

    def __init__(self, decay: float, device: torch.device) -> None:
        self.decay = decay
        self.counts = torch.zeros(BINS, dtype=torch.float64, device=device)

    def add(self, errors: torch.Tensor) -> None:
        """Add errors of any shape; those above 1 fall into the last bin."""
        bins = (errors.flatten() * BINS).long().clamp(0, BINS - 1)
        self.counts = self.decay * self.counts + torch.bincount(bins, minlength=BINS)

    def quantile(self, share: float) -> float:
        """The upper edge of the bin that a share of the errors does not exceed."""
        total = self.counts.cumsum(0)
        if float(total[-1]) == 0.0:
            return 1.0
        index = int(torch.searchsorted(total, share * total[-1]))
        return min(index + 1, BINS) / BINS


def pixel_errors(image: torch.Tensor, target: torch.Tensor) -> torch.Tensor:
    """Mean absolute error over channels: (B, H, W) of two (B, H, W, C), without gradient."""
    return (image.detach() - target).abs().mean(dim=-1)


def find_inliers(
    errors: torch.Tensor, hand: torch.Tensor, threshold: float, *, box: bool, patch: bool
) -> torch.Tensor:
    """Judge the pixels of the hand by their errors and by those of their neighbours.

    A pixel is an inlier if its error is below the threshold, if most of its 3 x 3 neighbourhood
    is, or if it lies in the inner 8 x 8 px of a patch of 16 x 16 px of which most is. Only pixels
    of the hand are counted: the others are black in both images.

    Args:
        errors: (B, H, W) not negative.
        hand: (B, H, W) bool, the pixels that are judged.
        threshold: of the errors.
        box: whether the 3 x 3 neighbourhood counts.
        patch: whether the patches count.

    Returns:
        (B, H, W) bool; True outside the hand, where nothing is judged.

    Source: Sabour et al., "RobustNeRF", and its code, in which the patch's
    majority is over pixels below the threshold.
    """
    below = (errors < threshold) & hand
    inliers = below | ~hand
    if box:
        inliers = inliers | (_share(below, hand, BOX, 1, BOX // 2) > 0.5)
    if patch:
        height, width = errors.shape[1:]
        room = (0, -width % INNER, 0, -height % INNER)
        blocks = _share(pad(below, room), pad(hand, room), PATCH, INNER, (PATCH - INNER) // 2) > 0.5
        wide = blocks.repeat_interleave(INNER, dim=1).repeat_interleave(INNER, dim=2)
        inliers = inliers | wide[:, :height, :width]
    return inliers


def _share(
    below: torch.Tensor, hand: torch.Tensor, edge: int, stride: int, margin: int
) -> torch.Tensor:
    """Share of inliers among the pixels of the hand in each window; 0 where there is no hand."""
    both = torch.stack((below, hand), dim=1).float()
    counted, all_of_them = avg_pool2d(both, edge, stride, margin).unbind(1)
    return counted / all_of_them.clamp(min=1e-6)


#: Hidden units.
HIDDEN = 16
#: Frequencies of the positional encoding; each gives a sine and a cosine for x and for y.
FREQUENCIES = 20
#: Wavelengths of the oriented energies, px, and the number of their directions.
WAVELENGTHS, DIRECTIONS = (4.0, 8.0), 4
#: Features of a pixel's look (CIELAB and energies), and of its place (the encodings).
LOOK, PLACE = 3 + len(WAVELENGTHS) * DIRECTIONS, 4 * FREQUENCIES


def look_features(image: np.ndarray) -> np.ndarray:
    """Describe the look of each pixel of an image (H, W, 3) uint8: (H, W, LOOK) float32.

    CIELAB divided by 100; the energies of even and odd Gabor filters of the lightness, by
    wavelength and direction.
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


def make_network(inputs: int, seed: int, device: torch.device) -> dict[str, torch.Tensor]:
    """The tensors of a network with one hidden layer, for so many features of a pixel."""
    random = torch.Generator().manual_seed(seed)

    def uniform(*shape: int) -> torch.Tensor:
        values = 2.0 * torch.rand(*shape, generator=random) - 1.0
        return (values / math.sqrt(shape[-1])).to(device)

    return {
        "mask.in": uniform(HIDDEN, inputs),
        "mask.in_bias": torch.zeros(HIDDEN, device=device),
        "mask.out": uniform(1, HIDDEN),
        "mask.out_bias": torch.zeros(1, device=device),
    }


def chances(features: torch.Tensor, network: dict[str, torch.Tensor]) -> torch.Tensor:
    """The chance of each pixel to be an inlier: (...) of features (..., F)."""
    hidden = features @ network["mask.in"].T + network["mask.in_bias"]
    return (hidden.relu() @ network["mask.out"].T + network["mask.out_bias"]).sigmoid()[..., 0]


def vote_loss(
    chance: torch.Tensor, surely_in: torch.Tensor, maybe_in: torch.Tensor
) -> torch.Tensor:
    """Penalty of chances that contradict the errors.

    Args:
        chance: (P,) in [0, 1].
        surely_in: (P,) 1 where the lower threshold says inlier, else 0.
        maybe_in: (P,) 1 where the upper threshold says inlier, else 0.

    Source: Sabour et al., "SpotLessSplats", and its code.
    """
    return ((chance - maybe_in).relu() + (surely_in - chance).relu()).mean()


def steepness(network: dict[str, torch.Tensor]) -> torch.Tensor:
    """max |W1| max |W2|, which is small for a smooth network. Source: as `vote_loss`."""
    return network["mask.in"].abs().amax() * network["mask.out"].abs().amax()


class MaskNetwork:
    """The chance of a frame's pixels to be inliers, by a network that learns with the fit.

    Args:
        material: whose frames are described.
        places: whether the network sees where in the image a pixel is.

    Attributes:
        tensors: the weights that Adam fits, by name.
    """

    def __init__(self, material: FitInputs, *, places: bool) -> None:
        frames, device = material.frames, material.device
        self.tensors = make_network(LOOK + PLACE * places, material.seed, device)
        size = 4 * LOOK * frames.masks[0].numel()

        def describe(rows: torch.Tensor) -> torch.Tensor:
            looks = np.stack([look_features(image) for image in frames.images[rows].numpy()])
            return upload(torch.from_numpy(looks), device)

        self._looks = FrameTable(describe, len(frames), size, device)
        height, width = frames.masks.shape[1:]
        found = encodings(height, width) if places else np.empty((height, width, 0), np.float32)
        self._places = torch.from_numpy(found).to(device)

    def chances(self, batch: Batch, hand: torch.Tensor) -> torch.Tensor:
        """The chances (P,) of the pixels that `hand`, (B, H, W) bool, has; differentiable."""
        places = self._places.expand(*hand.shape, -1)
        features = torch.cat((self._looks(batch.rows)[hand], places[hand]), dim=-1)
        return chances(features, self.tensors)


def patch_likeness(image: torch.Tensor, target: torch.Tensor, edge: int) -> torch.Tensor:
    """How alike the patches around a pixel are in two images, whatever their brightness.

    The cosine of the angle between the patches as vectors of opponent colours: brightness,
    red-green and yellow-blue, the latter two doubled. Patches that are black in both are alike.

    Args:
        image: (B, H, W, 3) sRGB, whose gradient is not kept.
        target: as `image`.
        edge: of a patch, px, odd.

    Returns:
        (B, H, W) in [-1, 1].
    """
    opponent = image.new_tensor([[1 / 3, 1 / 3, 1 / 3], [2.0, -2.0, 0.0], [1.0, 1.0, -2.0]]).T
    x, y = image.detach() @ opponent, target @ opponent
    products = torch.stack([(u * v).sum(dim=-1) for u, v in ((x, y), (x, x), (y, y))], dim=1)
    xy, xx, yy = avg_pool2d(products, edge, 1, edge // 2).unbind(1)
    return (xy + 1e-6) / ((xx + 1e-6) * (yy + 1e-6)).sqrt()
