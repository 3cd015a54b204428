"""The four perturbations and their severity, the eleven captures of the paper, names of suites."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from types import MappingProxyType

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


@dataclass(frozen=True)
class CatalogueEntry:
    """One row of the paper's dataset table."""

    #: `capture0` to `capture10`.
    id: str
    #: `single` or `interacting`.
    hands: str
    #: Action of the hands.
    action: str
    #: `Mobile phone` (handheld) or `Webcam` (fixed).
    device: str
    #: Frames of the real capture.
    frame_count: int
    #: Names of the perturbations that it carries, in the order of `PERTURBATIONS`.
    perturbations: tuple[str, ...]


_HOI, _CP, _IL, _MB = PERTURBATIONS
_PHONE, _WEBCAM = "Mobile phone", "Webcam"
# The paper's dataset table: hand, action, device, frames, perturbations.
_CAPTURES = (
    CatalogueEntry(
        "capture0",
        "single",
        "Grabbing blocks",
        _PHONE,
        901,
        (
            _HOI,
            _CP,
        ),
    ),
    CatalogueEntry(
        "capture1",
        "single",
        "Multiple gestures",
        _PHONE,
        742,
        (
            _CP,
            _MB,
        ),
    ),
    CatalogueEntry("capture2", "single", "Multiple gestures", _PHONE, 828, (_IL,)),
    CatalogueEntry(
        "capture3",
        "single",
        "Spinning a pen",
        _PHONE,
        1086,
        (
            _HOI,
            _MB,
        ),
    ),
    CatalogueEntry(
        "capture4",
        "interacting",
        "Spinning a pen",
        _WEBCAM,
        1662,
        (
            _HOI,
            _MB,
        ),
    ),
    CatalogueEntry(
        "capture5",
        "interacting",
        "Sticking stickers",
        _WEBCAM,
        1216,
        (
            _HOI,
            _MB,
        ),
    ),
    CatalogueEntry(
        "capture6",
        "interacting",
        "Applying lotion",
        _WEBCAM,
        1524,
        (
            _HOI,
            _CP,
        ),
    ),
    CatalogueEntry(
        "capture7",
        "interacting",
        "Multiple gestures",
        _WEBCAM,
        1360,
        (
            _CP,
            _IL,
        ),
    ),
    CatalogueEntry(
        "capture8",
        "interacting",
        "Putting on a watch",
        _WEBCAM,
        1444,
        (
            _HOI,
            _CP,
            _MB,
        ),
    ),
    CatalogueEntry(
        "capture9",
        "interacting",
        "Scrolling on a phone",
        _PHONE,
        1533,
        (
            _HOI,
            _CP,
            _MB,
        ),
    ),
    CatalogueEntry(
        "capture10",
        "interacting",
        "Shuffling cards",
        _PHONE,
        1525,
        (
            _HOI,
            _CP,
            _MB,
        ),
    ),
)
_BY_ID = MappingProxyType({entry.id: entry for entry in _CAPTURES})


def catalogue() -> Mapping[str, CatalogueEntry]:
    """Return the captures by id, in the paper's order; 13,821 frames in all."""
    return _BY_ID


#: The suites: those of the paper's captures, smallest first (`full-lite` has a twelfth of the
#: frames of `full`); then scenes as wide as the world,
#: for tuning (`wild-dev`) and for reports only (`wild-test`).
SUITES = ("smoke", "mini", "full-lite", "full", "wild-dev", "wild-test")
#: Suites whose captures have the frames and the size of another one: the preset that a method
#: has for that one fits them too.
SIZED_LIKE: Mapping[str, str] = MappingProxyType(
    {"full-lite": "full", "wild-dev": "mini", "wild-test": "mini"}
)
