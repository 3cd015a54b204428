"""Connect to a Ray cluster, or say in bounded time why that fails."""

from __future__ import annotations

import contextlib
import io
import os
import signal
import socket
import subprocess
import sys
import threading
from collections import deque
from collections.abc import Iterator
from typing import Any

from hwp_bench.base.errors import HwpError, MissingDependency, UsageError

#: Seconds that the head may take to accept a connection.
CONNECT_SECONDS = 10.0
#: Seconds that it may take to answer as a Ray head of this version.
ANSWER_SECONDS = 60.0
#: Port of a Ray head, where none is given.
HEAD_PORT = 6379

_REMEDY = "Give the address that `ray start --head` printed; run the command on a node of it."
# Ray itself tries for minutes before it gives up; so it is tried in a process that can be ended.
_PROBE = (
    "import sys, ray\nray.init(address=sys.argv[1], log_to_driver=False, logging_level='error')\n"
)


def import_ray() -> Any:
    """Import Ray.

    Raises:
        MissingDependency: it is not installed.
    """
    # No statistics about a run are sent to anybody.
    os.environ.setdefault("RAY_USAGE_STATS_ENABLED", "0")
    try:
        import ray
    except ImportError as error:
        raise MissingDependency(
            "Ray is not installed",
            field="--engine",
            remedy="Install it with `pip install 'hwp-bench[ray]'`, or use --engine local.",
        ) from error
    return ray


def head_address(address: str | None) -> str | None:
    """Return HOST:PORT of the head to join; None where a cluster of this machine is to be started.

    Args:
        address: what came after `ray://`; None takes the variable RAY_ADDRESS, if it is set.

    Raises:
        UsageError: it is not an address.
    """
    text = os.environ.get("RAY_ADDRESS", "") if address is None else address
    if address is None and text in ("", "auto", "local"):
        return None
    text = text.removeprefix("ray://")
    host, colon, port = text.rpartition(":")
    if not colon:
        host, port = text, str(HEAD_PORT)
    if not host or "/" in host or not port.isdecimal() or not 0 < int(port) < 65536:
        raise UsageError(f"{text!r} is not HOST:PORT", field="--engine", remedy=_REMEDY)
    return f"{host}:{port}"


def check_head(address: str) -> None:
    """Make sure that a Ray head answers.

    Raises:
        HwpError: it does not, within `CONNECT_SECONDS` and `ANSWER_SECONDS`.
    """
    host, _, port = address.rpartition(":")
    try:
        socket.create_connection((host.strip("[]"), int(port)), CONNECT_SECONDS).close()
    except OSError as error:
        reason = error.strerror or str(error) or type(error).__name__
        raise HwpError(
            f"there is no Ray head at {address} ({reason})", field="--engine", remedy=_REMEDY
        ) from error
    try:
        done = subprocess.run(
            [sys.executable, "-c", _PROBE, address],
            capture_output=True,
            text=True,
            timeout=ANSWER_SECONDS,
            check=False,
        )
    except subprocess.TimeoutExpired as error:
        raise HwpError(
            f"{address} does not answer as a Ray head within {ANSWER_SECONDS:g} s",
            field="--engine",
            remedy=_REMEDY,
        ) from error
    if done.returncode != 0:
        lines = done.stderr.strip().splitlines()
        raise HwpError(
            f"Ray at {address} refuses: {lines[-1][:300] if lines else 'it said nothing'}",
            field="--engine",
            remedy=_REMEDY,
        )


@contextlib.contextmanager
def connected(address: str | None) -> Iterator[Any]:
    """Join a cluster, or start one on this machine; left again at the end.

    Ray's output is thrown away: standard output is for results.

    Args:
        address: as `head_address` returns it.

    Yields:
        The module `ray`.

    Raises:
        MissingDependency: Ray is not installed.
        HwpError: there is no such cluster.
    """
    ray = import_ray()
    if address is not None:
        check_head(address)
    main = threading.current_thread() is threading.main_thread()
    terminated = signal.getsignal(signal.SIGTERM) if main else None
    quiet = {"log_to_driver": False, "logging_level": "error"}
    with contextlib.redirect_stdout(_Tail()) as tail:
        try:
            if address is not None:
                ray.init(address=address, **quiet)
            else:
                ray.init(address="local", include_dashboard=False, **quiet)
        except (ConnectionError, OSError, RuntimeError, ValueError, SystemExit) as error:
            reason = (str(error) or tail.last or type(error).__name__).splitlines()[0]
            raise HwpError(f"Ray cannot be reached: {reason[:300]}", field="--engine") from error
        if main:
            # Ray puts its own handler, which leaves without stopping the jobs.
            signal.signal(signal.SIGTERM, terminated or signal.SIG_DFL)
        try:
            yield ray
        finally:
            ray.shutdown()


class _Tail(io.TextIOBase):
    """A stream that keeps its last lines."""

    def __init__(self) -> None:
        self._lines: deque[str] = deque(maxlen=20)

    def write(self, text: str) -> int:
        self._lines.extend(text.splitlines())
        return len(text)

    @property
    def last(self) -> str:
        return self._lines[-1] if self._lines else ""
