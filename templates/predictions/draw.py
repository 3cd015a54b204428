"""Draw the test frames of all requests in the mean colour of the hand: draw.py REQUESTS.

`hwp-bench data inputs` writes the requests. It needs NumPy and Pillow alone. Replace `draw` by a
call of your own program, or copy the pictures that it has drawn to `predictions`.
"""

import json
import sys
from pathlib import Path

import numpy as np
from PIL import Image


def mean_colour(request, record):
    """Return the mean colour of the hand in the training frames, three numbers up to 255."""
    pixels = []
    for frame in record["train"]:
        name = f"{frame:06d}.png"
        image = np.asarray(Image.open(request / "frames" / name).convert("RGB"))
        mask = np.asarray(Image.open(request / "masks" / name))
        pixels.append(image[mask > 127])
    return np.concatenate(pixels).mean(axis=0)


def draw(request, predictions, free):
    """Draw what a request asks for: its test frames, and the views of its free-view clip.

    hands.npz and cameras.npz hold hand parameters and cameras of all frames; those of the
    free-view clip are in the folder `free`.
    """
    record = json.loads((request / "request.json").read_text())
    colour = mean_colour(request, record).round().astype(np.uint8)
    picture = np.broadcast_to(colour, (record["height"], record["width"], 3))
    # Captures without a free-view clip do not have the number of its frames.
    views = range(record.get("free_view", 0))
    wanted = {predictions: range(*record["split"]["test"]), free: views}
    for folder, frames in wanted.items():
        folder.mkdir(parents=True, exist_ok=True)
        for frame in frames:
            Image.fromarray(picture.copy()).save(folder / f"{frame:06d}.png")


if __name__ == "__main__":
    # Files may lie next to the folders of the requests.
    for request in sorted(path.parent for path in Path(sys.argv[1]).glob("*/request.json")):
        folder = Path(__file__).parent / "predictions" / request.name
        draw(request, folder, folder / "free")
