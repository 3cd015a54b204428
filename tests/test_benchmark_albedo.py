"""Learnt against true albedo. Oracles: the painted atlas of a subject, and errors made by hand."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from scipy.spatial import cKDTree

from benchmarks import albedo
from hwp_bench.hands import load_template
from hwp_bench.hands.anchors import sample_surface
from hwp_bench.sim.scene_files import load_scene
from hwp_bench.sim.subject.hand import skin_atlas

SUBJECT = load_scene("capture0").subject
TEMPLATE = load_template(SUBJECT.model, "right")
ANCHORS = sample_surface(TEMPLATE, 5000)


def test_the_true_albedo_is_that_of_the_atlas() -> None:
    """Anchors lie between the atlas's texels of 0.25 mm, so fine marks differ a little."""
    found = albedo.true_albedo(SUBJECT, "right", ANCHORS)[0]
    painted = skin_atlas(SUBJECT, "right").albedo
    corners = TEMPLATE.uv[TEMPLATE.face_uv][ANCHORS.face_index]
    u, v = np.einsum("nk,nkc->cn", ANCHORS.barycentric, corners)
    height, width = painted.shape[:2]
    texels = painted[((1.0 - v) * height).astype(int), (u * width).astype(int)]
    error = np.abs(np.log(texels / found)).mean(axis=1)
    assert np.median(error) < 0.01
    assert np.quantile(error, 0.9) < 0.1


def found_with(monkeypatch: pytest.MonkeyPatch, factor: np.ndarray) -> albedo.Albedo:
    """Compare a learnt albedo that is the true one times 0.3 and a factor (N,)."""
    true = albedo.true_albedo(SUBJECT, "right", ANCHORS)[0]
    learnt = 0.3 * true * factor[:, None]
    monkeypatch.setattr(albedo, "learnt_albedo", lambda *_: (learnt, np.ones(len(true))))
    rig = SimpleNamespace(anchors=ANCHORS)
    avatar: Any = SimpleNamespace(model=SimpleNamespace(rigs={"right": rig}))
    return albedo.compare_albedo(avatar, None, SUBJECT, "right")  # type: ignore[arg-type]


def test_brightness_of_the_clip_is_no_error(monkeypatch: pytest.MonkeyPatch) -> None:
    found = found_with(monkeypatch, np.ones(len(ANCHORS)))
    assert found.rms(found.seen) == pytest.approx(0.0, abs=1e-9)


def test_a_dark_palm_is_an_error_of_the_palm(monkeypatch: pytest.MonkeyPatch) -> None:
    """Where all neighbours are of the palm, or none, the two differ by the factor."""
    _, back, places = albedo.true_albedo(SUBJECT, "right", ANCHORS)
    palm = back < albedo.PALM
    found = found_with(monkeypatch, np.where(palm, 0.5, 1.0))
    around = palm[cKDTree(places).query(places, k=albedo.NEIGHBOURS)[1]].mean(axis=1)
    inside, outside = found.error[around == 1.0], found.error[around == 0.0]
    assert len(inside) > 200 < len(outside)
    assert inside - outside.mean() == pytest.approx(-np.log(2.0), abs=1e-9)
    assert np.ptp(outside) < 1e-9
    assert found.rms(palm) > found.rms(~palm)
