"""The failures of jobs: all are tried, then the first is raised; how one is sent and read."""

from __future__ import annotations

from collections.abc import Mapping

from hwp_bench.base import errors
from hwp_bench.base.errors import HwpError


class Failures:
    """Collects the errors of jobs."""

    def __init__(self) -> None:
        self._errors: list[HwpError] = []

    def add(self, error: HwpError) -> None:
        """Note one."""
        self._errors.append(error)

    def raise_first(self, count: int) -> None:
        """Raise the first error, if any, saying how many of `count` jobs failed."""
        if not self._errors:
            return
        first = self._errors[0]
        if len(self._errors) == 1:
            raise first
        raise type(first)(
            f"{first.problem} (the first of {len(self._errors)} failures in {count} jobs)",
            where=first.where,
            field=first.field,
            remedy=first.remedy,
        ) from first


def lost(text: str, retries: int, reason: str) -> HwpError:
    """Return the error of a job that lost its worker too often."""
    return HwpError(
        f"the worker of the job {text!r} was lost {retries + 1} times ({reason})",
        remedy="Is the memory enough? Start again with the same arguments: finished jobs stay.",
    )


def error_record(error: HwpError) -> dict[str, str | None]:
    """Return what `parse_error` takes: an error on its way to another process or node."""
    return {
        "kind": type(error).__name__,
        "problem": error.problem,
        "where": error.where,
        "field": error.field,
        "remedy": error.remedy,
    }


def parse_error(value: Mapping[str, str | None]) -> HwpError:
    """Make an error of the toolkit out of an `error_record`."""
    kind = getattr(errors, str(value["kind"]), HwpError)
    if not (isinstance(kind, type) and issubclass(kind, HwpError)):
        kind = HwpError
    return kind(
        str(value["problem"]),
        where=value["where"],
        field=value["field"],
        remedy=value["remedy"],
    )
