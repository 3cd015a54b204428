"""How many frames of which size are rendered, checked before anything takes memory for them."""

from __future__ import annotations

from hwp_bench.base.errors import UsageError, whole_number

#: Smallest and largest number of frames.
FRAMES = (10, 100_000)
#: Smallest and largest edge of a frame, px.
SIZES = (32, 1024)
#: Most processes.
MAX_WORKERS = 1024


def check_extent(frame_count: int, size: int, workers: int | None = None) -> None:
    """Refuse what cannot be rendered or planned.

    Args:
        frame_count: frames over which a scene is spread.
        size: edge of a frame, px.
        workers: processes; None leaves their number open.

    Raises:
        UsageError: a number is out of range; it is named.
    """
    for name, value, low, high in (
        ("frame_count", frame_count, *FRAMES),
        ("size", size, *SIZES),
        ("workers", 1 if workers is None else workers, 1, MAX_WORKERS),
    ):
        value = whole_number(value, name)
        if not low <= value <= high:
            raise UsageError(f"{value} is not in {low}..{high}", field=name)
