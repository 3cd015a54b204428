"""When an effect acts, and how strongly: severity over a capture."""

from __future__ import annotations

import numpy as np

from hwp_bench.sim.scene.schema import CLEAN_FROM, EffectCall, Scene

#: Share of an episode in which it rises, and in which it falls.
RAMP = 0.2
#: A level below this rounds to severity 0: the effect is absent.
ACTIVE_FROM = 0.5
# Moments at which the share of clean frames is measured.
_PROBES = 2001


def level(call: EffectCall, moment: float) -> float:
    """How strongly an effect acts at one moment: 0, or from `ACTIVE_FROM` to 5.

    Args:
        call: the effect.
        moment: fraction of the capture, 0-1.
    """
    strongest = 0.0
    for episode in call.episodes:
        if episode.start <= moment <= episode.end:
            through = (moment - episode.start) / (episode.end - episode.start)
            rise = min(through, 1.0 - through) / RAMP
            shape = min(1.0, 0.35 + 0.65 * rise)
            strongest = max(strongest, shape * episode.severity)
    return strongest if strongest >= ACTIVE_FROM else 0.0


def envelope(call: EffectCall, moment: float) -> float:
    """How far into an episode a moment is: 0 at its ends, 1 from `RAMP` on, smooth between."""
    for episode in call.episodes:
        if episode.start <= moment <= episode.end:
            through = (moment - episode.start) / (episode.end - episode.start)
            x = min(1.0, min(through, 1.0 - through) / RAMP)
            return x * x * (3.0 - 2.0 * x)
    return 0.0


def severity(call: EffectCall, moment: float) -> int:
    """Severity that is written into the capture: the level rounded to an integer, 0-5."""
    return int(np.floor(level(call, moment) + 0.5))


def moments(frame_count: int) -> np.ndarray:
    """Moment of every frame as a fraction of the capture: (F,) in [0, 1)."""
    return np.arange(frame_count) / frame_count


def clean_share(scene: Scene) -> float:
    """Share of the training part in which no effect acts."""
    probes = np.linspace(0.0, CLEAN_FROM, _PROBES)
    acting = [any(level(call, moment) for call in scene.effects) for moment in probes]
    return 1.0 - float(np.mean(acting))
