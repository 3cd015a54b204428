"""Segment Anything. Oracles: Meta's code (segment-anything 1.0) on tiny weights; a stub network.

`sam_reference.npz` is what Meta's `SamPredictor` (every fourth logit before it is enlarged) and
`SamAutomaticMaskGenerator` (8 points along an edge, quality 5.0, stability 0.95 at offset 0.5,
boxes 0.995) return for `picture()` and `POINTS` with the weights of `tiny_networks.sam_tensors()`.
"""

from __future__ import annotations

import json
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from safetensors.torch import save_file
from tiny_networks import EDGE, sam_tensors, write_sam_file, write_sam_folder

from hwp_bench.base.errors import BadInput, MissingDependency
from wildghand.pao.sam import (
    AutomaticSettings,
    PromptedHand,
    SegmentAnything,
    automatic_masks,
    check_checkpoint,
    checkpoint_digest,
    load_network,
    mask_of,
    open_sam,
    see_image,
    suppress_overlaps,
)
from wildghand.pao.segmenters import RegionCache

PICTURE = np.random.default_rng(0).integers(0, 256, (40, 48, 3), dtype=np.uint8)
POINTS = [[10.5, 20.5], [40.0, 30.0], [63.5, 0.5]]


def picture() -> np.ndarray:
    rows, columns = np.mgrid[:EDGE, :EDGE]
    board = ((rows // 8 + columns // 8) % 2) * 200
    return np.stack([(rows * 4) % 256, (columns * 4) % 256, board], -1).astype(np.uint8)


@pytest.fixture(scope="module")
def reference() -> dict[str, np.ndarray]:
    with np.load(Path(__file__).with_name("sam_reference.npz")) as stored:
        return dict(stored)


def test_masks_are_those_of_the_public_code(
    tmp_path: Path, reference: dict[str, np.ndarray]
) -> None:
    network = load_network(write_sam_file(tmp_path / "sam.pth"))
    seen = see_image(network, picture())
    # Stored with 16 bits.
    assert np.allclose(seen.embedding, reference["embedding"], atol=2e-3)
    coarse, quality = seen.masks_at(torch.tensor(POINTS))
    # Sums of float32 in another order: 1e-5 of the largest logit.
    assert np.allclose(coarse[:, :, ::4, ::4], reference["logits"], atol=2e-3)
    assert np.allclose(quality, reference["quality"], atol=1e-4)


def test_automatic_masks_are_those_of_the_public_code(
    tmp_path: Path, reference: dict[str, np.ndarray]
) -> None:
    network = load_network(write_sam_file(tmp_path / "sam.pth"))
    chosen = AutomaticSettings(points=8, quality=5.0, stability=0.95, offset=0.5, overlap=0.995)
    masks = automatic_masks(see_image(network, picture()), chosen)
    count = int(reference["count"])
    expected = np.unpackbits(reference["masks"])[: count * EDGE * EDGE].astype(bool)
    expected = expected.reshape(count, EDGE, EDGE)
    assert len(masks) == count
    for mask in expected:
        # A pixel whose logit is 0 to rounding may be on either side.
        assert min(int((mask ^ other).sum()) for other in masks) <= 2
    nothing = automatic_masks(
        see_image(network, picture()), AutomaticSettings(points=2, quality=100.0)
    )
    assert nothing.shape == (0, EDGE, EDGE)


@pytest.mark.parametrize("shape", [(20, 64), (64, 33), (5, 200), (1, 1)])
def test_images_of_any_shape_are_seen(tmp_path: Path, shape: tuple[int, int]) -> None:
    network = load_network(write_sam_file(tmp_path / "sam.pth"))
    image = np.random.default_rng(0).integers(0, 256, (*shape, 3), dtype=np.uint8)
    settings = AutomaticSettings(points=4, quality=0.0, stability=0.0, offset=0.01, overlap=1.0)
    masks = automatic_masks(see_image(network, image), settings)
    assert masks.shape[1:] == shape
    assert masks.dtype == bool


def test_both_formats_hold_the_same_network(tmp_path: Path) -> None:
    file, folder = write_sam_file(tmp_path / "any name.pth"), write_sam_folder(tmp_path / "folder")
    first, second = load_network(file).state_dict(), load_network(folder).state_dict()
    assert first.keys() == second.keys()
    assert all(torch.equal(first[name], second[name]) for name in first)
    assert checkpoint_digest(file) != checkpoint_digest(folder)
    assert checkpoint_digest(folder) == checkpoint_digest(write_sam_folder(tmp_path / "again"))


def test_transformers_reads_the_folder_as_we_do(tmp_path: Path) -> None:
    transformers = pytest.importorskip("transformers")
    folder = write_sam_folder(tmp_path / "folder")
    theirs, ours = transformers.SamModel.from_pretrained(folder), load_network(folder)
    assert ours.state_dict().keys() == theirs.state_dict().keys()
    for name, tensor in theirs.state_dict().items():
        assert torch.equal(tensor, ours.state_dict()[name]), name
    pixels = torch.rand(1, 3, EDGE, EDGE, generator=torch.Generator().manual_seed(0))
    given = {"pixel_values": pixels, "input_points": torch.tensor([[[POINTS[0]]]])}
    with torch.no_grad():
        assert torch.equal(theirs.eval()(**given).pred_masks, ours(**given).pred_masks)


def test_without_transformers_the_extra_is_named(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(sys.modules, "transformers", None)
    with pytest.raises(MissingDependency, match=r"hwp-bench\[sam\]"):
        check_checkpoint(write_sam_file(tmp_path / "sam.pth"))


def test_of_two_boxes_that_overlap_the_better_stays() -> None:
    boxes = torch.tensor([[0, 0, 10, 10], [0, 0, 10, 9], [20, 20, 30, 30], [0, 0, 10, 8]]).float()
    quality = torch.tensor([0.5, 0.9, 0.1, 0.8])
    assert suppress_overlaps(boxes, quality, 0.7).tolist() == [1, 2]
    assert suppress_overlaps(boxes, quality, 0.95).tolist() == [1, 3, 0, 2]
    assert suppress_overlaps(boxes[:0], quality[:0], 0.7).tolist() == []
    flat = torch.tensor([[3.0, 3.0, 3.0, 9.0]]).expand(2, 4)
    assert suppress_overlaps(flat, torch.ones(2), 0.7).tolist() == [0, 1]


def test_what_is_no_checkpoint_is_refused(tmp_path: Path) -> None:
    with pytest.raises(BadInput, match=r"does not exist.*SamModel"):
        check_checkpoint(tmp_path / "none.pth")
    for content in (b"", b"PK\x03\x04", b"no weights"):
        (tmp_path / "a.pth").write_bytes(content)
        with pytest.raises(BadInput, match="cannot be read"):
            check_checkpoint(tmp_path / "a.pth")
    (tmp_path / "empty").mkdir()
    with pytest.raises(BadInput, match=r"lacks config.json or model.safetensors"):
        check_checkpoint(tmp_path / "empty")
    torch.save({"a": torch.zeros(2)}, tmp_path / "b.pth")
    with pytest.raises(BadInput, match=r"not a checkpoint of Segment Anything.*patch_embed"):
        check_checkpoint(tmp_path / "b.pth")
    folder = write_sam_folder(tmp_path / "folder")
    (folder / "config.json").write_text(json.dumps({"model_type": "bert"}))
    with pytest.raises(BadInput, match="SamModel"):
        check_checkpoint(folder)


@pytest.mark.parametrize(
    ("name", "shape"),
    [
        ("mask_decoder.iou_token.weight", (1, 8)),
        ("image_encoder.neck.2.weight", None),
        ("image_encoder.pos_embed", (1, 200, 200, 1)),
        ("image_encoder.pos_embed", (8, 8)),
        ("image_encoder.blocks.1.attn.rel_pos_h", (14, 8)),
        ("image_encoder.blocks.0.attn.rel_pos_w", (7, 8)),
        ("mask_decoder.mask_tokens.weight", (4, 12)),
    ],
)
def test_tensors_that_do_not_fit_are_named(
    tmp_path: Path, name: str, shape: tuple[int, ...] | None
) -> None:
    tensors = sam_tensors()
    if shape is None:
        del tensors[name]
    else:
        tensors[name] = torch.zeros(shape)
    save_file(tensors, tmp_path / "sam.safetensors")
    with pytest.raises(BadInput, match="not a checkpoint of Segment Anything") as caught:
        load_network(tmp_path / "sam.safetensors")
    assert "\n" not in str(caught.value)


class StubImage:
    """Has the left half around points at the left, the right one around those at the right."""

    def masks_at(self, places: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        left = torch.where(torch.arange(48) < 24, 1.0, -1.0).expand(40, 48)
        masks = torch.stack([left if x < 24 else -left for x in places[:, 0]])
        return torch.stack([-masks, masks, -masks], dim=1), torch.tensor([[0.1, 0.9, 0.2]])

    def full(self, masks: torch.Tensor) -> torch.Tensor:
        return masks


def test_roots_prompt_the_best_mask_of_each_hand_once(tmp_path: Path) -> None:
    seen: list[Any] = []

    def see(image: np.ndarray) -> Any:
        seen.append(image)
        return StubImage()

    sam = SegmentAnything("x", see)
    left = np.broadcast_to(np.arange(48) < 24, (40, 48))
    cache = RegionCache(tmp_path)
    for _ in range(2):
        assert np.array_equal(
            mask_of(cache.regions(PICTURE, PromptedHand(sam, ((3.0, 4.0),)))), left
        )
    assert len(seen) == 1  # a fit whose masks are all kept needs no network
    both = PromptedHand(sam, ((3.0, 4.0), (40.0, 4.0)))
    assert mask_of(cache.regions(PICTURE, both)).all()
    outside = PromptedHand(sam, ((48.0, 4.0), (float("nan"), 4.0)))
    assert not mask_of(cache.regions(PICTURE, outside)).any()
    assert len(seen) == 2


@pytest.mark.parametrize("write", [write_sam_file, write_sam_folder])
def test_a_checkpoint_gives_regions_and_a_hand(tmp_path: Path, write: Any) -> None:
    path = write(tmp_path / "sam")
    check_checkpoint(path)
    sam = open_sam(path)
    regions = sam.regions(PICTURE)
    assert regions.labels.shape == (40, 48)
    assert regions.membership is not None
    mask = sam.hand(PICTURE, ((24.0, 20.0),))
    assert mask.shape == (40, 48)
    assert np.array_equal(mask, open_sam(path).hand(PICTURE, ((24.0, 20.0),)))
    assert open_sam(path).identity == sam.identity != open_sam(write(tmp_path / "b", 1)).identity


def test_what_is_missing_is_named(tmp_path: Path) -> None:
    with pytest.raises(BadInput, match="does not exist"):
        open_sam(tmp_path / "none.pth")
