"""The data of the suites: digests, so that no entry can bring its own, and severities."""

from __future__ import annotations

import argparse
import os
from collections.abc import Mapping
from dataclasses import asdict, dataclass, replace
from functools import cache
from pathlib import Path
from typing import Annotated, Any

from msgspec import Meta

from hwp_bench.base.errors import BadResult
from hwp_bench.base.files import cache_root, read_json, write_json
from hwp_bench.base.packages import data_folder
from hwp_bench.base.records import Digest, Line, parse_record, without_schema
from hwp_bench.capture import open_capture
from hwp_bench.capture.splits import split_for
from hwp_bench.results import Results
from hwp_bench.sim.produce.capture import RENDERER, suite, suite_names
from hwp_bench.sim.scene.scene import moments, severity
from hwp_bench.suites.suite import is_of_suite, suite_scenes
from hwp_bench.taxonomy import REAL_SUITES

#: Version of the file.
SCHEMA = "hwp-suite-data/2"
#: The file that ships, next to the entries' folder.
NAME = "suites.json"
#: Levels of 8 bits by which pictures of another processor may differ where results on them are
#: compared frame by frame; renderers that differ in rounding alone reach 11.
MOST_LEVELS = 11


@dataclass(frozen=True)
class Version:
    """A capture of a suite as one version of the renderer makes it."""

    #: Digest of the capture.
    digest: Digest
    #: Digest of its free-view clip, which is versioned apart; None where that is not known.
    free_view: Digest | None = None
    #: Processor that renders it so, where others differ; empty for the one of `current`.
    processor: Line = ""
    #: Largest difference of a value of its pictures from those of `current`, in levels of 8 bits.
    levels: Annotated[int, Meta(ge=0, le=255)] | None = None


@dataclass(frozen=True)
class CaptureData:
    """The data of one capture of a suite."""

    #: As this version of the renderer makes it; None where that is not known.
    current: Version | None
    #: Versions of it that differ in rounding alone, the latest first: results on them stand.
    former: tuple[Version, ...] = ()
    #: What this version of the renderer makes of it on processors that round otherwise.
    others: tuple[Version, ...] = ()

    @property
    def versions(self) -> tuple[Version, ...]:
        """All versions that are known, the latest first."""
        latest = () if self.current is None else (self.current,)
        return (*latest, *self.others, *self.former)

    def version(self, digest: str) -> Version | None:
        """Return the version of that digest, or None."""
        return next((one for one in self.versions if one.digest == digest), None)


@dataclass(frozen=True)
class SuiteData:
    """The known data of every suite."""

    #: By suite and capture id.
    suites: dict[Line, dict[Line, CaptureData]]
    #: Version of the renderer that makes them.
    renderer: Annotated[int, Meta(ge=1)] = RENDERER


def read_suite_data(path: str | os.PathLike[str] | None = None) -> SuiteData:
    """Read the digests of the suites' captures."""
    file = Path(path) if path is not None else data_folder("leaderboard") / NAME
    value = without_schema(read_json(file), SCHEMA, where=file, error=BadResult)
    return parse_record(SuiteData, value, where=file)


@cache
def known_data() -> SuiteData:
    """Return what `read_suite_data` reads of the file that ships, read once."""
    return read_suite_data()


def on_current_data(results: Results) -> Results:
    """Return results with one digest for captures that differ in rounding alone.

    Of a simulated capture it is that of this version, of a real clip its origin. So results on such
    captures can be compared. Other digests stay, also those of processors whose pictures differ by
    more than `MOST_LEVELS`, or by an amount that nobody has measured.
    """
    known, origins = known_data().suites.get(results.suite, {}), suite_origins(results.suite)
    captures = []
    for capture in results.captures:
        data = known.get(capture.id)
        version = data.version(capture.digest) if data is not None else None
        apart = version is not None and version.processor and not _is_near(version)
        if data is not None and data.current is not None and version is not None and not apart:
            capture = replace(capture, digest=data.current.digest)
        if (origin := origins.get(capture.id)) and origin == capture.origin:
            capture = replace(capture, digest=origin)
        captures.append(capture)
    return replace(results, captures=captures)


def _is_near(version: Version) -> bool:
    return version.levels is not None and version.levels <= MOST_LEVELS


def suite_origins(name: str) -> Mapping[str, str]:
    """Return what each clip of a suite of real clips is imported from; empty for other suites."""
    return suite_scenes(name) if name in REAL_SUITES else {}


#: By capture and perturbation: mean severity of the frames that show it, rounded.
Severities = Mapping[str, Mapping[str, int]]


@cache
def suite_severities(name: str) -> Severities:
    """Return how severe each perturbation of each capture of a suite is.

    It is read from the scenes, so that no capture has to be on this machine: the mean over the
    frames to learn from that show the perturbation, rounded, as `hwp-bench table --by severity`
    takes it from captures. Of real clips nothing is known.
    """
    found: dict[str, dict[str, int]] = {}
    for item in () if name in REAL_SUITES else suite(name):
        test = set(split_for(item.scene.id, item.frame_count).test.tolist())
        every = enumerate(moments(item.frame_count).tolist())
        learnt = [moment for frame, moment in every if frame not in test]
        own = found.setdefault(item.scene.id, {})
        for call in item.scene.effects:
            shown = [value for moment in learnt if (value := severity(call, moment))]
            own[call.kind] = round(sum(shown) / len(shown)) if shown else 0
    return found


def rendered_data(cache: Path) -> SuiteData:
    """Return the data of the suites' captures that this version rendered into a folder."""
    found: dict[str, dict[str, CaptureData]] = {}
    for file in sorted(cache.glob("*/capture.json")):
        capture = open_capture(file.parent)
        if capture.info.source.get("renderer") != RENDERER:
            continue
        clip = capture.free_view
        data = CaptureData(Version(capture.digest, None if clip is None else clip.digest))
        for name in suite_names():
            if is_of_suite(capture.info, name):
                found.setdefault(name, {})[capture.info.id] = data
    return SuiteData({name: found[name] for name in suite_names() if name in found})


def joined_data(
    known: SuiteData,
    rendered: SuiteData,
    *,
    rounding: bool = False,
    processor: str = "",
    levels: int | None = None,
) -> SuiteData:
    """Return all captures of both, as rendered where a capture is in both.

    With the name of a processor, what it renders otherwise is added to what is known.
    """
    kept = known.suites
    if known.renderer != rendered.renderer:
        kept = {
            name: {key: CaptureData(None, data.versions) for key, data in captures.items()}
            for name, captures in (known.suites if rounding else {}).items()
        }
    both = {name: dict(kept.get(name, {})) for name in suite_names()}
    for name, captures in rendered.suites.items():
        for key, data in captures.items():
            had = both[name].get(key, CaptureData(None))
            others = had.others if had.current == data.current else ()
            if processor and had.current is not None and data.current is not None:
                others = tuple(one for one in had.others if one.processor != processor)
                if had.current != data.current:
                    others += (replace(data.current, processor=processor, levels=levels),)
                data = had
            both[name][key] = replace(data, former=had.former, others=others)
    suites = {name: captures for name, captures in both.items() if captures}
    return SuiteData(suites, rendered.renderer)


def write_suite_data(path: Path, data: SuiteData) -> Path:
    """Write the file; returns it."""
    return write_json(path, {"schema": SCHEMA, **_without_empty(asdict(data))})


def _without_empty(value: Any) -> Any:
    """The record without empty optional fields."""
    if isinstance(value, dict):
        return {
            key: _without_empty(item)
            for key, item in value.items()
            if key in ("current", "free_view", "former") or item not in ("", None, ())
        }
    return [_without_empty(item) for item in value] if isinstance(value, tuple) else value


def main() -> None:
    """Write the digests of the captures that were rendered here into the file that ships."""
    parser = argparse.ArgumentParser(description=main.__doc__)
    parser.add_argument(
        "--rounding",
        action="store_true",
        help="the renderer so far differs from this one in rounding alone, which `python -m "
        "benchmarks.rounding` measures: results on its captures stand",
    )
    parser.add_argument(
        "--processor",
        default="",
        help="list digests that differ as those of this kind of processor, and change no other",
    )
    parser.add_argument(
        "--levels",
        type=int,
        help="levels by which its pictures differ at most, as `python -m benchmarks.rounding` says",
    )
    args = parser.parse_args()
    rendered = rendered_data(cache_root() / "sim" / "captures")
    joined = joined_data(
        read_suite_data(),
        rendered,
        rounding=args.rounding,
        processor=args.processor,
        levels=args.levels,
    )
    write_suite_data(data_folder("leaderboard") / NAME, joined)


if __name__ == "__main__":
    main()
