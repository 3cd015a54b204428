"""The web server of a view: viser, on this machine only unless asked otherwise.

A browser lets any web page open a WebSocket to this machine. Viser answers all of them, so that a
page elsewhere could look at the hand of a person who has a view open; `guarded` refuses pages that
the view itself has not served.
"""

from __future__ import annotations

import contextlib
import functools
import http
import inspect
import socket
import sys
import threading
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any
from urllib.parse import urlsplit

from hwp_bench.base.errors import UsageError
from hwp_bench.base.packages import import_extra

if TYPE_CHECKING:
    from viser import ViserServer


#: Names of this machine for itself.
LOOPBACK = ("127.0.0.1", "localhost", "::1")


def refusal(headers: Mapping[str, str], loopback: bool) -> str | None:
    """Say why a request is refused; None where it is answered."""
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


#: A web socket waits ten seconds for a browser that does not say goodbye; viser waits six for it.
CLOSING_SECONDS = 15.0


@dataclass(frozen=True)
class Address:
    """Where a view is served."""

    #: Name or address to bind to.
    host: str = "127.0.0.1"
    #: Port; where it is taken, the next free one; 0: any.
    port: int = 8080

    @property
    def loopback(self) -> bool:
        """Whether only this machine reaches it."""
        return self.host in LOOPBACK


def require_viser() -> None:
    """Check that the extra is installed, before work begins."""
    import_extra("viser", "view", "viser is not installed, which shows views in a browser")


@contextlib.contextmanager
def serving(address: Address, title: str) -> Iterator[ViserServer]:
    """Serve a page while the block runs; standard output stays free of viser's own messages."""
    require_viser()
    _check(address)
    import viser

    class Server(viser.ViserServer):
        """A server that never offers itself to the internet."""

        def request_share_url(self, verbose: bool = True) -> str | None:
            """Refuse: a page may ask for a tunnel through a machine of viser's authors."""
            return None

    others = set(threading.enumerate())
    with contextlib.redirect_stdout(sys.stderr), guarded(address.loopback):
        server = Server(host=address.host, port=address.port, label=title, verbose=False)
    started = set(threading.enumerate()) - others
    try:
        server.gui.configure_theme(show_logo=False, show_share_button=False, control_width="medium")
        yield server
    finally:
        with contextlib.redirect_stdout(sys.stderr):
            server.stop()
            # Its thread says on standard output that it stopped, however late that is.
            for thread in started:
                thread.join(CLOSING_SECONDS)


def url(server: ViserServer) -> str:
    """Return the address of the page, as a browser on this machine opens it."""
    host = server.get_host()
    shown = "127.0.0.1" if host in ("0.0.0.0", "::") else host
    return f"http://{f'[{shown}]' if ':' in shown else shown}:{server.get_port()}"


def _check(address: Address) -> None:
    """Viser tries a thousand ports and then waits for ever where a host cannot be bound."""
    if not 0 <= address.port <= 65_535:
        raise UsageError(f"is {address.port}", field="--port", remedy="Use 0 to 65535.")
    try:
        family = socket.getaddrinfo(address.host, 0, type=socket.SOCK_STREAM)[0][0]
        with socket.socket(family, socket.SOCK_STREAM) as probe:
            probe.bind((address.host, 0))
    except (OSError, UnicodeError) as error:
        raise UsageError(
            f"{address.host[:80]!r} is not an address of this machine ({error})",
            field="--host",
            remedy="Use 127.0.0.1 for this machine only, or 0.0.0.0 for every network it is in.",
        ) from error
    with socket.socket(family, socket.SOCK_STREAM) as probe:
        try:
            probe.bind((address.host, address.port))
        except PermissionError as error:
            problem = f"{address.port} may not be used by this user"
            raise UsageError(problem, field="--port", remedy="Use 1024 or more.") from error
        except OSError:
            return  # taken: viser goes on to the next one
