"""FLIP as the package computes it, where that is installed; and how it enters the scores."""

from __future__ import annotations

import importlib.machinery
import sys
import types
from typing import Any

import numpy as np
import pytest

from hwp_bench.metrics import metric_names, penalty
from hwp_bench.metrics.score import score_frame


def _pair() -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    rng = np.random.default_rng(0)
    target = rng.integers(0, 256, (96, 96, 3), dtype=np.uint8)
    prediction = np.clip(target + rng.normal(0, 20, target.shape), 0, 255).astype(np.uint8)
    rows, columns = np.mgrid[:96, :96]
    return prediction, target, (rows - 40) ** 2 + (columns - 50) ** 2 < 30**2


def test_a_map_is_averaged_over_the_scored_pixels() -> None:
    """Oracle: a map that is the squared error gives the mean squared error of PSNR."""
    prediction, target, mask = _pair()
    networks = {"flip": lambda x, y: ((x - y) ** 2).mean(axis=2)}
    scores = score_frame(prediction, target, mask, coverage=True, networks=networks)
    assert scores["flip"] == pytest.approx(10 ** (-scores["psnr"] / 10), rel=1e-12)
    assert "flip" not in score_frame(prediction, target, mask, coverage=True)
    assert set(metric_names(["flip"])) - set(metric_names()) == {"flip"}
    assert penalty(["flip"])["flip"] == 1.0


def test_flip_of_the_box_is_that_of_the_whole_frame_on_black() -> None:
    """Oracle: the package on the whole frame, the mean over the same pixels; 1e-5 (float32)."""
    evaluate = pytest.importorskip("flip_evaluator").evaluate
    from hwp_bench.metrics.lpips import flip_map, load_available

    assert load_available()["flip"] is flip_map
    prediction, target, mask = _pair()
    found = score_frame(prediction, target, mask, coverage=True, networks={"flip": flip_map})
    black = [
        (np.where(mask[..., None], i, 0) / 255).astype(np.float32) for i in (target, prediction)
    ]
    whole = evaluate(*black, "LDR", applyMagma=False)[0][..., 0][mask].mean()
    assert found["flip"] == pytest.approx(whole, abs=1e-5)
    same = score_frame(target, target, mask, coverage=True, networks={"flip": flip_map})
    assert same["flip"] == 0.0


def test_flip_is_the_map_of_distances_of_the_package(monkeypatch: pytest.MonkeyPatch) -> None:
    """Oracle: a stand-in with the package's call, whose distance is the mean difference."""
    asked = []

    def evaluate(
        reference: Any,
        test: Any,
        kind: str,
        *,
        applyMagma: bool,
        computeMeanError: bool,
        **more: Any,
    ) -> Any:
        asked.append((reference.dtype, test.dtype, kind, more))
        distance = np.abs(reference - test).mean(axis=2, keepdims=True)
        return (np.repeat(distance**0.5, 3, axis=2) if applyMagma else distance), None, {}

    module = types.ModuleType("flip_evaluator")
    module.__spec__ = importlib.machinery.ModuleSpec("flip_evaluator", None)
    module.evaluate = evaluate  # type: ignore[attr-defined]
    monkeypatch.setitem(sys.modules, "flip_evaluator", module)
    from hwp_bench.metrics.lpips import flip_map, load_available

    assert load_available()["flip"] is flip_map
    prediction, target, mask = _pair()
    found = score_frame(prediction, target, mask, coverage=True, networks={"flip": flip_map})
    expected = np.abs(prediction / 255.0 - target / 255.0)[mask].mean()
    assert found["flip"] == pytest.approx(expected, abs=1e-6)
    # 67 pixels a degree: its default.
    assert asked == [(np.dtype("f4"), np.dtype("f4"), "LDR", {})]
