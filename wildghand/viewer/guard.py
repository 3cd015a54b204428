"""Who may connect to a view: pages that the view itself has served.

A browser lets any web page open a WebSocket to this machine. Viser answers all of them, so that a
page elsewhere could look at the hand of a person who has a view open.
"""

from __future__ import annotations

import contextlib
import functools
import http
import inspect
from collections.abc import Callable, Iterator, Mapping
from typing import Any
from urllib.parse import urlsplit

#: Names of this machine for itself.
LOOPBACK = ("127.0.0.1", "localhost", "::1")


def refusal(headers: Mapping[str, str], loopback: bool) -> str | None:
    """Say why a request is refused; None where it is answered.

    Args:
        headers: of the request; only `Host` and `Origin` are read.
        loopback: the view is meant for this machine only, so that names of other machines are
            those of pages that point them here (DNS rebinding).
    """
    host = headers.get("Host", "")
    if loopback and urlsplit(f"//{host}").hostname not in LOOPBACK:
        return "This view is for the machine that it runs on."
    origin = headers.get("Origin")
    if origin is not None and urlsplit(origin).netloc.lower() != host.lower():
        return "This page was not served by the view."
    return None


@contextlib.contextmanager
def guarded(loopback: bool) -> Iterator[None]:
    """Within this, servers of the package `websockets` that are started refuse other pages.

    Viser has no setting for it; it starts its server while its object is made.
    """
    from websockets.asyncio import server

    serve = server.serve

    @functools.wraps(serve)
    def guarded_serve(*args: Any, process_request: Any = None, **options: Any) -> Any:
        return serve(*args, process_request=_first_asked(process_request, loopback), **options)

    setattr(server, "serve", guarded_serve)  # noqa: B010  mypy knows a class there
    try:
        yield
    finally:
        setattr(server, "serve", serve)  # noqa: B010


def _first_asked(then: Any, loopback: bool) -> Callable[[Any, Any], Any]:
    """A `process_request` of websockets that refuses, or goes on with another one."""

    async def process(connection: Any, request: Any) -> Any:
        reason = refusal(request.headers, loopback)
        if reason is not None:
            return connection.respond(http.HTTPStatus.FORBIDDEN, reason + "\n")
        answer: Any = then(connection, request) if then is not None else None
        return await answer if inspect.isawaitable(answer) else answer

    return process
