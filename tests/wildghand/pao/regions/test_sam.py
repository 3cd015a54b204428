"""Segment Anything. Oracles: stub packages; a randomly initialised model where transformers is."""

from __future__ import annotations

import sys
from pathlib import Path
from types import ModuleType, SimpleNamespace

import numpy as np
import pytest
import torch

from hwp_bench.base.errors import BadInput, MissingDependency, UsageError
from wildghand.pao.regions import RegionCache, SegmentAnything, open_sam

PICTURE = np.random.default_rng(0).integers(0, 256, (40, 48, 3), dtype=np.uint8)


def halves(image: np.ndarray) -> np.ndarray:
    masks = np.zeros((2, *image.shape[:2]), bool)
    masks[0, :, :24] = True
    masks[1, :20] = True
    return masks


def test_masks_become_regions_and_the_root_prompts_the_hand(tmp_path: Path) -> None:
    asked = []

    def at(image: np.ndarray, root: tuple[float, float]) -> np.ndarray:
        asked.append(root)
        return halves(image)[0]

    sam = SegmentAnything("x", halves, at)
    regions = RegionCache(tmp_path).regions(PICTURE, sam)
    assert (regions.count, regions.atoms) == (2, 4)
    assert sam.hand(PICTURE, (3.0, 4.0)).sum() == 40 * 24
    assert not sam.hand(PICTURE, (48.0, 4.0)).any()
    assert not sam.hand(PICTURE, (float("nan"), 4.0)).any()
    assert asked == [(3.0, 4.0)]
    nothing = SegmentAnything("y", lambda _: np.zeros(0), at)
    assert nothing.regions(PICTURE).count == 0


def test_what_is_missing_is_named(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    with pytest.raises(MissingDependency, match="does not exist"):
        open_sam(tmp_path / "none.pth")
    file = tmp_path / "sam_vit_b.pth"
    file.write_bytes(b"")
    for package, path in (("segment_anything", file), ("transformers", tmp_path)):
        monkeypatch.setitem(sys.modules, package, None)
        with pytest.raises(MissingDependency, match=package.replace("_", "-")):
            open_sam(path)


def test_a_checkpoint_of_the_original_package(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    package = ModuleType("segment_anything")
    package.sam_model_registry = {"vit_b": lambda: torch.nn.Linear(2, 1)}
    package.SamAutomaticMaskGenerator = lambda model: SimpleNamespace(
        generate=lambda image: [{"segmentation": mask} for mask in halves(image)]
    )
    package.SamPredictor = lambda model: SimpleNamespace(
        set_image=lambda image: None,
        predict=lambda **_: (halves(PICTURE), np.array([0.1, 0.9]), None),
    )
    monkeypatch.setitem(sys.modules, "segment_anything", package)
    path = tmp_path / "sam_vit_b_01ec64.pth"
    torch.save(torch.nn.Linear(2, 1).state_dict(), path)
    sam = open_sam(path)
    assert sam.regions(PICTURE).count == 2
    assert np.array_equal(sam.hand(PICTURE, (1.0, 1.0)), halves(PICTURE)[1])
    other = tmp_path / "model.pth"
    path.rename(other)
    with pytest.raises(UsageError, match="vit_h"):
        open_sam(other)
    for content in (b"", b"not a checkpoint"):
        path.write_bytes(content)
        with pytest.raises(BadInput, match="checkpoint"):
            open_sam(path)


@pytest.mark.slow
def test_a_random_model_of_transformers(tmp_path: Path) -> None:
    transformers = pytest.importorskip("transformers")
    pytest.importorskip("PIL")
    torch.manual_seed(0)
    config = transformers.SamConfig(
        vision_config={
            "hidden_size": 16,
            "num_hidden_layers": 1,
            "num_attention_heads": 2,
            "image_size": 64,
            "patch_size": 8,
            "output_channels": 16,
            "mlp_dim": 16,
            "num_pos_feats": 8,
            "window_size": 4,
            "global_attn_indexes": [0],
        },
        prompt_encoder_config={
            "hidden_size": 16,
            "image_size": 64,
            "patch_size": 8,
            "image_embedding_size": 8,
            "num_point_embeddings": 4,
            "mask_input_channels": 4,
        },
        mask_decoder_config={
            "hidden_size": 16,
            "mlp_dim": 16,
            "num_attention_heads": 2,
            "num_hidden_layers": 1,
            "iou_head_hidden_dim": 16,
            "attention_downsample_rate": 1,
        },
    )
    transformers.SamModel(config).save_pretrained(tmp_path)
    size = {"height": 64, "width": 64}
    processor = transformers.SamImageProcessor(size={"longest_edge": 64}, pad_size=size)
    transformers.SamProcessor(processor).save_pretrained(tmp_path)
    sam = open_sam(tmp_path)
    try:
        assert sam.regions(PICTURE).labels.shape == (40, 48)
    except MissingDependency as error:
        assert "torchvision" in str(error)  # noqa: PT017 - automatic masks need it
    mask = sam.hand(PICTURE, (24.0, 20.0))
    assert mask.shape == (40, 48)
    assert np.array_equal(mask, sam.hand(PICTURE, (24.0, 20.0)))
    (tmp_path / "config.json").write_text("{")
    with pytest.raises(BadInput, match="checkpoint"):
        open_sam(tmp_path)
