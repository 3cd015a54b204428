"""Where things lie inside a capture folder."""

from __future__ import annotations

from pathlib import Path

#: What the capture says of itself.
METADATA = "capture.json"
#: Estimated hand parameters, as a method is given them.
HANDS = "hands.npz"
#: Intrinsics and view matrices.
CAMERAS = "cameras.npz"
#: True hand parameters, where they are known; withheld from methods.
TRUE_HANDS = "truth/hands.npz"
#: Further files of the maker (scene, timings, overlays); withheld from methods.
EXTRA = "extra"

#: Folder of each kind of image. All but `frames` and `masks` are truth, withheld from methods.
IMAGE_FOLDERS = {
    "frames": "frames",
    "masks": "masks",
    "clean": "truth/clean",
    "true_masks": "truth/masks",
    "clean_masks": "truth/clean_masks",
}


def image_path(root: Path, kind: str, frame: int) -> Path:
    """Return the file of one image: `kind` is a key of `IMAGE_FOLDERS`."""
    return root / IMAGE_FOLDERS[kind] / frame_name(frame)


def frame_name(frame: int) -> str:
    """Return the file name of a frame, as captures and predictions use it."""
    return f"{frame:06d}.png"
