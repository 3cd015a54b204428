"""Settings of the poses that a fit believes in."""

from __future__ import annotations

from dataclasses import dataclass

from hwp_bench.methods.settings import number


@dataclass(frozen=True)
class PoseSettings:
    """How far given poses are drawn to what the clip's other poses say of them.

    The two errors of landmarks state the form of the poses' errors, not their size, which is found.
    """

    #: Correct the given poses of the clip before the fit.
    enabled: bool = True
    #: Frames at most from which the spread of poses is learnt, evenly spread over the clip.
    frames: int = number(240, 3, 10_000)
    #: Error of a landmark in the image, as a share of the hand's extent.
    image_error: float = number(0.01, 1e-6, 1.0)
    #: Error of a landmark in space against the hand's centre, along each axis, m.
    space_error: float = number(0.005, 1e-6, 1.0)
    #: What estimators expect of a joint before they see landmarks, rad about each axis.
    expected_turn: float = number(0.5, 1e-3, 10.0)
    #: What they expect of the hand's place, m along each axis.
    expected_shift: float = number(0.01, 1e-4, 10.0)
    #: Rounds in which the spread of the true poses is found.
    rounds: int = number(10, 1, 1000)
    #: Errors below this, rad (root mean square of finger joints), are left alone.
    least_error: float = number(0.01, 0.0, 10.0)
