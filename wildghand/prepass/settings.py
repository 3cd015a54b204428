"""Settings of the pre-pass; every one is a ratio, a share, or a length on the hand."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class PrepassSettings:
    """How training frames are judged; the defaults suit every capture."""

    #: Judge the frames before the fit.
    enabled: bool = True
    #: Refine the pose of frames whose mask disagrees with it.
    frame_poses: bool = True
    #: Edge of the cells that share one albedo, m on the rest surface.
    patch_size: float = 0.004
    #: Pixels of all frames together from which the intensity model is fitted.
    sample_count: int = 120_000
    #: Pixels of all frames together beyond which they are judged at a lower resolution.
    pixel_budget: int = 30_000_000
    #: Passes of the robust fit.
    iterations: int = 10
    #: Samples that the mean skin colour is worth in the albedo of a cell.
    albedo_prior: float = 3.0
    #: Share of the frames that is taken to be clean at least; the densest such part of a cue's
    #: values says what is normal.
    clean_share: float = 0.35
    #: Least log gain that counts as one deviation: what shading leaves unexplained.
    gain_floor: float = 0.08
    #: Least change of the log of the residual that does.
    residual_floor: float = 0.25
    #: Least loss of texture that does.
    texture_floor: float = 0.15
    #: Least change of the log of the border's width that does.
    border_floor: float = 0.15
    #: Least misplacement that does, share of the hand's size.
    misplacement_floor: float = 0.0006
    #: Least hidden share of the hand that does.
    hidden_floor: float = 0.02
    #: Evidence (`wildghand.prepass.classify.evidence`) at which a frame is as likely clean as not.
    tolerance: float = 1.2
    #: Validation frames, which are clean, raise it to the median of what is found against them.
    validated: bool = True
    #: Deviation from which a cue by itself calls a frame blurred or misplaced.
    clear_deviation: float = 3.0
    #: Least weight of a frame in the fit.
    weight_floor: float = 0.1
    #: Chance that omega is dropped in a clean frame.
    omega_dropout: float = 0.3
    #: A frame is clean for `omega_dropout` from this probability on.
    clean_threshold: float = 0.5
    #: Residual, in those of the clean frames at the same place, at which a pixel's weight has
    #: halved.
    residual_scale: float = 2.5
    #: Distance of a pixel's tint from the skin's, in those of the clean frames at the same place,
    #: at which its weight has halved.
    tint_scale: float = 4.0
    #: Factor on both scales in a frame that is surely clean. Little can cover the hand there, and
    #: what looks odd (nails, rings, seams of a glove a little off their place) belongs to it.
    clean_scale: float = 4.0
    #: Pixels that what is normal in the clean frames is worth in what is normal at a place.
    residual_prior: float = 20.0
    #: Fewer usable frames than this cannot be compared: all are judged clean. Nor do fewer
    #: validation frames raise the tolerance.
    least_frames: int = 4
