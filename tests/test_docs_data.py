"""Every command of docs/data.md runs, in its order, on files of the real formats."""

from __future__ import annotations

import json
import re
import shlex
import sys
import types
from pathlib import Path
from typing import Any

import pytest
from interhand_release import write_interhand
from official_release import write_release, write_rendered
from own_cache import make_own_cache
from synthetic_mano import write_mirrored_mano

from hwp_bench.base.images import write_image
from hwp_bench.capture import open_capture
from hwp_bench.cli.main import main
from hwp_bench.hands import load_template

ROOT = Path(__file__).resolve().parents[1]
#: Commands that are proven elsewhere: the tracker and the importer need a true video of a hand.
ELSEWHERE = ("python ", "hwp-bench data track", "hwp-bench data import video")


def commands() -> list[str]:
    text = (ROOT / "docs" / "data.md").read_text(encoding="utf-8")
    blocks = re.findall(r"^```\n(.*?)^```", text, re.DOTALL | re.MULTILINE)
    return [line for block in blocks for line in block.splitlines() if line]


def serve(monkeypatch: pytest.MonkeyPatch, store: Path) -> None:
    """A `huggingface_hub` whose data set is a folder here."""
    module = types.ModuleType("huggingface_hub")
    names = [str(path.relative_to(store)) for path in sorted(store.rglob("*")) if path.is_file()]

    class HfApi:
        def dataset_info(self, *_: Any, **__: Any) -> Any:
            rows = [types.SimpleNamespace(rfilename=name, size=None, lfs=None) for name in names]
            return types.SimpleNamespace(sha="c0ffee", siblings=rows)

    def hf_hub_download(repo: str, name: str, *, local_dir: str, **_: Any) -> str:
        target = Path(local_dir) / name
        target.parent.mkdir(parents=True, exist_ok=True)
        target.write_bytes((store / name).read_bytes())
        return str(target)

    module.HfApi, module.hf_hub_download = HfApi, hf_hub_download  # type: ignore[attr-defined]
    monkeypatch.setitem(sys.modules, "huggingface_hub", module)


def submission(folder: Path, captures: list[Path]) -> None:
    """Predictions of every test frame: the truth, darker."""
    for path in captures:
        capture = open_capture(path)
        for frame in range(len(capture) * 9 // 10, len(capture)):
            place = folder / "predictions" / capture.info.id / f"{frame:06d}.png"
            write_image(place, capture.frame(frame) // 2)
    (folder / "method.toml").write_text(
        'schema = "hwp-method/1"\ntraining = "none"\n'
        'name = "darker"\n[entry]\npredictions = "predictions"\n'
    )


@pytest.mark.slow
@pytest.mark.usefixtures("machine_code")
def test_the_page_leads_to_a_scored_table(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    mano = write_mirrored_mano(tmp_path / "mano_v1_2" / "models")
    right, left = (load_template(f"mano:{mano}", side) for side in ("right", "left"))
    store = tmp_path / "hub" / "dataset" / "WildGHand"
    write_release(store / "capture0_subsample3_single", right, 10, sides=("right",))
    write_release(store / "capture4_subsample4", right, 10)
    write_interhand(tmp_path / "InterHand2.6M", {"right": right, "left": left})
    serve(monkeypatch, tmp_path / "hub")
    # The page names a folder of the download; the hub's own layout is not known.
    (tmp_path / "baselines").symlink_to(ROOT / "baselines")
    monkeypatch.setenv("HWP_CACHE", str(make_own_cache(tmp_path / "cache")))
    monkeypatch.chdir(tmp_path)
    printed = {}
    for line in commands():
        if line.startswith(ELSEWHERE):
            continue
        words = shlex.split(line)[1:]
        if words[0] == "evaluate" and "baselines/plain" in words:
            words += ["--steps", "3"]
        if "submission" in words:
            submission(
                tmp_path / "submission", [tmp_path / "captures" / f"capture{n}" for n in (0, 4)]
            )
        if "rendered" in words:
            compat = open_capture(tmp_path / "compat" / "capture0")
            write_rendered(tmp_path / "EXPERIMENTS" / "c0_single", compat, [9])
        if words[-1:] == ["free/capture0"]:
            folder = next((tmp_path / "WildGHand").rglob("capture0_subsample3_single"))
            words = [str(folder) if word.startswith("WildGHand/") else word for word in words]
        status = main(words)
        captured = capsys.readouterr()
        assert status == 0, f"{line}\n{captured.err}"
        printed[line] = captured.out
    assert len(printed) > 12
    results = json.loads((tmp_path / "runs" / "plain" / "results.json").read_text())
    assert [capture["id"] for capture in results["captures"]] == ["capture0", "capture4"]
    assert all(frame["failure"] is None for c in results["captures"] for frame in c["frames"])
    assert (
        "Hand-object" in printed["hwp-bench table runs/plain"]
        or "psnr" in printed["hwp-bench table runs/plain"].lower()
    )
