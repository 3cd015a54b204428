"""How much of the way to its oracles a method goes, capture by capture.

Run from the repository: `python -m benchmarks.gap --base RESULTS... --method RESULTS... --selection
RESULTS... --clean RESULTS...`, results folders whose seeds are averaged. Base and method were given
the perturbed frames, the oracles (fits of the base) only the unperturbed frames (`--train-on
unperturbed-only`) and the clean versions of all frames (`--train-on clean`).

Share of a gap: (method - base) / (oracle - base). The last rows are of mean scores, so that a
capture whose gap is nearly nothing does not decide; a share is empty where the oracle is no better
than the base.
"""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from hwp_bench.results import read_all

_ROLES = ("base", "method", "selection", "clean")


def capture_means(folders: Sequence[Path], metric: str) -> tuple[dict[str, float], dict[str, str]]:
    """Mean score of every capture over test frames, then over seeds; and whether hands interact."""
    found: dict[str, list[float]] = {}
    hands = {}
    for results in read_all(folders):
        for capture in results.captures:
            scores = [frame.scores[metric] for frame in capture.frames]
            found.setdefault(capture.id, []).append(float(np.mean(scores)))
            hands[capture.id] = "interacting" if capture.hands == "both" else "single"
    return {name: float(np.mean(values)) for name, values in found.items()}, hands


def share(values: Sequence[float], oracle: float) -> str:
    """Of the way from the base to an oracle, what the method goes."""
    base, method = values
    return f"{(method - base) / (oracle - base):.0%}" if oracle > base else ""


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.split("\n", maxsplit=1)[0])
    for role in _ROLES:
        parser.add_argument(f"--{role}", type=Path, nargs="+", required=True, help="results")
    parser.add_argument("--metric", default="psnr", help="metric (psnr)")
    args = parser.parse_args()
    read = {role: capture_means(getattr(args, role), args.metric) for role in _ROLES}
    hands = read["base"][1]
    print(
        "| capture | base | method | gain | selection oracle | clean oracle | of selection gap "
        "| of clean gap |"
    )
    print("| --- |" + " ---: |" * 7)
    groups = [(name, [name]) for name in hands]
    groups += [
        (f"**{kind}**", [name for name in hands if kind in (hands[name], "all")])
        for kind in ("single", "interacting", "all")
    ]
    for label, names in groups:
        if not names:
            continue
        base, method, selection, clean = (
            float(np.mean([read[role][0][name] for name in names])) for role in _ROLES
        )
        print(
            f"| {label} | {base:.2f} | {method:.2f} | {method - base:+.2f} | {selection:.2f} "
            f"| {clean:.2f} | {share((base, method), selection)} | {share((base, method), clean)} |"
        )


if __name__ == "__main__":
    main()
