"""The numbers of the paper's tables, as data: always of other data than what is measured here."""

from __future__ import annotations

from dataclasses import dataclass

from hwp_bench.base.errors import BadResult
from hwp_bench.base.files import read_json
from hwp_bench.base.packages import data_folder
from hwp_bench.base.records import parse_record, without_schema

#: Version of the file.
SCHEMA = "hwp-published/1"
#: Follows the name of a method wherever a published number is shown.
MARK = "published, other data"
#: Note under every table with published numbers.
NOTE = (
    "Published rows are the paper's own numbers, on other captures, masks and weights; they show "
    "a table's scale and cannot be compared with measured rows."
)


@dataclass(frozen=True)
class Measurement:
    """Published scores of one method in one scope."""

    method: str
    #: A variant of the method, or a level of the perturbation; empty if neither.
    detail: str
    #: Which data: `single` and `interacting` (the paper's captures), `interhand2.6m`,
    #: `anchorcrafter`, a perturbation, `captureN`, or `all`.
    scope: str
    #: `psnr` [dB], `ssim`, `lpips`; `temporal_weight_e3` is a mean weight times 1000.
    scores: dict[str, float]
    #: Standard deviation of some of the scores.
    deviations: dict[str, float]


@dataclass(frozen=True)
class PublishedTable:
    """One table of the paper."""

    #: Its number in the paper, in Arabic digits.
    number: int
    label: str
    #: Its page in the paper, where known; the source file does not tell.
    page: int | None
    caption: str
    #: Its numbers, row by row, from left to right.
    measurements: list[Measurement]


@dataclass(frozen=True)
class Dataset:
    """One row of the paper's comparison of data sets."""

    name: str
    #: `Lab` or `Wild`.
    environment: str
    #: Its contents: `clean_test`, `single`, `interacting`, and perturbations.
    has: list[str]


@dataclass(frozen=True)
class Published:
    """All published numbers."""

    title: str
    #: Where it says its code and data are.
    url: str
    tables: list[PublishedTable]
    #: The comparison of data sets (table 1).
    datasets: list[Dataset]

    def table(self, number: int) -> PublishedTable:
        """Return the table of that number."""
        for table in self.tables:
            if table.number == number:
                return table
        raise BadResult(f"table {number} holds no published measurements", field="number")


def read_published() -> Published:
    """Read the published numbers, which come with the toolkit."""
    file = data_folder("leaderboard") / "published.json"
    return parse_record(Published, without_schema(read_json(file), SCHEMA, where=file), where=file)
