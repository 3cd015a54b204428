"""HWP bench: a benchmark for hand avatars learned from perturbed monocular video.

The names below are loaded when they are first used; `import hwp_bench` loads neither numpy nor
torch. Threads are set to sleep while they wait. `docs/python.md` shows the names at work.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from hwp_bench.base.numerics import wait_passively
from hwp_bench.base.packages import __version__, lazy_names

if TYPE_CHECKING:
    from hwp_bench.api import compare as compare
    from hwp_bench.api import evaluate as evaluate
    from hwp_bench.api import score as score
    from hwp_bench.base.errors import HwpError as HwpError
    from hwp_bench.capture import Capture as Capture
    from hwp_bench.capture import open_capture as open_capture
    from hwp_bench.importers.transforms import export_transforms as export_transforms
    from hwp_bench.importers.transforms import import_transforms as import_transforms
    from hwp_bench.methods.dataset import CaptureDataset as CaptureDataset
    from hwp_bench.results import Results as Results
    from hwp_bench.results import read_results as read_results
    from hwp_bench.sim.produce.capture import render_capture as render_capture

_HOMES = {
    "Capture": "hwp_bench.capture",
    "CaptureDataset": "hwp_bench.methods.dataset",
    "HwpError": "hwp_bench.base.errors",
    "Results": "hwp_bench.results",
    "compare": "hwp_bench.api",
    "evaluate": "hwp_bench.api",
    "export_transforms": "hwp_bench.importers.transforms",
    "import_transforms": "hwp_bench.importers.transforms",
    "open_capture": "hwp_bench.capture",
    "read_results": "hwp_bench.results",
    "render_capture": "hwp_bench.sim.produce.capture",
    "score": "hwp_bench.api",
}

__all__ = [*_HOMES, "__version__"]

# Here, since every process of ours comes by, before its first import of torch. Libraries read the
# variables when they are loaded.
wait_passively()

__getattr__, __dir__ = lazy_names(__name__, _HOMES)
