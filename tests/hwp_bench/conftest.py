"""Hands that the tests share."""

from __future__ import annotations

import numpy as np
import pytest
from synthetic_mano import write_mano_folder

from hwp_bench.hands import HandTemplate, load_template
from hwp_bench.hands.template import make_template


@pytest.fixture(scope="session")
def free_right() -> HandTemplate:
    """The free right hand."""
    return load_template()


@pytest.fixture(scope="session")
def free_left() -> HandTemplate:
    return load_template(side="left")


@pytest.fixture(scope="session")
def mano_folder(tmp_path_factory: pytest.TempPathFactory) -> str:
    folder = tmp_path_factory.mktemp("mano")
    write_mano_folder(folder)
    return str(folder)


@pytest.fixture(scope="session")
def mano_right(mano_folder: str) -> HandTemplate:
    return load_template(f"mano:{mano_folder}")


@pytest.fixture(scope="session")
def tiny_template() -> HandTemplate:
    """Seven vertices with every part that a template can have, drawn at random."""
    random = np.random.default_rng(5)
    count = 7
    weights = random.uniform(size=(count, 16)) ** 4
    return make_template(
        name="tiny",
        side="right",
        vertices=random.normal(size=(count, 3)),
        faces=np.array([[0, 1, 2], [2, 1, 3], [3, 4, 5], [5, 4, 6]]),
        shape_basis=0.1 * random.normal(size=(count, 3, 10)),
        pose_basis=0.1 * random.normal(size=(count, 3, 135)),
        joints=random.normal(size=(16, 3)),
        joint_basis=0.1 * random.normal(size=(16, 3, 10)),
        weights=weights / weights.sum(axis=1, keepdims=True),
        mean_pose=0.2 * random.normal(size=45),
        uv=random.uniform(size=(count, 2)),
        face_uv=np.array([[0, 1, 2], [2, 1, 3], [3, 4, 5], [5, 4, 6]]),
        fingertips=np.array([2, 3, 4, 5, 6]),
    )
