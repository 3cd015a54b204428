"""The colours that places take from the skin around them, which few frames have shown or none.

The network's colours of such places are nobody's: they began as the prior's and went where the
weights went that other places moved, which leaves blotches. What is known of the skin is carried on
to them as smoothly as can be.
"""

from __future__ import annotations

import functools
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from torch import Tensor

from wildghand.evidence import ColorChanges, kept_share
from wildghand.fitting.borrowed_colors import BorrowedColors
from wildghand.fitting.known_colors import changes_to, known_logits, log_linear
from wildghand.gaussians.regularizers import nearest_on_surface, rest_anchors
from wildghand.gaussians.rig import HandRig
from wildghand.model.model import WildGHandModel

# Neighbours of a Gaussian, and what a squared difference from one of them weighs against a squared
# change of a colour that is fully known.
_NEIGHBOURS, _SMOOTH = 8, 0.3
# Weight of the mean colour where nothing around is known either.
_MEAN = 1e-6


@dataclass(frozen=True, eq=False)
class FilledColors:
    """The colours that are known at the end of a fit, and how they are carried on."""

    #: What is read, with the colours that hands take from each other.
    model: WildGHandModel
    #: Those colours, and the clip.
    borrowed: BorrowedColors
    #: (N,) by side, how many training frames show each Gaussian.
    shown: Mapping[str, Tensor]
    #: Training frames that are fitted.
    frame_count: int

    def carried_on(self, shares: Sequence[float]) -> list[ColorChanges | None]:
        """All changes of colours, those of the model and those of places that are seldom shown.

        Args:
            shares: of the training frames that must show a place until its colour is half its own;
                0 leaves colours as they are.

        Returns:
            The changes for each share; those of the model for 0, and where there is no light under
            which colours compare.
        """
        light, before = self.model.light, self.model.color_changes
        if light is None or not any(share > 0.0 for share in shares):
            return [before] * len(shares)
        logits, levels = {}, {}
        for side in self.model.rigs:
            logits[side] = known_logits(self.model, self.borrowed.clip, side, light)
            change = 0.0 if before is None else before.changes[side].double().cpu().numpy()
            levels[side] = log_linear(logits[side] + change)
        device = self.model.log_gains.device
        return [
            changes_to(self._filled(levels, share), logits, device) if share > 0.0 else before
            for share in shares
        ]

    def rehearse(self) -> None:
        """Carry nothing on; it takes as long as a share of `carried_on`."""
        self._filled({side: np.zeros((len(rig), 3)) for side, rig in self.model.rigs.items()}, 1.0)

    def _filled(self, levels: Mapping[str, np.ndarray], share: float) -> dict[str, np.ndarray]:
        return {
            side: smooth_fill(self._roughness[side], values, self._known(side, share))
            for side, values in levels.items()
        }

    @functools.cached_property
    def _roughness(self) -> dict[str, Any]:
        return {side: roughness(rig) for side, rig in self.model.rigs.items()}

    def _known(self, side: str, share: float) -> np.ndarray:
        """(N,) in [0, 1), how far a Gaussian's colour is known, from either hand."""
        frames = self.shown[side].double().cpu()
        known: np.ndarray = kept_share(frames, share * self.frame_count).numpy()
        if self.borrowed.own:
            known = 1.0 - (1.0 - known) * (1.0 - self.borrowed.taken(side))
        return known


def roughness(rig: HandRig) -> Any:
    """(N, N) sparse form whose value is the sum of squared differences between neighbours.

    Args:
        rig: the hand and its N anchors.
    """
    from scipy.sparse import coo_array, diags_array

    near = nearest_on_surface(*rest_anchors(rig), _NEIGHBOURS)
    rows, places = np.nonzero(near >= 0)
    edges = coo_array((np.ones(len(rows)), (rows, near[rows, places])), shape=(len(rig), len(rig)))
    edges = 0.5 * (edges + edges.T)
    return diags_array(edges.sum(axis=1)) - edges


def smooth_fill(rough: Any, values: np.ndarray, known: np.ndarray) -> np.ndarray:
    """Carry values on from where they are known to where they are not.

    The filled values x are smooth and near what is known: they minimise the sum of known (x - v)^2
    + 0.3 roughness(x). A value keeps its own part as far as it is known, and takes the rest from x.

    Args:
        rough: see `roughness`.
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
