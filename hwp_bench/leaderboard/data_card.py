"""The data card of a suite: Croissant 1.0 (JSON-LD), made of what the toolkit knows of it.

Nothing is rendered or downloaded. See <http://mlcommons.org/croissant/1.0>.
"""

from __future__ import annotations

from typing import Any

from hwp_bench.base.packages import __version__
from hwp_bench.capture.schema import IMAGE_FOLDERS
from hwp_bench.capture.splits import split_for
from hwp_bench.leaderboard.suite_data import known_data
from hwp_bench.sim.produce.capture import LICENCE
from hwp_bench.suites.real import RealClip, read_clips
from hwp_bench.suites.suite import suite, suite_scenes
from hwp_bench.taxonomy import REAL_SUITES, SUITE_TEXTS

# The words of Croissant that stand for themselves.
_WORDS = (
    *("citeAs", "column", "equivalentProperty", "extract", "field", "fileObject", "fileProperty"),
    *("fileSet", "format", "includes", "isLiveDataset", "jsonPath", "key", "md5", "parentField"),
    *("path", "recordSet", "references", "regex", "repeated", "replace", "samplingRate"),
    *("separator", "source", "subField", "transform"),
)
_CONTEXT = {
    "@language": "en",
    "@vocab": "https://schema.org/",
    "sc": "https://schema.org/",
    "cr": "http://mlcommons.org/croissant/",
    "rai": "http://mlcommons.org/croissant/RAI/",
    "dct": "http://purl.org/dc/terms/",
    "conformsTo": "dct:conformsTo",
    "data": {"@id": "cr:data", "@type": "@json"},
    "dataType": {"@id": "cr:dataType", "@type": "@vocab"},
    "examples": {"@id": "cr:examples", "@type": "@json"},
} | {word: f"cr:{word}" for word in _WORDS}
# What stands of a capture in the card, with its type and what it means.
_FIELDS = {
    "id": ("Text", "Name of the capture."),
    "shows": ("Text", "What is seen."),
    "hands": ("Text", "right, left or both."),
    "perturbations": ("Text", "Perturbations that it declares; empty where nobody has said so."),
    "frames": ("Integer", "Frames."),
    "size": ("Integer", "Edge of a frame, px."),
    "training": ("Integer", "Frames to learn from."),
    "validation": ("Integer", "Validation frames."),
    "test": ("Integer", "Test frames."),
    "source": ("Text", "SHA-256 of the scene that is rendered, or of what is imported."),
    "digest": ("Text", "SHA-256 of the capture as this version renders it; empty if not known."),
}
_FOLDERS = {
    "frames": "8-bit sRGB frames; those of the test part are not given to methods",
    "masks": "visible hand, estimated",
    "true_masks": "visible hand, exact coverage",
    "clean": "the same frames without any perturbation",
}


def data_card(name: str) -> dict[str, Any]:
    """Return the card of a suite as JSON values.

    Raises:
        UsageError: there is no such suite.
    """
    items, real = suite(name), name in REAL_SUITES
    scenes, known = suite_scenes(name), known_data().suites.get(name, {})
    rows = []
    for item in items:
        split = split_for(item.id, item.frame_count)
        version = known[item.id].current if item.id in known else None
        values = (
            *(item.id, item.shows, item.hands, ", ".join(item.perturbations)),
            *(item.frame_count, item.size),
            *(len(split.train), len(split.validation), len(split.test)),
            *(scenes[item.id], version.digest if version else ""),
        )
        rows.append({f"captures/{key}": value for key, value in zip(_FIELDS, values, strict=True)})
    licences = sorted({clip.licence for clip in read_clips(name)}) if real else [LICENCE]
    command = f"hwp-bench data get {name}" if real else f"hwp-bench sim render --suite {name}"
    return {
        "@context": _CONTEXT,
        "@type": "sc:Dataset",
        "conformsTo": "http://mlcommons.org/croissant/1.0",
        "name": f"hwp-{name}",
        "description": f"HWP bench, suite {name}: {SUITE_TEXTS[name]}. Made on your machine by "
        f"`{command}`; test frames are the last tenth of each capture.",
        "version": __version__,
        "license": [f"https://spdx.org/licenses/{licence}" for licence in licences],
        "creator": {"@type": "sc:Organization", "name": "The HWP bench developers"},
        "isLiveDataset": False,
        "distribution": [_file(clip) for clip in read_clips(name)] if real else _file_sets(),
        "recordSet": [
            {
                "@type": "cr:RecordSet",
                "@id": "captures",
                "name": "captures",
                "description": "The captures of the suite.",
                "key": {"@id": "captures/id"},
                "field": [
                    {
                        "@type": "cr:Field",
                        "@id": f"captures/{key}",
                        "name": f"captures/{key}",
                        "description": text,
                        "dataType": f"sc:{kind}",
                    }
                    for key, (kind, text) in _FIELDS.items()
                ],
                "data": rows,
            }
        ],
    }


def _file(clip: RealClip) -> dict[str, Any]:
    return {
        "@type": "cr:FileObject",
        "@id": clip.id,
        "name": clip.id,
        "description": clip.shows,
        "contentUrl": clip.file.name,
        "contentSize": f"{clip.bytes} B",
        "sha256": clip.sha256,
        "encodingFormat": "video/mp4",
    }


def _file_sets() -> list[dict[str, Any]]:
    return [
        {
            "@type": "cr:FileSet",
            "@id": kind,
            "name": kind,
            "description": text,
            "encodingFormat": "image/png",
            "includes": f"*/{IMAGE_FOLDERS[kind]}/*.png",
        }
        for kind, text in _FOLDERS.items()
    ]
