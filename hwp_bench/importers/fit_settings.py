"""The numbers of the hand fit, each with its unit and its reason."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class FitSettings:
    """Weights and scales of the energy that `fit_clip` minimises.

    Every term is a sum over frames of a robust function of residual / scale, so a scale is the
    size of an error that is still ordinary.
    """

    #: Steps of Adam from the rigid start, led by the world landmarks.
    start_steps: int = 150
    #: Steps of Adam after that, on all landmarks, with outliers let go.
    landmark_steps: int = 450
    #: Steps of Adam in each round against the masks.
    contour_steps: int = 120
    #: Rounds of: find the mesh's outline, pull it to the mask's outline.
    contour_rounds: int = 3
    #: Factor on the learning rates in those rounds: only corrections are left.
    contour_rate: float = 0.3
    #: Landmark error in the picture, as a share of the hand's size in the picture.
    image_scale: float = 0.012
    #: Error of centred world landmarks, m; the tracker's bones change by 5 mm between frames.
    world_scale: float = 0.015
    #: Weight of the world landmarks; they guide depth, the picture decides the rest.
    world_weight: float = 0.5
    #: Weight of the image landmarks in the first steps, beside 1 of the world landmarks.
    start_image_weight: float = 0.05
    #: Acceleration of landmarks in space, m per (1/30 s)^2.
    motion_scale: float = 0.003
    #: Acceleration of joint angles, rad per (1/30 s)^2.
    turning_scale: float = 0.06
    #: Weight of both smoothness terms.
    motion_weight: float = 0.3
    #: Weight of the joint-limit penalty (rad^2 beyond the anatomical range).
    limit_weight: float = 300.0
    #: Overlap of fingers with each other or the palm, m.
    contact_scale: float = 0.003
    #: Weight of that overlap.
    contact_weight: float = 0.5
    #: Weight of the finger angles squared: what nothing else decides stays near the rest pose.
    pose_weight: float = 0.02
    #: Constant distance between the tracker's landmark and the model's joint, m.
    offset_scale: float = 0.004
    #: Share of the frames that shape, offsets, scale and focal length priors weigh as much as:
    #: the tracker's errors repeat from frame to frame, so a clip is worth far fewer views.
    prior_share: float = 0.1
    #: Uncertainty of the metres in the world landmarks (log).
    size_scale: float = 0.05
    #: Uncertainty of the default focal length (log).
    focal_scale: float = 0.15
    #: Outline error in the picture, as a share of the hand's size in the picture.
    contour_scale: float = 0.007
    #: How far an outline vertex looks for the mask's outline, as a share of the hand's size.
    contour_reach: float = 0.06
    #: Weight of one outline vertex; neighbours say the same, so each counts little.
    contour_weight: float = 0.2
