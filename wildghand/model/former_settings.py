"""Names that settings had before they were nested.

Old command lines, presets, results, avatars and priors still hold them. `current_names` reads both
kinds; the newest value wins where a setting is given twice.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from types import MappingProxyType
from typing import Any

from hwp_bench.base.records import flattened

#: Components that were one setting, true or false; today `NAME.enabled`.
SWITCHES = ("dpd", "pao", "heads", "prepass")

#: Single settings: former name to name.
NAMES: Mapping[str, str] = MappingProxyType(
    {
        "gains": "dpd.gains",
        "gain_weight": "dpd.gain_weight",
        "omega_dropout": "dpd.omega_dropout",
        "omega_scale": "dpd.omega_scale",
        "omega_weight": "dpd.omega_weight",
        "refinement": "heads.refinement",
        "frame_poses": "prepass.frame_poses",
        "heads.frame_poses": "prepass.frame_poses",
        "dssim_weight": "terms.dssim_weight",
        "outside_weight": "terms.outside_weight",
        "steps": "schedule.steps",
        "batch": "schedule.batch",
        "decay": "schedule.decay",
        "final_rate": "schedule.final_rate",
        "halvings": "schedule.halvings",
        "plateau_steps": "schedule.plateau_steps",
        "clip_gradient": "schedule.clip_gradient",
    }
)

#: Tables: former name to name.
TABLES: Mapping[str, str] = MappingProxyType(
    {"weights": "pao", "judge": "prepass", "rates": "schedule.rates"}
)

#: Settings without a successor of the same meaning: `robust`, weights by the residuals of pixels,
#: was never on by default and has no effect; `pao.normalise_errors` chose among `pao.errors`.
GONE = ("robust", "robust_start", "pao.robust", "pao.robust_start", "pao.normalise_errors")

#: Former values of `pao.variant`. `weights`, in version 1, meant the mode's.
_VARIANTS = {"judged": "scaled", "paper": "printed"}

#: The default of `weights.background_threshold`, which stood for 10 where two hands were fitted.
_SINGLE_HAND = 3.0


def current_names(values: Mapping[str, Any]) -> dict[str, Any]:
    """Return settings as nested tables under today's names.

    Args:
        values: tables within tables, or `table.field` as names, or both; today's or former names.
            Unknown names stay as they are.
    """
    tree: dict[str, Any] = {}
    for former, value in flattened(values):
        for name, meant in _today(former, value):
            *tables, field = name.split(".")
            place = tree
            for table in tables:
                inner = place.get(table)
                if not isinstance(inner, dict):
                    inner = place[table] = {}
                place = inner
            place[field] = meant
    return tree


def _today(name: str, value: Any) -> Iterator[tuple[str, Any]]:
    """The settings that stand today for one setting; there may be two, or none."""
    table, _, field = name.partition(".")
    if field == "normalise_errors" and table in ("pao", "weights"):
        yield "pao.errors", "batch" if value else "absolute"
    elif name.replace("weights.", "pao.", 1) in GONE:
        return
    elif name in ("pao.variant", "weights.variant") and value in _VARIANTS:
        yield "pao.variant", _VARIANTS[value]
    elif name in SWITCHES and isinstance(value, bool):
        yield f"{name}.enabled", value
    elif name in NAMES:
        yield NAMES[name], value
    elif name == "binary_mask" and isinstance(value, bool):
        # It stood in place of PAO's weights, with PAO and without.
        if value:
            yield "pao.enabled", True
            yield "pao.variant", "binary"
    elif name == "weights.variant" and value in ("weights", "binary"):
        if value == "binary":
            yield "pao.variant", "binary"
    elif name == "weights.background_threshold":
        yield "pao.background_threshold", value
        if value != _SINGLE_HAND:
            yield "pao.background_threshold_both", value
    elif field and table in TABLES:
        yield f"{TABLES[table]}.{field}", value
    else:
        yield name, value
