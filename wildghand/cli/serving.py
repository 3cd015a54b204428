"""Arguments of the commands that serve a page."""

from __future__ import annotations

import argparse
import contextlib
from collections.abc import Iterator
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from wildghand.fitting.optimize import Watch
    from wildghand.viewer.server import Address


def add_address(parser: argparse.ArgumentParser) -> None:
    """Add --host and --port."""
    parser.add_argument(
        "--host",
        default="127.0.0.1",
        metavar="ADDRESS",
        help="address to serve at (default: 127.0.0.1, for this machine only)",
    )
    parser.add_argument(
        "--port", type=int, default=8080, help="port; the next free one if it is taken"
    )


def address_of(args: argparse.Namespace) -> Address:
    """Return what `add_address` read."""
    from wildghand.viewer.server import Address

    return Address(args.host, args.port)


@contextlib.contextmanager
def watching(args: argparse.Namespace, *, shown: bool) -> Iterator[Watch | None]:
    """Serve the page of a fit while the block runs, if it is `shown`.

    Yields:
        What the fit is given as `watch`.
    """
    if not shown:
        yield None
        return
    from hwp_bench.base.console import notice
    from wildghand.viewer.live import serve_fit

    with serve_fit(address_of(args)) as served:
        notice(f"The fit is shown at {served.url}")
        yield served.watch
