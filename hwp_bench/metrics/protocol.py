"""The two scoring protocols as data: every choice that can move a number, by name.

The code that scores reads its settings from here, and results store `Protocol.as_dict()`, so
that a number can be traced to the settings that made it.
"""

from __future__ import annotations

from dataclasses import asdict, dataclass
from typing import Any, Literal

from hwp_bench.base.errors import UsageError
from hwp_bench.base.text import did_you_mean

#: Score of identical images, in dB; keeps means finite.
PSNR_CAP = 100.0


@dataclass(frozen=True)
class SsimSettings:
    """Every choice that "SSIM" leaves open (Wang et al., 2004)."""

    #: Weights of the local window.
    window: Literal["gaussian", "uniform"]
    #: Side of the window, px, odd.
    size: int
    #: Standard deviation of the Gaussian window, px; 0 for the uniform one.
    sigma: float
    #: True: covariances are divided by N - 1 (scikit-image's default); False: by N.
    sample_covariance: bool
    #: Difference between the largest and the smallest value that a pixel is said to take.
    data_range: float
    #: Constant of the luminance term: C1 = (k1 * data_range)^2.
    k1: float = 0.01
    #: Constant of the contrast term: C2 = (k2 * data_range)^2.
    k2: float = 0.03

    @property
    def radius(self) -> int:
        """Pixels that the window reaches to each side of its centre."""
        return self.size // 2


@dataclass(frozen=True)
class Protocol:
    """One way of scoring a frame."""

    #: Name in results and tables.
    name: str
    #: Pixels that the mask loses at its border where the hand's coverage is not known.
    mask_erosion: int
    #: Pixels that the mask's box is grown by on each side before box metrics look at it.
    box_padding: int
    #: Smallest side of that box, px; a smaller one is grown evenly.
    smallest_box: int
    #: Smallest side of the image that LPIPS is given, px (the networks' strides need it).
    smallest_lpips_box: int
    #: Largest PSNR, dB: the score of identical images.
    psnr_cap: float
    #: The structural similarity.
    ssim: SsimSettings

    def as_dict(self) -> dict[str, Any]:
        """The protocol as plain JSON data, for results."""
        return asdict(self)


#: The headline: the scored pixels are those that the hand covers fully.
HWP_V1 = Protocol(
    name="hwp-v1",
    mask_erosion=1,
    box_padding=5,
    smallest_box=11,
    smallest_lpips_box=64,
    psnr_cap=PSNR_CAP,
    ssim=SsimSettings("gaussian", 11, 1.5, sample_covariance=False, data_range=1.0),
)

#: The released evaluator's settings on the data set's mask. The data range of 2 is what an old
#: scikit-image assumes for float images when it is told nothing; it inflates the score, and it
#: is kept only so that published numbers can be compared with something.
PAPER_WILDGHAND = Protocol(
    name="paper-wildghand",
    mask_erosion=0,
    box_padding=0,
    smallest_box=7,
    smallest_lpips_box=64,
    psnr_cap=PSNR_CAP,
    ssim=SsimSettings("uniform", 7, 0.0, sample_covariance=True, data_range=2.0),
)

#: The protocols that every evaluation scores in, the headline first.
PROTOCOLS = (HWP_V1, PAPER_WILDGHAND)


def protocol(name: str) -> Protocol:
    """The protocol of that name.

    Raises:
        UsageError: there is none; the message offers the nearest name.
    """
    for candidate in PROTOCOLS:
        if candidate.name == name:
            return candidate
    names = [candidate.name for candidate in PROTOCOLS]
    hint = did_you_mean(name, names) or f"There are: {', '.join(names)}."
    raise UsageError(f"no protocol is called {name!r}", field="protocol", remedy=hint)
