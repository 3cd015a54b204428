"""From the profiler's events to shares of a step by pass, component and operation.

Time counts where it is spent: an event's own time, without that of the events within it, belongs to
the innermost component around it. An operation of the backward pass belongs to the component whose
forward operation made its node: both carry the same sequence number.
"""

from __future__ import annotations

from collections import defaultdict
from typing import Any

from benchmarks.step_spans import OTHER, PASS, component_of

#: What the names of the engine's events begin with.
_NODE = "autograd::engine::evaluate_function: "

#: Share of the time by (pass, component, operation).
Shares = dict[tuple[str, str, str], float]


def shares_of(profiler: Any, seconds: float) -> Shares:
    """Shares of the time of a profiled block of steps; they sum to 1.

    Args:
        profiler: a stopped `torch.profiler.profile`.
        seconds: of the block; what no event accounts for is `other`.
    """
    events = list(profiler.events())
    main = next(event.thread for event in events if event.name.startswith(PASS))
    events = [event for event in events if event.thread == main]
    makers = _makers(events)
    found: dict[tuple[str, str, str], float] = defaultdict(float)
    roots = [event for event in events if event.cpu_parent is None]
    covered = 0.0
    for root in sorted(roots, key=lambda event: event.time_range.start):
        covered += root.time_range.elapsed_us()
        _add(root, "forward", OTHER, makers, found)
    total = max(1e6 * seconds, covered)
    found["forward", OTHER, "between operations"] += total - covered
    return {key: value / total for key, value in found.items()}


def _makers(events: list[Any]) -> dict[int, str]:
    """The component of the forward operation that made each node, by sequence number."""
    makers: dict[int, tuple[float, str]] = {}
    for event in events:
        number = event.sequence_nr
        if number < 0 or event.name.startswith(_NODE) or _inside_node(event):
            continue
        start = event.time_range.start
        # Operations that make no node have the number of the next node: the last one made it.
        if number not in makers or start >= makers[number][0]:
            makers[number] = (start, _around(event))
    return {number: component for number, (_, component) in makers.items()}


def _inside_node(event: Any) -> bool:
    parent = event.cpu_parent
    while parent is not None:
        if parent.name.startswith(_NODE):
            return True
        parent = parent.cpu_parent
    return False


def _around(event: Any) -> str:
    while event is not None:
        component = component_of(event.name)
        if component is not None:
            return component
        event = event.cpu_parent
    return OTHER


def _add(
    event: Any,
    step_pass: str,
    component: str,
    makers: dict[int, str],
    found: dict[tuple[str, str, str], float],
) -> str:
    """Add an event and those within it; returns the component that the next event may belong to."""
    opened = component_of(event.name)
    if event.name.startswith(PASS):
        step_pass, opened = event.name.removeprefix(PASS), OTHER
    elif event.name.startswith(_NODE) and "AccumulateGrad" not in event.name:
        opened = makers.get(event.sequence_nr, OTHER)
    # A gradient is accumulated right after the node that it comes from, so it stays with it.
    component = opened or component
    if component == "optimizer":
        step_pass = "update"
    inner, within = 0.0, component
    for child in sorted(event.cpu_children, key=lambda child: child.time_range.start):
        inner += child.time_range.elapsed_us()
        last = _add(child, step_pass, within, makers, found)
        within = last if child.name.startswith(_NODE) else component
    own = max(event.time_range.elapsed_us() - inner, 0.0)
    found[step_pass, component, _operation(event.name)] += own
    return component


def _operation(name: str) -> str:
    if name.startswith(_NODE):
        return "autograd"
    if component_of(name) is not None or name.startswith(PASS):
        return "Python"
    return name.removeprefix("aten::")


def by_component(shares: Shares) -> dict[str, dict[str, float]]:
    """Shares by component and pass, the largest component first."""
    table: dict[str, dict[str, float]] = defaultdict(lambda: defaultdict(float))
    for (step_pass, component, _), share in shares.items():
        table[component][step_pass] += share
    return dict(sorted(table.items(), key=lambda item: -sum(item[1].values())))
