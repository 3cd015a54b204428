"""Settings of the network: what both sizes share, and the layers of each."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from dataclasses import dataclass
from types import MappingProxyType
from typing import Any

from hwp_bench.base.errors import UsageError
from hwp_bench.hands.skeleton import SIDES
from hwp_bench.methods.settings import choice, number, settings_from
from wildghand.gaussians.attributes import CHANNELS

#: The sizes by name.
SIZES = ("compact", "paper")


@dataclass(frozen=True)
class NetworkSettings:
    """How the network is built; the defaults are those of `compact`."""

    #: `compact` (convolutions on a small plane) or `paper` (point network and transformer).
    size: str = choice(*SIZES)
    #: Texels along each edge of one hand's half of the identity map.
    identity_resolution: int = number(160, 4, 4096)
    #: Channels of the identity map.
    identity_channels: int = number(33, 1, 1024)
    #: Standard deviation of the identity map at the start; values are clamped to +-1 of it.
    identity_spread: float = number(0.1, 0.0, 10.0)
    #: Leave the first 14 channels of the map at 0 and add them to the raw attributes.
    direct: bool = True
    #: Opacities depend on pose and normals, as the other attributes do. Without, they are the
    #: texture branch's: skin that bends or turns does not become transparent.
    frame_opacities: bool = True
    #: Cells along each edge of the UV plane that the encoder-decoder works on; a multiple of 4.
    plane_resolution: int = number(40, 4, 512)
    #: Features of a cell; of `paper`'s tokens too.
    plane_width: int = number(24, 1, 4096)
    #: Hidden width of `paper`'s point network and of `compact`'s geometry branch.
    point_width: int = number(32, 1, 4096)
    #: Layers of `paper`'s transformer; `compact` has none.
    transformer_layers: int = number(0, 0, 100)
    #: Attention heads in each of them.
    attention_heads: int = number(8, 1, 64)
    #: Frequencies of each number of the pose in its embedding; 8 make the paper's 768 numbers.
    pose_frequencies: int = number(1, 1, 16)
    #: Degree of the spherical harmonics in which the geometry branch sees a normal.
    shading_degree: int = number(3, 1, 3)
    #: Hidden width of the heads.
    head_width: int = number(32, 1, 4096)
    #: Hidden layers of each head.
    head_layers: int = number(1, 1, 10)
    #: Opacity of every Gaussian at the start.
    initial_opacity: float = number(0.9, 0.01, 0.99)
    #: Shadow coefficient of every Gaussian at the start.
    initial_shadow: float = number(0.75, 0.05, 0.99)
    #: Largest displacement of a Gaussian by head (i), m.
    max_offset: float = number(0.01, 1e-6, 0.1)
    #: Largest displacement of the template by head (iii) along each axis of a surface frame, m.
    max_template_offset: float = number(0.003, 1e-6, 0.1)
    #: Largest refinement by head (iv) of each number of a pose, rad.
    max_pose: float = number(0.1, 0.0, 3.2)
    #: Largest refinement of a shape parameter, standard deviations.
    max_betas: float = number(0.5, 0.0, 10.0)
    #: Largest refinement of each coordinate of the translation, m.
    max_transl: float = number(0.005, 0.0, 1.0)

    def __post_init__(self) -> None:
        """Check what no single field shows; `network_settings` checks each of them."""
        if self.plane_resolution % 4:
            raise UsageError(
                f"is {self.plane_resolution}", field="plane_resolution", remedy="Use 4, 8, 12, ..."
            )
        if self.size == "paper" and self.plane_width % self.attention_heads:
            raise UsageError(
                f"of {self.plane_width} cannot be shared by {self.attention_heads} heads",
                field="plane_width",
                remedy="Use a multiple of attention_heads.",
            )
        if self.size == "paper" and self.plane_width % 16:
            raise UsageError(
                f"is {self.plane_width}", field="plane_width", remedy="Use a multiple of 16."
            )
        if self.direct and self.identity_channels < CHANNELS:
            raise UsageError(
                f"of {self.identity_channels} leaves no room for {CHANNELS} direct ones",
                field="identity_channels",
                remedy=f"Use {CHANNELS} or more, or direct = false.",
            )

    def to_json(self) -> dict[str, Any]:
        """The fields by name."""
        return dataclasses.asdict(self)


# What `paper` changes; where the paper is silent, what the authors' public code does.
_PAPER: Mapping[str, Any] = MappingProxyType(
    {
        "size": "paper",
        "identity_resolution": 64,
        "identity_spread": 1.0,
        "direct": False,
        "plane_resolution": 32,
        "plane_width": 512,
        "point_width": 128,
        "transformer_layers": 10,
        "pose_frequencies": 8,
        "shading_degree": 2,
        "head_width": 256,
        "head_layers": 2,
        "initial_opacity": 0.1,
        "max_offset": 0.01875,
        "max_template_offset": 0.001,
        "max_pose": 0.0016,
        "max_betas": 0.0015,
        "max_transl": 0.0005,
    }
)


def network_settings(size: str = "compact", **changes: Any) -> NetworkSettings:
    """Return the settings of a size, some of them changed."""
    base = dict(_PAPER) if size == "paper" else {"size": size}
    return settings_from(NetworkSettings, {**base, **changes}, "network")


def check_sides(sides: Mapping[str, Any]) -> None:
    """Refuse a set of hands that is empty or names something else."""
    if not sides or set(sides) - set(SIDES):
        raise UsageError(
            f"are {sorted(map(str, sides))}"[:200], field="sides", remedy="Use right, left or both."
        )
