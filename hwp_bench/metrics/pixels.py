"""The images that scoring accepts: 8-bit sRGB, (H, W, 3), all of one size."""

from __future__ import annotations

import numpy as np

from hwp_bench.base.errors import BadImage, BadPrediction, ShapeMismatch


def quantize(image: np.ndarray) -> np.ndarray:
    """Round a float image to the 8 bits that it will have on disk.

    Args:
        image: any shape, float, sRGB; 0 is black, 1 is white; values outside are clipped.

    Returns:
        uint8 of the same shape: 255 * image, rounded half to even.

    Raises:
        BadPrediction: not a float array, or a value is NaN or infinite.
    """
    if not np.issubdtype(image.dtype, np.floating):
        raise BadPrediction(f"a float image is wanted, not {image.dtype}", field="image")
    if not np.isfinite(image).all():
        raise BadPrediction("the image holds NaN or infinite values", field="image")
    return np.rint(np.clip(image.astype(np.float64), 0.0, 1.0) * 255.0).astype(np.uint8)


def check_truth(target: np.ndarray, mask: np.ndarray) -> None:
    """Refuse a target and mask that cannot be scored against.

    Args:
        target: (H, W, 3) uint8.
        mask: (H, W) uint8 or bool.

    Raises:
        BadImage: a type is wrong.
        ShapeMismatch: a shape is wrong.
    """
    if target.dtype != np.uint8:
        raise BadImage(f"the target is {target.dtype}, not uint8", field="target")
    if target.ndim != 3 or target.shape[2] != 3 or target.size == 0:
        raise ShapeMismatch(f"the target is {target.shape}, not (H, W, 3)", field="target")
    if mask.dtype not in (np.uint8, np.bool_):
        raise BadImage(f"the mask is {mask.dtype}, not uint8 or bool", field="mask")
    if mask.shape != target.shape[:2]:
        raise ShapeMismatch(
            f"the mask is {mask.shape}, the target {target.shape[:2]}", field="mask"
        )


def check_prediction(prediction: np.ndarray, target: np.ndarray) -> None:
    """Refuse a prediction that is not an image like `target`.

    Raises:
        BadPrediction: the type is not uint8.
        ShapeMismatch: the shape differs from the target's; nothing is ever resized.
    """
    if prediction.dtype != np.uint8:
        raise BadPrediction(
            f"the prediction is {prediction.dtype}, not uint8",
            field="prediction",
            remedy="Round float images with hwp_bench.metrics.pixels.quantize.",
        )
    if prediction.shape != target.shape:
        raise ShapeMismatch(
            f"the prediction is {prediction.shape}, the target {target.shape}",
            field="prediction",
            remedy="Predict at the target's own resolution, three channels.",
        )


def check_same_shape(
    prediction: np.ndarray, target: np.ndarray, mask: np.ndarray | None = None
) -> None:
    """Refuse arrays that do not describe one image.

    Args:
        prediction: (H, W, 3).
        target: (H, W, 3).
        mask: (H, W), or None.

    Raises:
        ShapeMismatch: they differ, or are not of that form.
    """
    if prediction.shape != target.shape or target.ndim != 3:
        raise ShapeMismatch(
            f"prediction and target are {prediction.shape} and {target.shape}, not both (H, W, 3)"
        )
    if mask is not None and mask.shape != target.shape[:2]:
        raise ShapeMismatch(f"the mask is {mask.shape}, the image {target.shape[:2]}", field="mask")
