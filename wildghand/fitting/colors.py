"""Colours of places that frames do not show well: before the fit, and after it.

Before it, the identity map starts from the frames' colours where no skin has these (`StartColors`).
After it, places that few frames have shown take the colours of the skin around them and of the
same place of the other hand (`FilledColors`), compared under the light that the clip shows, as
logarithms of linear light.
"""

from __future__ import annotations

import functools
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from torch import Tensor

from hwp_bench.base.colors import linear_to_srgb, srgb_to_linear
from wildghand.fitting.fit import Component, Fit
from wildghand.fitting.light import Lighting, best_of_each_part
from wildghand.gaussians.attributes import CHANNELS, SIZES
from wildghand.gaussians.quaternions import quat_third_axis
from wildghand.gaussians.regularizers import nearest_on_surface, rest_anchors
from wildghand.gaussians.rig import HandRig
from wildghand.gaussians.training import TrainingClip
from wildghand.light import KnownLight
from wildghand.light.light import ring_around
from wildghand.model.model import WildGHandModel
from wildghand.network.surface import Chart, PlaneSampler
from wildghand.visibility import ColorChanges, kept_share
from wildghand.visibility.count import read_images, seen_anchors

#: Frames that are read, spread over the clip: of each part the one that the pre-pass weighs most.
FRAMES = 16
#: Distance of the tint from the network's, in logits of sRGB, at which the frames' colour begins to
#: count, and at which it counts fully.
FROM, FULL = 0.3, 0.5
# Corrections of the map one after the other, and the share of the difference that each takes.
_ROUNDS, _SHARE = 3, 0.8
# Views with which a Gaussian has half of its weight among those of a texel.
_VIEWS = 0.5
# Weight of a cell of the map below which it keeps what it has.
_CELL = 0.02
# sRGB nearer to 0 or 1 says nothing in logits; nor do larger differences.
_END, _FARTHEST = 0.01, 3.0
_COLORS = slice(CHANNELS - SIZES["logit_colors"], CHANNELS)
# Normals at which colours are read: the axis of the cap that the light knows, and so many around it
# at this share of the cap's angle.
_RING, _INSIDE = 4, 0.6
# sRGB nearer to 0 or 1, linear light below this, and logits beyond say nothing.
_EDGE, _DARKEST, _WHITE = 0.005, 1e-3, 12.0
# A colour that is somebody's is better than none: it takes so much less to be lent.
_LENT = 0.25
_OTHER = {"left": "right", "right": "left"}
# Neighbours of a Gaussian, and what a squared difference from one of them weighs against a squared
# change of a colour that is fully known.
_NEIGHBOURS, _SMOOTH = 8, 0.3
# Weight of the mean colour where nothing around is known either.
_MEAN = 1e-6


class StartColors(Component):
    """Colours that skin does not have are read from the frames before the first step.

    The prior knows skin. From there it takes hundreds of steps to the palm of a green glove that
    few frames show, and a short fit ends on the way. So where the frames show a tint that is far
    from what the network says, the identity map starts from theirs. Differences in brightness are
    left alone: they are light too, which the network has to tell from colour.
    """

    def before(self, fit: Fit) -> None:
        """Move the identity map."""
        start_from_colors(fit)


@dataclass(eq=False)
class FilledColors:
    """The colours that places take which few frames have shown or none.

    The network's colours of such places are unconstrained: they began as the prior's and followed
    the weights that other places moved, which leaves blotches. Both hands of a person look alike:
    what is known of the same place of the other hand comes first. Then what is known of the skin is
    carried on as smoothly as can be.
    """

    #: Of one or two hands.
    fit: Fit
    #: (N,) by side, how many training frames show each Gaussian.
    shown: Mapping[str, Tensor]
    #: (N,) bool by side, those amid skin that none shows.
    unseen: Mapping[str, Tensor]

    def carried_on(self, shares: Sequence[float]) -> list[ColorChanges | None]:
        """The changes of colours for some values of `visibility.fill_share`; None: nothing changes.

        With a share of 0 the skin around a place counts only if no frame shows the place; the other
        hand counts always. Colours are compared at normals that the clip's light knows; without one
        none change.
        """
        model, clip, light = self.fit.model, self.fit.clip, self.fit.model.light
        if light is None or not self.fit.settings.visibility.fill_share:
            return [None] * len(shares)
        own = {side: known_colors(model, clip, side, light) for side in model.rigs}
        levels = {side: colors.levels() for side, colors in own.items()}
        return [
            changes_to(self._filled(levels, share), own, self.fit.device)
            if share > 0.0 or self._joined or any(bool(each.any()) for each in self.unseen.values())
            else None
            for share in shares
        ]

    def rehearse(self) -> None:
        """Carry nothing on; it takes as long as a share of `carried_on`."""
        rigs = self.fit.model.rigs
        self._filled({side: np.zeros((len(rig), 3)) for side, rig in rigs.items()}, 1.0)

    @property
    def _joined(self) -> bool:
        return len(self.fit.model.rigs) == 2 and self.fit.settings.visibility.other_hand

    def _filled(self, levels: Mapping[str, np.ndarray], share: float) -> dict[str, np.ndarray]:
        half = (share or self.fit.settings.visibility.fill_share) * len(self.fit.data.frames)
        found = {}
        for side, values in levels.items():
            known = self._kept(side, half)
            if self._joined:
                other = _OTHER[side]
                taken = (1.0 - known) * self._kept(other, _LENT * half)
                values = values + taken[:, None] * (levels[other] - values)
                known = 1.0 - (1.0 - known) * (1.0 - taken)
            if not share:
                known = np.where(self.unseen[side].cpu(), known, 1.0)
            filled = bool(share) or known.min() < 1.0
            found[side] = smooth_fill(self._roughness[side], values, known) if filled else values
        return found

    def _kept(self, side: str, half: float) -> np.ndarray:
        """(N,) in [0, 1), how well the colours of a hand are known."""
        shown = torch.where(self.unseen[side], 0.0, self.shown[side])
        return np.asarray(kept_share(shown.double().cpu(), half))

    @functools.cached_property
    def _roughness(self) -> dict[str, Any]:
        return {side: roughness(rig) for side, rig in self.fit.model.rigs.items()}


@torch.no_grad()
def start_from_colors(fit: Fit) -> None:
    """Move the identity map to the frames' colours where their tint is far from the network's.

    The shadows and the light are taken out of the colours. Nothing is random. A network without a
    direct path from map to attributes stays as it is.
    """
    model, clip, data, cast = fit.model, fit.clip, fit.data, fit.part(Lighting)
    direct = model.network.attribute_head.direct
    if direct is None:
        return
    rows = best_of_each_part(data.judgement.frame_weights, FRAMES)
    says = data.visible(rows)
    images = data.frames.images[rows].to(says.device).float() / 255.0
    here = rows.to(says.device)
    hands = {side: clip.hand(side, here) for side in model.rigs}
    seen = seen_anchors(hands, clip.viewmats[here], clip.Ks[here], says.shape[1:])
    shadows = {} if cast is None else cast.dark(rows)
    to_map = torch.linalg.pinv(direct.weight[_COLORS, _COLORS])
    for side, (pixels, facing) in seen.items():
        views = read_images(says, pixels) * facing
        shown = [read_images(images[..., channel].contiguous(), pixels) for channel in range(3)]
        normals, poses = quat_third_axis(hands[side].orientations), clip.parameters[side][0][here]
        wanted = _logits(torch.stack(shown, dim=-1) / _lit(model, normals, shadows.get(side)))
        chart = model.network.charts[side]
        assert isinstance(chart, Chart)
        share = None
        for _ in range(_ROUNDS):
            made = model.network(side, normals, poses)
            drawn = _logits(made.raw.logit_colors.sigmoid() * made.shadow)
            off = _mean((wanted - drawn).clamp(-_FARTHEST, _FARTHEST), views)
            share = tint_share(off) if share is None else share
            trust = views.sum(dim=0) / (views.sum(dim=0) + _VIEWS)
            change = share * off @ to_map.mT
            step = _spread(
                chart.identity, torch.cat((change, torch.ones_like(share)), dim=1), trust
            )
            model.network.identity.maps[side][:, _COLORS] += _SHARE * step


def tint_share(off: Tensor) -> Tensor:
    """(N, 1) in [0, 1], how far colours that differ by (N, 3) are not skin: by their tint alone."""
    tint = (off - off.mean(dim=-1, keepdim=True)).norm(dim=-1, keepdim=True)
    return ((tint - FROM) / (FULL - FROM)).clamp(0.0, 1.0)


def _lit(model: WildGHandModel, normals: Tensor, dark: Tensor | None) -> Tensor:
    """(B, N, 1) factors of light and shadows on colours of (B, N) places."""
    lit = torch.ones_like(normals[..., 0]) if dark is None else dark
    return (lit if model.shadows is None else lit * model.shadows.shading(normals))[..., None]


def _logits(colors: Tensor) -> Tensor:
    return torch.logit(colors.clamp(_END, 1.0 - _END))


def _mean(values: Tensor, weights: Tensor) -> Tensor:
    """(N, C) mean over B frames of (B, N, C), weighted by (B, N); 0 without any weight."""
    sums = (weights[..., None] * values).sum(dim=0)
    return sums / weights.sum(dim=0).clamp(min=1e-6)[:, None]


def _spread(sampler: PlaneSampler, values: Tensor, weights: Tensor) -> Tensor:
    """(cells, C) weighted means in the cells of a plane of what Gaussians ask of it.

    Args:
        values: (N, C + 1), the last one 1.
        weights: (N,) in [0, 1].
    """
    asked = sampler.transposed(values * weights[:, None])
    return asked[:, :-1] / (asked[:, -1:] + _CELL)


@dataclass(frozen=True, eq=False)
class KnownColors:
    """Colours of the N Gaussians of a hand: means over normals and poses that a clip knows."""

    #: (N, 3) logits of sRGB, which `ColorChanges` change.
    logits: np.ndarray
    #: (N, 1) the network's shadow coefficients, by which the colours are multiplied.
    shadow: np.ndarray

    def levels(self, change: np.ndarray | float = 0.0) -> np.ndarray:
        """(N, 3) logarithms of linear light, after a change of the logits."""
        srgb = self.shadow / (1.0 + np.exp(-(self.logits + change)))
        return np.log(np.clip(srgb_to_linear(srgb), _DARKEST, 1.0))

    def change_to(self, levels: np.ndarray) -> np.ndarray:
        """(N, 3) change of the logits that leads to other levels."""
        # The shadow cannot be changed: a colour that is nearly white under a dark shadow needs a
        # larger change than their product.
        srgb = (linear_to_srgb(np.exp(levels)) / self.shadow).clip(_EDGE, 1.0 - _EDGE)
        return np.asarray(np.log(srgb / (1.0 - srgb)) - self.logits)


@torch.no_grad()
def known_colors(
    model: WildGHandModel, clip: TrainingClip, side: str, light: KnownLight
) -> KnownColors:
    """Mean colours of a hand over the normals that a light knows, and over poses of the clip."""
    poses = clip.parameters[side][0]
    normals = known_normals(light).to(poses)
    rows = torch.linspace(0, len(poses) - 1, len(normals)).long().to(poses.device)
    spread = normals[:, None].expand(-1, len(model.rigs[side]), 3).contiguous()
    made = model.network(side, spread, poses[rows], model.network.features(side))
    logits = made.raw.logit_colors.clamp(-_WHITE, _WHITE).mean(dim=0)
    shadow = made.shadow.clamp(min=_EDGE).log().mean(dim=0).exp()
    return KnownColors(logits.double().cpu().numpy(), shadow.double().cpu().numpy())


def known_normals(light: KnownLight) -> Tensor:
    """(5, 3) normals of the cap that a light knows: its axis, and four around it."""
    axis = light.axis.double().cpu().numpy()
    axis = axis / max(float(np.linalg.norm(axis)), 1e-6)
    angle = _INSIDE * math.acos(max(-1.0, min(1.0, float(light.cosine))))
    return torch.from_numpy(np.concatenate([axis[None], ring_around(axis, angle, _RING)])).float()


def changes_to(
    levels: Mapping[str, np.ndarray], own: Mapping[str, KnownColors], device: torch.device
) -> ColorChanges:
    """Return the changes that turn the own colours into others.

    Args:
        levels: (N, 3) by side, the wanted colours as logarithms of linear light.
        own: by side.
    """
    changes = {side: own[side].change_to(aim) for side, aim in levels.items()}
    return ColorChanges(
        {
            side: torch.as_tensor(change, dtype=torch.float32, device=device)
            for side, change in changes.items()
        }
    )


def neighbours(rig: HandRig) -> np.ndarray:
    """(N, 8) int64, the nearest Gaussians on the skin of the resting hand; -1: there are fewer."""
    return nearest_on_surface(*rest_anchors(rig), _NEIGHBOURS)


def roughness(rig: HandRig) -> Any:
    """(N, N) sparse form whose value is the sum of squared differences between neighbours."""
    from scipy.sparse import coo_array, diags_array

    near = neighbours(rig)
    rows, places = np.nonzero(near >= 0)
    edges = coo_array((np.ones(len(rows)), (rows, near[rows, places])), shape=(len(rig), len(rig)))
    edges = 0.5 * (edges + edges.T)
    return diags_array(edges.sum(axis=1)) - edges


def smooth_fill(rough: Any, values: np.ndarray, known: np.ndarray) -> np.ndarray:
    """Carry values on from where they are known to where they are not.

    The filled values x are smooth and near what is known: they minimise the sum of known (x - v)^2
    + 0.3 roughness(x). A value keeps its own part where it is known, and takes the rest from x.

    Args:
        values: (N, C).
        known: (N,) in [0, 1].

    Returns:
        (N, C); the values themselves where nothing is known at all.
    """
    from scipy.sparse import diags_array
    from scipy.sparse.linalg import splu

    if known.sum() <= 0.0:
        return values
    system = diags_array(known + _MEAN) + _SMOOTH * rough
    mean = known @ values / known.sum()
    found = splu(system.tocsc()).solve(known[:, None] * (values - mean)) + mean
    return np.asarray(known[:, None] * values + (1.0 - known)[:, None] * found)
