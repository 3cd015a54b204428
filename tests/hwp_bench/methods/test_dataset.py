"""A capture as a data set of PyTorch. Oracle: the capture's own arrays and images."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
import torch
from small_captures import CaptureMaker
from torch.utils.data import DataLoader, Dataset

import hwp_bench
from hwp_bench.capture.splits import contiguous_split
from hwp_bench.methods.contract import RunSettings
from hwp_bench.methods.request import open_request, write_request


def test_items_are_the_frames_of_the_capture(make_capture: CaptureMaker) -> None:
    capture = make_capture(frames=12, size=24, hands="both")
    data = hwp_bench.CaptureDataset(capture)
    assert isinstance(data, Dataset)
    assert len(data) == 12
    item = data[5]
    assert item["frame"] == 5
    # A level of 255 in float32 is read back exactly.
    pixels = (item["image"].numpy() * 255.0).round().astype(np.uint8)
    np.testing.assert_array_equal(pixels, capture.frame(5))
    np.testing.assert_array_equal(item["mask"].numpy(), capture.mask(5) / np.float32(255))
    for name, array in (("K", capture.cameras.Ks), ("viewmat", capture.cameras.viewmats)):
        np.testing.assert_array_equal(item[name].numpy(), array[5].astype(np.float32))
    hand = capture.hands["left"]
    np.testing.assert_array_equal(
        item["hands"]["left"]["pose"].numpy(), hand.pose[5].astype(np.float32)
    )
    assert item["hands"]["left"]["valid"] is True


def test_a_loader_makes_batches_in_workers_too(make_capture: CaptureMaker) -> None:
    data = hwp_bench.CaptureDataset(make_capture(frames=12, size=24), [2, 4, 6])
    for workers in (0, 1):
        (batch,) = DataLoader(data, batch_size=3, num_workers=workers)
        assert batch["frame"].tolist() == [2, 4, 6]
        assert (tuple(batch["image"].shape), batch["image"].dtype) == (
            (3, 24, 24, 3),
            torch.float32,
        )
        assert batch["hands"]["right"]["pose"].shape == (3, 16, 3)


def test_a_method_gets_the_training_frames(make_capture: CaptureMaker, tmp_path: Path) -> None:
    capture = make_capture(frames=20, size=24)
    root = write_request(tmp_path / "r", capture, contiguous_split("tiny", 20), RunSettings())
    training = open_request(root)
    assert hwp_bench.CaptureDataset(training).frames == list(range(16))
    assert hwp_bench.CaptureDataset(training, training.validation).frames == [16, 17]


def test_wrong_arguments_are_named(make_capture: CaptureMaker) -> None:
    capture = make_capture(frames=12, size=24)
    with pytest.raises(hwp_bench.HwpError, match="there is no frame 12, only 0 to 11"):
        hwp_bench.CaptureDataset(capture, [3, 12])[1]
    with pytest.raises(hwp_bench.HwpError, match=r"capture: .*an opened capture"):
        hwp_bench.CaptureDataset(str(capture.root))  # type: ignore[arg-type]


def test_torch_is_loaded_when_it_is_asked_for() -> None:
    code = "import sys, hwp_bench; hwp_bench.Capture; sys.exit('torch.utils.data' in sys.modules)"
    assert subprocess.run([sys.executable, "-c", code], check=False).returncode == 0
