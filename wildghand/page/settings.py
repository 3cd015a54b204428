"""How much of an avatar its page holds."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class PageSettings:
    """How much of the avatar a page holds."""

    #: Principal components of places and of colours that depend on the pose.
    geometry_rank: int = 6
    color_rank: int = 12
    #: Principal components of the biases of the frames that are played; 0: pages cannot show them.
    bias_rank: int = 4
    #: Poses of the clip, and random ones within the limits of the joints, that are drawn to bake.
    clip_samples: int = 80
    random_samples: int = 48
    #: Most training frames whose motion is played.
    most_frames: int = 240
    #: Edge of the still image for browsers without WebGL2, px.
    still_size: int = 384
    #: Of the random poses.
    seed: int = 0
