"""Small valid inputs of every kind, which the fuzzer changes, made by the toolkit itself."""

from __future__ import annotations

import pickle
import shutil
import subprocess
import sys
from pathlib import Path

import numpy as np

ROOT = Path(__file__).resolve().parents[1]
_METHOD = """
import numpy as np
class Method:
    steps = 4
    def __init__(self, settings, seed):
        self.level = settings["level"] + 0.01 * seed
    def fit(self, training, budget, report):
        return self
    def render(self, hands, camera):
        return np.full((camera.height, camera.width, 4), self.level)
"""
_MANIFEST = """schema = "hwp-method/1"
training = "none"
name = "gray"
title = "Gray"
description = "One level of gray"
authors = ["A. Person"]
licence = "MIT"
url = "https://example.org/gray"
settings = ["level"]
[entry]
python = "gray_method:Method"
[presets.default]
level = 0.5
[switches.bright]
title = "Bright"
settings_off = { level = 0.2 }
"""
#: Settings of the smallest fit.
FIT = ("--steps", "2", "--set", "gaussians=200", "--set", "device=cpu")


def make_seeds(folder: Path) -> None:
    """Make every seed in a folder: captures, scenes, methods, predictions, results, an avatar, ...

    Raises:
        SystemExit: a command that makes one fails.
    """
    _write_scene(folder / "scene.toml")
    bench, hand = "hwp_bench.cli.main", "wildghand.cli.main"
    capture = str(folder / "capture")
    # The smallest clip that can be divided into training, validation and test frames.
    _make(bench, "sim", "render", str(folder / "scene.toml"), "-o", capture, "--frame-count", "10",
          "--size", "32", "--workers", "1", "--no-free-view")  # fmt: skip
    method = folder / "gray"
    method.mkdir()
    (method / "gray_method.py").write_text(_METHOD)
    (method / "method.toml").write_text(_MANIFEST)
    scored = ("--capture", capture)
    _make(bench, "evaluate", str(method), *scored, "-o", str(folder / "results"))
    _make(bench, "data", "inputs", *scored, "-o", str(folder / "inputs"))
    _write_submission(folder)
    _copy_entry(folder / "entries")
    sealed = ("--frame-count", "10", "--size", "32", "--workers", "1", "-o", str(folder / "sealed"))
    _make(bench, "challenge", "make", "capture0", *sealed)
    _make(bench, "challenge", "reveal", str(folder / "sealed"), "-o", str(folder / "revealed.json"))
    shutil.copy(ROOT / "splits" / "hwp-v1.json", folder / "splits.json")
    _write_split(folder / "split.json", capture)
    _make(hand, "fit", capture, "-o", str(folder / "avatar"), *FIT)
    shutil.copytree(ROOT / "wildghand" / "priors" / "compact", folder / "prior")
    _write_mano(folder / "mano")
    _write_video(folder)


def _make(module: str, *words: str) -> None:
    done = subprocess.run(
        [sys.executable, "-m", module, *words],
        cwd=ROOT,
        capture_output=True,
        text=True,
        check=False,
    )
    if done.returncode:
        raise SystemExit(f"{module} {' '.join(words)} failed: {done.stderr[-2000:]}")


def _write_scene(path: Path) -> None:
    text = (ROOT / "hwp_bench" / "sim" / "scene" / "scenes" / "capture0.toml").read_text("utf-8")
    path.write_text(text.replace('id = "capture0"', 'id = "seed"'), encoding="utf-8")


def _write_submission(folder: Path) -> None:
    """Predictions of the method, as an author hands them in."""
    made = folder / "submission"
    made.mkdir()
    kept = next((folder / "results").rglob("predictions"))
    shutil.copytree(kept, made / "predictions" / "seed")
    (made / "method.toml").write_text(
        'schema = "hwp-method/1"\ntraining = "none"\n'
        'name = "handed-in"\n[entry]\npredictions = "predictions"\n'
    )


def _copy_entry(target: Path) -> None:
    """One entry of the leaderboard with its check: the smallest that has one."""
    checks = list((ROOT / "leaderboard" / "entries" / "checks").glob("*.json"))
    pairs = [(check.parent.parent / f"{check.name.split('.')[0]}.json", check) for check in checks]
    entry, check = min(pairs, key=lambda pair: (pair[0].stat().st_size, pair[1].name))
    (target / "checks").mkdir(parents=True)
    shutil.copy(entry, target)
    shutil.copy(check, target / "checks")


def _write_split(path: Path, capture: str) -> None:
    from hwp_bench.capture.splits import contiguous_split, write_splits

    write_splits(path, [contiguous_split("seed", 10)])


def _write_mano(folder: Path) -> None:
    """Arrays of MANO's names and shapes: a ball of noise, which reads as well as a hand."""
    folder.mkdir()
    random = np.random.default_rng(0)
    roots = [2**32 - 1, 0, 1, 2, 0, 4, 5, 0, 7, 8, 0, 10, 11, 0, 13, 14]
    weights = random.random((778, 16))
    content = {
        "v_template": 0.1 * random.normal(size=(778, 3)),
        "shapedirs": 0.001 * random.normal(size=(778, 3, 10)),
        "posedirs": 0.001 * random.normal(size=(778, 3, 135)),
        "J_regressor": np.full((16, 778), 1.0 / 778) + 0.01 * random.normal(size=(16, 778)),
        "weights": weights / weights.sum(axis=1, keepdims=True),
        "kintree_table": np.array([roots, range(16)], dtype=np.int64),
        "f": random.integers(0, 778, (1538, 3)).astype(np.uint32),
        "hands_mean": np.zeros(45),
    }
    for side in ("RIGHT", "LEFT"):
        (folder / f"MANO_{side}.pkl").write_bytes(pickle.dumps(content, protocol=2))


def _write_video(folder: Path) -> None:
    import cv2

    random = np.random.default_rng(0)
    writer = cv2.VideoWriter(
        str(folder / "seed.avi"), cv2.VideoWriter.fourcc(*"MJPG"), 30.0, (64, 64)
    )
    for _ in range(6):
        writer.write(random.integers(0, 255, (64, 64, 3), dtype=np.uint8))
    writer.release()
    points = 32.0 + 8.0 * random.normal(size=(21, 2))
    np.savez(
        folder / "landmarks.npz",
        image=np.repeat(points[None], 6, 0),
        world=np.repeat(0.03 * random.normal(size=(1, 21, 3)), 6, 0),
        score=np.ones(6),
    )
