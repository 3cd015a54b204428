"""Untrusted checkpoints and tensors. Oracle: what the payload would have done."""

from __future__ import annotations

import json
import struct
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
import torch
from hostile import Exploit
from safetensors import SafetensorError
from safetensors.torch import load_file

from hwp_bench.base.errors import BadInput
from wildghand.fitting.session import SCHEMA, load_state
from wildghand.gaussians.perceptual import Vgg19
from wildghand.plain.choice import Averaging, KeptStates


@pytest.mark.parametrize("reader", ["state", "weights"])
def test_checkpoints_that_ask_for_calls_are_refused_and_make_none(
    tmp_path: Path, reader: str
) -> None:
    marker, file = tmp_path / "executed", tmp_path / "checkpoint.pt"
    torch.save({"schema": SCHEMA, "digest": "d", "step": Exploit(marker)}, file)
    with pytest.raises(BadInput, match=str(file)):
        if reader == "state":
            load_state(file, SimpleNamespace(device="cpu"), None, "d")  # type: ignore[arg-type]
        else:
            Vgg19(file)
    assert not marker.exists()
    # The payload is a sound one: an ordinary reader would have run it.
    torch.load(file, weights_only=False)
    assert marker.exists()


@pytest.mark.parametrize("content", [b"", b"PK\x03\x04", b"\x80\x05]\x94(", b"x" * 1000])
def test_damaged_states_are_one_kind_of_error(tmp_path: Path, content: bytes) -> None:
    file = tmp_path / "state.pt"
    file.write_bytes(content)
    with pytest.raises(BadInput, match="is damaged") as caught:
        load_state(file, SimpleNamespace(device="cpu"), None, "d")  # type: ignore[arg-type]
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize("kept", [[1], {5: [1.0]}, None])
def test_a_state_that_keeps_no_tensors_is_damaged(tmp_path: Path, kept: Any) -> None:
    file = tmp_path / "state.pt"
    parts = {"fit": {"steps": 9, "kept": kept}, "watchers": {}, "step": 9, "seconds": 1.0}
    torch.save({"schema": SCHEMA, "digest": "d", **parts}, file)
    states = KeptStates(Averaging([], 0.0), 5)
    fit = SimpleNamespace(device="cpu", load_state_dict=states.load_state_dict)
    with pytest.raises(BadInput, match="is damaged"):
        load_state(file, fit, None, "d")  # type: ignore[arg-type]


def _tensors(header: Any, size: int | None = None, body: bytes = b"") -> bytes:
    text = header if isinstance(header, bytes) else json.dumps(header).encode()
    return struct.pack("<Q", len(text) if size is None else size) + text + body


@pytest.mark.parametrize(
    "content",
    [
        _tensors({"a": {"dtype": "F32", "shape": [10**9], "data_offsets": [0, 4 * 10**9]}}),
        _tensors({"a": {"dtype": "F32", "shape": [2], "data_offsets": [0, 4]}}, body=b"1234"),
        _tensors({"a": {"dtype": "F32", "shape": [1], "data_offsets": [4, 0]}}, body=b"1234"),
        _tensors({}, size=2**60),
        _tensors(b"[" * 100_000),
        b"",
    ],
)
def test_tensors_that_lie_about_their_size_are_refused(tmp_path: Path, content: bytes) -> None:
    # `load_avatar` turns this error into one message (test_wildghand_fit.py).
    file = tmp_path / "model.safetensors"
    file.write_bytes(content)
    with pytest.raises(SafetensorError):
        load_file(file)
