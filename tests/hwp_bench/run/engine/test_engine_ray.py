"""A real Ray cluster of two nodes on this machine. Oracle: the same jobs in turn, without Ray."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import psutil
import pytest
from engine_jobs import Told, hold, write_gray_method
from own_cache import make_own_cache
from same_results import contents
from small_captures import CaptureMaker

from hwp_bench.evaluation.ablate.runs import make_design, run_ablation
from hwp_bench.evaluation.capture_evaluation import EvaluationSettings
from hwp_bench.methods.manifest import read_manifest
from hwp_bench.run.engine import LocalEngine, Needs

pytest.importorskip("ray")
pytestmark = pytest.mark.slow


class Nodes:
    """A head and a second node, one processor and one cache each."""

    #: Of their caches' folders.
    NAMES = ("head", "second")

    def __init__(self, folder: Path) -> None:
        from ray.cluster_utils import Cluster

        self._folder = folder
        self._cluster = Cluster()
        head, second = self.NAMES
        self._head = self._add(head, include_dashboard=False)
        self._second = self._add(second)

    def _add(self, name: str, **more: Any) -> Any:
        # A node hands its environment on to its workers.
        os.environ["HWP_CACHE"] = str(self._folder / name)
        os.environ["RAY_USAGE_STATS_ENABLED"] = "0"
        return self._cluster.add_node(num_cpus=1, object_store_memory=80 << 20, **more)

    @property
    def address(self) -> str:
        return self._cluster.address

    @property
    def second_place(self) -> str:
        return self._second.node_id[:6]

    def hold_head(self, folder: Path) -> Path:
        """Take the head's processor.

        Returns:
            The file that gives it back once it is there.
        """
        import ray
        from ray.util.scheduling_strategies import NodeAffinitySchedulingStrategy

        holding, release = folder / "holding", folder / "release"
        place = NodeAffinitySchedulingStrategy(self._head.node_id, soft=False)
        ray.remote(hold).options(num_cpus=1, scheduling_strategy=place).remote(holding, release)
        while not holding.exists():
            time.sleep(0.1)
        return release

    def kill_second(self) -> None:
        self._cluster.remove_node(self._second, allow_graceful=False)

    def cached(self) -> list[str]:
        """Digests of the folders that were fetched."""
        return sorted(path.name for path in self._folder.glob("*/engine/inputs/*"))

    def stop(self) -> None:
        self._cluster.shutdown()


@pytest.fixture(scope="module")
def nodes(tmp_path_factory: pytest.TempPathFactory, machine_code: None) -> Iterator[Nodes]:
    tests = str(Path(__file__).resolve().parents[3])
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("RAY_USAGE_STATS_ENABLED", "0")
        patch.setenv("PYTHONPATH", os.pathsep.join([tests, os.environ.get("PYTHONPATH", "")]))
        folder = tmp_path_factory.mktemp("nodes")
        for name in Nodes.NAMES:
            make_own_cache(folder / name, skins=True)
        patch.setenv("HWP_CACHE", "")
        started = Nodes(folder)
    yield started
    started.stop()


def fits() -> list[int]:
    """Processes of the method."""
    every = psutil.process_iter(["cmdline"])
    return [
        process.pid for process in every if "gray_method:Gray" in (process.info["cmdline"] or ())
    ]


def wait_until_none_is_left() -> None:
    """Wait for the method's processes to end; the suite's own time limit ends this otherwise."""
    while fits():
        time.sleep(0.2)


def test_a_node_is_killed_in_the_middle_and_the_results_are_those_without_ray(
    nodes: Nodes, make_capture: CaptureMaker, tmp_path: Path
) -> None:
    from hwp_bench.run.engine.ray import RayEngine

    names = ("one", "two")
    captures = [make_capture(name, frames=20, size=32, perturbations={}).root for name in names]
    # On the second node no fit ends: however busy the machine is, the kill comes first.
    stuck = f"/{nodes.NAMES[1]}/"
    manifest = read_manifest(write_gray_method(tmp_path / "gray", seconds=0.0, stuck=stuck))
    design = make_design(manifest, [], [])
    settings = EvaluationSettings()
    killed: list[int] = []

    def kill(index: int, place: str) -> None:
        # The method's fit has begun there.
        if nodes.second_place in place and not killed:
            killed.append(index)
            nodes.kill_second()
            release.touch()

    view = Told()
    view.on_steps = kill
    # The nodes may not look at the tests' folders: inputs must be fetched.
    with RayEngine(nodes.address, view, shared=False) as engine:
        # A head that is free may end every job before the second node's worker has started.
        release = nodes.hold_head(tmp_path)
        run_ablation(manifest, design, captures, tmp_path / "ray", settings, [0], engine=engine)
    assert len(killed) == 1
    assert sum("again, its worker was lost" in text for text in view.said) <= 1
    # What is said of the second start, and when, depends on how soon Ray notices the loss; that
    # every job ends, with the results of a run without Ray, does not.
    assert any(index == killed[0] and nodes.second_place in place for index, place in view.starts)
    assert len(view.ends) == 4
    assert not any(view.ends.values())
    assert len(set(nodes.cached())) == 3
    run_ablation(manifest, design, captures, tmp_path / "turn", settings, [0], engine=LocalEngine())
    assert contents(tmp_path / "ray") == contents(tmp_path / "turn")
    wait_until_none_is_left()


def test_a_capture_is_rendered_to_the_same_digest(nodes: Nodes, tmp_path: Path) -> None:
    from hwp_bench.capture import open_capture
    from hwp_bench.run.engine.ray import RayEngine
    from hwp_bench.sim.produce.capture import RenderRequest
    from hwp_bench.sim.scene_files import load_scene

    work = RenderRequest(load_scene("capture0"), frame_count=10, size=32, workers=1)
    with RayEngine(nodes.address) as engine:
        engine.run([work.job(tmp_path / "ray", Needs())], lambda index: None)
    work.render(tmp_path / "turn")
    there, here = (open_capture(tmp_path / name) for name in ("ray", "turn"))
    assert there.digest == here.digest
    assert there.free_view is not None
    assert here.free_view is not None
    assert there.free_view.digest == here.free_view.digest


def test_a_stop_ends_the_jobs_on_the_nodes_and_leaves_no_half_result(
    nodes: Nodes, make_capture: CaptureMaker, tmp_path: Path
) -> None:
    capture = make_capture("one", frames=20, size=32, perturbations={})
    method = write_gray_method(tmp_path / "gray", seconds=600)
    out = tmp_path / "out"
    words = ["evaluate", str(method), "--capture", str(capture.root), "-o", str(out)]
    command = [sys.executable, "-m", "hwp_bench.cli.main", *words]
    engine = ["--engine", f"ray://{nodes.address}"]
    with subprocess.Popen(
        [*command, *engine], stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True
    ) as process:
        while not fits():
            assert process.poll() is None
            time.sleep(0.2)
        process.send_signal(signal.SIGTERM)
        shown, errors = process.communicate()
    assert process.returncode == 130, errors
    assert shown == ""
    assert "Traceback" not in errors
    wait_until_none_is_left()
    # The lock that keeps a second run away stays, and holds nothing.
    written = [path for path in out.rglob("*") if path.is_file() and path.stat().st_size]
    assert written == []
