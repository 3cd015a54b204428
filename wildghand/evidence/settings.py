"""Settings of how far a Gaussian is trusted that few frames have shown."""

from __future__ import annotations

from dataclasses import dataclass

from hwp_bench.methods.settings import number


@dataclass(frozen=True)
class EvidenceSettings:
    """How much evidence outweighs that a Gaussian is an opaque disc on the skin."""

    #: Draw free poses with Gaussians that are the more discs on the skin, the fewer frames have
    #: shown them.
    enabled: bool = True
    #: Share of the training frames that must show a Gaussian until half of its offset from the skin
    #: is kept.
    offset_share: float = number(0.08, 0.0, 100.0)
    #: Share of the training frames that must show a Gaussian until half of its shape and
    #: transparency is kept.
    shape_share: float = number(0.002, 0.0, 100.0)
    #: Share of the training frames that must show a place clearly until its colour is half its own;
    #: the rest is that of the same place of the other hand, where that is known. 0: all of it is.
    color_share: float = number(0.02, 0.0, 100.0)
    #: Share of the training frames that must show a place until its colour is half its own; the
    #: rest is that of the skin around it. 0: all of it is its own.
    fill_share: float = number(0.02, 0.0, 100.0)
    #: After the last step, take a quarter or four times of `offset_share`, or 0, where that draws
    #: the validation frames better, and nothing of it where that draws them much better; then five
    #: times of `fill_share`, or 0. With fewer than four of these frames the settings hold.
    validated: bool = True
