"""The key of an evaluation: one digest of everything that decides its scores.

A stored result of the same key is taken as it is. The key also binds a result: whoever changes the
name, settings, seed or budget of a result by hand leaves a key that is not of its content.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from typing import Any

from hwp_bench.base.files import sha256_json
from hwp_bench.metrics import METRICS
from hwp_bench.results import CaptureResult, Results

#: Version of the evaluation itself; a stored result of another version is not taken.
RECIPE = 1


def evaluation_key(
    *,
    method: tuple[str, str],
    capture: str,
    split: str,
    settings: Mapping[str, Any],
    seed: int,
    budget: Mapping[str, float | None],
    frames: str,
    protocols: Sequence[Mapping[str, Any]],
    networks: Iterable[str],
    exposed: str | None,
    free_view: str | None,
) -> str:
    """Return the SHA-256 (hex) of everything that decides the scores of a capture.

    Args:
        method: name and digest.
        capture: digest.
        split: digest.
        settings: the preset with its overrides.
        seed: of everything random.
        budget: `seconds` and `steps`.
        frames: the training frames that the method is given.
        protocols: settings of the protocols that are scored.
        networks: backbones of LPIPS that are scored.
        exposed: digest of further files that the method is shown; None where there are none.
        free_view: digest of the free-view clip; None where there is none.
    """
    return sha256_json(
        {
            "recipe": RECIPE,
            "method": list(method),
            "capture": capture,
            "split": split,
            "settings": dict(settings),
            "seed": seed,
            "budget": dict(budget),
            "frames": frames,
            "protocols": list(protocols),
            "networks": sorted(networks),
            **({"exposed": exposed} if exposed is not None else {}),
            **({"free_view": free_view} if free_view is not None else {}),
        }
    )


def key_of(results: Results, capture: CaptureResult, clip: str | None) -> str:
    """Return the key of one capture of a result, from the result's other fields.

    Args:
        results: the result.
        capture: one of its captures.
        clip: digest of the capture's free-view clip; None where it has none.
    """
    scored = {name for frame in capture.frames for name in frame.scores}
    return evaluation_key(
        method=(results.method.name, results.method.digest),
        capture=capture.digest,
        split=capture.split_digest,
        settings=results.method.settings,
        seed=results.seed,
        budget=results.budget,
        frames=results.frames,
        protocols=list(results.protocols.values()),
        networks={item.weights for item in METRICS if item.weights and item.name in scored},
        exposed=capture.exposed,
        free_view=clip,
    )
