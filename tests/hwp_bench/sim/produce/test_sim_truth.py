"""The subject's own rest hands as truth. Oracles: the subject as it is rendered, exact masks."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from tiny_scene import SceneMaker

from hwp_bench.base.arrays import read_npz
from hwp_bench.capture import Capture, open_capture
from hwp_bench.capture.schema import TRUE_TEMPLATE
from hwp_bench.capture.splits import contiguous_split
from hwp_bench.hands import HandTemplate
from hwp_bench.hands.anchors import HandSurfaces
from hwp_bench.hands.raster import overlap
from hwp_bench.methods.contract import RunSettings
from hwp_bench.methods.request import frame_choice, known_oracle_inputs, open_request, write_request
from hwp_bench.sim.hand.anatomy import SubjectAnatomy
from hwp_bench.sim.produce.capture import render_capture
from hwp_bench.sim.produce.truth import add_subject_mesh, subject_template, subject_templates
from hwp_bench.sim.scene.scene import HandKey, hand_parameters, moment_of_key
from hwp_bench.sim.subject.hand import subject_hand, template_vertices
from hwp_bench.sim.subject.subject import Subject

FRAMES, SIZE = 10, 72
#: Far off the template: thin fingers of other lengths, moved joints.
PERSON = """age = 31.0

[subject.anatomy]
seed = 4
bone_length = 8.0
finger_lengths = [1.2, 0.8, 1.2, 0.8, 1.25]
finger_widths = [0.75, 0.75, 0.75, 0.75, 0.75]
joint_shift = 4.0
knuckles = 1.5
"""


@pytest.fixture
def capture(make_scene: SceneMaker, tmp_path: Path, small_paintings: None) -> Capture:
    scene = make_scene(("age = 31.0\n", PERSON))
    render_capture(
        scene, tmp_path / "tiny", frame_count=FRAMES, size=SIZE, workers=1, free_view=False
    )
    return open_capture(tmp_path / "tiny")


def agreement(capture: Capture, template: HandTemplate) -> tuple[float, float]:
    """Of the silhouettes of a template in the true poses: IoU with the exact masks of the clean
    frames, and the share of these that they cover."""
    assert capture.true_hands is not None
    frames = np.arange(FRAMES)
    drawn = HandSurfaces({"right": template}, 0.004).footprints(
        capture.true_hands, capture.cameras.Ks, capture.cameras.viewmats, frames, capture.size
    )
    masks = [capture.clean_mask(frame) > 127 for frame in range(FRAMES)]
    rows = [
        (overlap(item.silhouette, mask), (item.silhouette & mask).sum() / mask.sum())
        for item, mask in zip(drawn, masks, strict=True)
    ]
    first, second = np.mean(rows, axis=0)
    return float(first), float(second)


def test_a_method_with_the_truth_mesh_gets_hands_that_fill_the_masks(
    capture: Capture, tmp_path: Path
) -> None:
    assert "mesh" in known_oracle_inputs(capture)
    split = contiguous_split("tiny", FRAMES)
    given = {}
    for choice in ("perturbed", frame_choice(["mesh"])):
        root = write_request(tmp_path / "r", capture, split, RunSettings({}, frames=choice))
        given[choice] = open_request(root).template("right")
    model, own = given.values()
    assert (own.name, own.faces.shape) == (model.name, model.faces.shape)
    assert not own.shape_basis.any()
    (before, _), (after, covered) = agreement(capture, model), agreement(capture, own)
    # A sleeve hides the wrist of both, so that neither comes to 1.
    assert after > before + 0.03
    assert covered > 0.99


def test_captures_of_before_get_it_from_their_scene(capture: Capture) -> None:
    path = capture.root / TRUE_TEMPLATE
    stored, digest = read_npz(path), capture.digest
    assert add_subject_mesh(capture)
    path.unlink()
    assert "mesh" not in known_oracle_inputs(capture)
    assert add_subject_mesh(capture)
    again = open_capture(capture.root)
    assert again.digest == digest
    for name, values in read_npz(path).items():
        np.testing.assert_array_equal(values, stored[name])
    path.unlink()
    (capture.root / "extra" / "scene.json").write_text('{"subject": {}}')
    assert not add_subject_mesh(capture)
    assert not path.exists()


@pytest.mark.parametrize("side", ["right", "left"])
@pytest.mark.parametrize("anatomy", [None, SubjectAnatomy(seed=3, bone_length=8.0, joint_shift=4)])
def test_posed_by_the_capture_it_is_where_the_subject_is(
    side: str, anatomy: SubjectAnatomy | None
) -> None:
    hand = subject_hand(Subject(seed=11, tone=0.2, age=30.0, anatomy=anatomy), side)
    own = subject_template(hand)
    for gesture in ("open", "fist"):
        moment = moment_of_key(HandKey(gesture, turn=40.0, tilt=25.0, roll=10.0))
        rendered = hand_parameters(moment, side, hand.joints)
        stated = hand_parameters(moment, side, hand.model_joints)
        exact = hand.pose(*rendered)[0][: len(own.vertices)]
        posed = template_vertices(own.to_torch(torch.float64), stated[0], hand.betas, stated[1])
        # Angles are counted along the bones of either skeleton, and relief along posed normals.
        way = np.linalg.norm(posed - exact, axis=1)
        assert way.mean() < 2e-4
        assert way.max() < 2e-3


def test_another_mesh_does_not_know_it() -> None:
    subject = Subject(seed=11, tone=0.2, age=30.0)
    assert subject_templates(replace(subject, model="rig:generic-hand"), ("right",)) == {}
    assert list(subject_templates(subject, ("right", "left"))) == ["right", "left"]
