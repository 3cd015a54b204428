"""The tracking program without MediaPipe. Oracle: a landmarker that says what it was told."""

from __future__ import annotations

import importlib.util
import subprocess
import sys
from pathlib import Path
from types import ModuleType, SimpleNamespace
from typing import Any

import cv2
import numpy as np
import pytest

from hwp_bench.importers.shared.landmarks import read_landmarks

PROGRAM = Path(__file__).resolve().parents[2] / "tools" / "track_mediapipe.py"


@pytest.fixture(scope="module")
def tool() -> ModuleType:
    spec = importlib.util.spec_from_file_location("track_mediapipe", PROGRAM)
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


class FakeLandmarker:
    """Sees a left and a right hand in every frame but the third."""

    def __init__(self) -> None:
        self.frame = -1

    def process(self, image: np.ndarray) -> Any:
        assert image.dtype == np.uint8
        self.frame += 1
        if self.frame == 2:
            return SimpleNamespace(
                multi_hand_landmarks=None, multi_handedness=None, multi_hand_world_landmarks=None
            )

        def points(offset: float) -> SimpleNamespace:
            rows = [SimpleNamespace(x=offset + 0.01 * k, y=0.5, z=-0.02 * k) for k in range(21)]
            return SimpleNamespace(landmark=rows)

        def label(name: str, score: float) -> SimpleNamespace:
            return SimpleNamespace(classification=[SimpleNamespace(label=name, score=score)])

        return SimpleNamespace(
            multi_hand_landmarks=[points(0.1), points(0.6)],
            multi_hand_world_landmarks=[points(-0.1), points(0.0)],
            multi_handedness=[label("Left", 0.8), label("Right", 0.9)],
        )


@pytest.mark.parametrize(
    ("hand", "first", "score"), [("right", 0.1, 0.8), ("left", 0.6, 0.9), ("any", 0.6, 0.9)]
)
def test_what_is_written_is_what_the_import_reads(
    tool: ModuleType, tmp_path: Path, hand: str, first: float, score: float
) -> None:
    video = tmp_path / "clip.avi"
    writer = cv2.VideoWriter(str(video), cv2.VideoWriter_fourcc(*"MJPG"), 30, (64, 48))
    for level in range(5):
        writer.write(np.full((48, 64, 3), 40 * level, dtype=np.uint8))
    writer.release()
    frames = tool.read_frames(str(video))
    tool.write(str(tmp_path / "out.npz"), tool.track(frames, FakeLandmarker(), hand))
    read = read_landmarks(tmp_path / "out.npz", min_score=0.5)
    np.testing.assert_array_equal(read.detected, [True, True, False, True, True])
    np.testing.assert_allclose(read.score[0], score)
    # Pixels of the whole frame: 64 px wide, 48 px high. The labels of a selfie are swapped.
    np.testing.assert_allclose(read.image[0, :, 0], 64 * (first + 0.01 * np.arange(21)))
    np.testing.assert_allclose(read.image[0, :, 1], 24.0)
    np.testing.assert_allclose(read.world[0, :, 2], -0.02 * np.arange(21))
    assert sorted(path.name for path in tmp_path.iterdir()) == ["clip.avi", "out.npz"]


def test_without_mediapipe_it_says_so() -> None:
    block = (
        "import sys, runpy; sys.modules['mediapipe'] = None; sys.argv = ['t', 'a', 'b']; "
        f"runpy.run_path({str(PROGRAM)!r}, run_name='__main__')"
    )
    done = subprocess.run(
        [sys.executable, "-c", block], capture_output=True, text=True, check=False
    )
    assert done.returncode == 1
    assert "mediapipe is not installed" in done.stderr
    assert "Traceback" not in done.stderr
