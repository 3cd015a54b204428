"""The server of views: who reaches it, how it ends. Oracles: a WebSocket client, exit statuses."""

from __future__ import annotations

import atexit
import json
import os
import signal
import subprocess
import sys
import time
import urllib.error
import urllib.request
from pathlib import Path
from typing import Any

import pytest
import rich

from hwp_bench.base.errors import UsageError
from wildghand.avatar.avatar import WildGHandAvatar
from wildghand.avatar.files import save_avatar
from wildghand.cli.main import main
from wildghand.viewer.server import Address, serving, url

viser = pytest.importorskip("viser")


def connect(address: str, origin: str | None) -> str:
    """What a WebSocket client of some page gets: `open`, or the status of the refusal."""
    from websockets.exceptions import InvalidStatus
    from websockets.sync.client import connect as open_socket

    headers = {} if origin is None else {"Origin": origin}
    try:
        with open_socket(
            address.replace("http", "ws"),
            additional_headers=headers,
            subprotocols=[f"viser-v{viser.__version__}"],  # type: ignore[list-item]
            proxy=None,
        ):
            return "open"
    except InvalidStatus as error:
        return str(error.response.status_code)


def page_status(address: str) -> int:
    """The status of a page; a connection that stays open would hold the server up."""
    with urllib.request.urlopen(address) as page:
        return int(page.status)


def test_other_pages_cannot_look(capfd: pytest.CaptureFixture[str]) -> None:
    with serving(Address(port=0), "test") as server:
        address = url(server)
        assert address.startswith("http://127.0.0.1:")
        assert page_status(address) == 200
        assert connect(address, address) == "open"
        assert connect(address, None) == "open"
        assert connect(address, "https://elsewhere.org") == "403"
        assert connect(address, "http://127.0.0.1:1") == "403"
        asked = urllib.request.Request(address, headers={"Host": "rebound.org"})
        with pytest.raises(urllib.error.HTTPError) as refused:
            urllib.request.urlopen(asked)
        refused.value.close()
        assert refused.value.code == 403
        assert server.request_share_url() is None
    # Results go to standard output; what viser says does not.
    assert capfd.readouterr().out == ""
    with pytest.raises(OSError, match="refused"):
        urllib.request.urlopen(address)


def test_a_server_that_stops_late_keeps_off_standard_output(
    monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str]
) -> None:
    """As with a browser that never answers: viser gives up before its thread ends."""
    say = rich.print

    def late(*words: Any) -> None:
        time.sleep(0.3)
        say(*words)

    def hasty(server: viser.ViserServer) -> None:
        sockets = server._websock_server
        atexit.unregister(server.stop)
        atexit.unregister(sockets.stop)
        sockets._background_event_loop.call_soon_threadsafe(sockets._stop_event.set)

    monkeypatch.setattr(rich, "print", late)
    monkeypatch.setattr(viser.ViserServer, "stop", hasty)
    with serving(Address(port=0), "late"):
        pass
    said = capfd.readouterr()
    assert said.out == ""
    assert "Server stopped" in said.err


def test_a_port_that_is_taken_is_passed_over() -> None:
    with (
        serving(Address(port=0), "one") as first,
        serving(Address(port=first.get_port()), "two") as second,
    ):
        assert second.get_port() != first.get_port()


@pytest.mark.parametrize(
    ("address", "message"),
    [
        (Address("no.such.host.invalid"), "--host: 'no.such.host.invalid' is not an address"),
        (Address("192.0.2.1"), "--host: '192.0.2.1' is not an address of this machine"),
        (Address(port=70_000), "--port: is 70000"),
    ],
    ids=str,
)
def test_an_address_that_cannot_be_used_is_refused(address: Address, message: str) -> None:
    with pytest.raises(UsageError, match=message), serving(address, "never"):
        pass


@pytest.mark.parametrize(
    "words", [["view", "avatar"], ["fit", "capture", "-o", "avatar", "--live"]], ids=" ".join
)
def test_without_the_extra_a_command_says_how_to_get_it(
    words: list[str],
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
    tmp_path: Path,
) -> None:
    monkeypatch.chdir(tmp_path)
    monkeypatch.setitem(sys.modules, "viser", None)
    assert main(words) == 1
    said = capsys.readouterr()
    assert said.out == ""
    (line,) = said.err.splitlines()
    assert "viser is not installed" in line
    assert "pip install 'hwp-bench[view]'" in line


@pytest.mark.slow
def test_ctrl_c_ends_the_view_with_status_0(tiny_avatar: WildGHandAvatar, tmp_path: Path) -> None:
    save_avatar(tiny_avatar, tmp_path / "avatar")
    command = [sys.executable, "-m", "wildghand.cli.main", "view", str(tmp_path / "avatar")]
    running = subprocess.Popen(
        [*command, "--port", "0", "--json"],
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        env={**os.environ},
        # A shell lets what it starts in the background ignore Ctrl-C, these tests too.
        preexec_fn=lambda: signal.signal(signal.SIGINT, signal.SIG_DFL),
    )
    try:
        assert running.stdout is not None
        facts = json.loads(running.stdout.readline())
        assert page_status(facts["url"]) == 200
        running.send_signal(signal.SIGINT)
        out, err = running.communicate()
    finally:
        running.kill()
    assert running.returncode == 0, err
    assert out == ""
    assert "Traceback" not in err
