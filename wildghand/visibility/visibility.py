"""Gaussians become opaque discs on the skin, the more so the less the frames show them.

An offset from the skin moves a Gaussian along the line of sight too, where a single direction shows
nothing of it; from elsewhere it is at the wrong place. Its shape is as uncertain. The maximum of a
Gaussian likelihood of n frames and a prior that weighs as much as k of them keeps n / (n + k) of
what the frames say, and the rest of the prior: no offset, and a disc that closes the skin.

Colours change too, where the other hand or the skin around a place says more of it than frames do.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Annotated, ClassVar

import torch
from torch import Tensor
from torch.nn.functional import normalize

from hwp_bench.methods.settings import number
from wildghand.gaussians.attributes import RawAttributes
from wildghand.gaussians.found import Found, Kept, read_tensor
from wildghand.visibility.count import FACING


@dataclass(frozen=True)
class VisibilitySettings:
    """How much visibility outweighs that a Gaussian is an opaque disc on the skin."""

    #: Draw free poses with Gaussians that are the more discs on the skin, the fewer frames have
    #: shown them.
    enabled: bool = True
    #: Share of the training frames that must show a Gaussian until half of its offset from the skin
    #: is kept.
    offset_share: float = number(0.08, 0.0, 100.0)
    #: Share of the training frames that must show a place until its colour is half its own; the
    #: rest is that of the skin around it and of the other hand. 0: all of it is its own.
    fill_share: float = number(0.02, 0.0, 100.0)
    #: The same place of the other hand says as well what colour a place has.
    other_hand: bool = True

    #: Share of the training frames that must show a Gaussian until half of its shape and
    #: transparency is kept: an image says more of these than of an offset.
    shape_share: ClassVar[float] = 0.002


_WALLS = "visibility_wall_"
# The disc: standard deviations along the skin and across it, in spacings of the anchors, and its
# opacity before the sigmoid. Anchors are not even: narrower discs leave gaps.
_WIDE, _THIN, _OPAQUE = 0.9, 0.2, 4.0


@dataclass(frozen=True, eq=False)
class Visibility(Found):
    """The share of what a fit has found that is kept of each Gaussian, in [0, 1]."""

    prefix = "visibility_"
    #: (N,) by side, of the offset.
    offsets: Annotated[Mapping[str, Tensor], Kept(("N",), 0.0, 1.0)]
    #: (N,) by side, of scales, orientation and transparency.
    shapes: Annotated[Mapping[str, Tensor], Kept(("N",), 0.0, 1.0)]
    #: Sides whose open wrist is drawn without the wall that closes it.
    open_wrists: frozenset[str] = frozenset()

    def settle(
        self,
        side: str,
        raw: RawAttributes,
        spacing: float,
        log_scale_bias: float,
        behind: Tensor | None = None,
    ) -> RawAttributes:
        """Bring Gaussians nearer to discs on the skin, by what is missing of the visibility.

        Args:
            spacing: mean distance between neighbouring anchors, m.
            behind: see `behind`; None: discs from everywhere.
        """
        kept, shape = self.offsets[side], self.shapes[side]
        if behind is not None:
            # All of an offset is kept already where a fit keeps offsets as they were learnt.
            kept, shape = torch.maximum(kept, behind), torch.maximum(shape, behind)
        kept, shape = kept[..., None], shape[..., None]
        disc = raw.log_scales.new_tensor([_WIDE, _WIDE, _THIN]).mul(spacing).log() - log_scale_bias
        # A quaternion and its negative turn alike: the one near the identity is the shorter way.
        quats = normalize(raw.quats, dim=-1)
        quats = torch.where(quats[..., :1] < 0.0, -quats, quats)
        upright = quats.new_tensor([1.0, 0.0, 0.0, 0.0])
        opaque = raw.logit_opacities.clamp(min=_OPAQUE)
        return RawAttributes(
            offsets=kept * raw.offsets,
            log_scales=disc + shape * (raw.log_scales - disc),
            quats=upright + shape * (quats - upright),
            logit_opacities=opaque + shape * (raw.logit_opacities - opaque),
            logit_colors=raw.logit_colors,
        )

    def behind(self, side: str, facing: Tensor) -> Tensor:
        """(B, N) in [0, 1], how far Gaussians of skin that no frame shows are as they were learnt.

        They are discs in their changed colours only where the skin faces the camera: training
        frames have shown them from behind. 0 for all other Gaussians.

        Args:
            facing: (B, N) cosine between the skin's normal and the direction to the camera.
        """
        unseen = (self.shapes[side] <= 0.0).to(facing)
        return unseen * (1.0 - (facing / FACING).clamp(0.0, 1.0))

    def shown(self, side: str) -> Tensor:
        """(N,) in [0, 1], how well frames show Gaussians: the share of the offsets, 0 if unseen."""
        return self.offsets[side] * (self.shapes[side] > 0.0)

    def spare(self, chosen: Mapping[str, Tensor]) -> Visibility:
        """Keep all of some Gaussians.

        Args:
            chosen: (N,) bool by side, which.
        """
        return self._with(chosen, 1.0)

    def spare_all(self) -> Visibility:
        """Keep all of all Gaussians."""
        return self.spare({side: torch.ones_like(share) > 0 for side, share in self.shapes.items()})

    def without(self, unseen: Mapping[str, Tensor]) -> Visibility:
        """Keep nothing of some Gaussians, those of skin that no frame shows.

        Args:
            unseen: (N,) bool by side, which.
        """
        return self._with(unseen, 0.0)

    def _with(self, chosen: Mapping[str, Tensor], share: float) -> Visibility:
        def changed(shares: Mapping[str, Tensor]) -> dict[str, Tensor]:
            return {
                side: values.masked_fill(chosen[side], share) for side, values in shares.items()
            }

        return replace(self, offsets=changed(self.offsets), shapes=changed(self.shapes))

    def to_tensors(self) -> dict[str, Tensor]:
        """The shares, and whether a cap closes each wrist (1,), as an avatar keeps them."""
        walls = {
            f"{_WALLS}{side}": shares.new_tensor([float(side not in self.open_wrists)])
            for side, shares in self.shapes.items()
        }
        return {**super().to_tensors(), **walls}

    @classmethod
    def from_tensors(
        cls, tensors: Mapping[str, Tensor], where: str, **sizes: int | Mapping[str, int]
    ) -> Visibility | None:
        """Read what `to_tensors` made; see `Found.from_tensors`."""
        found = super().from_tensors(tensors, where, **sizes)
        if found is None:
            return None
        walls = {
            side: read_tensor(tensors, f"{_WALLS}{side}", (1,), (0.0, 1.0), where)
            for side in found.shapes
        }
        return replace(found, open_wrists=frozenset(s for s, wall in walls.items() if wall <= 0.5))


def weigh_visibility(
    shown: Mapping[str, Tensor], count: int, settings: VisibilitySettings
) -> Visibility:
    """The shares that follow from how many frames show each Gaussian.

    Frames of a clip that follow one another show the same, so that what counts is their share.

    Args:
        shown: (N,) frames by side.
    """

    def shares(half: float) -> dict[str, Tensor]:
        return {side: kept_share(frames, half) for side, frames in shown.items()}

    return Visibility(shares(settings.offset_share * count), shares(settings.shape_share * count))


def kept_share(frames: Tensor, half: float) -> Tensor:
    """The weight n / (n + half) of n frames against a prior; ones without a prior.

    Args:
        frames: (N,) n of each Gaussian.
    """
    if half <= 0.0:
        return torch.ones_like(frames)
    return frames / (frames + half).clamp(min=1e-12)


def strengths(settings: VisibilitySettings) -> list[VisibilitySettings]:
    """The strengths among which validation frames choose, the settings' own first.

    The others are a quarter and four times of its `offset_share`, and offsets as they were learnt.
    """
    share = settings.offset_share
    return [settings, *(replace(settings, offset_share=factor * share) for factor in (0.25, 4, 0))]


def fill_shares(settings: VisibilitySettings) -> list[float]:
    """The values of `fill_share` among which validation frames choose, the settings' own first.

    The others are five times as much, and colours as they were learnt.
    """
    own = settings.fill_share
    return [own, 5.0 * own, 0.0] if own > 0.0 else [0.0]


_PREFIX = "color_changes_"
# Largest change of a colour that is read, in logits.
_LARGEST = 20.0


@dataclass(frozen=True, eq=False)
class ColorChanges(Found):
    """Changes of the colours of Gaussians, in logits of sRGB."""

    prefix = _PREFIX
    #: (N, 3) by side.
    changes: Annotated[Mapping[str, Tensor], Kept(("N", 3), -_LARGEST, _LARGEST, name="")]

    def color(self, side: str, raw: RawAttributes, behind: Tensor | None = None) -> RawAttributes:
        """Gaussians in their changed colours.

        Args:
            behind: (B, N) how far each is as it was learnt (`Visibility.behind`); None: not at all.
        """
        changes = self.changes[side]
        if behind is not None:
            changes = changes * (1.0 - behind)[..., None]
        return replace(raw, logit_colors=raw.logit_colors + changes)
