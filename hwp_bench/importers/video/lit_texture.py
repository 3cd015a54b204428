"""The colours of a hand over a clip, and the light of each frame."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from hwp_bench.base.colors import COUNT, harmonics
from hwp_bench.hands import HandTemplate
from hwp_bench.importers.shared.row_products import row_products
from hwp_bench.importers.video.atlas import Atlas, sample

# Edge of the map, texels; twice as many change nothing.
_EDGE = 256
#: Added to colours before the logarithm: noise of dark pixels counts less.
DARK = 0.04
# Logarithm of a colour: a frame that differs by more counts less.
_ODD = 0.1
# Weight of no light of its own, as a share of the frame's texels.
_RIDGE = 0.02
# Weight of the mean colour at each texel, in frames that show it from the front.
_COMMON = 0.5
# Frames from the front that a texel must have been seen in to count fully.
_ENOUGH = 2.0
# Turns of light and colours, at first and each time after that.
_FIRST_TURNS, _LATER_TURNS = 4, 2


@dataclass(frozen=True, eq=False)
class SeenTexels:
    """The texels that a frame shows, T of them.

    Attributes:
        texels: (T,) int32, their numbers.
        logs: (T, 3) logarithms of colours in [0, 1], with `DARK` added before.
        normals: (T, 3) unit, camera axes.
        weights: (T,) in [0, 1].
    """

    texels: np.ndarray
    logs: np.ndarray
    normals: np.ndarray
    weights: np.ndarray


class LitTexture:
    """A colour at each texel, and for each frame a gain that is a function of the normal.

    In logarithms of sRGB both are sums, and each follows from the other by weighted means and
    small least squares. A shadow that the hand casts on itself is in neither.

    Args:
        template: the hand, with its texture coordinates.
        frames: of the clip.
    """

    def __init__(self, template: HandTemplate, frames: int) -> None:
        self.atlas = Atlas(template, _EDGE)
        self._light = np.zeros((frames, COUNT, 3))
        self._colors: np.ndarray | None = None

    def fit(self, seen: Mapping[int, SeenTexels]) -> None:
        """Fit colours and light to frames; what an earlier call found is the start.

        Args:
            seen: by frame, at least one.
        """
        turns = _LATER_TURNS
        if self._colors is None:
            turns = _FIRST_TURNS
            total = sum(float(frame.weights.sum()) for frame in seen.values())
            common = sum(frame.weights @ frame.logs for frame in seen.values()) / max(total, 1e-9)
            self._colors = np.tile(common, (len(self.atlas), 1))
        for _ in range(turns):
            self._turn(seen)
        self._map = self.atlas.drawn(self._colors)
        self._known = self.atlas.drawn_weights(np.minimum(self._count / _ENOUGH, 1.0))

    def expected(
        self, frame: int, face: np.ndarray, mix: np.ndarray, normals: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray]:
        """Colours of points of the surface in the light of a frame.

        Args:
            frame: which frame.
            face: (P,) which face each point is on.
            mix: (P, 2) barycentric coordinates as `draw_faces` returns them.
            normals: (P, 3) unit, camera axes.

        Returns:
            (P, 3) sRGB in [0, 1], and (P,) how well the colours are known, in [0, 1].
        """
        places = self.atlas.places(face, mix)
        logs = sample(self._map, places) + harmonics(normals) @ self._light[frame]
        return np.clip(np.exp(logs) - DARK, 0.0, 1.0), sample(self._known, places)

    def _turn(self, seen: Mapping[int, SeenTexels]) -> None:
        """Fit the light of each frame to the colours, and then the colours to all frames."""
        assert self._colors is not None
        count = len(self.atlas)
        total, weight = np.zeros((count, 3)), np.zeros(count)
        for frame, shown in seen.items():
            basis, colors = harmonics(shown.normals), self._colors[shown.texels]
            trust = _trust(shown, shown.logs - colors - basis @ self._light[frame])
            moment = (basis * trust[:, None]).T
            normal = moment @ basis + (_RIDGE * trust.sum() + 1e-9) * np.eye(COUNT)
            self._light[frame] = np.linalg.solve(normal, moment @ (shown.logs - colors))
            unlit = shown.logs - basis @ self._light[frame]
            trust = _trust(shown, unlit - colors)
            weight += np.bincount(shown.texels, trust, minlength=count)
            for channel in range(3):
                part = trust * unlit[:, channel]
                total[:, channel] += np.bincount(shown.texels, part, minlength=count)
        common = total.sum(axis=0) / max(float(weight.sum()), 1e-9)
        self._colors = (total + _COMMON * common) / (weight + _COMMON)[:, None]
        self._count = weight


def _trust(shown: SeenTexels, error: np.ndarray) -> np.ndarray:
    return np.asarray(shown.weights / (1.0 + row_products(error, error) / (3.0 * _ODD**2)))
