"""What frames lose at each severity: the stated loss, and that of every frame of a suite.

Run from the repository: `python -m benchmarks.severities -o severities.svg` compares each training
frame of simulated captures, in which one perturbation acts, with its clean version over the pixels
that the hand covers fully: the covered share for hand-object interaction, PSNR for illumination and
motion blur. Severities are calibrated in the middle of episodes at 112 px (`hwp-bench dev
calibrate`); here all frames of an episode count, at the suite's size. Complex poses change what a
method is given, not the frame, and are left out.
"""

from __future__ import annotations

import argparse
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from hwp_bench.base.console import track
from hwp_bench.base.tables import Cell, to_markdown
from hwp_bench.capture import Capture, open_capture
from hwp_bench.cli.options import named_table
from hwp_bench.sim.produce.calibration import TARGETS, psnr
from hwp_bench.sim.produce.capture import ensure_suite, suite
from hwp_bench.taxonomy import perturbation

#: Perturbations that change a frame, and the range of their losses in the picture.
KINDS: Mapping[str, tuple[float, float]] = {
    "hand_object_interaction": (0.0, 0.6),
    "illumination": (10.0, 60.0),
    "motion_blur": (10.0, 60.0),
}
SUITES = ("mini", "wild-dev", "persistent")
# PSNR of frames that equal their clean version, dB.
_EQUAL = 60.0


@dataclass(frozen=True)
class Loss:
    """What one frame loses."""

    kind: str
    severity: int
    #: Covered share of the hand, or PSNR over it in dB.
    value: float
    #: Capture and number of the frame.
    where: str


def losses(capture: Capture) -> list[Loss]:
    """Measure every frame of a capture in which one of `KINDS` acts alone."""
    found = []
    for frame in range(len(capture)):
        acting = [(kind, level) for kind, level in capture.info.severity(frame).items() if level]
        if len(acting) != 1 or acting[0][0] not in KINDS:
            continue
        (kind, level), hand = acting[0], capture.clean_mask(frame) == 255
        if not hand.any():
            continue
        if kind == "hand_object_interaction":
            value = 1.0 - float(capture.true_mask(frame)[hand].mean()) / 255.0
        else:
            shown, clean = (read(frame)[hand] / 255.0 for read in (capture.frame, capture.clean))
            value = min(psnr(shown, clean), _EQUAL)
        found.append(Loss(kind, level, value, f"{capture.info.id}, {frame}"))
    return found


def rows_of(found: Sequence[Loss]) -> list[list[Cell]]:
    """Rows of a table: perturbation, severity, stated, median, tenth and ninetieth percentile."""
    rows: list[list[Cell]] = []
    for kind in KINDS:
        for level, stated in enumerate(TARGETS[kind], start=1):
            values = [one.value for one in found if (one.kind, one.severity) == (kind, level)]
            if values:
                shown = [stated, *np.percentile(values, (50, 10, 90))]
                share = kind == "hand_object_interaction"
                texts = [f"{100 * value:.0f} %" if share else f"{value:.1f} dB" for value in shown]
                rows.append([perturbation(kind).title, level, len(values), *texts])
    return rows


def draw(found: Sequence[Loss], path: Path) -> None:
    """Draw every frame's loss over its severity, and the stated ones."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=(9.0, 3.2), layout="constrained")
    jitter = np.random.default_rng(0)
    for axes, (kind, (least, most)) in zip(figure.subplots(1, 3), KINDS.items(), strict=True):
        own = [one for one in found if one.kind == kind]
        across = [one.severity + jitter.uniform(-0.25, 0.25) for one in own]
        axes.plot(across, [one.value for one in own], ".", ms=3, alpha=0.5, label="a frame")
        axes.plot(range(1, 6), TARGETS[kind], "k_", ms=22, mew=2, label="stated")
        unit = "covered share" if kind == "hand_object_interaction" else "PSNR [dB]"
        axes.set(title=perturbation(kind).title, xlabel="severity", ylabel=unit)
        axes.set(xlim=(0.5, 5.5), ylim=(least - 0.02 * most, 1.02 * most))
    axes.legend(fontsize=8)
    figure.savefig(path, dpi=110)


def main() -> None:
    """Measure, and write the table and the picture."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--suites", nargs="+", default=list(SUITES))
    parser.add_argument("-o", "--out", type=Path, required=True, help="picture to write")
    given = parser.parse_args()
    folders = [folder for name in given.suites for folder in ensure_suite(suite(name))]
    found = [one for folder in track(folders, "Measuring") for one in losses(open_capture(folder))]
    titles = "Perturbation, Severity, Frames, Stated, Median, 10 %, 90 %"
    print(to_markdown(named_table("Losses by severity", titles, rows_of(found))))
    draw(found, given.out)


if __name__ == "__main__":
    main()
