"""The two scoring protocols and the table of metrics as data: every choice that moves a number.

The code that scores reads its settings from here, and results store `Protocol.as_dict()`, so
that a number can be traced to the settings that made it.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import asdict, dataclass
from typing import Any, Literal

from hwp_bench.base.errors import UsageError, did_you_mean

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
    #: Difference between the largest and the smallest value that a pixel is assumed to take.
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


@dataclass(frozen=True)
class Metric:
    """The facts of a metric."""

    #: Key in results; unique over all protocols.
    name: str
    label: str
    #: Name of the protocol that defines it.
    protocol: str
    #: Unit; empty for a plain number.
    unit: str
    #: True where a larger value means a better image.
    higher_is_better: bool
    #: Smallest and largest value that a frame can get; None where there is no bound.
    range: tuple[float, float | None]
    #: Value that a failed frame is given.
    penalty: float
    #: Digits after the decimal point that tables print.
    digits: int
    reference: str
    description: str
    #: What the user must have: the weights of an LPIPS backbone, or the package of FLIP ("flip").
    needs: str | None = None

    @property
    def perfect(self) -> float:
        """The score of identical images."""
        low, high = self.range
        return low if not self.higher_is_better or high is None else high


def _psnr(name: str, label: str, description: str, protocol: Protocol = HWP_V1) -> Metric:
    reference = "-10 log10(mean squared error), data range 1"
    spread = (0.0, PSNR_CAP)
    return Metric(name, label, protocol.name, "dB", True, spread, 0.0, 2, reference, description)


def _ssim(name: str, label: str, description: str, protocol: Protocol = HWP_V1) -> Metric:
    reference = "Wang et al., Image quality assessment, IEEE TIP 13(4), 2004"
    spread = (-1.0, 1.0)
    return Metric(name, label, protocol.name, "", True, spread, 0.0, 4, reference, description)


def _lpips(
    name: str, label: str, net: str, description: str, protocol: Protocol = HWP_V1
) -> Metric:
    reference = "Zhang et al., The unreasonable effectiveness of deep features, CVPR 2018, v0.1"
    spread = (0.0, None)
    return Metric(
        name, label, protocol.name, "", False, spread, 1.0, 4, reference, description, net
    )


#: In the order in which tables show them.
METRICS: tuple[Metric, ...] = (
    _psnr("psnr", "PSNR", "Error on the pixels that the hand covers fully."),
    _ssim("ssim", "SSIM", "Gaussian 11/1.5, mean over the scored pixels of the hand."),
    Metric(
        "oriented_distance",
        "Oriented distance",
        HWP_V1.name,
        "",
        False,
        (0.0, 1.0),
        1.0,
        4,
        "docs/protocol.md; filters of Freeman and Adelson, IEEE TPAMI 13(9), 1991",
        "Weight-free perceptual distance: normalised oriented energies on four scales.",
    ),
    Metric(
        "flip",
        "FLIP",
        HWP_V1.name,
        "",
        False,
        (0.0, 1.0),
        1.0,
        4,
        "Andersson et al., FLIP: a difference evaluator for alternating images, HPG 2020",
        "Mean over the scored pixels, at 67 pixels a degree.",
        "flip",
    ),
    _lpips("lpips_alex", "LPIPS (alex)", "alex", "AlexNet features on the padded box."),
    _lpips("lpips_vgg", "LPIPS (vgg)", "vgg", "VGG-16 features on the padded box."),
    _psnr("psnr_full", "PSNR (full)", "The whole frame, black outside the scored pixels."),
    _psnr("psnr_box", "PSNR (box)", "The padded box, black outside the scored pixels."),
    _psnr("psnr_edge", "PSNR (edge)", "The hand with its mixed border pixels."),
    _ssim("ssim_full", "SSIM (full)", "As SSIM, mean over the whole black-padded frame."),
    _psnr("paper_psnr", "PSNR", "The whole frame, black outside the mask.", PAPER_WILDGHAND),
    _ssim("paper_ssim", "SSIM", "Uniform 7x7, data range 2, on the mask's box.", PAPER_WILDGHAND),
    _lpips("paper_lpips", "LPIPS", "alex", "AlexNet features on the mask's box.", PAPER_WILDGHAND),
)


def metric(name: str) -> Metric:
    """The facts of the metric of that name.

    Raises:
        UsageError: there is none; the message offers the nearest name.
    """
    for candidate in METRICS:
        if candidate.name == name:
            return candidate
    hint = did_you_mean(name, [candidate.name for candidate in METRICS]) or None
    raise UsageError(f"no metric is called {name!r}", field="metric", remedy=hint)


def metric_names(networks: Iterable[str] = ()) -> tuple[str, ...]:
    """Names of the metrics that are scored, in table order.

    Args:
        networks: what is at hand of "alex", "vgg" and "flip"; without one its metric is absent.
    """
    available = {None, *networks}
    return tuple(item.name for item in METRICS if item.needs in available)


def penalty(networks: Iterable[str] = ()) -> dict[str, float]:
    """The declared scores of a frame that failed, for the metrics of `metric_names`."""
    return {name: metric(name).penalty for name in metric_names(networks)}
