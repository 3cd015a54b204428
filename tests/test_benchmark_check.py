"""Regressions of stored ratios are found, and a busy machine is none. Oracle: scripted measures."""

from __future__ import annotations

import json
import sys
import types
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path

import pytest

from benchmarks.check import main
from benchmarks.ratio_store import STORE, Ratio, read_store, write_store
from hwp_bench.base.errors import BadInput

Script = Callable[..., None]


@pytest.fixture
def scripted(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> tuple[Path, list[str], Script]:
    """A store of two benchmarks, what was measured so far, and how to say what they measure."""
    asked: list[str] = []

    def script(name: str, *values: Mapping[str, float]) -> None:
        turns: Iterator[Mapping[str, float]] = iter(values)

        def measure(size: int) -> Mapping[str, float]:
            asked.append(f"{name} {size}")
            return next(turns)

        module = types.ModuleType(f"benchmarks.made_up_{name}")
        module.__dict__["measure"] = measure
        monkeypatch.setitem(sys.modules, module.__name__, module)

    store = tmp_path / "ratios.json"
    entries = [
        {
            "name": name,
            "module": f"benchmarks.made_up_{name}",
            "command": f"python -m benchmarks.made_up_{name}",
            "arguments": {"size": 3},
            "quick": name == "quick",
            "ratios": [{"name": "a / b", "ratio": 2.0, "tolerance": 0.25, "better": better}],
        }
        for name, better in (("quick", "lower"), ("long", "higher"))
    ]
    store.write_text(json.dumps({"schema": "hwp-ratios/1", "benchmarks": entries}))
    return store, asked, script


def test_what_is_within_the_tolerance_passes_at_once(
    scripted: tuple[Path, list[str], Script], capsys: pytest.CaptureFixture[str]
) -> None:
    store, asked, script = scripted
    script("quick", {"a / b": 2.5, "not stored": 9.0})
    script("long", {"a / b": 1.6})
    assert main(["--store", str(store)]) == 0
    assert asked == ["quick 3", "long 3"]
    assert "kept" in capsys.readouterr().out


def test_a_regression_is_one_only_when_it_repeats(
    scripted: tuple[Path, list[str], Script],
) -> None:
    store, asked, script = scripted
    script("quick", {"a / b": 9.0}, {"a / b": 2.6}, {"a / b": 2.4})
    assert main(["--store", str(store), "--quick"]) == 0
    assert asked == ["quick 3"] * 3
    script("quick", *[{"a / b": 2.51}] * 3)
    assert main(["--store", str(store), "--only", "quick"]) == 1
    script("long", *[{"a / b": 1.59}] * 3)
    assert main(["--store", str(store), "--only", "long"]) == 1


def test_on_another_processor_tolerances_are_wider(
    scripted: tuple[Path, list[str], Script],
) -> None:
    store, _, script = scripted
    entries = json.loads(store.read_text())
    entries["benchmarks"][0]["machine"] = "Abacus, 1 core"
    store.write_text(json.dumps(entries))
    script("quick", {"a / b": 3.49})
    assert main(["--store", str(store), "--quick"]) == 0
    script("quick", *[{"a / b": 3.51}] * 3)
    assert main(["--store", str(store), "--quick"]) == 1


@pytest.mark.parametrize("found", [{}, {"a / b": float("nan")}], ids=["missing", "not a number"])
def test_a_ratio_that_is_not_measured_any_more_is_reported(
    found: dict[str, float], scripted: tuple[Path, list[str], Script]
) -> None:
    store, _, script = scripted
    script("quick", found, found, found)
    assert main(["--store", str(store), "--quick"]) == 1


def test_update_stores_what_is_measured_and_nothing_else(
    scripted: tuple[Path, list[str], Script],
) -> None:
    store, _, script = scripted
    script("quick", {"a / b": 7.12345, "not stored": 1.0})
    before = read_store(store)
    assert main(["--store", str(store), "--quick", "--update"]) == 0
    after = read_store(store)
    assert after[1] == before[1]
    assert after[0].ratios == [Ratio("a / b", 7.1235, 0.25, "lower")]
    assert "cores" in after[0].machine
    script("quick", {"a / b": 8.0})
    assert main(["--store", str(store), "--quick"]) == 0


def test_numbers_for_programs_and_the_list(
    scripted: tuple[Path, list[str], Script], capsys: pytest.CaptureFixture[str]
) -> None:
    store, asked, script = scripted
    script("quick", {"a / b": 1.0})
    assert main(["--store", str(store), "--quick", "--json"]) == 0
    (entry,) = json.loads(capsys.readouterr().out)
    assert entry["now"] == 1.0
    assert entry["kept"] is True
    assert entry["allowed"] == 2.5
    asked.clear()
    assert main(["--store", str(store), "--list"]) == 0
    assert asked == []
    assert "made_up_long" in capsys.readouterr().out


def test_an_unknown_benchmark_and_a_broken_store_are_refused(
    scripted: tuple[Path, list[str], Script], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    store, _, _ = scripted
    assert main(["--store", str(store), "--only", "slow"]) == 2
    assert "quick, long" in capsys.readouterr().err
    text = store.read_text().replace("benchmarks.made_up_long", "os")
    store.write_text(text)
    with pytest.raises(BadInput, match="not a module in benchmarks"):
        read_store(store)


def test_the_stored_ratios_are_whole_and_written_as_they_are_read(tmp_path: Path) -> None:
    benchmarks = read_store(STORE)
    assert any(benchmark.quick for benchmark in benchmarks)
    for benchmark in benchmarks:
        assert (STORE.parent / f"{benchmark.module.partition('.')[2]}.py").is_file()
        assert benchmark.command.startswith("python -m benchmarks.")
        assert benchmark.machine
        assert all(ratio.ratio is not None for ratio in benchmark.ratios)
    write_store(benchmarks, tmp_path / "again.json")
    assert (tmp_path / "again.json").read_text() == STORE.read_text()
