"""A digest that binds a data set's keeper to hidden frames without revealing anything of them.

The public manifest holds the commitments, the sealed part the salt. Without the salt nobody can
test a guess of the hidden content; with it anybody can check, once the sealed part is opened,
that it was not changed after the publication.
"""

from __future__ import annotations

import hashlib
from collections.abc import Iterable, Mapping, Sequence
from typing import Any

from hwp_bench.base.files import canonical_json
from hwp_bench.base.images import pixel_digest
from hwp_bench.capture import Capture
from hwp_bench.capture.splits import Split

#: Version of the commitments.
SCHEME = "hwp-commitment/1"
#: Length of a salt in bytes: too long to be guessed.
SALT_BYTES = 32


def target_content(capture: Capture, split: Split) -> dict[str, Any]:
    """Describe by digests the truth that test frames are scored against.

    Args:
        capture: the capture.
        split: its split.

    Returns:
        JSON: id, split digest, and for every test frame the SHA-256 of its decoded pixels and of
        its scoring mask, with whether the mask is exact coverage. The same of the free-view clip,
        where there is one.

    Raises:
        BadImage: a test frame or mask is missing or damaged.
    """
    frames = _frame_digests(capture, split.test.tolist())
    content = {"id": capture.info.id, "split": split.digest, "frames": frames}
    clip = capture.free_view
    if clip is not None:
        content["free_view"] = _frame_digests(clip, range(len(clip)))
    return content


def _frame_digests(capture: Capture, frames: Iterable[int]) -> list[list[Any]]:
    rows: list[list[Any]] = []
    for frame in frames:
        mask, exact = capture.scoring_mask(frame)
        rows.append([frame, pixel_digest(capture.frame(frame)), pixel_digest(mask), exact])
    return rows


def commitment(content: Mapping[str, Any], salt: str) -> str:
    """Return the SHA-256 (hex) of a salted content.

    Args:
        content: from `target_content`.
        salt: at least `SALT_BYTES` random bytes in hex.
    """
    text = f"{SCHEME}\n{salt}\n{canonical_json(dict(content))}"
    return hashlib.sha256(text.encode()).hexdigest()


def joint_commitment(commitments: Sequence[str]) -> str:
    """Return one digest (hex) of the commitments of all captures, in the manifest's order."""
    return hashlib.sha256("\n".join([SCHEME, *commitments]).encode()).hexdigest()
