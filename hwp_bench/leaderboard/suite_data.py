"""The data of the suites: digests of captures and clips, so that no entry can bring its own."""

from __future__ import annotations

import os
from dataclasses import asdict, dataclass
from pathlib import Path

from hwp_bench.base.errors import BadResult
from hwp_bench.base.files import cache_root, read_json, write_json
from hwp_bench.base.packages import data_folder
from hwp_bench.base.records import Digest, Line, parse_record, without_schema
from hwp_bench.capture import open_capture
from hwp_bench.evaluation.completeness import is_of_suite
from hwp_bench.sim.produce.production import RENDERER
from hwp_bench.sim.produce.suites import suite_names

#: Version of the file.
SCHEMA = "hwp-suite-data/1"
#: The file that ships, next to the entries' folder.
NAME = "suites.json"


@dataclass(frozen=True)
class CaptureData:
    """The data of one capture of a suite."""

    #: Digest of the capture.
    digest: Digest
    #: Digest of its free-view clip, which is versioned apart; None where that is not known.
    free_view: Digest | None = None


@dataclass(frozen=True)
class SuiteData:
    """The data of every suite, as far as it is known."""

    #: By suite and capture id.
    suites: dict[Line, dict[Line, CaptureData]]


def read_suite_data(path: str | os.PathLike[str] | None = None) -> SuiteData:
    """Read the digests of the suites' captures.

    Args:
        path: the file; None takes the one that ships.

    Raises:
        BadInput: missing or no JSON.
        BadResult: a field is missing, unknown or of the wrong type; it is named.
    """
    file = Path(path) if path is not None else data_folder("leaderboard") / NAME
    value = without_schema(read_json(file), SCHEMA, where=file, error=BadResult)
    return parse_record(SuiteData, value, where=file)


def rendered_data(cache: Path) -> SuiteData:
    """Return the data of the suites' captures that this version rendered into a folder.

    Args:
        cache: the folder of capture folders, `sim/captures` of the toolkit's cache.
    """
    found: dict[str, dict[str, CaptureData]] = {}
    for file in sorted(cache.glob("*/capture.json")):
        capture = open_capture(file.parent)
        if capture.info.source.get("renderer") != RENDERER:
            continue
        clip = capture.free_view
        data = CaptureData(capture.digest, None if clip is None else clip.digest)
        for name in suite_names():
            if is_of_suite(capture.info, name):
                found.setdefault(name, {})[capture.info.id] = data
    return SuiteData({name: found[name] for name in suite_names() if name in found})


def joined_data(known: SuiteData, rendered: SuiteData) -> SuiteData:
    """Return all captures of both, as rendered where a capture is in both.

    Args:
        known: the data so far, of the same version of the renderer.
        rendered: the data of captures in a cache, which need not hold every suite.
    """
    both = {
        name: {**known.suites.get(name, {}), **rendered.suites.get(name, {})}
        for name in suite_names()
    }
    return SuiteData({name: captures for name, captures in both.items() if captures})


def write_suite_data(path: Path, data: SuiteData) -> Path:
    """Write the file; returns it."""
    return write_json(path, {"schema": SCHEMA, **asdict(data)})


if __name__ == "__main__":
    # After suites were rendered: `python -m hwp_bench.leaderboard.suite_data`. A new version of the
    # renderer has other pixels: empty `suites` of the file before.
    rendered = rendered_data(cache_root() / "sim" / "captures")
    write_suite_data(data_folder("leaderboard") / NAME, joined_data(read_suite_data(), rendered))
