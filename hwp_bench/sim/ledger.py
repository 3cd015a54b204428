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

    #: Processor seconds by pass; other work on the machine does not count.
    seconds: dict[str, float] = field(default_factory=lambda: defaultdict(float))
    #: Rays by purpose.
    rays: Counter[str] = field(default_factory=Counter)

    @contextmanager
    def time(self, name: str) -> Iterator[None]:
        """Charge what happens inside to one pass."""
        start = time.process_time()
        yield
        self.seconds[name] += time.process_time() - start
