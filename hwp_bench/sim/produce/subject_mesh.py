"""The truth `template.npz` of a capture: the subject's own hands in the hand model's place."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from hwp_bench.base.errors import BadInput, HwpError
from hwp_bench.base.files import read_json, sha256_json
from hwp_bench.base.records import parse_record
from hwp_bench.capture import Capture
from hwp_bench.capture.schema import EXTRA, SIMULATED, TRUE_TEMPLATE, write_subject_mesh
from hwp_bench.hands.template import HandTemplate, rebuilt
from hwp_bench.sim.geometry.mesh import surface_normals
from hwp_bench.sim.scene.motion import palm_of
from hwp_bench.sim.scene.schema import Subject
from hwp_bench.sim.subject.hand import SubjectHand, subject_hand

# The hand model whose geometry may lie in a capture; MANO's may not be passed on.
_FREE = "anny"


def subject_templates(subject: Subject, sides: Sequence[str]) -> dict[str, HandTemplate]:
    """The rest hands of a subject by side; empty where it is another mesh.

    Posed with the true angles and places of a capture they are where the subject is. The angles
    are counted along the hand model's bones, which differ a little in direction.
    """
    if subject.model != _FREE:
        return {}
    return {side: subject_template(subject_hand(subject, side)) for side in sides}


def subject_template(hand: SubjectHand) -> HandTemplate:
    """A subject's hand as a template of the hand model's triangles without shape parameters.

    Args:
        hand: of a subject whose template has the hand model's triangles.
    """
    template = hand.template
    smooth = hand.rest
    normals = surface_normals(smooth, hand.faces, hand.normal_sum)
    # The first vertices of the fine mesh are those of the template.
    surface = (smooth + hand.relief[:, None] * normals)[: len(template.vertices)]
    joints = template.joints + template.joint_basis @ hand.betas
    # A capture puts the middle of both palms in one place, and turns hands about the model's wrist.
    aside = palm_of(hand.model_joints) - palm_of(hand.joints)
    joints = joints + aside
    joints[0] = hand.model_joints[0]
    return rebuilt(
        template,
        name=hand.model.name,
        vertices=surface + aside,
        shape_basis=np.zeros_like(template.shape_basis),
        joints=joints,
        joint_basis=np.zeros_like(template.joint_basis),
    )


def write_truth(folder: Path, subject: Subject, sides: Sequence[str]) -> bool:
    """Write the subject's hands into a capture folder; returns whether they are known."""
    templates = subject_templates(subject, sides)
    if templates:
        write_subject_mesh(folder / TRUE_TEMPLATE, templates)
    return bool(templates)


def add_subject_mesh(capture: Capture) -> bool:
    """Write the subject's hands into a capture that was rendered before they were stored.

    They follow from the scene that lies in the capture. Digests do not change.

    Returns:
        Whether the capture has them now; False for other captures than simulated ones of the
        free hand, and where the folder cannot be written to.
    """
    path, source = capture.root / EXTRA / "scene.json", capture.info.source
    if (capture.root / TRUE_TEMPLATE).is_file():
        return True
    if source.get("kind") != SIMULATED or not path.is_file():
        return False
    try:
        scene = read_json(path)
        if sha256_json(scene) != source.get("scene_digest"):
            return False
        subject = parse_record(
            Subject, scene["subject"], where=path, field="subject", error=BadInput
        )
        return write_truth(capture.root, subject, capture.info.sides)
    except (HwpError, OSError):
        return False
