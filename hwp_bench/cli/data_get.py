"""`hwp-bench data get`."""

from __future__ import annotations

import argparse
import json
from pathlib import Path

_EXAMPLES = """examples:
  hwp-bench data get hwp
  hwp-bench data get hwp -o WildGHand --capture capture0_ capture1_
  hwp-bench data get hwp --revision 0123456789abcdef

Needs huggingface_hub: pip install 'hwp-bench[hub]'. Run the same command again to continue an
interrupted download. Checksums are pinned on first use; existing files are never replaced.
"""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the arguments of the command."""
    parser.description = "Download a public data set."
    parser.epilog = _EXAMPLES
    parser.add_argument("name", choices=("hwp",), help="hwp: the official release")
    parser.add_argument(
        "-o", "--out", type=Path, default=Path("WildGHand"), metavar="DIR", help="folder to make"
    )
    parser.add_argument(
        "--capture",
        nargs="+",
        action="extend",
        default=[],
        metavar="NAME",
        help="only folders whose names begin with this",
    )
    parser.add_argument("--revision", help="branch, tag or commit (default: the newest)")
    parser.add_argument("--json", action="store_true", help="print what was downloaded as JSON")


def run(args: argparse.Namespace) -> int:
    """Run the command."""
    from hwp_bench.base.console import JobsView, notice
    from hwp_bench.base.files import check_places
    from hwp_bench.importers.official.download import HuggingFaceHub, download_release

    check_places({"--out": args.out}, {})
    with JobsView() as jobs:
        update = jobs.turn(0, 1, f"downloading to {args.out}")
        made = download_release(
            args.out,
            HuggingFaceHub(),
            captures=args.capture,
            revision=args.revision,
            update=update,
        )
    for name in made.archives:
        notice(f"warning: {name} is an archive; it is left packed")
    if args.json:
        value = {
            "folder": str(made.folder),
            "commit": made.commit,
            "files": made.files,
            "kept": made.kept,
        }
        print(json.dumps(value, indent=1))
        return 0
    print(f"folder: {made.folder}, {len(made.files)} files, {made.kept} of them existed before")
    print(f"commit: {made.commit}")
    return 0
