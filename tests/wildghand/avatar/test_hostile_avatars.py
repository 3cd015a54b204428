"""Avatars that claim what is not there. Oracle: the bounds of their description."""

from __future__ import annotations

import json
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
import torch
from safetensors.torch import load_file, save_file

from hwp_bench.base.errors import BadInput
from wildghand.avatar.avatar import WildGHandAvatar
from wildghand.avatar.files import DESCRIPTION, MODEL, load_avatar, save_avatar

Change = Callable[[dict[str, Any]], Any]
#: A fit that says nothing of single frames.
_OF_NONE: dict[str, Any] = {"temporal": {}, "clean": [], "frame_weights": []}


@pytest.fixture(scope="module")
def saved(tiny_avatar: WildGHandAvatar, tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tiny_avatar.folder
    path = save_avatar(tiny_avatar, tmp_path_factory.mktemp("saved") / "avatar")
    tiny_avatar.folder = folder
    load_avatar(path)
    return path


@pytest.fixture
def avatar(saved: Path, tmp_path: Path) -> Path:
    return Path(shutil.copytree(saved, tmp_path / "avatar"))


def _describe(avatar: Path, change: Change) -> None:
    value = json.loads((avatar / DESCRIPTION).read_text())
    change(value)
    (avatar / DESCRIPTION).write_text(json.dumps(value))


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda v: v.update(seed=-1), "seed: is -1"),
        (lambda v: v.update(seed=2**63), "seed: is"),
        (lambda v: v.update(mean_color=[0.5] * 100_000), "mean_color"),
        (lambda v: v["fit"].update(frames=[*range(8192)], **_OF_NONE), "log_gains.* not .*8192"),
        (lambda v: v["fit"].update(frames=[0] * 200_000), "fit.frames"),
        (lambda v: v["fit"].update(frames=[-1]), r"fit.frames\[0\]: is -1"),
        (lambda v: v["fit"].update(frames=[10**18]), r"fit.frames\[0\]"),
        (lambda v: v["fit"].update(clean=[0.5] * 200_000), "fit.clean"),
        (lambda v: v["fit"].update(temporal={"right": [0.5] * 200_000}), "fit.temporal"),
        (lambda v: v["fit"].update(temporal={"right": [1e300]}), "fit.temporal"),
        (lambda v: v["fit"].update(frame_weights=[1e300]), "fit.frame_weights"),
        (lambda v: v["fit"].update(clean=[-1e300]), "fit.clean"),
        (lambda v: v["fit"]["frames"].__setitem__(0, v["fit"]["frames"][1]), "frames: .* twice"),
        (lambda v: v["fit"]["temporal"]["right"].pop(), r"fit\.temporal\.right: has \d+ numbers"),
        (lambda v: v["fit"]["temporal"].update(left=[0.5]), "fit.temporal: names 'left'"),
        (lambda v: v["fit"]["clean"].pop(), "fit.clean: has .* another copy"),
        (lambda v: v["fit"]["frame_weights"].append(1.0), "fit.frame_weights: has .* another copy"),
        (
            lambda v: v["betas"].update(right=[1e308] * 10),
            r"betas.right: must be ten numbers from -100 to 100.*another copy",
        ),
        (lambda v: v["betas"].update(right=[0.0] * 9 + [-101.0]), "betas.right"),
        (
            lambda v: v["settings"]["network"].update(identity_resolution=4096),
            "network.*as its description says",
        ),
        (
            lambda v: v["settings"]["network"].update(size="paper"),
            "network",
        ),
        (
            lambda v: v["hand_model"].update(digest="0" * 64),
            "another edition of the hand model .*000000000000",
        ),
    ],
)
def test_claims_are_refused_before_memory_is_taken(
    avatar: Path, change: Change, message: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    def make_model(*arguments: object) -> None:
        raise AssertionError("a model is made of what the file does not hold")

    monkeypatch.setattr("wildghand.avatar.files.make_model", make_model)
    _describe(avatar, change)
    with pytest.raises(BadInput, match=message) as caught:
        load_avatar(avatar)
    assert "\n" not in str(caught.value)
    assert len(str(caught.value)) < 1000


@pytest.mark.parametrize(
    "kind", [torch.int32, torch.int64, torch.uint8, torch.bool], ids=lambda kind: str(kind)
)
def test_tensors_of_integers_are_refused(avatar: Path, kind: torch.dtype) -> None:
    tensors = load_file(avatar / MODEL)
    name = "network.attribute_head.attributes.bias"
    tensors[name] = tensors[name].to(kind)
    save_file(tensors, avatar / MODEL)
    with pytest.raises(BadInput, match=f"{name}: holds .*, not floating point"):
        load_avatar(avatar)


def test_what_is_missing_or_not_finite_is_named(avatar: Path) -> None:
    tensors = load_file(avatar / MODEL)
    lost = tensors.pop("log_gains")
    save_file(tensors, avatar / MODEL)
    with pytest.raises(BadInput, match="log_gains: is missing"):
        load_avatar(avatar)
    save_file({**tensors, "log_gains": torch.full_like(lost, torch.nan)}, avatar / MODEL)
    with pytest.raises(BadInput, match="log_gains: holds NaN"):
        load_avatar(avatar)


def test_others_may_read_an_avatar(avatar: Path) -> None:
    plain = avatar / "plain"
    plain.write_text("")
    for name in (DESCRIPTION, MODEL):
        assert (avatar / name).stat().st_mode == plain.stat().st_mode


def test_a_tensor_that_the_description_names_is_required(avatar: Path) -> None:
    """Also of those that an avatar need not have, such as changes of colours. Those of the network
    are required anyway."""
    whole = load_file(avatar / MODEL)
    named = json.loads((avatar / DESCRIPTION).read_text())["tensors"]
    assert named == sorted(whole)
    for name in [each for each in named if not each.startswith("network.")]:
        save_file({key: value for key, value in whole.items() if key != name}, avatar / MODEL)
        with pytest.raises(BadInput, match=f"{name}: is missing.*another copy"):
            load_avatar(avatar)
    save_file({**whole, "more": torch.zeros(1)}, avatar / MODEL)
    with pytest.raises(BadInput, match="more: is not among the tensors"):
        load_avatar(avatar)


def test_numbers_out_of_range_are_refused(avatar: Path) -> None:
    """Finite ones, too: multiplied they would not be."""
    whole = load_file(avatar / MODEL)
    name = "network.attribute_head.attributes.bias"
    save_file({**whole, name: torch.full_like(whole[name], 1e30)}, avatar / MODEL)
    with pytest.raises(BadInput, match=rf"{name}: holds a number beyond 1e\+06.*another copy"):
        load_avatar(avatar)
