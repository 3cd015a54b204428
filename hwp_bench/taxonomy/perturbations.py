"""The four perturbations of the paper and the scale of their severity."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

from hwp_bench.base.errors import BadInput

#: Severity runs from 0 (absent) to this.
MAX_SEVERITY = 5


@dataclass(frozen=True)
class Perturbation:
    """One kind of disturbance."""

    #: Name in files and on the command line.
    name: str
    #: Its name over a frame, before the severity.
    short: str
    #: Column title of the paper's dataset table.
    title: str
    #: Heading of the paper's per-scenario table.
    heading: str
    #: Its effect on a frame.
    description: str
    #: Whether it acts on the whole frame (True) or on a part of it.
    holistic: bool


_ALL = (
    Perturbation(
        name="hand_object_interaction",
        short="hoi",
        title="Interaction",
        heading="Hand-object Interactions",
        description="An object that the hand holds or touches covers and shades part of it.",
        holistic=False,
    ),
    Perturbation(
        name="complex_poses",
        short="cp",
        title="Complex Poses",
        heading="Complex Poses",
        description="Fast articulation, self-occlusion and extreme angles; "
        "the estimated hand parameters are further off.",
        holistic=False,
    ),
    Perturbation(
        name="illumination",
        short="il",
        title="Illumination Changes",
        heading="Illumination Variations",
        description="Exposure, colour temperature, light direction or cast shadows change.",
        holistic=True,
    ),
    Perturbation(
        name="motion_blur",
        short="mb",
        title="Motion Blur",
        heading="Motion Blur",
        description="Hand or camera move while the shutter is open.",
        holistic=True,
    ),
)

#: Names in the order of the paper's tables.
PERTURBATIONS: tuple[str, ...] = tuple(item.name for item in _ALL)


def perturbation(name: str, *, where: str | None = None, field: str | None = None) -> Perturbation:
    """Look a perturbation up by name.

    Args:
        name: its name.
        where: the file that names it, for the message.
        field: the field in it.

    Raises:
        BadInput: no perturbation has that name; the message lists the four.
    """
    for item in _ALL:
        if item.name == name:
            return item
    raise BadInput(
        f"there is no perturbation {name!r}",
        where=where,
        field=field,
        remedy=f"Known are: {', '.join(PERTURBATIONS)}.",
    )


def check_severity(values: Iterable[int], *, where: str, field: str) -> tuple[int, ...]:
    """Check the severities of one perturbation, one integer from 0 to 5 for each frame.

    Raises:
        BadInput: a value is not an integer or is out of range; the frame is named.
    """
    checked = []
    for frame, value in enumerate(values):
        if isinstance(value, bool) or not isinstance(value, int) or not 0 <= value <= MAX_SEVERITY:
            raise BadInput(
                f"severity {value!r} of frame {frame} is not an integer from 0 to {MAX_SEVERITY}",
                where=where,
                field=field,
            )
        checked.append(value)
    return tuple(checked)
