"""Finding and reading the LPIPS weights: nothing downloaded, nothing foreign accepted."""

from __future__ import annotations

import hashlib
import importlib.util
import pickle
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from hwp_bench.base.errors import BadInput, MissingDependency, UsageError
from hwp_bench.metrics import lpips as lpips_weights
from hwp_bench.metrics.lpips import (
    BACKBONE_FILES,
    LINEAR_DIGESTS,
    LpipsFiles,
    find_weights,
    load_available,
    load_lpips,
    lpips_available,
)

torch = pytest.importorskip("torch")


@pytest.fixture
def hub(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """An empty torch hub cache, and no package with linear layers."""
    monkeypatch.setenv("TORCH_HOME", str(tmp_path))
    monkeypatch.setattr(lpips_weights, "LINEAR_PACKAGES", ())
    folder = tmp_path / "hub" / "checkpoints"
    folder.mkdir(parents=True)
    return folder


def small_states() -> tuple[dict, dict]:
    """States with the shapes of AlexNet."""
    from hwp_bench.metrics.lpips import BACKBONES

    backbone, channels = {}, []
    for layer in BACKBONES["alex"]:
        fan_in, fan_out = layer.channels
        shape = (fan_out, fan_in, layer.kernel, layer.kernel)
        backbone[f"features.{layer.index}.weight"] = 0.01 * torch.ones(shape)
        backbone[f"features.{layer.index}.bias"] = torch.zeros(fan_out)
        channels.append(fan_out)
    return backbone, {
        f"lin{k}.model.1.weight": torch.ones(1, c, 1, 1) for k, c in enumerate(channels)
    }


@pytest.fixture
def installed(hub: Path, monkeypatch: pytest.MonkeyPatch) -> LpipsFiles:
    """Made-up weights that are declared to be the published ones."""
    backbone, linear = small_states()
    draft, linear_path = hub / "draft", hub / "alex-linear.pth"
    torch.save(backbone, draft)
    torch.save(linear, linear_path)
    digest = hashlib.sha256(draft.read_bytes()).hexdigest()
    path = draft.rename(hub / f"alexnet-owt-{digest[:8]}.pth")
    monkeypatch.setattr(lpips_weights, "BACKBONE_FILES", {"alex": (path.name,)})
    linear_digest = hashlib.sha256(linear_path.read_bytes()).hexdigest()
    monkeypatch.setattr(lpips_weights, "LINEAR_DIGESTS", {"alex": linear_digest})
    return LpipsFiles(backbone=path, linear=linear_path)


def test_absent_weights_are_a_reason_and_never_an_entry(hub: Path):
    for net in ("alex", "vgg"):
        reason = lpips_available(net)
        assert reason is not None
        assert BACKBONE_FILES[net][0] in reason
        with pytest.raises(MissingDependency):
            load_lpips(net)
    assert load_available() == {}


def test_an_absent_linear_file_is_a_reason_too(installed: LpipsFiles, tmp_path: Path):
    reason = lpips_available("alex")
    assert reason is not None
    assert "linear layers" in reason
    gone = LpipsFiles(installed.backbone, tmp_path / "gone.pth")
    assert "gone.pth" in (lpips_available("alex", gone) or "")


def test_weights_by_path_and_in_the_hub_cache_are_loaded(installed: LpipsFiles):
    assert lpips_available("alex", installed) is None
    images = np.random.default_rng(0).random((2, 64, 64, 3))
    by_path = load_lpips("alex", installed)(*images)
    from_cache = load_lpips("alex", LpipsFiles(linear=installed.linear))(*images)
    assert by_path == from_cache > 0.0


def test_the_cache_is_where_torch_says(hub: Path, monkeypatch: pytest.MonkeyPatch):
    """Oracle: torch.hub.get_dir()."""
    assert lpips_weights._hub_checkpoints() == Path(torch.hub.get_dir()) / "checkpoints"
    monkeypatch.delenv("TORCH_HOME")
    monkeypatch.setenv("XDG_CACHE_HOME", "/somewhere")
    assert lpips_weights._hub_checkpoints() == Path(torch.hub.get_dir()) / "checkpoints"


def test_a_file_that_is_not_the_published_one_is_refused(hub: Path, installed: LpipsFiles):
    assert installed.backbone is not None
    installed.backbone.write_bytes(installed.backbone.read_bytes() + b"x")
    with pytest.raises(BadInput, match="not the published checkpoint"):
        load_lpips("alex", installed)


class Foreign:
    """What a hostile pickle would bring."""

    def __reduce__(self) -> tuple:
        return (print, ("run",))


@pytest.mark.parametrize(
    "content",
    [pickle.dumps(Foreign(), 2), b"", b"PK\x03\x04 truncated", pickle.dumps([1, 2], 2)],
    ids=["foreign class", "empty", "truncated", "no dictionary"],
)
def test_a_foreign_or_damaged_file_runs_nothing(
    content: bytes, installed: LpipsFiles, monkeypatch: pytest.MonkeyPatch, capsys
):
    assert installed.linear is not None
    installed.linear.write_bytes(content)
    digest = hashlib.sha256(content).hexdigest()
    monkeypatch.setattr(lpips_weights, "LINEAR_DIGESTS", {"alex": digest})
    with pytest.raises(BadInput, match=r"alex-linear\.pth"):
        load_lpips("alex", installed)
    assert "run" not in capsys.readouterr().out


@pytest.mark.parametrize("source", lpips_weights.LINEAR_PACKAGES, ids=lambda source: source[0])
@pytest.mark.parametrize("net", ["alex", "vgg"])
def test_the_linear_layers_of_packages_are_the_published_ones(source, net, monkeypatch):
    """Oracle: the bytes that the packages ship, where one is installed."""
    if importlib.util.find_spec(source[0]) is None:
        pytest.skip(f"{source[0]} is not installed")
    monkeypatch.setattr(lpips_weights, "LINEAR_PACKAGES", (source,))
    path = lpips_weights._find_linear(net, None)
    assert hashlib.sha256(path.read_bytes()).hexdigest() == LINEAR_DIGESTS[net]
    state = lpips_weights._read_state(path, [LINEAR_DIGESTS[net]])
    assert all(float(weight.min()) >= 0 for weight in state.values())


def test_an_unknown_network_is_refused():
    with pytest.raises(UsageError, match="alex and vgg"):
        find_weights("squeeze")


def test_asking_does_not_import_torch():
    code = (
        "import sys; from hwp_bench.metrics.lpips import lpips_available;"
        "lpips_available('alex'); sys.exit('torch' in sys.modules)"
    )
    assert subprocess.run([sys.executable, "-c", code]).returncode == 0
