"""Images on a disc that is full. Oracle: a limit of the system on the size of a file.

OpenImageIO answers that all is well when the last bytes of an image find no space.
"""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

WRITE = """
import resource, signal, sys
import numpy as np
from hwp_bench.base.errors import HwpError
from hwp_bench.base.images import write_image
signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
noise = np.random.default_rng(0).integers(0, 256, (64, 64, 3), dtype=np.uint8)
_, most = resource.getrlimit(resource.RLIMIT_FSIZE)
for ending in ("png", "jpg", "bmp"):
    for limit in (0, 1, 1000, 4000):
        resource.setrlimit(resource.RLIMIT_FSIZE, (limit, most))
        try:
            write_image(f"{sys.argv[1]}/{limit}.{ending}", noise)
        except HwpError as error:
            print(error)
"""


def test_an_image_is_written_whole_or_not_at_all(tmp_path: Path) -> None:
    done = subprocess.run(
        [sys.executable, "-c", WRITE, str(tmp_path)], capture_output=True, text=True, check=False
    )
    assert done.returncode == 0, done.stderr
    lines = done.stdout.splitlines()
    assert len(lines) == 12
    assert all("cannot be written" in line for line in lines)
    assert list(tmp_path.iterdir()) == []
