"""Settings of fits that take seconds, for the tests of the method."""

from __future__ import annotations

from typing import Any

#: The smallest network, with few Gaussians. The prior that ships is of another network, so that a
#: fit starts from random weights.
TINY: dict[str, Any] = {
    "gaussians": 300,
    "network.identity_resolution": 24,
    "network.plane_resolution": 12,
    "device": "cpu",
}
#: The same with nothing that looks at the frames before the first step: no verdict on them, no
#: shadows, and the hand model as it is.
UNJUDGED: dict[str, Any] = {
    **TINY,
    "prepass.enabled": False,
    "subject.enabled": False,
    "shadows.enabled": False,
}
#: The network alone.
BARE: dict[str, Any] = {**TINY, "mode": "bare"}
#: A network that learns what a small clip shows.
QUICK: dict[str, Any] = {
    "gaussians": 600,
    "device": "cpu",
    "network.identity_resolution": 40,
    "network.plane_resolution": 20,
}
