"""The plain fit without pixels whose error is among the largest."""

from __future__ import annotations

import math
from dataclasses import dataclass

import cv2
import numpy as np
import torch
from torch.nn.functional import avg_pool2d, pad

from hwp_bench.methods.settings import choice, number
from wildghand.gaussians.training import FrameTable, upload
from wildghand.plain.recipe import Batch, Drawing, FitInputs, FitSettings, PlainRecipe, RecipeMethod

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
    of the hand are counted: the others are black in both images, so they say nothing.

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


def chance_of_all(fraction: float, schedule_steps: float) -> float:
    """The share alpha of pixels that are kept whatever their error; it falls from 1 to 0.

    Args:
        fraction: share of the fit that is done, in [0, 1).
        schedule_steps: steps of the published schedule that the whole fit stands for; 0 gives 0.

    Returns:
        exp(-0.003 floor((1 + step) / 1.5)) at the published schedule's step.

    Source: the code of SpotLessSplats.
    """
    if schedule_steps == 0.0:
        return 0.0
    return math.exp(-3e-3 * math.floor((1.0 + fraction * schedule_steps) / 1.5))


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


def make_network(seed: int, device: torch.device) -> dict[str, torch.Tensor]:
    """The tensors of a network with one hidden layer."""
    random = torch.Generator().manual_seed(seed)

    def uniform(*shape: int) -> torch.Tensor:
        values = 2.0 * torch.rand(*shape, generator=random) - 1.0
        return (values / math.sqrt(shape[-1])).to(device)

    return {
        "vote.in": uniform(HIDDEN, FEATURES),
        "vote.in_bias": torch.zeros(HIDDEN, device=device),
        "vote.out": uniform(1, HIDDEN),
        "vote.out_bias": torch.zeros(1, device=device),
    }


def chances(features: torch.Tensor, network: dict[str, torch.Tensor]) -> torch.Tensor:
    """The chance of each pixel to be an inlier: (...) of features (..., FEATURES)."""
    hidden = features @ network["vote.in"].T + network["vote.in_bias"]
    return (hidden.relu() @ network["vote.out"].T + network["vote.out_bias"]).sigmoid()[..., 0]


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
    steepness = network["vote.in"].abs().amax() * network["vote.out"].abs().amax()
    return wrong.mean() + smoothness * steepness


@dataclass(frozen=True)
class TrimmedSettings(FitSettings):
    """Those of the plain fit, and how outliers are found."""

    #: Who says which pixels are inliers: `rules` (threshold and neighbourhoods), or `vote` (a
    #: network of the image's features that learns from the rules).
    inliers: str = choice("rules", "vote")
    #: Share of the hand's pixels below the threshold, of all recent errors.
    quantile: float = number(0.7, 0.0, 1.0)
    #: Share of the histogram of errors that stays at each step.
    decay: float = number(0.95, 0.0, 1.0)
    #: Whether a pixel counts whose 3 x 3 neighbours are mostly inliers.
    box: bool = True
    #: Whether the inner 8 x 8 px of a patch of 16 x 16 px count if most of the patch does.
    patch: bool = True
    #: Steps of the published schedule that the whole fit stands for; 0 trims from the start.
    schedule_steps: float = number(3_000.0, 0.0, 1e9)
    #: `vote`: share of errors below which a pixel is surely an inlier.
    sure_inlier: float = number(0.5, 0.0, 1.0)
    #: `vote`: share of errors above which a pixel is surely an outlier.
    sure_outlier: float = number(0.9, 0.0, 1.0)
    #: `vote`: Adam step of the network; it does not fall.
    vote_rate: float = 1e-3
    #: `vote`: weight of max |W1| max |W2|, which keeps the network smooth.
    smoothness: float = number(0.5, 0.0, 1e6)


class TrimmedRecipe(PlainRecipe[TrimmedSettings]):
    """See `PlainRecipe`. Weights are multiplied by draws from the chance of being an inlier.

    Attributes:
        histogram: of the errors of recent frames.
        network: what `vote` fits; empty with `rules`.
    """

    def __init__(self, material: FitInputs, settings: TrimmedSettings) -> None:
        super().__init__(material, settings)
        device = material.device
        self.histogram = ErrorHistogram(settings.decay, device)
        self.network = make_network(material.seed, device) if settings.inliers == "vote" else {}
        self._random = torch.Generator().manual_seed(material.seed)
        frames = material.frames
        size = 4 * LOOK * frames.masks[0].numel()
        self._looks = FrameTable(self._describe, len(frames), size, device)
        self._places = torch.from_numpy(encodings(*frames.masks.shape[1:])).to(device)
        self._network_loss: torch.Tensor | None = None

    def parameters(self) -> dict[str, torch.Tensor]:
        """The plain fit's, and the network's."""
        return {**super().parameters(), **self.network}

    def rate(self, name: str, fraction: float) -> float:
        """Adam's step of a tensor; that of the network does not fall."""
        if name in self.network:
            return self.settings.vote_rate
        return super().rate(name, fraction)

    def weights(self, batch: Batch, drawing: Drawing) -> torch.Tensor:
        """The plain fit's, times 0 or 1."""
        weights = super().weights(batch, drawing)
        errors, hand = pixel_errors(drawing.image, batch.images), batch.masks > 0.5
        if self.network:
            inliers = self._vote(batch, errors, hand)
        else:
            inliers = self._judge(errors, hand, self.settings.quantile).float()
        self.histogram.add(errors[hand])
        alpha = chance_of_all(batch.fraction, self.settings.schedule_steps)
        draws = torch.rand(errors.shape, generator=self._random).to(errors.device)
        return weights * (draws < alpha + (1.0 - alpha) * inliers)

    def loss(self, batch: Batch, drawing: Drawing, weights: torch.Tensor) -> torch.Tensor:
        """The plain fit's, and the network's own."""
        loss = super().loss(batch, drawing, weights)
        return loss if self._network_loss is None else loss + self._network_loss

    def _judge(self, errors: torch.Tensor, hand: torch.Tensor, share: float) -> torch.Tensor:
        settings = self.settings
        threshold = self.histogram.quantile(share)
        return find_inliers(errors, hand, threshold, box=settings.box, patch=settings.patch)

    def _vote(self, batch: Batch, errors: torch.Tensor, hand: torch.Tensor) -> torch.Tensor:
        """Ask the network for the chances of the hand's pixels, and keep what it has to learn."""
        settings = self.settings
        places = self._places.expand(*hand.shape, -1)
        features = torch.cat((self._looks(batch.rows)[hand], places[hand]), dim=-1)
        chance = chances(features, self.network)
        surely = self._judge(errors, hand, settings.sure_inlier)[hand].float()
        maybe = self._judge(errors, hand, settings.sure_outlier)[hand].float()
        self._network_loss = vote_loss(chance, surely, maybe, self.network, settings.smoothness)
        found = torch.ones_like(errors)
        found[hand] = chance.detach()
        return found

    def _describe(self, rows: torch.Tensor) -> torch.Tensor:
        """The looks of the pixels of some frames, (B, H, W, LOOK)."""
        images = self.material.frames.images[rows].numpy()
        described = torch.from_numpy(np.stack([look_features(image) for image in images]))
        return upload(described, self.material.device)


class TrimmedMethod(RecipeMethod):
    """The plain fit without pixels that fit badly."""

    name = "baselines/trimmed"
    settings_type = TrimmedSettings
    recipe_type = TrimmedRecipe
