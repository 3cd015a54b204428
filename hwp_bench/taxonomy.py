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


_ALL = (
    Perturbation(
        name="hand_object_interaction",
        short="hoi",
        title="Interaction",
        heading="Hand-object Interactions",
        description="An object that the hand holds or touches covers and shades part of it.",
    ),
    Perturbation(
        name="complex_poses",
        short="cp",
        title="Complex Poses",
        heading="Complex Poses",
        description="Fast articulation, self-occlusion and extreme angles; "
        "the estimated hand parameters are further off.",
    ),
    Perturbation(
        name="illumination",
        short="il",
        title="Illumination Changes",
        heading="Illumination Variations",
        description="Exposure, colour temperature, light direction or cast shadows change.",
    ),
    Perturbation(
        name="motion_blur",
        short="mb",
        title="Motion Blur",
        heading="Motion Blur",
        description="Hand or camera move while the shutter is open.",
    ),
)

#: Names in the order of the paper's tables.
PERTURBATIONS: tuple[str, ...] = tuple(item.name for item in _ALL)


def perturbation(name: str, *, where: str | None = None, field: str | None = None) -> Perturbation:
    """Look a perturbation up by name."""
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
    """Check the severities of one perturbation, one integer from 0 to 5 for each frame."""
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


_BY_SHORT = {item.short: item.name for item in _ALL}


def _capture(row: str) -> CatalogueEntry:
    identifier, hands, device, count, shorts, action = row.split(maxsplit=5)
    names = tuple(_BY_SHORT[short] for short in shorts.split("+"))
    device = {"phone": "Mobile phone", "webcam": "Webcam"}[device]
    return CatalogueEntry(identifier, hands, action, device, int(count), names)


# The paper's dataset table: hands, device, frames, perturbations, action.
_CAPTURES = """
capture0  single      phone   901 hoi+cp    Grabbing blocks
capture1  single      phone   742 cp+mb     Multiple gestures
capture2  single      phone   828 il        Multiple gestures
capture3  single      phone  1086 hoi+mb    Spinning a pen
capture4  interacting webcam 1662 hoi+mb    Spinning a pen
capture5  interacting webcam 1216 hoi+mb    Sticking stickers
capture6  interacting webcam 1524 hoi+cp    Applying lotion
capture7  interacting webcam 1360 cp+il     Multiple gestures
capture8  interacting webcam 1444 hoi+cp+mb Putting on a watch
capture9  interacting phone  1533 hoi+cp+mb Scrolling on a phone
capture10 interacting phone  1525 hoi+cp+mb Shuffling cards
"""
_BY_ID = MappingProxyType(
    {entry.id: entry for entry in map(_capture, _CAPTURES.strip().splitlines())}
)


def catalogue() -> Mapping[str, CatalogueEntry]:
    """Return the captures by id, in the paper's order; 13,821 frames in all."""
    return _BY_ID


#: The simulated suites: those of the paper's captures, smallest first (`full-lite` has a twelfth of
#: the frames of `full`); then scenes as wide as the world,
#: for tuning (`wild-dev`) and for reports only (`wild-test`); then scenes whose perturbations last,
#: with 10 % of the training frames clean (`persistent`) and with other shares in percent.
SIMULATED_SUITES = (
    *("smoke", "mini", "full-lite", "full", "wild-dev", "wild-test", "persistent"),
    *("persistent-clean0", "persistent-clean20", "persistent-clean35", "persistent-clean60"),
)
#: The suites of real clips, for reports only.
REAL_SUITES = ("real-1",)
#: Every suite.
SUITES = (*SIMULATED_SUITES, *REAL_SUITES)
#: What each suite is, in a few words for people.
SUITE_TEXTS: Mapping[str, str] = MappingProxyType(
    {
        "smoke": "two captures, to see that a method runs",
        "mini": "eight of the paper's captures, simulated and short; WildGHand's design set",
        "full-lite": "the paper's eleven captures, simulated, every twelfth frame",
        "full": "the paper's eleven captures, simulated, every frame",
        "wild-dev": "simulated hands as various as the world, for tuning",
        "wild-test": "simulated hands as various as the world, on which nothing was tuned",
        "persistent": "simulated, with perturbations that last: 10 % of training frames are clean",
        "real-1": "real clips, whose test scores decided on some parts of WildGHand",
    }
    | {
        f"persistent-clean{share}": f"as persistent, with {share} % of training frames clean"
        for share in (0, 20, 35, 60)
    }
)
#: Suites whose captures have the frames and the size of another one: the preset that a method
#: has for that one fits them too.
SIZED_LIKE: Mapping[str, str] = MappingProxyType(
    {"full-lite": "full"}
    | {name: "mini" for name in SUITES if name.startswith(("wild-", "persistent", "real-"))}
)
