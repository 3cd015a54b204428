"""Segment Anything, where the user has a checkpoint: nothing is ever downloaded."""

from __future__ import annotations

import functools
import importlib
import os
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

from hwp_bench.base.errors import BadInput, MissingDependency, UsageError
from hwp_bench.base.files import sha256_file, sha256_json
from wildghand.pao.regions.frame_regions import FrameRegions, overlapping

#: Model types of the package segment-anything, as its checkpoint files are named.
MODEL_TYPES = ("vit_h", "vit_l", "vit_b")


class SegmentAnything:
    """Overlapping regions of an image, and the object at a pixel.

    Args:
        identity: digest of the model and its options.
        masks: gives the automatic masks of an image, (U, H, W) bool.
        at: gives the best mask at a pixel (x, y) of an image, (H, W) bool.
    """

    def __init__(
        self,
        identity: str,
        masks: Callable[[np.ndarray], np.ndarray],
        at: Callable[[np.ndarray, tuple[float, float]], np.ndarray],
    ) -> None:
        self.identity = identity
        self._masks = masks
        self._at = at

    def regions(self, image: np.ndarray) -> FrameRegions:
        """The automatic masks of an (H, W, 3) uint8 sRGB image; there may be none."""
        masks = np.asarray(self._masks(image), dtype=bool)
        return overlapping(masks.reshape(-1, *image.shape[:2]))

    def hand(self, image: np.ndarray, root: tuple[float, float]) -> np.ndarray:
        """y_h: the mask prompted by the projected hand root.

        Args:
            image: (H, W, 3) uint8 sRGB.
            root: (x, y) px, the centre of the top left pixel at 0.5.

        Returns:
            (H, W) bool, empty where the root is off the image.
        """
        height, width = image.shape[:2]
        if not (0.0 <= root[0] < width and 0.0 <= root[1] < height):
            return np.zeros((height, width), dtype=bool)
        return np.asarray(self._at(image, root), dtype=bool).reshape(height, width)


def open_sam(checkpoint: str | os.PathLike[str], device: str = "cpu") -> SegmentAnything:
    """Load a Segment Anything model from the user's disk.

    Args:
        checkpoint: a folder in the layout of `transformers` (config.json and weights), or a
            .pth file of the package `segment-anything` with the model type in its name.
        device: torch device.

    Raises:
        MissingDependency: the checkpoint or a package that reads it is not there.
        BadInput: the checkpoint cannot be read.
        UsageError: the file's name does not tell the model type.
    """
    path = Path(checkpoint)
    if not path.exists():
        raise MissingDependency(
            "does not exist",
            where=path,
            remedy="Name a local checkpoint of Segment Anything, or use superpixels.",
        )
    return _open_folder(path, device) if path.is_dir() else _open_file(path, device)


def _open_folder(path: Path, device: str) -> SegmentAnything:
    transformers = _package("transformers", path)
    torch = importlib.import_module("torch")
    try:
        model = transformers.SamModel.from_pretrained(str(path), local_files_only=True)
        processor = transformers.SamProcessor.from_pretrained(str(path), local_files_only=True)
    # A damaged checkpoint raises whatever its reader stumbles over.
    except Exception as error:
        raise _unreadable(path, error) from error
    model = model.to(device).eval()
    pil_image = _package("PIL.Image", path)

    @functools.cache
    def generator() -> Any:
        _package("torchvision", path)  # transformers says so only after the first image
        return transformers.pipeline(
            "mask-generation", model=model, image_processor=processor.image_processor, device=device
        )

    def masks(image: np.ndarray) -> np.ndarray:
        found = generator()(pil_image.fromarray(image), points_per_batch=64)["masks"]
        return np.stack([np.asarray(mask) for mask in found]) if len(found) else np.zeros(0)

    def at(image: np.ndarray, root: tuple[float, float]) -> np.ndarray:
        inputs = processor(
            pil_image.fromarray(image), input_points=[[list(root)]], return_tensors="pt"
        ).to(device)
        with torch.no_grad():
            outputs = model(**inputs, multimask_output=True)
        found = processor.image_processor.post_process_masks(
            outputs.pred_masks.cpu(),
            inputs["original_sizes"].cpu(),
            inputs["reshaped_input_sizes"].cpu(),
        )[0][0]
        return found[int(outputs.iou_scores.flatten().argmax())].numpy()

    files = sorted(item for item in path.iterdir() if item.is_file())
    digest = sha256_json(["transformers", *((item.name, sha256_file(item)) for item in files)])
    return SegmentAnything(digest, masks, at)


def _open_file(path: Path, device: str) -> SegmentAnything:
    package = _package("segment_anything", path)
    torch = importlib.import_module("torch")
    kinds = [kind for kind in MODEL_TYPES if kind in path.name]
    if len(kinds) != 1:
        raise UsageError(
            "the name does not tell the model type",
            where=path,
            remedy=f"Let it hold one of {', '.join(MODEL_TYPES)}.",
        )
    try:
        # The package's own loader would run what the file asks for.
        weights = torch.load(path, map_location="cpu", weights_only=True)
        model = package.sam_model_registry[kinds[0]]()
        model.load_state_dict(weights)
    except Exception as error:
        raise _unreadable(path, error) from error
    model = model.to(device).eval()
    generator = package.SamAutomaticMaskGenerator(model)
    predictor = package.SamPredictor(model)

    def masks(image: np.ndarray) -> np.ndarray:
        return np.array([item["segmentation"] for item in generator.generate(image)])

    def at(image: np.ndarray, root: tuple[float, float]) -> np.ndarray:
        predictor.set_image(image)
        found, scores, _ = predictor.predict(
            point_coords=np.array([root]), point_labels=np.ones(1, int), multimask_output=True
        )
        return found[int(np.argmax(scores))]

    digest = sha256_json(["segment-anything", kinds[0], sha256_file(path)])
    return SegmentAnything(digest, masks, at)


def _package(name: str, path: Path) -> Any:
    try:
        return importlib.import_module(name)
    # A package that does not fit the others (torchvision of another torch) fails in its own way.
    except (ImportError, RuntimeError) as error:
        shown = name.replace("_", "-")
        raise MissingDependency(
            f"the package {shown} is needed to use it ({error})",
            where=path,
            remedy=f"Install {shown}, or use superpixels.",
        ) from error


def _unreadable(path: Path, error: Exception) -> BadInput:
    return BadInput(
        f"is not a readable Segment Anything checkpoint ({type(error).__name__}: {error})",
        where=path,
    )
