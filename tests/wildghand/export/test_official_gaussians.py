"""Gaussians of the authors' code. Oracles: a file of its form that the test writes, the numbers in
it, and the drawing of these numbers by our rasterizer."""

from __future__ import annotations

import gzip
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import pygltflib
import pytest
import torch
from hostile import Exploit
from splat_files import read_ply

from hwp_bench.base.errors import BadInput
from hwp_bench.methods.contract import Camera
from wildghand.avatar.avatar import PosedGaussians, splat
from wildghand.cli.main import main
from wildghand.export.official import MAX_GAUSSIANS, read_official_gaussians

COUNT = 300


class GaussianModel(NamedTuple):
    """As their renderer names the attributes."""

    xyz: torch.Tensor
    opacity: torch.Tensor
    rotation: torch.Tensor
    scaling: torch.Tensor
    shs: torch.Tensor


def gaussians(count: int = COUNT) -> GaussianModel:
    """A ball of coloured Gaussians, half a metre in front of the camera."""
    generator = torch.Generator().manual_seed(0)
    return GaussianModel(
        xyz=0.05 * torch.randn(count, 3, generator=generator) + torch.tensor([0.0, 0.02, 0.5]),
        opacity=0.2 + 0.7 * torch.rand(count, 1, generator=generator),
        rotation=torch.nn.functional.normalize(torch.randn(count, 4, generator=generator)),
        scaling=0.002 + 0.006 * torch.rand(count, 3, generator=generator),
        shs=torch.rand(count, 1, 3, generator=generator),
    )


def save(path: Path, **changes: Any) -> Path:
    """A file as `torch.save(out["3dgs_input"][0]._asdict(), path)` writes it; None: left out."""
    saved = {**gaussians()._asdict(), **changes}
    torch.save({name: value for name, value in saved.items() if value is not None}, path)
    return path


def test_a_file_of_theirs_becomes_gaussians_that_are_drawn_as_they_are(tmp_path: Path) -> None:
    given = gaussians()
    made = tmp_path / "hand.ply"
    assert main(["export", str(save(tmp_path / "frame649.pth")), "-o", str(made)]) == 0
    found = read_ply(made)
    for name, wanted in (
        ("means", given.xyz),
        ("scales", given.scaling),
        ("opacities", given.opacity[:, 0]),
        ("colors", given.shs[:, 0]),
        ("quats", given.rotation),
    ):
        np.testing.assert_allclose(getattr(found, name), wanted.numpy(), rtol=2e-5, atol=1e-6)
    read = read_official_gaussians(tmp_path / "frame649.pth")
    K = np.array([[90.0, 0.0, 32.0], [0.0, 90.0, 32.0], [0.0, 0.0, 1.0]])
    camera = Camera(K, np.eye(4), 64, 64)
    drawn = splat(read, camera)
    assert drawn[..., 3].max() > 0.9
    np.testing.assert_allclose(splat(found, camera), drawn, atol=1e-3)
    # Down in the picture is +y of the file: the middle of the ball lies below the centre.
    rows = (drawn[..., 3].sum(axis=1) * np.arange(64)).sum() / drawn[..., 3].sum()
    assert rows == pytest.approx(31.5 + 90.0 * 0.02 / 0.5, abs=1.5)


def positions(path: Path) -> np.ndarray:
    """Where a file has its Gaussians."""
    if path.suffix == ".glb":
        made = pygltflib.GLTF2().load(str(path))
        accessor = made.accessors[made.meshes[0].primitives[0].attributes.POSITION]
        view = made.bufferViews[accessor.bufferView]
        data = made.binary_blob()[view.byteOffset :][: view.byteLength]
        return np.frombuffer(data, "<f4").reshape(-1, 3)
    data = gzip.decompress(path.read_bytes())
    packed = np.frombuffer(data[16:], np.uint8)[: 9 * COUNT].reshape(COUNT, 3, 3)
    low = packed.astype(np.int64) @ [1, 1 << 8, 1 << 16]
    return (low - np.where(low >= 1 << 23, 1 << 24, 0)) / 2.0 ** data[13]


@pytest.mark.parametrize("suffix", [".spz", ".glb"])
def test_in_other_formats_y_is_up(suffix: str, tmp_path: Path) -> None:
    made = tmp_path / f"hand{suffix}"
    words = ["export", str(save(tmp_path / "a.ckpt")), "-o", str(made), "--scale", "2"]
    assert main(words) == 0
    wanted = 2.0 * gaussians().xyz.numpy() * [1.0, -1.0, -1.0]
    np.testing.assert_allclose(positions(made), wanted, atol=3e-4)


def test_half_precision_and_strides_are_read(tmp_path: Path) -> None:
    given = gaussians()
    file = save(
        tmp_path / "a.pth",
        scaling=given.scaling.half(),
        opacity=torch.full((1, 1), 0.5).expand(COUNT, 1),
        rotation=3.0 * given.rotation,
    )
    read = read_official_gaussians(file)
    assert isinstance(read, PosedGaussians)
    np.testing.assert_allclose(read.scales, given.scaling.numpy(), rtol=1e-3)
    np.testing.assert_allclose(read.quats, given.rotation.numpy(), atol=1e-6)
    assert (read.opacities == 0.5).all()


BAD: dict[str, tuple[dict[str, Any], str]] = {
    "no shs": ({"shs": None}, "holds no shs"),
    "harmonics": ({"shs": torch.zeros(COUNT, 16, 3)}, "set use_rgb"),
    "nan": ({"xyz": torch.full((COUNT, 3), torch.nan)}, "NaN or infinity"),
    "far": ({"xyz": torch.full((COUNT, 3), 1e6)}, "beyond"),
    "flat": ({"scaling": torch.zeros(COUNT, 3)}, "is not above 0"),
    "no rotation": ({"rotation": torch.zeros(COUNT, 4)}, "has length 0"),
    "opacity": ({"opacity": torch.full((COUNT, 1), -0.5)}, "is below 0"),
    "opacity above 1": ({"opacity": torch.full((COUNT, 1), 1.5)}, "beyond"),
    "colour": ({"shs": torch.full((COUNT, 1, 3), -0.1)}, "is below 0"),
    "rows": ({"opacity": torch.ones(COUNT - 1, 1)}, "has shape"),
    "integers": ({"xyz": torch.ones(COUNT, 3, dtype=torch.int64)}, "not floats"),
    "sparse": ({"xyz": torch.ones(COUNT, 3).to_sparse()}, "not floats"),
    "scalar": ({"xyz": torch.tensor(1.0)}, "has 0 rows"),
    # One number in the file, a terabyte where it is copied.
    "huge": ({"xyz": torch.ones(1, 1).expand(10**11, 3)}, f"1 to {MAX_GAUSSIANS}"),
    "huge colour": ({"shs": torch.ones(1, 1, 1).expand(COUNT, 10**9, 3)}, "has shape"),
}


@pytest.mark.parametrize("name", BAD)
def test_what_is_no_gaussian_is_one_line(name: str, tmp_path: Path) -> None:
    changes, problem = BAD[name]
    with pytest.raises(BadInput, match=problem) as caught:
        read_official_gaussians(save(tmp_path / "a.pth", **changes))
    assert "\n" not in str(caught.value)
    assert "a.pth" in str(caught.value)


def test_hostile_files_and_networks_are_refused_by_one_line(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    marker = tmp_path / "executed"
    network = {"state_dict": {"model.renderer.gs_net.shade_layer.weight": torch.zeros(1, 256)}}
    contents: dict[str, Any] = {
        "exploit": {**gaussians()._asdict(), "more": Exploit(marker)},
        "tuple": gaussians(),
        "network": {"epoch": 49, **network},
        "list": [1, 2, 3],
    }
    for name, content in contents.items():
        file = tmp_path / f"{name}.ckpt"
        torch.save(content, file)
        assert main(["export", str(file), "-o", str(tmp_path / "hand.ply")]) == 1
        said = capsys.readouterr().err
        assert said.count("\n") == 1, said
        assert str(file) in said
        assert '["3dgs_input"][0]._asdict()' in said
    for content in (b"", b"PK\x03\x04", b"\x80\x05]\x94(", b"x" * 1000):
        (tmp_path / "bad.pth").write_bytes(content)
        with pytest.raises(BadInput, match=r"bad\.pth"):
            read_official_gaussians(tmp_path / "bad.pth")
    monkeypatch.setattr("wildghand.export.official.MAX_BYTES", 1000)
    with pytest.raises(BadInput, match="is larger than 1000 bytes"):
        read_official_gaussians(save(tmp_path / "large.pth"))
    assert not marker.exists()
    assert not (tmp_path / "hand.ply").exists()


@pytest.mark.parametrize(
    "words",
    [
        ["--mesh"],
        ["--supersplat"],
        ["--poses", "x"],
        ["--harmonics", "2"],
        ["--hand-model", "anny"],
    ],
    ids=lambda words: words[0],
)
def test_what_needs_an_avatar_is_refused(
    words: list[str], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = str(tmp_path / ("hand.glb" if "--mesh" in words else "hand.ply"))
    assert main(["export", str(save(tmp_path / "a.pth")), "-o", out, *words]) == 2
    assert "needs an avatar" in capsys.readouterr().err
