"""Settings of what a phone's camera does by itself while it records."""

from __future__ import annotations

from dataclasses import MISSING, asdict, dataclass, fields
from typing import Any

from hwp_bench.base.records import number


@dataclass(frozen=True)
class AutoControl:
    """Exposure and white balance that follow the image with a lag, and wander."""

    #: Mean linear luminance of the image that the exposure aims at.
    level: float = number(0.2, 0.02, 0.8)
    #: Share of the way to that level that the exposure goes, in stops; 0 holds it.
    exposure: float = number(1.0, 0.0, 1.0)
    #: Share of the way to a grey mean of the image that the white balance goes; 0 holds it.
    white_balance: float = number(0.6, 0.0, 1.0)
    #: Seconds in which both go 63 % of their way.
    lag: float = number(0.5, 0.05, 5.0)
    #: Standard deviation of the slow wandering around what the image asks for, stops.
    wander: float = number(0.06, 0.0, 1.0)


def without_defaults(record: Any, keep: tuple[str, ...]) -> dict[str, Any]:
    """Return a record as JSON values, without fields that say what they say by default.

    Args:
        record: a dataclass.
        keep: fields that are always in it. Those are a format's first fields; what came later is
            left out where it changes nothing, so that digests stay.
    """
    content = asdict(record)
    for item in fields(record):
        default = item.default
        if default is MISSING and item.default_factory is not MISSING:
            default = item.default_factory()
        if item.name not in keep and getattr(record, item.name) == default:
            del content[item.name]
    return content
