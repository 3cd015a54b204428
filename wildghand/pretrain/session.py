"""Pretraining from capture folders to a prior, which can be stopped and goes on."""

from __future__ import annotations

import shutil
import time
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from hwp_bench.base.console import notice, progress
from hwp_bench.base.errors import UsageError
from hwp_bench.base.files import sha256_file, sha256_json
from hwp_bench.base.folders import exclusive
from hwp_bench.capture import Capture, open_capture
from hwp_bench.methods.contract import REQUEST, Budget, RunSettings
from hwp_bench.methods.request import open_request, write_request
from wildghand.fitting.optimize import Watchers
from wildghand.fitting.ready import ready_fit
from wildghand.fitting.saved_state import load_state, save_state
from wildghand.fitting.session import SAVE_EVERY, STATE, every_frame
from wildghand.model.settings import WildGHandSettings, read_settings
from wildghand.pretrain.joint import JointFit, take_steps
from wildghand.prior.files import save_prior
from wildghand.prior.prior import Prior
from wildghand.splat.threads import denormals_flushed

# Thousands of steps end with low rates, as those of the shipped prior did.
_RATES = {
    "schedule.final_rate": 0.05,
    "schedule.root_steps": 0.0,
    "schedule.average_share": 0.0,
}


@denormals_flushed()
def pretrain(
    sources: Sequence[Path],
    out: Path,
    *,
    settings: Mapping[str, Any],
    steps: int | None = None,
    seed: int = 0,
    overwrite: bool = False,
) -> Prior:
    """Fit one network to captures of several subjects, and write it as a prior.

    The state is saved next to `out` every 20 seconds. The same call goes on with it after a stop;
    the result is that of a run that was never stopped.

    Args:
        sources: capture folders, one for each subject; all their frames are used.
        out: the folder to make.
        settings: overrides of the defaults of a fit; it starts from random weights unless they
            name a prior, and its rates fall to a twentieth.
        steps: optimizer steps over all captures; None: the settings' number for each capture.
        seed: of everything random.
        overwrite: replace a prior that is there.

    Raises:
        UsageError: `out` exists, or fewer than two captures.
        BadInput: captures of different hand models, one without a usable frame, or a saved state
            of another run.
        DidNotConverge: the fit diverged at once.
        HwpError: another run is writing to `out`, or nobody can.
    """
    if out.exists() and not overwrite:
        raise UsageError("exists", where=out, remedy="Choose another name, or give --overwrite.")
    # A new prior starts from neither the one that ships nor one person's colours, and knows light
    # by itself, unless asked to.
    settings = {
        "prior": "",
        "start_colors": False,
        "shadows.enabled": False,
        **_RATES,
        **settings,
    }
    chosen = read_settings(settings)
    captures = [open_capture(source) for source in sources]
    _check_captures(captures)
    total = chosen.schedule.steps * len(captures) if steps is None else steps
    run = RunSettings(dict(settings), seed, Budget(steps=total))
    work = out.with_name(out.name + ".pretrain")
    with exclusive(work):
        joint, done = _fit_in(work, captures, run, chosen, total)
        prior = save_prior(
            out,
            joint.weights(),
            hand_model=captures[0].info.hand_model,
            captures=[_described(capture) for capture in captures],
            settings=chosen,
            seed=seed,
            steps=done,
            overwrite=overwrite,
        )
        shutil.rmtree(work, ignore_errors=True)
    return prior


def _fit_in(
    work: Path,
    captures: Sequence[Capture],
    run: RunSettings,
    chosen: WildGHandSettings,
    total: int,
) -> tuple[JointFit, int]:
    """Fit, from the state that is saved in the work folder if there is one."""
    requests = [
        write_request(work / f"request-{index}", capture, every_frame(capture), run)
        for index, capture in enumerate(captures)
    ]
    digest = sha256_json(
        [
            [sha256_file(request / REQUEST), capture.info.to_json().get("digests")]
            for request, capture in zip(requests, captures, strict=True)
        ]
    )
    joint = JointFit(
        [open_request(request) for request in requests],
        chosen,
        run.seed,
        ready_fit(chosen.device),
    )
    watchers, start, before, state = Watchers(chosen.schedule.plateau_steps), 0, 0.0, work / STATE
    if state.is_file():
        start, before = load_state(state, joint, watchers, digest)
        notice(f"Going on after {start} steps.")
    began = saved = time.perf_counter()

    with progress(f"Pretraining on {len(captures)} captures", total) as show:

        def after_step(step: int) -> None:
            nonlocal saved
            show(step)
            now = time.perf_counter()
            if now - saved >= SAVE_EVERY:
                seconds = before + now - began
                save_state(state, joint, watchers, step=step, seconds=seconds, digest=digest)
                saved = time.perf_counter()

        return joint, take_steps(joint, total, watchers, start=start, after_step=after_step)


def _check_captures(captures: Sequence[Capture]) -> None:
    if len(captures) < 2:
        raise UsageError(
            "one capture makes no prior over subjects",
            field="CAPTURE",
            remedy="Give captures of several people.",
        )
    first = captures[0].info.hand_model
    for capture in captures:
        if capture.info.hand_model.name != first.name:
            raise UsageError(
                f"has the hand model {capture.info.hand_model.name}, the first one {first.name}",
                where=capture.root,
                remedy="Give captures of one hand model.",
            )


def _described(capture: Capture) -> dict[str, Any]:
    """A prior's description of a capture that it was fitted to."""
    info = capture.info.to_json()
    return {
        "id": capture.info.id,
        "hands": capture.info.hands,
        "frames": capture.info.frame_count,
        "digest": sha256_json(info),
        "source": info["source"],
    }
