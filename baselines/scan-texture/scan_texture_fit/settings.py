"""Settings of the scan-texture fit."""

from __future__ import annotations

from dataclasses import dataclass

from hwp_bench.methods.settings import number
from wildghand.plain.settings import LoopSettings


@dataclass(frozen=True)
class ScanSettings(LoopSettings):
    """Those of the loop, and those of the two stages."""

    #: Texels along an edge of the texture.
    texture_size: int = number(512, 16, 2048)
    #: Share of the budget of stage 1: shape, poses and shadows, with one colour of the skin.
    shape_share: float = number(0.3, 0.01, 0.99)
    #: Steps of what stage 1 fits while stage 2 fits the texture, as a share (UHM: 1e-5 of 1e-4).
    late_rate: float = number(0.1, 0.0, 1.0)
    #: Adam step of the shape parameters.
    betas_rate: float = 3e-3
    #: Adam step of the displacement of each vertex along its normal, m.
    displacement_rate: float = 1e-4
    #: Adam step of the corrections of training frames' joint angles, rad.
    pose_rate: float = 3e-4
    #: Adam step of the corrections of a hand's place in training frames, m.
    transl_rate: float = 3e-4
    #: Adam step of the skin's colour in stage 1.
    color_rate: float = 0.01
    #: Adam step of the shadow network's weights.
    shadow_rate: float = 3e-3
    #: Adam step of the texels.
    texture_rate: float = 0.01
    #: Standard deviation of a Gaussian along the surface, in units of the anchors' spacing.
    width: float = number(0.55, 0.2, 2.0)
    #: Cells along an edge of the plane on which the shadow network works.
    shadow_cells: int = number(64, 4, 256)
    #: Whether the shadow network sees posed normals, and not only how they face the camera.
    normals: bool = True
    #: Weight of the coverage's distance to the mask.
    mask_weight: float = number(0.1, 0.0, 1e4)
    #: Weight of the roughness of the displacements over the surface.
    displacement_smoothness: float = number(1e-3, 0.0, 1e4)
    #: Weight of the shadows' distance to 1 (UHM: 0.1, of an L1 of weight 1).
    shadow_one: float = number(1e-3, 0.0, 1e4)
    #: Weight of the shadows' total variation over the texture plane.
    shadow_smoothness: float = number(0.0, 0.0, 1e4)
    #: Weight of the total variation of texels that no training frame shows.
    unseen_smoothness: float = number(0.1, 0.0, 1e4)
