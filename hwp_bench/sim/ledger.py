"""What rendering costs: seconds by pass, rays by purpose."""

from __future__ import annotations

import time
from collections import Counter, defaultdict
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field


@dataclass
class Ledger:
    """Measured cost of a frame."""

    #: Seconds by pass.
    seconds: dict[str, float] = field(default_factory=lambda: defaultdict(float))
    #: Rays by purpose.
    rays: Counter[str] = field(default_factory=Counter)

    @contextmanager
    def time(self, name: str) -> Iterator[None]:
        """Charge what happens inside to one pass."""
        start = time.perf_counter()
        yield
        self.seconds[name] += time.perf_counter() - start
