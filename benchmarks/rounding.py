"""How far the pictures of two renderings of the same captures are from each other, in levels.

Run from the repository: `python -m benchmarks.rounding OLD NEW`, each a capture or a folder of
captures, such as `sim/captures` of two caches. For each capture it prints how many values of its
pictures differ (frames, clean versions, masks, the free-view clip), and by how many levels at most.
Captures are matched by their scene, frames and size; the version of the renderer may differ.
"""

from __future__ import annotations

import argparse
from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple

import numpy as np

from hwp_bench.capture import Capture, open_capture


class Difference(NamedTuple):
    """What two renderings of one capture have that is not the same."""

    #: Pictures, and those of them that differ.
    pictures: int
    other_pictures: int
    #: Values of all pictures, and those of them that differ.
    values: int
    other_values: int
    #: The largest difference, in levels.
    most: int

    @classmethod
    def of(cls, old: Path, new: Path) -> Difference:
        """Compare all pictures of two capture folders, the free-view clip included.

        Raises:
            SystemExit: the folders do not hold the same pictures.
        """
        names = [
            sorted(file.relative_to(root) for file in root.rglob("*.png")) for root in (old, new)
        ]
        if names[0] != names[1]:
            raise SystemExit(f"{old} and {new} do not hold the same pictures")
        found = np.array([_compared(old / name, new / name) for name in names[0]])
        values, other, most = found.T
        return cls(
            len(found), int((other > 0).sum()), int(values.sum()), int(other.sum()), int(most.max())
        )


def _compared(old: Path, new: Path) -> tuple[int, int, int]:
    first, second = (_values(file) for file in (old, new))
    if first.shape != second.shape:
        raise SystemExit(f"{old} and {new} are not of the same size")
    apart = np.abs(first - second)
    return apart.size, int((apart > 0).sum()), int(apart.max(initial=0))


def _values(file: Path) -> np.ndarray:
    import cv2

    read = cv2.imread(str(file), cv2.IMREAD_UNCHANGED)
    if read is None:
        raise SystemExit(f"{file} is no picture")
    return read.astype(np.int64)


def captures(folder: Path) -> Iterator[tuple[tuple[str, ...], Capture]]:
    """Captures of a folder, or the one that it is, each with what is the same in any version."""
    for file in sorted([*folder.glob("capture.json"), *folder.glob("*/capture.json")]):
        capture = open_capture(file.parent)
        info = capture.info
        size = f"{info.frame_count} x {info.width} x {info.height}"
        yield (info.id, size, str(info.source.get("scene_digest"))), capture


def main() -> None:
    """Compare the folders that the arguments name."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("old", type=Path, help="a capture, or a folder of captures")
    parser.add_argument("new", type=Path, help="the same of another version or machine")
    args = parser.parse_args()
    old, new = (dict(captures(folder)) for folder in (args.old, args.new))
    print("| capture | pictures | that differ | values | that differ | levels at most |")
    print("| --- | ---: | ---: | ---: | ---: | ---: |")
    for key in sorted(old.keys() & new.keys()):
        found = Difference.of(old[key].root, new[key].root)
        print(f"| {key[0]} | {' | '.join(f'{number:,}' for number in found)} |")
    if not old.keys() & new.keys():
        raise SystemExit("no capture is in both folders")


if __name__ == "__main__":
    main()
