"""The two networks as functions of an image, run by LiteRT (the runtime of TensorFlow Lite)."""

from __future__ import annotations

import contextlib
import importlib
import os
from collections.abc import Iterator
from typing import Any, Protocol

import numpy as np

from hwp_bench.base.errors import BadInput, MissingDependency
from hwp_bench.tracking.hand_landmarks import HAND_EDGE, HandReading
from hwp_bench.tracking.model_files import HandModels
from hwp_bench.tracking.palms import ANCHOR_COUNT, PALM_EDGE, PALM_VALUES


class HandNetworks(Protocol):
    """Finds palms, and the landmarks of a hand."""

    def palms(self, image: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Find palms.

        Args:
            image: (192, 192, 3) uint8 RGB.

        Returns:
            Boxes and keypoints (2016, 18), and logits of scores (2016,).
        """

    def hand(self, image: np.ndarray) -> HandReading:
        """Read the landmarks of the hand in an image, (224, 224, 3) uint8 RGB."""


class LiteRtNetworks:
    """MediaPipe's networks.

    Args:
        models: the two networks.
        threads: of each network.

    Raises:
        MissingDependency: `ai-edge-litert` is not installed.
        BadInput: a network cannot be loaded, or has other inputs and outputs than MediaPipe's.
    """

    def __init__(self, models: HandModels, *, threads: int = 1) -> None:
        try:
            runtime: Any = importlib.import_module("ai_edge_litert.interpreter")
        except ImportError as error:
            raise MissingDependency(
                "ai-edge-litert is not installed, which runs the networks of the hand tracker",
                remedy="pip install 'hwp-bench[track]'",
            ) from error
        palm_outputs: list[tuple[int, ...]] = [(1, ANCHOR_COUNT, PALM_VALUES), (1, ANCHOR_COUNT, 1)]
        hand_outputs: list[tuple[int, ...]] = [(1, 63), (1, 1), (1, 1), (1, 63)]
        self._palm = _Network(runtime, models.palm, models.source, PALM_EDGE, palm_outputs, threads)
        self._hand = _Network(runtime, models.hand, models.source, HAND_EDGE, hand_outputs, threads)

    def palms(self, image: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Find palms; see `HandNetworks`."""
        values, logits = self._palm(image)
        return values[0], logits[0, :, 0]

    def hand(self, image: np.ndarray) -> HandReading:
        """Read the landmarks of a hand; see `HandNetworks`."""
        points, presence, right, world = self._hand(image)
        return HandReading(
            points.reshape(21, 3), world.reshape(21, 3), float(presence[0, 0]), float(right[0, 0])
        )


class _Network:
    """One network: an image in, arrays out."""

    def __init__(
        self,
        runtime: Any,
        content: bytes,
        source: str,
        edge: int,
        outputs: list[tuple[int, ...]],
        threads: int,
    ) -> None:
        try:
            with _silent():
                self._run = runtime.Interpreter(model_content=content, num_threads=threads)
                self._run.allocate_tensors()
            (given,), results = self._run.get_input_details(), self._run.get_output_details()
            # Their order in the file is not fixed; their names count up.
            results = sorted(results, key=lambda result: str(result["name"]))
        # The runtime raises ValueError or RuntimeError, by what is wrong with the file.
        except Exception as error:
            reason = str(error).strip().split("\n")[0][:200]
            raise BadInput(
                f"holds a network that cannot be loaded ({reason})", where=source
            ) from error
        shapes = [tuple(int(size) for size in result["shape"]) for result in results]
        found = tuple(int(size) for size in given["shape"])
        if found != (1, edge, edge, 3) or shapes != outputs or given["dtype"] is not np.float32:
            raise BadInput(
                f"holds a network from {found} to {shapes}, expected (1, {edge}, {edge}, 3) to "
                f"{outputs}",
                where=source,
                remedy="Only MediaPipe's networks for hands can be used.",
            )
        self._given = given["index"]
        self._results = [result["index"] for result in results]

    def __call__(self, image: np.ndarray) -> list[np.ndarray]:
        self._run.set_tensor(self._given, image[None].astype(np.float32) / np.float32(255))
        self._run.invoke()
        return [self._run.get_tensor(index) for index in self._results]


@contextlib.contextmanager
def _silent() -> Iterator[None]:
    """Keep the runtime's own remarks, which it writes past Python, from standard error."""
    kept = os.dup(2)
    nowhere = os.open(os.devnull, os.O_WRONLY)
    try:
        os.dup2(nowhere, 2)
        yield
    finally:
        os.dup2(kept, 2)
        os.close(kept)
        os.close(nowhere)
