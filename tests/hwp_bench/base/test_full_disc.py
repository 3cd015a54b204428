"""Images on a disc that is full. Oracle: a limit of the system on the size of a file.

OpenImageIO answers that all is well when the last bytes of an image find no space.
"""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import pytest

WRITE = """
import resource, signal, sys
import numpy as np
from hwp_bench.base.errors import HwpError
from hwp_bench.base.images import write_image
signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
resource.setrlimit(resource.RLIMIT_FSIZE, (int(sys.argv[2]), int(sys.argv[2])))
noise = np.random.default_rng(0).integers(0, 256, (64, 64, 3), dtype=np.uint8)
try:
    write_image(sys.argv[1], noise)
except HwpError as error:
    print(error)
    raise SystemExit(2)
"""


@pytest.mark.parametrize("ending", ["png", "jpg", "bmp"])
@pytest.mark.parametrize("limit", [0, 1, 1000, 4000])
def test_an_image_is_written_whole_or_not_at_all(tmp_path: Path, ending: str, limit: int) -> None:
    path = tmp_path / f"image.{ending}"
    done = subprocess.run(
        [sys.executable, "-c", WRITE, str(path), str(limit)],
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 2, done.stderr
    assert "cannot be written" in done.stdout
    assert done.stdout.count("\n") == 1
    assert list(tmp_path.iterdir()) == []
