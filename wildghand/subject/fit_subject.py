"""The subject's own hand: the template bent until its outlines meet those of the masks.

Posed points are linear in the rest surface and the rest joints, so each round is one linear least
squares problem: outlines are drawn, every point of them is asked to move by its gap to the mask's
outline, and control points, joints, proportions and the frames' translations share what is asked.
Gaps that nothing smooth explains (an object in front, a blurred border, a wrong mask) count less
and less.
"""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
from scipy.linalg import solve

from hwp_bench.base.arrays import evenly
from hwp_bench.capture import Cameras
from hwp_bench.hands import HandParameters, HandTemplate
from wildghand.gaussians.training import LEAST_CHOOSING, MOST_CHOOSING
from wildghand.subject.outlines import ComparedFrames
from wildghand.subject.shape import SubjectShape
from wildghand.subject.unknowns import Unknowns, outline_rows

#: Frames that are compared at most, evenly spread over the clip.
FRAMES = 24
#: Expected error of a point of the outline, px; as large as neighbouring points and frames, which
#: err together, make it.
NOISE = 1.5
#: Stiffnesses among which frames that are not compared choose, the stiffest first. A stiffness
#: multiplies the expected error of an outline and divides the expected change of a proportion.
STIFFNESS = (8.0, 4.0, 2.0, 1.0, 0.7)
#: The stiffness where no frames choose.
FIXED_STIFFNESS = 4.0
# Share of the template's misfit in the frames that choose by which a softer hand must be better.
_LEAST_GAIN = 0.04
# Rounds; in each the silhouettes are drawn again, and a third one changes little.
_ROUNDS = 2
# Points of all outlines together that are compared in a round.
_POINTS = 3000
# Distance at which a point of the outline counts a quarter in the last round, px.
_REACH = 1.5
# The reach in the first round, in those of the last.
_FIRST_REACH = 3.0
# Least number of points that a fit needs.
_LEAST = 100


def fit_subject(
    templates: Mapping[str, HandTemplate],
    hands: Mapping[str, HandParameters],
    cameras: Cameras,
    frames: np.ndarray,
    masks: np.ndarray,
    *,
    judges: ComparedFrames | None = None,
) -> SubjectShape:
    """Fit a person's hand to masks; deterministic.

    Args:
        frames: (R,) numbers of the frames with masks, ascending.
        masks: (R, H, W) uint8, 255 = visible hand.
        judges: further frames, which choose how far the hand bends; None: those of the R frames
            that are not compared do.
    """

    def compared(rows: np.ndarray) -> ComparedFrames:
        return ComparedFrames(templates, hands, cameras, frames[rows], masks[rows] > 127)

    every = np.arange(len(frames))
    rows = every[evenly(len(every), FRAMES)]
    if judges is None:
        others = np.setdiff1d(every, rows)
        few = others[evenly(len(others), MOST_CHOOSING)]
        judges = compared(few) if len(others) >= LEAST_CHOOSING else None
    bending = _Bending(compared(rows))
    shape = bending.begin(FIXED_STIFFNESS) if judges is None else _chosen(bending, judges)
    # An avatar keeps float32: it is drawn with what is read again.
    return SubjectShape(
        shape.vertices.astype(np.float32).astype(np.float64),
        shape.joints.astype(np.float32).astype(np.float64),
    )


def _chosen(bending: _Bending, judges: ComparedFrames) -> SubjectShape:
    """The stiffest hand whose outlines meet those of other frames almost as well as any does."""
    before = judges.misfit(bending.shape, _REACH)
    if before is None:
        return bending.begin(FIXED_STIFFNESS)
    shapes, misfits = [bending.shape], [before]
    for stiffness in STIFFNESS:
        shape = bending.begin(stiffness) if len(shapes) == 1 else bending.soften(stiffness)
        misfit = judges.misfit(shape, _REACH)
        if misfit is None or misfit >= misfits[-1]:
            break
        shapes.append(shape)
        misfits.append(misfit)
    enough = misfits[-1] + _LEAST_GAIN * before
    return next(shape for shape, one in zip(shapes, misfits, strict=True) if one <= enough)


class _Bending:
    """A hand that bends, round by round, to the masks of some frames.

    Args:
        frames: that are compared.

    Attributes:
        shape: so far.
    """

    def __init__(self, frames: ComparedFrames) -> None:
        self.frames = frames
        template = next(iter(frames.templates.values()))
        self.unknowns = Unknowns.of(template, len(frames.templates), len(frames))
        self.expected = self.unknowns.expected()
        self.values = np.zeros(len(self.unknowns))
        self.shape = self.unknowns.shape(self.values)

    def begin(self, stiffness: float) -> SubjectShape:
        """Bend the template; the reach falls round by round.

        Args:
            stiffness: as in `STIFFNESS`.

        Returns:
            The shape; the one before where too little can be compared.
        """
        for fraction in np.linspace(0.0, 1.0, _ROUNDS):
            reach = _REACH * _FIRST_REACH ** (1.0 - fraction)
            if not self._solve(reach, stiffness):
                break
        return self.shape

    def soften(self, stiffness: float) -> SubjectShape:
        """Bend a hand whose outlines are near the masks': one round with the last reach is enough.

        Arguments and result are those of `begin`.
        """
        self._solve(_REACH, stiffness)
        return self.shape

    def _solve(self, reach: float, stiffness: float) -> bool:
        """Solve one round: the numbers that best explain the gaps of the outlines.

        Args:
            reach: gap at which a point counts a quarter, px.
        """
        rows, gaps = [], []
        frames, unknowns = self.frames, self.unknowns
        posed = frames.posed(self.shape, unknowns.moves(self.values))
        quota = max(20, _POINTS // len(frames))
        for frame in range(len(frames)):
            seen = frames.compare(posed, frame, quota)
            if len(seen.gap):
                rows.append(outline_rows(unknowns, frames, posed, frame, seen))
                gaps.append(seen.gap)
        if not rows or sum(map(len, gaps)) < _LEAST:
            return False
        matrix, gap = np.concatenate(rows), np.concatenate(gaps)
        noise = stiffness * NOISE
        weight = 1.0 / (1.0 + (gap / reach) ** 2) ** 2 / noise**2
        # The unknowns are the whole displacement, so that each round regularises all of it.
        target = gap + matrix @ self.values
        right = matrix.T @ (weight * target)
        matrix *= np.sqrt(weight).astype(np.float32)[:, None]
        normal = (matrix.T @ matrix).astype(np.float64) + self.expected
        own = np.arange(*unknowns.cuts[1:])
        normal[own, own] += (stiffness**2 - 1.0) * self.expected[own, own]
        self.values = solve(normal, right, assume_a="pos")
        self.shape = unknowns.shape(self.values)
        return True
