"""Biases of training frames, for a page that shows what the fit explained as perturbations.

The page draws the canonical hand. With these biases it draws the hand as the fit saw it in a
frame: what DPD's biases change after the activations, and the frame's gain. They are kept as
principal components over the frames, with the coefficients of every frame.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch

from wildghand.avatar import WildGHandAvatar
from wildghand.model.dress import Gaussians
from wildghand.page.bake import BakedHand
from wildghand.splat.threads import denormals_flushed

#: Numbers of a Gaussian: place at rest (3, m), colour (3, sRGB), opacity, log of the scale.
WIDTH = 8
# How much of each number the eye takes for about as much: 4 mm, a quarter of the colours.
_UNITS = np.array([0.004] * 3 + [0.25] * 3 + [0.25, 0.5])
# Frames that are posed together.
_CHUNK = 8


@dataclass(frozen=True, eq=False)
class FrameBiases:
    """Additions of F frames to the N Gaussians of a hand: the sum over k of c_fk basis_k."""

    #: (K, N, 8) int8.
    basis: np.ndarray
    #: (K, 8) by which the basis is multiplied.
    steps: np.ndarray
    #: (F, K).
    coefficients: np.ndarray

    def at(self, row: int) -> np.ndarray:
        """(N, 8) that frame number `row` of F adds."""
        scaled = self.coefficients[row][:, None] * self.steps
        return np.einsum("kc,knc->nc", scaled, self.basis)


@denormals_flushed()
@torch.no_grad()
def bake_biases(
    avatar: WildGHandAvatar,
    side: str,
    hand: BakedHand,
    frames: Sequence[int],
    motion: np.ndarray,
    rank: int,
) -> FrameBiases | None:
    """Bake the biases of some training frames; None where the avatar has none.

    Args:
        avatar: of the frames; it knows their biases.
        side: which of its hands.
        hand: this hand as it was baked.
        frames: F numbers of frames that were fitted.
        motion: (F, 51) their poses (48, rad) and translations (m).
        rank: components that are kept.
    """
    model = avatar.model
    if side not in model.perturbation or not len(frames) or rank < 1:
        return None
    known = {frame: row for row, frame in enumerate(avatar.record.frames)}
    # The wall of the wrist, which comes last, is not fitted.
    found = np.zeros((len(frames), len(hand), WIDTH), dtype=np.float32)
    count = len(model.rigs[side])
    for start in range(0, len(frames), _CHUNK):
        part = slice(start, start + _CHUNK)
        given = torch.as_tensor(motion[part], dtype=torch.float32, device=model.log_gains.device)
        rows = torch.tensor([known[frame] for frame in frames[part]], device=given.device)
        pose, transl = given[:, :48].reshape(-1, 16, 3), given[:, 48:]
        betas = torch.as_tensor(avatar.betas[side], dtype=torch.float32, device=given.device)
        refine = avatar.settings.heads.refinement
        clean, _ = model.gaussians(side, pose, betas, transl, refine=refine)
        biased, _ = model.gaussians(side, pose, betas, transl, refine=refine, rows=rows)
        found[part, :count] = _differences(clean, biased, len(pose))
        for row in range(len(pose)):
            linear, _ = hand.motions(pose[row].double().cpu().numpy(), np.zeros(3))
            places = found[start + row, :, :3, None]
            found[start + row, :, :3] = np.linalg.solve(linear, places)[..., 0]
    return _components(found / _UNITS.astype(np.float32), rank)


def _differences(clean: Gaussians, biased: Gaussians, count: int) -> np.ndarray:
    """(B, N, 8) of B frames; places in the world."""

    def number(a: torch.Tensor, b: torch.Tensor) -> torch.Tensor:
        return (b - a).expand(count, *torch.broadcast_shapes(a.shape, b.shape)[-2:])

    parts = [
        number(clean.means, biased.means),
        number(clean.colors, biased.colors),
        number(clean.opacities[..., None], biased.opacities[..., None]),
        number(
            clean.scales.log().mean(dim=-1, keepdim=True),
            biased.scales.log().mean(dim=-1, keepdim=True),
        ),
    ]
    return torch.cat(parts, dim=-1).cpu().numpy()


def _components(values: np.ndarray, rank: int) -> FrameBiases:
    """Principal components, about zero, of (F, N, 8) values in units of `_UNITS`."""
    flat = values.reshape(len(values), -1)
    power, vectors = np.linalg.eigh((flat @ flat.T).astype(np.float64))
    order = np.argsort(power)[::-1][:rank]
    order = order[power[order] > 1e-9 * max(float(power.max()), 1e-30)]
    roots = np.sqrt(power[order])
    components = (flat.T @ (vectors[:, order] / roots)).T.reshape(len(order), *values.shape[1:])
    peaks = np.abs(components).max(axis=1, initial=1e-30)
    whole = np.rint(components / peaks[:, None] * 127.0).astype(np.int8)
    return FrameBiases(whole, peaks / 127.0 * _UNITS, vectors[:, order] * roots)
