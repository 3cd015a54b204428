"""Hostile methods: what they try must fail, on any Linux and, where there are namespaces, fully.

Nothing that they try would do harm if it succeeded. Oracle: what they report of themselves in
their log, and the process table outside.
"""

from __future__ import annotations

import ctypes
import json
import os
import shutil
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest
from hostile import folder_of, hostile_method
from small_methods import write_manifest

from hwp_bench.base.errors import MethodFailed
from hwp_bench.methods.manifest import read_manifest
from hwp_bench.run.runner import run_method
from hwp_bench.run.sandbox.confinement import Confinement

MODES = ("required", "none")
pytestmark = pytest.mark.skipif(sys.platform != "linux", reason="process control is Linux's")


@pytest.mark.parametrize("mode", MODES)
def test_no_secret_comes_through_the_environment_or_descriptors(
    attack, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, mode: str
) -> None:
    frame = tmp_path / "capture" / "000018.png"
    folder_of(frame.parent)
    frame.write_text("a test frame")
    monkeypatch.setenv("SECRET_TOKEN", "s3cret")
    monkeypatch.setenv("CAPTURE", str(frame))
    script = """
held = [os.readlink(f"/proc/self/fd/{name}") for name in os.listdir("/proc/self/fd")
        if os.path.lexists(f"/proc/self/fd/{name}")]
print(json.dumps({"environment": dict(os.environ), "held": held, "input": sys.stdin.read()}))
"""
    with frame.open() as stream:
        os.set_inheritable(stream.fileno(), True)
        record, said = attack(script, mode)
    text = json.dumps(said)
    assert "s3cret" not in text
    assert "000018" not in text
    assert said["input"] == ""
    assert len(said["held"]) <= 4
    assert record.isolation == ("namespaces" if mode == "required" else "processes")


def test_nothing_but_what_is_shown_can_be_seen(attack, tmp_path: Path) -> None:
    secret = folder_of(tmp_path / "capture") / "000018.png"
    secret.write_text("a test frame")
    script = f"""
def sees(path):
    try:
        return bool(os.listdir(path)) if os.path.isdir(path) else bool(open(path, "rb").read(1))
    except OSError:
        return False
parents = [pid for pid in os.listdir("/proc") if pid.isdigit()]
print(json.dumps({{
    "frame": sees({str(secret)!r}), "tests": sees({str(Path(__file__).parent)!r}),
    "shadow": sees("/etc/shadow"), "home": sees({str(Path.home() / ".ssh")!r}),
    "processes": len(parents), "first": sees("/proc/1/environ"), "held": sees("/proc/1/fd/0"),
    "root": sorted(os.listdir("/")), "request": os.path.isdir(sys.argv[1]),
    "method": sees(os.path.dirname(__file__)),
}}))
"""
    _, said = attack(script)
    hidden = ("frame", "tests", "shadow", "home", "first", "held")
    assert {name: said[name] for name in hidden} == dict.fromkeys(hidden, False)
    assert said["processes"] == 2
    assert said["request"]
    assert said["method"]
    assert "run" not in said["root"]


def test_nothing_outside_the_work_folder_can_be_written(attack, tmp_path: Path) -> None:
    script = """
def writes(folder):
    path = os.path.join(folder, "written-by-a-test")
    try:
        open(path, "w").close()
    except OSError:
        return False
    os.unlink(path)
    return True
print(json.dumps({name: writes(folder) for name, folder in {
    "method": os.path.dirname(__file__), "request": sys.argv[1], "usr": "/usr", "root": "/",
    "packages": os.path.dirname(json.__file__), "prefix": sys.prefix, "output": sys.argv[2],
    "home": os.environ["HOME"], "scratch": "/tmp", "cache": os.environ["HWP_CACHE"],
}.items()}))
"""
    _, said = attack(script)
    assert [name for name, written in said.items() if written] == [
        "output",
        "home",
        "scratch",
        "cache",
    ]
    assert not (tmp_path / "method" / "written-by-a-test").exists()


def test_there_is_no_network_but_itself(attack) -> None:
    script = """
import socket
def reaches(address):
    try:
        socket.create_connection(address, timeout=30).close()
    except OSError:
        return False
    return True
server = socket.create_server(("127.0.0.1", 0))
print(json.dumps({"own": reaches(server.getsockname()), "host": reaches(("127.0.0.1", PORT)),
    "world": reaches(("192.0.2.1", 80)), "interfaces": [n for _, n in socket.if_nameindex()]}))
"""
    import socket

    with socket.create_server(("127.0.0.1", 0)) as listener:
        _, said = attack(script.replace("PORT", str(listener.getsockname()[1])))
    assert said["own"]
    assert not said["host"]
    assert not said["world"]
    assert said["interfaces"] == ["lo"]


def test_the_walls_cannot_be_taken_down(attack) -> None:
    # Unmounting and remounting are tried in the sandbox only: there it is all that would change.
    script = """
import ctypes
libc = ctypes.CDLL(None, use_errno=True)
if os.path.exists("/etc/shadow"):
    raise SystemExit("no sandbox, so nothing is tried")
def undo():
    flags = 0x20 | 0x1000  # remount, bind: writable again
    return [libc.umount2(b"/proc", 2), libc.mount(None, b"/usr", None, flags, None)]
first = undo()
made = libc.unshare(0x10000000 | 0x00020000)  # a user namespace inside gives capabilities there
second = [libc.umount2(b"/usr", 2), libc.mount(None, b"/usr", None, 0x1020, None)]
caps = [line for line in open("/proc/1/status") if line.startswith(("CapEff", "NoNewPrivs"))]
print(json.dumps({"first": first, "second": second, "status": "".join(caps).split()}))
"""
    _, said = attack(script)
    assert said["first"] == [-1, -1]
    assert said["second"] == [-1, -1]
    assert said["status"] == ["CapEff:", "0" * 16, "NoNewPrivs:", "1"]


GRANDCHILD = """
child = "import os, time, pathlib; os.setsid(); time.sleep(600)"
here, there = os.pipe()  # the grandchild's end closes when its new program begins
if os.fork() == 0:
    os.setsid()
    if os.fork() == 0:
        os.execv(sys.executable, [sys.executable, "-c", child, "TAG"])
    os._exit(0)
os.close(there)
os.read(here, 1)
"""


@pytest.mark.parametrize("mode", MODES)
@pytest.mark.parametrize("ending", ["", "time.sleep(600)", "os.kill(os.getpid(), 9)"])
def test_grandchildren_in_other_sessions_die_too(
    attack, tmp_path: Path, mode: str, ending: str
) -> None:
    tag = f"tag-{tmp_path.name}"
    script = GRANDCHILD.replace("TAG", tag) + ending
    if ending:
        with pytest.raises(MethodFailed):
            attack(script, mode, time_limit=2.0)
    else:
        attack(script, mode)
    _assert_gone(tag)


@pytest.mark.parametrize("mode", MODES)
def test_a_killed_toolkit_takes_the_method_along(
    tmp_path: Path, namespaces: bool, mode: str
) -> None:
    if mode == "required" and not namespaces:
        pytest.skip("no user namespaces on this machine")
    tag = f"tag-{tmp_path.name}"
    method = hostile_method(tmp_path / "method", GRANDCHILD.replace("TAG", tag) + "time.sleep(600)")
    program = f"""
from pathlib import Path
from hwp_bench.methods.manifest import read_manifest
from hwp_bench.run.runner import run_method
from hwp_bench.run.sandbox.confinement import Confinement
run_method(read_manifest({str(method)!r}), "tiny", Path({str(folder_of(tmp_path / "request"))!r}),
           Path({str(tmp_path / "output")!r}), confinement=Confinement({mode!r}))
"""
    toolkit = subprocess.Popen([sys.executable, "-c", program], cwd=Path(__file__).parents[3])
    while not _tagged(tag):
        assert toolkit.poll() is None
        time.sleep(0.05)
    toolkit.send_signal(signal.SIGKILL)
    toolkit.wait()
    _assert_gone(tag)


def _tagged(tag: str) -> list[str]:
    found = []
    for path in Path("/proc").glob("[0-9]*/cmdline"):
        try:
            if path.read_bytes().endswith(tag.encode() + b"\0"):
                found.append(path.parent.name)
        except OSError:
            continue
    return found


def _assert_gone(tag: str) -> None:
    # The suite's own time limit ends a wait that never comes true.
    while _tagged(tag):
        time.sleep(0.05)


@pytest.mark.parametrize("mode", MODES)
def test_memory_of_all_processes_is_limited(attack, mode: str) -> None:
    # Three processes of 80 MB each, where 200 MB together are allowed.
    script = """
for _ in range(2):
    if os.fork() == 0:
        break
held = bytearray(os.urandom(1)) * 80_000_000
time.sleep(600)
"""
    problem = r"hostile took more than 0\.2 GB of memory on tiny. Raise --memory-limit"
    with pytest.raises(MethodFailed, match=problem):
        attack(script, mode, memory_limit=200_000_000)


def test_a_storm_of_processes_is_ended(attack, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("hwp_bench.run.sandbox.supervise.MAX_PROCESSES", 20)
    script = """
for _ in range(60):
    if os.fork() == 0:
        time.sleep(600)
time.sleep(600)
"""
    with pytest.raises(MethodFailed, match="processes at once on tiny"):
        attack(script)


def test_a_system_that_refuses_is_named_and_the_run_goes_on(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    # A place of no known source cannot be bound: the same path as a refusing kernel takes.
    monkeypatch.setattr(
        "hwp_bench.run.sandbox.confinement.visible_places",
        lambda **_: [("read", "/no/such/place", "")],
    )
    method = read_manifest(hostile_method(tmp_path / "method", ""))
    places = (method, "tiny", folder_of(tmp_path / "request"), tmp_path / "output")
    record = run_method(*places)
    assert record.isolation is not None
    assert record.isolation.startswith("processes (")
    with pytest.raises(MethodFailed, match="namespaces are required, but the system refuses them"):
        run_method(*places, confinement=Confinement("required"))


@pytest.mark.parametrize("mode", ["auto", "none"])
def test_a_command_that_is_not_there_is_one_message(tmp_path: Path, mode: str) -> None:
    method = hostile_method(tmp_path / "method", "")
    manifest = (method / "method.toml").read_text().replace("{python}", "no-such-program")
    (method / "method.toml").write_text(manifest)
    with pytest.raises(MethodFailed, match=r"no-such-program: .*cannot be started \(No such file"):
        run_method(
            read_manifest(method),
            "tiny",
            folder_of(tmp_path / "request"),
            tmp_path / "output",
            confinement=Confinement(mode),
        )


def _environment_of_the_author(tmp_path: Path, script: str) -> tuple[Path, Path]:
    """A method whose own `env` leads to a program of the user; returns it and the user's home."""
    home = tmp_path / "home"
    (home / "bin").mkdir(parents=True)
    (home / "secret").write_text("PRIVATE-KEY")
    tool = home / "bin" / "tool"
    tool.write_text(f'#!{shutil.which("sh")}\n. "$1"\n')
    tool.chmod(0o755)
    method = tmp_path / "method"
    (method / "env" / "bin").mkdir(parents=True)
    (method / "env" / "pyvenv.cfg").write_text("home = /usr/bin\n")
    (method / "env" / "bin" / "python").symlink_to(tool)
    (method / "go.sh").write_text(script)
    write_manifest(method, "et", 'command = ["{method}/env/bin/python", "{method}/go.sh"]')
    return method, home


def test_an_environment_in_a_method_opens_nothing(tmp_path: Path, namespaces: bool) -> None:
    """A link in it to a program of the user showed the folder two levels above that program."""
    if not namespaces:
        pytest.skip("no user namespaces on this machine")
    method, home = _environment_of_the_author(tmp_path, f"cat {tmp_path}/home/secret; exit 3\n")
    places = read_manifest(method), "tiny", folder_of(tmp_path / "request"), tmp_path / "output"
    with pytest.raises(MethodFailed, match=r"cannot be started \(No such file") as caught:
        run_method(*places, confinement=Confinement("required"))
    assert f"It leads to {home}/bin/tool" in str(caught.value)
    assert "--expose" in str(caught.value)
    assert (tmp_path / "output" / "log.txt").read_text() == ""


def test_an_interpreter_that_a_person_names_runs(tmp_path: Path, namespaces: bool) -> None:
    """And no more than what was named is seen."""
    if not namespaces:
        pytest.skip("no user namespaces on this machine")
    script = f"cat {tmp_path}/home/secret 2> /dev/null || echo hidden\n"
    method, home = _environment_of_the_author(tmp_path, script)
    places = read_manifest(method), "tiny", folder_of(tmp_path / "request"), tmp_path / "output"
    run_method(*places, confinement=Confinement("required", exposed=(home / "bin",)))
    assert (tmp_path / "output" / "log.txt").read_text() == "hidden\n"


def test_a_program_behind_the_process_table_is_one_message(
    tmp_path: Path, namespaces: bool
) -> None:
    if not namespaces:
        pytest.skip("no user namespaces on this machine")
    method, _ = _environment_of_the_author(tmp_path, "")
    program = method / "env" / "bin" / "python"
    program.unlink()
    program.symlink_to("/proc/1/cwd/bin/python3")
    places = read_manifest(method), "tiny", folder_of(tmp_path / "request"), tmp_path / "output"
    with pytest.raises(MethodFailed, match="cannot be started") as caught:
        run_method(*places, confinement=Confinement("required"))
    assert "but not what links in that folder lead to" in str(caught.value)


@pytest.mark.parametrize("mode", MODES)
def test_keys_of_the_caller_stay_with_the_caller(attack, mode: str) -> None:
    """Inside the walls there are no keys; without them there is another session keyring.

    Where the machine has no keys at all, all answers are -1.
    """
    script = """
import ctypes
libc = ctypes.CDLL(None, use_errno=True)
x86 = os.uname().machine == "x86_64"
keyctl, add_key = (250, 248) if x86 else (219, 217)
print(json.dumps({
    "keyring": libc.syscall(keyctl, 0, ctypes.c_long(-3), 0),
    "left": libc.syscall(add_key, b"user", b"left-by-method", b"x", ctypes.c_long(1),
                         ctypes.c_long(-3)),
}))
"""
    x86 = os.uname().machine == "x86_64"
    libc = ctypes.CDLL(None, use_errno=True)
    keyctl = 250 if x86 else 219
    mine = libc.syscall(keyctl, 0, ctypes.c_long(-3), 0)
    _, said = attack(script, mode)
    if mode == "required":
        assert said == {"keyring": -1, "left": -1}
    assert said["keyring"] == -1 or said["keyring"] != mine
    # keyctl(KEYCTL_SEARCH): what a method leaves is not found outside.
    assert libc.syscall(keyctl, 10, ctypes.c_long(-3), b"user", b"left-by-method", 0) == -1


def test_a_signal_to_the_first_process_does_not_open_the_walls(
    tmp_path: Path, namespaces: bool
) -> None:
    if not namespaces:
        pytest.skip("no user namespaces on this machine")
    # Only inside: never to the machine's own first process.
    script = (
        "import json, os, signal, time\n"
        "if not os.path.exists('/etc/shadow'):\n"
        "    os.kill(1, signal.SIGINT)\n"
        "    time.sleep(1)\n"
        "print(json.dumps(os.path.exists('/etc/shadow')))\n"
    )
    method = read_manifest(hostile_method(tmp_path / "method", script))
    before = signal.signal(signal.SIGINT, signal.default_int_handler)  # as in a terminal
    try:
        record = run_method(method, "tiny", folder_of(tmp_path / "request"), tmp_path / "output")
    finally:
        signal.signal(signal.SIGINT, before)
    assert record.isolation == "namespaces"
    assert "false" in (tmp_path / "output" / "log.txt").read_text()
