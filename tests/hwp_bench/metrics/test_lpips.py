"""LPIPS with random weights. Oracles: layers written out with torch.nn and the formula in
float64 numpy (1e-5 relative), and torchmetrics where it is installed (1e-5 relative).
"""

from __future__ import annotations

import hashlib
import importlib.util
import pickle
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from hwp_bench.base.errors import BadInput, MissingDependency
from hwp_bench.metrics import lpips as lpips_weights
from hwp_bench.metrics.lpips import (
    BACKBONE_FILES,
    LINEAR_DIGESTS,
    Lpips,
    load_available,
    load_lpips,
    lpips_available,
)

torch = pytest.importorskip("torch")
nn = torch.nn

#: Index in `features` after which LPIPS compares, and the channels there.
TAPS = {"alex": (1, 4, 7, 9, 11), "vgg": (3, 8, 15, 22, 29)}
CHANNELS = {"alex": (64, 192, 384, 256, 256), "vgg": (64, 128, 256, 512, 512)}


def alexnet_features() -> nn.Sequential:
    """The convolutional part of AlexNet as Krizhevsky's one-column form publishes it."""
    return nn.Sequential(
        *(nn.Conv2d(3, 64, 11, 4, 2), nn.ReLU(), nn.MaxPool2d(3, 2)),
        *(nn.Conv2d(64, 192, 5, padding=2), nn.ReLU(), nn.MaxPool2d(3, 2)),
        *(nn.Conv2d(192, 384, 3, padding=1), nn.ReLU()),
        *(nn.Conv2d(384, 256, 3, padding=1), nn.ReLU()),
        *(nn.Conv2d(256, 256, 3, padding=1), nn.ReLU(), nn.MaxPool2d(3, 2)),
    )


def vgg16_features() -> nn.Sequential:
    """The convolutional part of VGG-16 (configuration D of the paper)."""
    layers: list[nn.Module] = []
    previous = 3
    for width in (64, 64, "pool", 128, 128, "pool", *(256,) * 3, "pool", *(512,) * 3, "pool",
                  *(512,) * 3, "pool"):  # fmt: skip
        if width == "pool":
            layers.append(nn.MaxPool2d(2, 2))
        else:
            layers += [nn.Conv2d(previous, width, 3, padding=1), nn.ReLU()]
            previous = width
    return nn.Sequential(*layers)


FEATURES: dict[str, Callable[[], nn.Sequential]] = {
    "alex": alexnet_features,
    "vgg": vgg16_features,
}


def random_network(net: str) -> tuple[nn.Sequential, dict, dict]:
    """Random layers, and their states under the names of the published checkpoints."""
    torch.manual_seed(0)
    features = FEATURES[net]().eval()
    backbone = {f"features.{name}": value for name, value in features.state_dict().items()}
    backbone["classifier.6.bias"] = torch.zeros(1000)
    linear = {
        f"lin{k}.model.1.weight": torch.rand(1, channels, 1, 1)
        for k, channels in enumerate(CHANNELS[net])
    }
    return features, backbone, linear


def written_out(net: str, features: nn.Sequential, linear: dict, x, y) -> float:
    """The formula of the paper, layer after layer."""
    shift, scale = np.array([-0.030, -0.088, -0.188]), np.array([0.458, 0.448, 0.450])
    total = 0.0
    a, b = (
        torch.from_numpy(((2 * image - 1 - shift) / scale).transpose(2, 0, 1)[None]).float()
        for image in (x, y)
    )
    with torch.no_grad():
        for index, layer in enumerate(features):
            a, b = layer(a), layer(b)
            if index in TAPS[net]:
                f, g = a[0].double().numpy(), b[0].double().numpy()
                f, g = (v / (np.sqrt((v**2).sum(0)) + 1e-10) for v in (f, g))
                weight = linear[f"lin{TAPS[net].index(index)}.model.1.weight"].double().numpy()
                total += float(((f - g) ** 2 * weight[0]).sum(0).mean())
    return total


@pytest.fixture
def images():
    rng = np.random.default_rng(0)
    return rng.random((70, 64, 3)), rng.random((70, 64, 3))


@pytest.mark.parametrize("net", ["alex", "vgg"])
def test_matches_the_formula_written_out(net, images):
    features, backbone, linear = random_network(net)
    lpips = Lpips(net, backbone, linear)
    assert lpips(*images) == pytest.approx(written_out(net, features, linear, *images), rel=1e-5)


@pytest.mark.parametrize("net", ["alex", "vgg"])
def test_matches_torchmetrics(net, images, monkeypatch):
    oracle = pytest.importorskip("torchmetrics.functional.image.lpips")
    features, backbone, linear = random_network(net)
    monkeypatch.setattr(oracle, "_get_tv_model_features", lambda *_: features)
    network = oracle._LPIPS(pretrained=False, net=net, pnet_rand=True)
    missing = network.load_state_dict(linear, strict=False).unexpected_keys
    assert not missing
    x, y = (torch.from_numpy(i.transpose(2, 0, 1)[None]).float() * 2 - 1 for i in images)
    with torch.no_grad():
        expected = float(network(x, y))
    assert Lpips(net, backbone, linear)(*images) == pytest.approx(expected, rel=1e-5)


def test_identical_images_score_zero(images):
    _, backbone, linear = random_network("alex")
    assert Lpips("alex", backbone, linear)(images[0], images[0]) == 0.0


@pytest.fixture
def hub(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """An empty torch hub cache, and no package with linear layers."""
    monkeypatch.setenv("TORCH_HOME", str(tmp_path))
    monkeypatch.setattr(lpips_weights, "LINEAR_PACKAGES", ())
    folder = tmp_path / "hub" / "checkpoints"
    folder.mkdir(parents=True)
    return folder


@pytest.fixture
def installed(hub: Path, monkeypatch: pytest.MonkeyPatch) -> tuple[Path, Path]:
    """Made-up weights, backbone and linear layers, that are declared to be the published ones."""
    _, backbone, linear = random_network("alex")
    draft, package = hub / "draft", hub.parent / "layers"
    (package / "v").mkdir(parents=True)
    (package / "__init__.py").touch()
    linear_path = package / "v" / "alex.pth"
    torch.save(backbone, draft)
    torch.save(linear, linear_path)
    digest = hashlib.sha256(draft.read_bytes()).hexdigest()
    path = draft.rename(hub / f"alexnet-owt-{digest[:8]}.pth")
    monkeypatch.syspath_prepend(hub.parent)
    monkeypatch.setattr(lpips_weights, "LINEAR_PACKAGES", (("layers", "v"),))
    monkeypatch.setattr(lpips_weights, "BACKBONE_FILES", {"alex": (path.name,)})
    linear_digest = hashlib.sha256(linear_path.read_bytes()).hexdigest()
    monkeypatch.setattr(lpips_weights, "LINEAR_DIGESTS", {"alex": linear_digest})
    return path, linear_path


def test_absent_weights_are_a_reason_and_never_an_entry(hub: Path):
    for net in ("alex", "vgg"):
        reason = lpips_available(net)
        assert reason is not None
        assert BACKBONE_FILES[net][0] in reason
        with pytest.raises(MissingDependency):
            load_lpips(net)
    assert load_available() == {}


def test_weights_are_found_and_an_absent_file_is_a_reason(installed: tuple[Path, Path]):
    images = np.random.default_rng(0).random((2, 64, 64, 3))
    assert load_available()["alex"](*images) > 0.0
    installed[1].unlink()
    assert "linear layers" in (lpips_available("alex") or "")


def test_the_cache_is_where_torch_says(hub: Path, monkeypatch: pytest.MonkeyPatch):
    """Oracle: torch.hub.get_dir()."""
    assert lpips_weights.torch_home() / "hub" == Path(torch.hub.get_dir())
    monkeypatch.delenv("TORCH_HOME")
    monkeypatch.setenv("XDG_CACHE_HOME", "/somewhere")
    assert lpips_weights.torch_home() / "hub" == Path(torch.hub.get_dir())


def test_a_file_that_is_not_the_published_one_is_refused(installed: tuple[Path, Path]):
    installed[0].write_bytes(installed[0].read_bytes() + b"x")
    with pytest.raises(BadInput, match="not the published checkpoint"):
        load_lpips("alex")


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
    content: bytes, installed: tuple[Path, Path], monkeypatch: pytest.MonkeyPatch, capsys
):
    installed[1].write_bytes(content)
    digest = hashlib.sha256(content).hexdigest()
    monkeypatch.setattr(lpips_weights, "LINEAR_DIGESTS", {"alex": digest})
    with pytest.raises(BadInput, match=r"alex\.pth"):
        load_lpips("alex")
    assert "run" not in capsys.readouterr().out


@pytest.mark.parametrize("source", lpips_weights.LINEAR_PACKAGES, ids=lambda source: source[0])
@pytest.mark.parametrize("net", ["alex", "vgg"])
def test_the_linear_layers_of_packages_are_the_published_ones(source, net, monkeypatch):
    """Oracle: the bytes that the packages ship, where one is installed."""
    if importlib.util.find_spec(source[0]) is None:
        pytest.skip(f"{source[0]} is not installed")
    monkeypatch.setattr(lpips_weights, "LINEAR_PACKAGES", (source,))
    path = lpips_weights._find_linear(net)
    assert hashlib.sha256(path.read_bytes()).hexdigest() == LINEAR_DIGESTS[net]
    state = lpips_weights._read_state(path, [LINEAR_DIGESTS[net]])
    assert all(float(weight.min()) >= 0 for weight in state.values())


def test_asking_does_not_import_torch():
    code = (
        "import sys; from hwp_bench.metrics.lpips import lpips_available;"
        "lpips_available('alex'); sys.exit('torch' in sys.modules)"
    )
    assert subprocess.run([sys.executable, "-c", code]).returncode == 0
