"""Hard cases of scoring, for `hwp-bench dev stability` and for the tests.

Each compares with an independent form: float64 sums over the scored pixels, or scikit-image's SSIM.
"""

from __future__ import annotations

import math

import numpy as np

from hwp_bench.base.errors import HwpError
from hwp_bench.metrics.protocol import HWP_V1, METRICS, PSNR_CAP, metric, penalty
from hwp_bench.metrics.score import ScoredFrame, score_frame, score_frames
from hwp_bench.stability import CaseGroup, Measured, largest

#: Largest difference from float64 and from scikit-image: dB, and SSIM.
EXACT, ROUNDED = 1e-9, 1e-9
_SIZE = 48
_RANGES = "every score in its range"

#: Every hard case of the metrics.
cases = CaseGroup("metrics")


def _mask(name: str) -> np.ndarray:
    """(H, W) bool."""
    rows, columns = np.mgrid[:_SIZE, :_SIZE]
    masks = {
        "of one pixel": (rows == 20) & (columns == 30),
        "of one pixel in the corner": (rows == 0) & (columns == 0),
        "of one row": rows == 20,
        "of half the frame": columns < _SIZE // 2,
        "of every pixel": rows >= 0,
        "of a disc": (rows - 20) ** 2 + (columns - 20) ** 2 < 15**2,
    }
    return masks[name]


_MASKS = tuple(
    f"of {name}"
    for name in (
        *("one pixel", "one pixel in the corner", "one row"),
        *("half the frame", "every pixel", "a disc"),
    )
)


@cases.case("identical images on a mask {}", "perfect in every metric", *_MASKS)
def _run_identical(name: str) -> Measured:
    image = _noise(1)
    scores = score_frame(image, image.copy(), _mask(name), coverage=True)
    off = largest(abs(value - metric(key).perfect) for key, value in scores.items())
    return Measured(off <= EXACT, f"off by {off:.0e}")


@cases.case(
    "noise on a mask {}",
    f"PSNR to {EXACT:g} dB of float64, SSIM to {ROUNDED:g} of scikit-image; {_RANGES}",
    *_MASKS,
)
def _run_noise(name: str) -> Measured:
    return _compare(_noise(1), _noise(2), _mask(name))


@cases.case(
    "{} against {}",
    f"PSNR to {EXACT:g} dB of float64, SSIM to {ROUNDED:g} of scikit-image; {_RANGES}",
    ("black", "white"),
    ("white", "black"),
    ("black", "noise"),
    ("noise", "white"),
)
def _run_extremes(first: str, second: str) -> Measured:
    images = {
        "black": np.zeros_like(_noise(1)),
        "white": np.full_like(_noise(1), 255),
        "noise": _noise(1),
    }
    return _compare(images[first], images[second], _mask("of a disc"))


@cases.case("one level in one channel of one pixel", f"PSNR below {PSNR_CAP:g} dB and as by hand")
def _run_one_level() -> Measured:
    target = np.zeros((_SIZE, _SIZE, 3), np.uint8)
    prediction = target.copy()
    prediction[10, 10, 1] = 1
    found = score_frame(prediction, target, _mask("of every pixel"), coverage=True)["psnr"]
    wanted = 10.0 * math.log10(255.0**2 * _SIZE * _SIZE * 3)
    return Measured(abs(found - wanted) <= EXACT and found < PSNR_CAP, f"{found:.3f} dB")


@cases.case("pixels outside of the mask that are wrong", "the same scores, bit for bit")
def _run_outside() -> Measured:
    mask, target, prediction = _mask("of a disc"), _noise(1), _noise(2)
    plain = score_frame(prediction, target, mask, coverage=True)
    spoiled = np.where(mask[..., None], prediction, 255 - prediction)
    other = np.where(mask[..., None], target, 0).astype(np.uint8)
    same = score_frame(spoiled, other, mask, coverage=True) == plain
    return Measured(same, f"PSNR {plain['psnr']:.3f} dB")


@cases.case("a float prediction with {}", "refused by one sentence that names it", "NaN", "inf")
def _run_not_finite(name: str) -> Measured:
    prediction = _noise(1) / 255.0
    prediction[3, 4, 1] = {"NaN": math.nan, "inf": math.inf}[name]
    return _refused(prediction, _noise(1), _mask("of a disc"), "prediction")


@cases.case("a float prediction of 0 to 255", "refused by one sentence with the remedy")
def _run_large_floats() -> Measured:
    return _refused(_noise(1).astype(float), _noise(1), _mask("of a disc"), "divide")


@cases.case("a float prediction that overshoots by 1e-3", "the score of the clipped image")
def _run_overshoot() -> Measured:
    target, mask = _noise(1), _mask("of a disc")
    prediction = 1.002 * _noise(2) / 255.0 - 1e-3
    clipped = np.rint(255.0 * prediction.clip(0.0, 1.0)).astype(np.uint8)
    found = score_frame(prediction, target, mask)
    return Measured(found == score_frame(clipped, target, mask), f"PSNR {found['psnr']:.3f} dB")


@cases.case(
    "a mask {}", "refused by one sentence that names the mask", "of no pixel", "thinner than 3 px"
)
def _run_nothing_to_score(name: str) -> Measured:
    mask = np.zeros((_SIZE, _SIZE), np.uint8)
    if name != "of no pixel":
        mask[20:22, :] = 255  # the erosion of an estimated mask leaves nothing
    return _refused(_noise(1), _noise(1), mask, "mask")


@cases.case("an image of {0} x {0} px", "refused by one sentence, or scored in range", 1, 2, 10, 11)
def _run_small(size: int) -> Measured:
    image = _noise(1)[:size, :size]
    try:
        scores = score_frame(image, 255 - image, np.ones((size, size), bool), coverage=True)
    except HwpError as error:
        return Measured("\n" not in str(error) and size < HWP_V1.ssim.size, str(error)[:60])
    return Measured(_in_range(scores), f"PSNR {scores['psnr']:.3f} dB")


@cases.case("a frame without a prediction among others", "the penalty, and it changes no other")
def _run_missing() -> Measured:
    target, mask = _noise(1), _mask("of a disc")
    frames = [ScoredFrame(image, target, mask, True) for image in (_noise(2), None, _noise(3))]
    found = score_frames(frames)
    alone = [score_frames([frame])[0] for frame in frames]
    punished = found[1] == {name: penalty()[name] for name in found[1]}
    return Measured(punished and found == alone, f"PSNR {found[1]['psnr']:g} dB")


def _compare(prediction: np.ndarray, target: np.ndarray, mask: np.ndarray) -> Measured:
    """PSNR and SSIM against float64 and scikit-image; everything else must be in range."""
    from skimage.metrics import structural_similarity

    scores = score_frame(prediction, target, mask, coverage=True)
    x, y = (np.where(mask[..., None], image, 0) / 255.0 for image in (prediction, target))
    error = float(((x - y)[mask] ** 2).mean())
    psnr = PSNR_CAP if error == 0.0 else min(PSNR_CAP, -10.0 * math.log10(error))
    # Windows may reach beyond the frame, where everything is black.
    wide = ((20, 20), (20, 20), (0, 0))
    _, similarity = structural_similarity(
        np.pad(x, wide),
        np.pad(y, wide),
        gaussian_weights=True,
        sigma=1.5,
        use_sample_covariance=False,
        data_range=1.0,
        channel_axis=2,
        full=True,
    )
    ssim = float(similarity.mean(axis=2)[20:-20, 20:-20][mask].mean())
    off = abs(scores["psnr"] - psnr), abs(scores["ssim"] - ssim)
    passed = off[0] <= EXACT and off[1] <= ROUNDED and _in_range(scores)
    return Measured(passed, f"off by {off[0]:.0e} dB, {off[1]:.0e}")


def _in_range(scores: dict[str, float]) -> bool:
    limits = {facts.name: facts for facts in METRICS}
    return all(
        math.isfinite(value)
        and min(limits[name].perfect, limits[name].penalty, -1.0) - EXACT <= value
        and value <= max(limits[name].perfect, limits[name].penalty, 1.0) + EXACT
        for name, value in scores.items()
    )


def _refused(prediction: np.ndarray, target: np.ndarray, mask: np.ndarray, named: str) -> Measured:
    try:
        scores = score_frame(prediction, target, mask)
    except HwpError as error:
        said = str(error)
        return Measured("\n" not in said and named in said, said[:60])
    return Measured(False, f"scored {scores['psnr']:.3g} dB")


def _noise(seed: int) -> np.ndarray:
    """(H, W, 3) uint8."""
    generator = np.random.default_rng(seed)
    return generator.integers(0, 256, (_SIZE, _SIZE, 3), dtype=np.uint8)
