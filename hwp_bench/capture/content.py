"""Whether the content of a capture is what its digests say: refused where it was changed since."""

from __future__ import annotations

import os
from collections.abc import Callable, Iterable
from concurrent.futures import ThreadPoolExecutor

import numpy as np

from hwp_bench.base.errors import BadCapture
from hwp_bench.base.images import pixel_digest
from hwp_bench.capture.reader import Capture
from hwp_bench.capture.schema import METADATA
from hwp_bench.capture.tracks import arrays_digest, hand_arrays
from hwp_bench.capture.writer import combine


def refuse_changed(capture: Capture, kinds: Iterable[str] = ("frames", "masks")) -> None:
    """Refuse a capture whose images or numbers are not those of its digests.

    A score stands under the digest of its capture, so that the pixels behind it must be those.
    Every image of the kinds is decoded: about 2 ms for a frame of 256 x 256 px.

    Args:
        capture: the capture.
        kinds: images that are looked at, keys of `IMAGE_FOLDERS`; estimated hand parameters and
            cameras always are.

    Raises:
        BadImage: an image is missing or damaged.
        BadCapture: a part was changed after the capture was written; it is named.
    """
    found = {
        "hands": arrays_digest(hand_arrays(capture.hands)),
        "cameras": arrays_digest({"Ks": capture.cameras.Ks, "viewmats": capture.cameras.viewmats}),
        **{kind: images_digest(capture, kind) for kind in kinds},
    }
    stored = capture.info.digests or {}
    for part, digest in found.items():
        if stored.get(part) != digest:
            raise BadCapture(
                "does not match the content" if part in stored else "is missing",
                where=capture.root / METADATA,
                field=f"digests.{part}",
                remedy="The content was changed after the capture was written; get it again.",
            )


def images_digest(capture: Capture, kind: str) -> str:
    """Return the digest over the decoded images of one kind.

    Args:
        capture: the capture.
        kind: a key of `IMAGE_FOLDERS`.

    Raises:
        BadImage: an image is missing or damaged.
    """
    read = image_reader(capture, kind)
    with ThreadPoolExecutor(max_workers=os.cpu_count()) as pool:
        return combine(pool.map(lambda frame: pixel_digest(read(frame)), range(len(capture))))


def image_reader(capture: Capture, kind: str) -> Callable[[int], np.ndarray]:
    """Return the function that reads one image of a kind, a key of `IMAGE_FOLDERS`, by frame."""
    return {
        "frames": capture.frame,
        "masks": capture.mask,
        "clean": capture.clean,
        "true_masks": capture.true_mask,
        "clean_masks": capture.clean_mask,
    }[kind]
