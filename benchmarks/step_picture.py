"""The components of a step as a flame graph: pass, component, operation, as wide as their time."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Mapping
from typing import TYPE_CHECKING

from benchmarks.step_shares import Shares
from hwp_bench.report.figures import PALETTE, SERIES, figure_style

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

#: Width of the figure and height of one level, inches.
WIDTH, LEVEL = 13.0, 0.85
#: Width of a letter in inches, and that of a box that is worth a text.
LETTER, WORTH = 0.074, 0.15
#: Order of the passes.
PASSES = ("forward", "backward", "update")


def draw_flames(shares: Mapping[str, Shares], steps: Mapping[str, float], title: str) -> Figure:
    """Draw the steps of methods above each other, on one scale.

    Args:
        shares: of each method's step.
        steps: ms of each method's step.
        title: what was measured.
    """
    from matplotlib.figure import Figure

    largest: dict[str, float] = defaultdict(float)
    for found in shares.values():
        for (_, component, _), share in found.items():
            largest[component] += share
    # The palette has fewer colours than there are components: the largest ones differ.
    names = sorted(largest, key=lambda name: -largest[name])
    order = {name: index for index, name in enumerate(names)}
    longest = max(steps.values())
    with figure_style():
        figure = Figure(figsize=(WIDTH, 0.9 + len(shares) * 4 * LEVEL), layout="constrained")
        plots = figure.subplots(len(shares), 1, sharex=True, squeeze=False)[:, 0]
        figure.suptitle(title, fontsize=11)
        for axes, (method, found) in zip(plots, shares.items(), strict=True):
            _draw(axes, method, found, steps[method], longest, order)
        plots[-1].set_xlabel("ms of a step (shares of the profiler, time of steps without it)")
    return figure


def _draw(
    axes: Axes, method: str, found: Shares, step: float, longest: float, order: Mapping[str, int]
) -> None:
    axes.set_xlim(0.0, longest)
    axes.set_ylim(4.0, 0.0)
    axes.set_yticks([])
    axes.spines[["left", "top", "right"]].set_visible(False)
    _box(axes, 0, 0.0, step, f"{method}: {step:.1f} ms", PALETTE["line"], longest)
    tree: dict[str, dict[str, dict[str, float]]] = defaultdict(lambda: defaultdict(dict))
    for (step_pass, component, operation), share in found.items():
        tree[step_pass][component][operation] = share * step
    left = 0.0
    for step_pass in sorted(tree, key=PASSES.index):
        components = tree[step_pass]
        width = sum(sum(parts.values()) for parts in components.values())
        _box(axes, 1, left, width, step_pass, PALETTE["shade"], longest)
        for component, parts in sorted(components.items(), key=lambda item: -sum(item[1].values())):
            part = sum(parts.values())
            colour = PALETTE[f"s{order[component] % SERIES}"]
            _box(axes, 2, left, part, component.removeprefix("network: "), colour, longest, 0.55)
            start = left
            for operation, size in sorted(parts.items(), key=lambda item: -item[1]):
                _box(axes, 3, start, size, operation, colour, longest, 0.25)
                start += size
            left += part


def _box(
    axes: Axes,
    level: int,
    left: float,
    width: float,
    text: str,
    colour: str,
    longest: float,
    alpha: float = 1.0,
) -> None:
    from matplotlib.patches import Rectangle

    axes.add_patch(
        Rectangle(
            (left, level), width, 0.96, facecolor=colour, alpha=alpha, edgecolor="white", lw=0.5
        )
    )
    inches = width / longest * (WIDTH - 0.6)
    if inches < WORTH:
        return
    upright = inches < min(LETTER * len(text), LEVEL)
    room = int((LEVEL if upright else inches) / LETTER)
    shown = text if len(text) <= room else text[: max(room - 1, 1)] + "…"
    axes.text(
        left + width / 2, level + 0.5, shown, ha="center", va="center", fontsize=8,
        rotation=90 if upright else 0, clip_on=True,
    )  # fmt: skip
