"""The job of `benchmarks.engine`, importable from the processes that do it."""

from __future__ import annotations

import time
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

from hwp_bench.run.engine.job import OnProgress

#: Bytes of the input, about a capture of the suite `mini`.
INPUT_BYTES = 8 << 20
#: Bytes of the result, about predictions and pictures of one.
OUTPUT_BYTES = 1 << 20


@dataclass(frozen=True)
class Wait:
    """Reads its input, waits as for a fit on a device of its own, and writes a result."""

    #: Seconds that it waits.
    seconds: float

    def __call__(self, inputs: Mapping[str, Path], output: Path, on_progress: OnProgress) -> None:
        """Do the job; see `hwp_bench.run.engine.job.Work`."""
        content = (inputs["capture"] / "frames.bin").read_bytes()
        time.sleep(self.seconds)
        output.mkdir(parents=True, exist_ok=True)
        (output / "result.bin").write_bytes(content[:OUTPUT_BYTES])
