"""Names of sequences of InterHand2.6M, among them the three of the paper."""

from __future__ import annotations

import re
from collections.abc import Mapping
from dataclasses import dataclass
from types import MappingProxyType

from hwp_bench.base.errors import UsageError

#: Parts of the data set.
SPLITS = ("train", "val", "test")
_PATH = re.compile(r"(?:(train|val|test)/)?Capture(\d{1,4})/([A-Za-z0-9_.-]{1,80})/cam(\d{1,9})")


@dataclass(frozen=True)
class InterHandSequence:
    """One camera of one sequence."""

    #: Number of the capture.
    capture: int
    #: Name of the sequence.
    name: str
    #: Number of the camera.
    camera: str
    #: Part of the data set, or None: the first that has it.
    split: str | None = None

    @property
    def id(self) -> str:
        """Id of the HWP capture that is made of it."""
        return f"interhand-{self.capture}-{self.name}-{self.camera}"


#: The three sequences of the paper.
PAPER_SEQUENCES: Mapping[str, InterHandSequence] = MappingProxyType(
    {
        "touchrom-15": InterHandSequence(21, "0390_dh_touchROM", "400015"),
        "touchrom-16": InterHandSequence(21, "0390_dh_touchROM", "400016"),
        "handscratch-16": InterHandSequence(21, "0286_handscratch", "400016"),
    }
)


def find_sequence(name: str) -> InterHandSequence:
    """Look up a sequence.

    Args:
        name: one of `PAPER_SEQUENCES`, or `[split/]CaptureN/SEQUENCE/camID` as the data set's
            folders are named.

    Raises:
        UsageError: it is neither; the message lists the paper's.
    """
    if name in PAPER_SEQUENCES:
        return PAPER_SEQUENCES[name]
    match = _PATH.fullmatch(name.strip("/"))
    if match is None or match.group(3).strip(".") == "":
        raise UsageError(
            f"{name!r} is not a sequence",
            field="SEQUENCE",
            remedy=f"Use {', '.join(PAPER_SEQUENCES)}, or CaptureN/SEQUENCE/camID.",
        )
    return InterHandSequence(int(match.group(2)), match.group(3), match.group(4), match.group(1))
