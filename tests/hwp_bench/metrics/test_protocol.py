"""The table of metric facts is complete, consistent and light."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import pytest

from hwp_bench.base.errors import UsageError
from hwp_bench.metrics import (
    HWP_V1,
    METRICS,
    PAPER_WILDGHAND,
    PROTOCOLS,
    metric,
    metric_names,
    penalty,
)


def test_names_are_unique_and_every_protocol_has_metrics():
    names = [m.name for m in METRICS]
    assert len(names) == len(set(names))
    assert {m.protocol for m in METRICS} == {p.name for p in PROTOCOLS}


@pytest.mark.parametrize("facts", METRICS, ids=lambda m: m.name)
def test_penalty_lies_in_the_range_and_never_is_the_perfect_score(facts):
    low, high = facts.range
    assert low <= facts.penalty
    assert high is None or facts.penalty <= high
    worse = (
        facts.penalty < facts.perfect if facts.higher_is_better else (facts.penalty > facts.perfect)
    )
    assert worse
    assert facts.description.endswith(".")
    assert facts.reference


def test_lpips_metrics_are_listed_only_with_their_network():
    assert not any("lpips" in name for name in metric_names())
    assert set(metric_names(networks=["alex"])) - set(metric_names()) == {
        "lpips_alex",
        "paper_lpips",
    }
    assert set(metric_names(["alex", "vgg"])) >= {"lpips_alex", "lpips_vgg"}


def test_declared_penalties():
    values = penalty(networks=["alex"])
    assert tuple(values) == metric_names(networks=["alex"])
    assert values["psnr"] == values["paper_psnr"] == 0.0
    assert values["ssim"] == 0.0
    assert values["oriented_distance"] == values["lpips_alex"] == 1.0


def test_settings_that_give_the_protocols_their_names():
    assert (HWP_V1.ssim.window, HWP_V1.ssim.size, HWP_V1.ssim.sigma) == ("gaussian", 11, 1.5)
    assert (HWP_V1.ssim.sample_covariance, HWP_V1.ssim.data_range) == (False, 1.0)
    assert (PAPER_WILDGHAND.ssim.window, PAPER_WILDGHAND.ssim.size) == ("uniform", 7)
    assert (PAPER_WILDGHAND.ssim.sample_covariance, PAPER_WILDGHAND.ssim.data_range) == (True, 2.0)
    assert HWP_V1.as_dict()["ssim"]["data_range"] == 1.0


def test_unknown_names_are_answered_with_the_nearest():
    with pytest.raises(UsageError, match="Did you mean 'ssim_full'"):
        metric("ssim_ful")
    assert metric("psnr").unit == "dB"


def test_the_package_imports_no_numpy_opencv_or_torch():
    code = (
        "import sys, hwp_bench.metrics;"
        "sys.exit(' '.join({'numpy', 'cv2', 'torch', 'scipy'} & set(sys.modules)) or None)"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True)
    assert done.returncode == 0, done.stderr


@pytest.mark.parametrize("facts", METRICS, ids=lambda m: m.name)
def test_the_documentation_states_every_metric_with_its_penalty(facts):
    text = (Path(__file__).parents[3] / "docs" / "protocol.md").read_text(encoding="utf-8")
    rows = [line for line in text.splitlines() if line.startswith("| `") and facts.name in line]
    cells = [cell.strip() for cell in rows[0].strip("|").split("|")]
    assert f"`{facts.name}`" in cells[0]
    assert cells[1] == facts.unit
    assert cells[2] == ("higher" if facts.higher_is_better else "lower")
    assert float(cells[4]) == facts.penalty
