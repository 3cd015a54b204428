"""Many frames, in order, on several threads; a failed frame costs its penalty and no more."""

from __future__ import annotations

import os
from collections import deque
from collections.abc import Callable, Iterable, Iterator, Mapping
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass

import numpy as np

from hwp_bench.base.errors import EmptyMask, HwpError
from hwp_bench.metrics.pixels import check_prediction, check_truth
from hwp_bench.metrics.protocol import PROTOCOLS, Protocol
from hwp_bench.metrics.score import Network, score_frame
from hwp_bench.metrics.table import penalty

#: Frames per worker that are read ahead; bounds the memory of a long list of frames.
READ_AHEAD = 4


@dataclass(frozen=True, eq=False)
class Frame:
    """One frame to score."""

    #: (H, W, 3) uint8, or the error that says why it is missing.
    prediction: np.ndarray | HwpError
    #: (H, W, 3) uint8.
    target: np.ndarray
    #: (H, W) uint8 or bool, the data set's own visible-hand mask.
    mask: np.ndarray
    #: True where the mask holds the hand's share of each pixel.
    coverage: bool = False


@dataclass(frozen=True)
class FrameScore:
    """The scores of one frame."""

    #: Metric name -> score; the declared penalties where the prediction failed; empty where
    #: the data set shows no hand to score.
    values: dict[str, float]
    #: Why the prediction failed; None where it did not.
    failure: str | None = None

    @property
    def empty(self) -> bool:
        """True where the mask leaves no pixel to score; this does not depend on the prediction."""
        return not self.values


def score_frames(
    frames: Iterable[Frame | Callable[[], Frame]],
    protocols: Iterable[Protocol] = PROTOCOLS,
    *,
    networks: Mapping[str, Network] | None = None,
    workers: int | None = None,
) -> Iterator[FrameScore]:
    """Score frames in parallel and yield the results in the order of the frames.

    Args:
        frames: the frames, or functions that read one each (they run on the workers, so
            reading files is parallel too).
        protocols: which protocols to score in.
        networks: LPIPS by backbone name; see `score_frame`.
        workers: number of threads; None takes one per core.

    Yields:
        one `FrameScore` per frame; the scores do not depend on `workers`.

    Raises:
        HwpError: the data set's own side of a frame is at fault (target or mask), or a reading
            function raised; a fault of the prediction is a `FrameScore.failure` instead.
    """
    chosen = tuple(protocols)
    available = dict(networks or {})

    def work(item: Frame | Callable[[], Frame]) -> FrameScore:
        return _score(item if isinstance(item, Frame) else item(), chosen, available)

    _keep_freed_memory()
    count = workers or os.cpu_count() or 1
    if count == 1:
        yield from map(work, frames)
        return
    pool = ThreadPoolExecutor(count, thread_name_prefix="score")
    pending: deque[Future[FrameScore]] = deque()
    try:
        for item in frames:
            pending.append(pool.submit(work, item))
            if len(pending) > READ_AHEAD * count:
                yield pending.popleft().result()
        while pending:
            yield pending.popleft().result()
    finally:
        pool.shutdown(wait=True, cancel_futures=True)


def _keep_freed_memory() -> None:
    """Let the C library keep freed arrays of a frame's size for the next frame.

    glibc hands blocks back to the kernel that are larger than the largest it has seen freed,
    up to 32 MiB; getting them again, page by page, takes longer than the arithmetic does, and
    threads wait for each other meanwhile. The block here is never touched, so it costs nothing.
    """
    np.empty(31 * 2**20, np.uint8)


def _score(
    frame: Frame, protocols: tuple[Protocol, ...], networks: Mapping[str, Network]
) -> FrameScore:
    check_truth(frame.target, frame.mask)
    prediction = frame.prediction
    failure: HwpError | None = None
    if isinstance(prediction, HwpError):
        # The mask is still checked first: a frame without a hand is not a failure of the method.
        failure, prediction = prediction, frame.target
    else:
        try:
            check_prediction(prediction, frame.target)
        except HwpError as error:
            failure, prediction = error, frame.target
    try:
        values = score_frame(
            prediction,
            frame.target,
            frame.mask,
            protocols,
            coverage=frame.coverage,
            networks={} if failure else networks,
        )
    except EmptyMask:
        return FrameScore({})
    if failure is not None:
        return FrameScore(penalty(protocols, networks), str(failure))
    return FrameScore(values)
