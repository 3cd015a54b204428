"""How the oriented distance orders known degradations, next to PSNR, SSIM, FLIP and LPIPS.

Run from the repository: `python -m benchmarks.perceptual_order [--picture FILE.png]`.
The images are three photographs that scikit-image contains, seen through a disc as a hand is
seen through its mask. LPIPS columns appear where its weights lie in the usual places.
"""

from __future__ import annotations

import argparse
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
from skimage import data

from hwp_bench.base.images import as_uint8
from hwp_bench.metrics.lpips import load_available
from hwp_bench.metrics.protocol import HWP_V1
from hwp_bench.metrics.score import Network, mean_scores, score_frame

#: Side of the images and radius of the disc, px.
SIZE, RADIUS = 256, 90
#: PSNR, dB, at which the kinds are compared with each other.
EQUAL_PSNR = 28.0
#: Metrics that are printed where they are there.
SHOWN = ("psnr", "ssim", "oriented_distance", "flip", "lpips_alex", "lpips_vgg")


def shift(image: np.ndarray, pixels: float) -> np.ndarray:
    """Moved to the right by a number of pixels."""
    move = np.array([[1.0, 0.0, pixels], [0.0, 1.0, 0.0]])
    return cv2.warpAffine(image, move, (SIZE, SIZE), borderMode=cv2.BORDER_REFLECT)


def blur(image: np.ndarray, sigma: float) -> np.ndarray:
    """Gaussian blur of a standard deviation in px."""
    return cv2.GaussianBlur(image, (0, 0), sigma)


def gamma(image: np.ndarray, exponent: float) -> np.ndarray:
    """Every sRGB value raised to a power: darker above 1."""
    return as_uint8((image / 255.0) ** exponent)


def noise(image: np.ndarray, sigma: float) -> np.ndarray:
    """Independent Gaussian noise per channel of a standard deviation in 8-bit levels."""
    return as_uint8((image + np.random.default_rng(0).normal(0.0, sigma, image.shape)) / 255.0)


def jpeg(image: np.ndarray, loss: float) -> np.ndarray:
    """Through JPEG of quality 100 - loss."""
    quality = [cv2.IMWRITE_JPEG_QUALITY, round(100 - loss)]
    return np.asarray(cv2.imdecode(cv2.imencode(".jpg", image, quality)[1], cv2.IMREAD_COLOR))


@dataclass(frozen=True)
class Kind:
    """One kind of degradation."""

    #: The degradation: (H, W, 3) uint8 and a strength to (H, W, 3) uint8.
    apply: Callable[[np.ndarray, float], np.ndarray]
    #: Name of the strength.
    strength: str
    #: Four strengths, weakest first.
    levels: tuple[float, float, float, float]
    #: Weakest and strongest that are tried for an equal PSNR.
    limits: tuple[float, float]


KINDS: Mapping[str, Kind] = {
    "gamma": Kind(gamma, "exponent", (1.1, 1.25, 1.6, 2.2), (1.01, 3.0)),
    "shift": Kind(shift, "px", (1.0, 2.0, 4.0, 8.0), (0.1, 16.0)),
    "noise": Kind(noise, "levels", (4.0, 10.0, 25.0, 50.0), (1.0, 60.0)),
    "JPEG": Kind(jpeg, "100 - quality", (20.0, 60.0, 85.0, 95.0), (5.0, 98.0)),
    "blur": Kind(blur, "px", (0.5, 1.0, 2.0, 4.0), (0.3, 16.0)),
}


def photographs() -> dict[str, np.ndarray]:
    """Three photographs, (SIZE, SIZE, 3) uint8."""
    crops = {
        "cat": data.chelsea()[:300, 75:375],
        "cup": data.coffee()[:400, 100:500],
        "astronaut": data.astronaut(),
    }
    return {
        name: cv2.resize(image, (SIZE, SIZE), interpolation=cv2.INTER_AREA)
        for name, image in crops.items()
    }


def disc() -> np.ndarray:
    """The mask, (SIZE, SIZE) uint8."""
    rows, columns = np.mgrid[:SIZE, :SIZE] - SIZE // 2
    return (rows**2 + columns**2 < RADIUS**2).astype(np.uint8) * 255


def score(
    prediction: np.ndarray, target: np.ndarray, networks: Mapping[str, Network] | None = None
) -> dict[str, float]:
    """The protocol's scores of a degraded photograph."""
    return score_frame(prediction, target, disc(), networks=networks)


def at_equal_psnr(kind: Kind, target: np.ndarray) -> tuple[float, np.ndarray]:
    """The strength at which the PSNR falls to `EQUAL_PSNR`, by bisection, and its image."""
    weak, strong = kind.limits
    for _ in range(20):
        middle = float(np.sqrt(weak * strong))
        if score(kind.apply(target, middle), target)["psnr"] > EQUAL_PSNR:
            weak = middle
        else:
            strong = middle
    return weak, kind.apply(target, weak)


def strength_table(networks: Mapping[str, Network]) -> str:
    """Means over the photographs for every kind and level, as Markdown."""
    rows = []
    for name, kind in KINDS.items():
        for level in kind.levels:
            scores = mean_scores(
                score(kind.apply(target, level), target, networks)
                for target in photographs().values()
            )
            rows.append((f"{name} ({kind.strength})", f"{level:g}", scores))
    return _markdown(("degradation", "strength"), rows)


def equal_table(networks: Mapping[str, Network]) -> str:
    """Means over the photographs at equal PSNR, nearest first, as Markdown."""
    rows = []
    for name, kind in KINDS.items():
        pairs = [(at_equal_psnr(kind, target), target) for target in photographs().values()]
        scores = mean_scores(score(image, target, networks) for (_, image), target in pairs)
        strengths = " / ".join(
            f"{strength:.3g}" if strength < 20 else f"{strength:.0f}" for (strength, _), _ in pairs
        )
        rows.append((f"{name} ({kind.strength})", strengths, scores))
    rows.sort(key=lambda row: row[2]["oriented_distance"])
    return _markdown(("degradation", f"strength ({' / '.join(photographs())})"), rows)


def _markdown(head: tuple[str, str], rows: list[tuple[str, str, dict[str, float]]]) -> str:
    names = [name for name in SHOWN if name in rows[0][2]]
    lines = [f"| {' | '.join((*head, *names))} |", "| --- " * (len(names) + 2) + "|"]
    for first, second, scores in rows:
        values = [f"{scores[n]:.2f}" if n == "psnr" else f"{scores[n]:.4f}" for n in names]
        lines.append(f"| {' | '.join((first, second, *values))} |")
    return "\n".join(lines)


def save_figure(path: Path) -> None:
    """Write the photograph and its five degradations at equal PSNR, and curves over PSNR."""
    import matplotlib

    matplotlib.use("Agg")
    import matplotlib.pyplot as plt

    target = photographs()["cat"]
    shown = [("original", target)]
    equal = {name: at_equal_psnr(kind, target)[1] for name, kind in KINDS.items()}
    shown += sorted(equal.items(), key=lambda item: score(item[1], target)["oriented_distance"])
    figure = plt.figure(figsize=(10, 5.6), layout="constrained")
    grid = figure.add_gridspec(2, len(shown), height_ratios=(1, 1.4))
    for column, (name, image) in enumerate(shown):
        axes = figure.add_subplot(grid[0, column])
        scores = score(image, target)
        axes.imshow(np.where(disc()[..., None] > 0, image, 0)[32:224, 32:224])
        axes.set_title(f"{name}, {scores['psnr']:.0f} dB", fontsize=9)
        axes.set_xlabel(
            f"SSIM {scores['ssim']:.3f}\ndistance {scores['oriented_distance']:.4f}", fontsize=9
        )
        axes.set_xticks([])
        axes.set_yticks([])
    half = len(shown) // 2
    left = figure.add_subplot(grid[1, :half])
    right = figure.add_subplot(grid[1, half:])
    for name, kind in KINDS.items():
        low, high = kind.limits
        strengths = np.geomspace(low, high, 16)
        points = [score(kind.apply(target, float(s)), target) for s in strengths]
        psnrs = [point["psnr"] for point in points]
        left.plot(psnrs, [point["oriented_distance"] for point in points], ".-", label=name)
        right.plot(psnrs, [1.0 - point["ssim"] for point in points], ".-", label=name)
    left.set(ylabel="oriented distance", ylim=(1e-4, 0.3))
    right.set(ylabel="1 - SSIM", ylim=(1e-3, 1.2))
    for axes in (left, right):
        axes.set(xlabel="PSNR, dB", yscale="log", xlim=(14, 40))
        axes.grid(alpha=0.3)
    left.legend(fontsize=8)
    path.parent.mkdir(parents=True, exist_ok=True)
    figure.savefig(path, dpi=100, metadata={"Software": None})
    plt.close(figure)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.split("\n", maxsplit=1)[0])
    parser.add_argument("--picture", type=Path, help="also draw the comparison to this PNG")
    args = parser.parse_args()
    networks = load_available()
    print(f"Means over {len(photographs())} photographs, protocol {HWP_V1.name}\n")
    print(strength_table(networks))
    print(f"\nAll at a PSNR of {EQUAL_PSNR:.0f} dB, nearest by oriented distance first\n")
    print(equal_table(networks))
    if args.picture is not None:
        save_figure(args.picture)


if __name__ == "__main__":
    main()
