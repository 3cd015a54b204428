"""Shadows of posed hands. Oracle: every ray against every face in float64."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
import trimesh
from painted import TrainingMaker
from tiny_fits import UNJUDGED

from hwp_bench.hands import load_template, pose_hand, vertex_normals
from wildghand.avatar.files import load_avatar, save_avatar
from wildghand.fitting.components import make_fit
from wildghand.fitting.light import Lighting
from wildghand.gaussians.quaternions import quat_third_axis
from wildghand.gaussians.rig import HandRig, make_rig
from wildghand.light import CastLight, HandShadows, Obstacles, ShadowTable
from wildghand.light.hand_shadows import LIFT
from wildghand.model.settings import read_settings

SHADED: dict[str, Any] = {**UNJUDGED, "shadows.enabled": True}


def a_light() -> CastLight:
    directions = np.array([[0.0, 0.0, -1.0], [0.6, 0.0, 0.8], [0.0, 1.0, 0.0]], np.float32)
    return CastLight(directions, np.array([1.0, 0.0, 0.5], np.float32), 0.25)


@pytest.fixture(scope="module")
def rigs() -> dict[str, HandRig]:
    return {side: make_rig(load_template("anny", side), 400) for side in ("left", "right")}


def hand(bend: float, shift: tuple[float, float, float]) -> tuple[torch.Tensor, ...]:
    """A hand whose fingers bend, in one frame."""
    pose = torch.zeros(1, 16, 3)
    pose[:, 1:, 2] = bend
    return pose, torch.zeros(10), torch.tensor([shift])


def meets(mesh: trimesh.Trimesh, starts: np.ndarray, direction: np.ndarray) -> np.ndarray:
    """(M,) whether rays along one direction meet a mesh (Moeller and Trumbore)."""
    first, *others = np.moveaxis(np.asarray(mesh.triangles), 1, 0)
    edges = [other - first for other in others]
    across = np.cross(direction, edges[1])
    inverse = 1.0 / (edges[0] * across).sum(axis=1)
    found = np.zeros(len(starts), dtype=bool)
    for part in np.array_split(np.arange(len(starts)), len(starts) // 100 + 1):
        away = starts[part, None] - first
        u = (away * across).sum(axis=2) * inverse
        turned = np.cross(away, edges[0])
        v = (turned @ direction) * inverse
        distance = (turned * edges[1]).sum(axis=2) * inverse
        found[part] = ((u >= 0) & (v >= 0) & (u + v <= 1) & (distance > 0)).any(axis=1)
    return found


def test_what_is_in_the_way_is_what_rays_meet() -> None:
    ball = trimesh.creation.icosphere(subdivisions=3, radius=0.02)
    plate = trimesh.creation.box((0.1, 0.1, 0.002))
    plate.apply_translation([0.0, 0.0, 0.05])
    obstacles = Obstacles([(ball.vertices, ball.faces), (plate.vertices, plate.faces)])
    random = np.random.default_rng(0)
    directions = random.normal(size=(12, 3))
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    free = obstacles.free(ball.vertices, ball.vertex_normals, directions)
    both = trimesh.util.concatenate([ball, plate])
    facing = ball.vertex_normals @ directions.T > 0.02
    starts = ball.vertices + LIFT * ball.vertex_normals
    met = np.stack([meets(both, starts, direction) for direction in directions], axis=1)
    expected = np.where(facing & met, 0.0, 1.0)
    # Rays that pass an edge within rounding may differ.
    assert (free != expected).mean() < 1e-3
    assert 0.02 < (free == 0.0).mean() < 0.5


def test_an_open_hand_has_less_shadow_than_a_bent_one(rigs: dict[str, HandRig]) -> None:
    shadows = HandShadows({"right": rigs["right"]}, a_light(), darkest=0.0)
    least = []
    for bend in (0.0, 0.9):
        dark = shadows.of({"right": hand(bend, (0.0, 0.0, 0.4))})["right"]
        assert dark.shape == (1, 400)
        assert float(dark.max()) <= 1.0 + 1e-6
        assert float(dark.min()) >= 0.0
        least.append(float(dark.mean()))
    assert least[1] < least[0] - 0.005


def test_factors_at_vertices_are_those_of_the_formula(rigs: dict[str, HandRig]) -> None:
    light, darkest = a_light(), 0.15
    shadows = HandShadows({"right": rigs["right"]}, light, darkest=darkest)
    pose = hand(0.9, (0.0, 0.0, 0.4))
    got = shadows.at_vertices({"right": pose})["right"][0]
    template = rigs["right"].template
    vertices = pose_hand(template, *pose).vertices
    normals = vertex_normals(vertices, template.faces)[0].double().numpy()
    places, faces = vertices[0].double().numpy(), template.faces.numpy()
    mesh = trimesh.Trimesh(places, faces, process=False)
    full, left = np.full(len(places), 0.25), np.full(len(places), 0.25)
    for direction, strength in zip(light.directions, light.strengths, strict=True):
        falling = np.maximum(normals @ direction, 0.0) * strength
        starts = places + LIFT * normals
        met = meets(mesh, starts, direction.astype(float))
        full, left = full + falling, left + falling * ~met
    expected = np.clip(left / full, darkest, 1.0) ** (1.0 / 2.2)
    assert (np.abs(got - expected) > 0.01).mean() < 0.01  # rays along an edge
    assert got.min() < 0.8


def test_a_hand_in_the_light_of_the_other_shades_it(rigs: dict[str, HandRig]) -> None:
    lamp = CastLight(np.array([[0.0, 0.0, -1.0]], np.float32), np.ones(1, np.float32), 0.25)
    shadows = HandShadows(rigs, lamp, darkest=0.0)
    middles = {side: rig.template.vertices.mean(dim=0) for side, rig in rigs.items()}
    # One is straight in front of the other.
    far = hand(0.0, tuple((torch.tensor([0.0, 0.0, 0.5]) - middles["right"]).tolist()))
    near = hand(0.0, tuple((torch.tensor([0.0, 0.0, 0.4]) - middles["left"]).tolist()))
    alone = shadows.of({"right": far})["right"]
    behind = shadows.of({"left": near, "right": far})
    assert float(behind["right"].mean()) < float(alone.mean()) - 0.02
    # The lamp stands on the camera's side, so the hand in front has its light.
    torch.testing.assert_close(behind["left"], shadows.of({"left": near})["left"])


def test_shading_is_the_irradiance_with_nothing_in_the_way(rigs: dict[str, HandRig]) -> None:
    light = a_light()
    normals = np.random.default_rng(3).normal(size=(2, 50, 3))
    normals /= np.linalg.norm(normals, axis=-1, keepdims=True)
    falling = np.maximum(normals @ light.directions.T.astype(float), 0.0) @ light.strengths
    expected = (0.25 + falling) ** (1.0 / 2.2)
    got = HandShadows(rigs, light).shading(torch.from_numpy(normals).float())
    np.testing.assert_allclose(got, expected, rtol=1e-5)
    # In the dark skin is dim and not black.
    dark = CastLight(light.directions, np.zeros(3, np.float32), 0.0)
    night = HandShadows(rigs, dark).shading(torch.zeros(1, 1, 3))
    assert 0.3 < float(night[0, 0]) < 0.5


def test_the_table_of_a_clip_holds_the_same(make_training: TrainingMaker) -> None:
    fit = make_fit(make_training(), read_settings(SHADED), 0, torch.device("cpu"))
    shadows = HandShadows(fit.model.rigs, a_light())
    table = ShadowTable(shadows, fit.clip)
    pose, betas, transl = fit.clip.parameters["right"]
    for rows in ([3], [0, 3, 5], [5, 0]):
        here = torch.tensor(rows)
        expected = shadows.of({"right": (pose[here], betas, transl[here])})["right"]
        torch.testing.assert_close(table(here)["right"], expected, rtol=0.0, atol=1e-6)


def test_shadows_darken_what_is_drawn_and_are_kept(
    make_training: TrainingMaker, tmp_path: Path
) -> None:
    training = make_training()
    fit = make_fit(training, read_settings(SHADED), 0, torch.device("cpu"))
    frame = int(training.validation[0])
    hands, camera = training.hand_poses(frame), training.camera(frame)
    fit.model.shadows = None
    without = fit.avatar(0).pose(hands)
    fit.model.keep(a_light())
    avatar = fit.avatar(0)
    made = avatar.pose(hands)
    posed = avatar.posed(hands)
    dark = fit.model.cast(posed)["right"][0].numpy()
    assert dark.min() < 0.98
    anchors = fit.model.rigs["right"].pose(*posed["right"])
    lit = fit.model.shadows.shading(quat_third_axis(anchors.orientations))
    assert lit is not None
    factor = (dark * lit[0].numpy())[:, None]
    np.testing.assert_allclose(made.colors, without.colors * factor, atol=1e-6)
    np.testing.assert_array_equal(made.opacities, without.opacities)
    drawn = avatar.render(hands, camera)
    again = load_avatar(save_avatar(avatar, tmp_path / "avatar"))
    np.testing.assert_array_equal(again.render(hands, camera), drawn)


def test_training_frames_are_drawn_with_their_shadows(make_training: TrainingMaker) -> None:
    fit = make_fit(make_training(), read_settings(SHADED), 0, torch.device("cpu"))
    fit.model.keep(a_light())
    rows = torch.tensor([1, 4])
    table = ShadowTable(HandShadows(fit.model.rigs, a_light()), fit.clip)
    size = fit.data.training.width, fit.data.training.height
    # Without factors at hand the model casts them itself.
    own = fit.model.draw_frames(fit.clip, rows, *size)
    given = fit.model.draw_frames(fit.clip, rows, *size, dark=table(rows))
    none = fit.model.draw_frames(fit.clip, rows, *size, dark={})
    torch.testing.assert_close(own.image, given.image, rtol=0.0, atol=1e-5)
    assert float(none.image.detach().sum()) > float(given.image.detach().sum())


def test_a_fit_finds_a_light_unless_it_is_switched_off(make_training: TrainingMaker) -> None:
    found = make_fit(make_training(), read_settings(SHADED), 0, torch.device("cpu"))
    assert found.model.shadows is not None
    shadows = found.part(Lighting)
    assert shadows is not None
    assert set(shadows.dark(torch.tensor([0]))) == {"right"}
    without = make_fit(make_training(), read_settings(UNJUDGED), 0, torch.device("cpu"))
    assert without.model.shadows is None
    assert not without.part(Lighting).dark(torch.tensor([0]))
    assert not [name for name, _ in without.model.named_buffers() if name.startswith("shadows_")]
