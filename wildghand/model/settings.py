"""Settings of WildGHand: what is fitted, how, and for how long.

One table for each component. `read_settings` makes the settings of a mode with some of them
changed. What it returns says plainly what runs: of its settings only `schedule.epochs` overrules
another one.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from dataclasses import dataclass, field
from types import MappingProxyType
from typing import Any

from hwp_bench.base.errors import BadMethod, nearest
from hwp_bench.base.records import flattened, merged
from hwp_bench.methods.settings import check_source, choice, number, settings_from
from wildghand.dpd.dpd import DpdSettings
from wildghand.gaussians.attributes import MAX_SCALE
from wildghand.model.terms import TermSettings
from wildghand.network.settings import SIZES, NetworkSettings, network_settings
from wildghand.pao.pao import PaoSettings
from wildghand.prepass import PrepassSettings
from wildghand.visibility import VisibilitySettings

#: Where messages place a wrong setting.
WHERE = "wildghand"


@dataclass(frozen=True)
class SwitchSettings:
    """An addition whose numbers are constants next to their use."""

    #: Whether it is a part of the fit.
    enabled: bool = True


@dataclass(frozen=True)
class NetworkChoice:
    """Which network; what is not here follows from its size (`wildghand.network.settings`)."""

    #: `compact` (convolutions on a small plane) or `paper` (point network and transformer).
    size: str = choice(*SIZES)
    #: Texels along each edge of one hand's half of the identity map.
    identity_resolution: int = number(160, 4, 4096)
    #: Cells along each edge of the UV plane that the encoder-decoder works on; a multiple of 4.
    plane_resolution: int = number(40, 4, 512)
    #: Leave the first 14 channels of the map at 0 and add them to the raw attributes.
    direct: bool = True
    #: Opacities depend on pose and normals, as the other attributes do. `wildghand fit VIDEO` has
    #: false: there they open dark spots in the palm in poses that no frame has shown.
    frame_opacities: bool = True

    def __post_init__(self) -> None:
        self.build()

    def build(self) -> NetworkSettings:
        """All settings of the network."""
        return network_settings(**dataclasses.asdict(self))


@dataclass(frozen=True)
class ScheduleSettings:
    """Steps of the optimizer."""

    #: Optimizer steps unless epochs or the budget say otherwise.
    steps: int = number(2_000, 1, 10_000_000)
    #: How often a fit looks at every frame, whatever `steps` is, unless the budget says otherwise;
    #: 0: `steps` counts.
    epochs: int = number(0, 0, 1_000_000)
    #: Frames in each step; 0: one for each hand, in every process.
    batch: int = number(1, 0, 64)
    #: Steps that share one evaluation of the texture branch, which moves at the last of them.
    texture_every: int = number(8, 1, 64)
    #: How `fast` rates fall: `root` (to 0.3, and with the root of the steps, so that a long fit
    #: ends with lower rates than a short one) or `geometric` (to 0.05).
    decay: str = choice("root", "geometric")
    #: The fit ends with a running mean of its steps: for 0.1, two thirds of it are from the last
    #: tenth of them (`Averaging`); 0: with the last step.
    average_share: float = number(0.1, 0.0, 1.0)
    #: Addition: after the last step, go back to an earlier state of the fit where that draws the
    #: validation frames better. With fewer than four of these frames it ends with the last state.
    validated: bool = True
    #: Most training frames for each second of a budget in seconds, evenly spread; 0: all. Every
    #: frame is judged before the first step, at a cost.
    frames_per_second: float = number(4.0, 0.0, 1e6)
    #: Adam's steps and constants: `fast`, ours; the `paper`'s, halved every five epochs; or the
    #: authors' code's (`released`), the same, where gradients that are not finite count as 0.
    rates: str = choice("fast", "paper", "released")


@dataclass(frozen=True)
class WildGHandSettings:
    """How an avatar is fitted; the defaults are those of the mode `default`."""

    #: The prior over subjects that the network starts from. `shipped`: that of this package, where
    #: it is of the fit's network and hand model. Empty: random weights. Else a folder made by
    #: `wildghand pretrain`; a relative path is one within this package.
    prior: str = "shipped"
    #: Addition: where the frames show a tint that is far from the prior's, the fit starts from
    #: theirs.
    start_colors: bool = True
    #: Gaussians on each hand.
    gaussians: int = number(12_337, 1, 1_000_000)
    #: Largest standard deviation of a Gaussian, m. `wildghand fit VIDEO` has 0.003: wider ones draw
    #: a rim outside of the hand.
    max_scale: float = number(MAX_SCALE, 1e-4, 0.1)
    #: `auto` (CUDA where both a GPU and gsplat are there), `cpu` or `cuda`.
    device: str = choice("auto", "cpu", "cuda")
    #: Mixed precision of the network; CUDA only.
    mixed_precision: bool = False
    #: Component: dynamic perturbation disentanglement.
    dpd: DpdSettings = field(default_factory=DpdSettings)
    #: Component: perturbation-aware optimization.
    pao: PaoSettings = field(default_factory=PaoSettings)
    #: Component: template offsets (head iii) and refinement of the hand parameters (head iv).
    heads: bool = True
    #: Addition: given poses are corrected by what the clip's poses have in common.
    poses: SwitchSettings = field(default_factory=SwitchSettings)
    #: Addition: the template is bent to the person before the fit.
    subject: SwitchSettings = field(default_factory=SwitchSettings)
    #: Addition: a light for normals that no frame has shown.
    light: SwitchSettings = field(default_factory=SwitchSettings)
    #: Addition: shadows that the hands cast on themselves and on each other.
    shadows: SwitchSettings = field(default_factory=SwitchSettings)
    #: Addition: Gaussians that few frames show are discs on the skin.
    visibility: VisibilitySettings = field(default_factory=VisibilitySettings)
    #: Addition: the judge of the frames. It says where the temporal weights start, which pixels are
    #: covered, and which poses need refining.
    prepass: PrepassSettings = field(default_factory=PrepassSettings)
    #: The network.
    network: NetworkChoice = field(default_factory=NetworkChoice)
    #: Weights of the terms of the loss.
    terms: TermSettings = field(default_factory=TermSettings)
    #: The perceptual distance of the loss, where `terms.perceptual` is above 0: `filter-bank`, or
    #: `vgg19:PATH`, torchvision's weights.
    perceptual: str = "filter-bank"
    #: Steps of the optimizer.
    schedule: ScheduleSettings = field(default_factory=ScheduleSettings)

    def __post_init__(self) -> None:
        check_source(self.perceptual, "perceptual", ("filter-bank",), ("vgg19",))


#: What the paper and the authors' code do without, in place of the defaults.
_BARE: Mapping[str, Any] = MappingProxyType(
    {
        "start_colors": False,
        # Nothing judges the frames, so that all of them can be fitted.
        "schedule": {"validated": False, "frames_per_second": 0.0},
        "terms": {"surface": 0.0, "leave_hidden": False},
        **{
            name: {"enabled": False}
            for name in ("poses", "subject", "light", "shadows", "visibility", "prepass")
        },
    }
)
_PUBLISHED = merged(
    _BARE,
    {
        "dpd": {"additions": False},
        "schedule": {
            "epochs": 50,
            "texture_every": 1,
            "average_share": 0.0,
        },
        # Without PAO every pixel counts, as in Eq. 7 without W.
        "terms": {"dssim_weight": 0.0, "outside_weight": 1.0, "perceptual": 0.1},
    },
)
_PAPER = {
    "pao": {"variant": "printed"},
    "schedule": {"batch": 4, "rates": "paper"},
    "terms": {"weights": "paper"},
}
_RELEASED = {
    "dpd": {"poses": True},
    "pao": {"variant": "released"},
    "schedule": {"batch": 0, "rates": "released"},
    "terms": {"weights": "released"},
}

#: The modes: settings by name, in place of the defaults. `default`: what measurements keep.
#: `paper`: the formulas as printed, in the reading that works. `released`: what the authors' code
#: does. docs/dpd_pao.md compares the three. `bare`: the network alone, what the paper's components
#: are added to (`baselines/network-scratch`).
MODES: Mapping[str, Mapping[str, Any]] = MappingProxyType(
    {
        "default": {},
        "paper": merged(_PUBLISHED, _PAPER),
        "released": merged(_PUBLISHED, _RELEASED),
        "bare": merged(_BARE, {"prior": "", "dpd": {"enabled": False}, "pao": {"enabled": False}}),
    }
)


def read_settings(values: Mapping[str, Any]) -> WildGHandSettings:
    """Make the settings of a mode with some of them changed.

    A setting that is given wins over the mode's. Parts of a component that is off are off in what
    is returned.
    """
    changes = nested(values)
    mode = _mode_of(changes)
    start = dataclasses.asdict(WildGHandSettings())
    _check_names(changes, start)
    network = changes.get("network")
    if isinstance(network, Mapping) and network.get("size") == "paper":
        paper = network_settings("paper")
        start["network"] = {name: getattr(paper, name) for name in start["network"]}
    chosen = merged(merged(start, MODES[mode]), changes)
    return _without_idle_parts(settings_from(WildGHandSettings, chosen, WHERE))


def nested(values: Mapping[str, Any]) -> dict[str, Any]:
    """Settings as nested tables, from tables, `table.field` as names, or both."""
    tree: dict[str, Any] = {}
    for name, value in flattened(values):
        *tables, last = name.split(".")
        place = tree
        for table in tables:
            inner = place.get(table)
            if not isinstance(inner, dict):
                inner = place[table] = {}
            place = inner
        place[last] = value
    return tree


def _mode_of(changes: dict[str, Any]) -> str:
    """Take the mode out of what is given, and check it."""
    mode = changes.pop("mode", "default")
    if not isinstance(mode, str) or mode not in MODES:
        raise BadMethod(
            f"is {str(mode)[:100]!r}",
            where=WHERE,
            field="mode",
            remedy=f"Use one of {', '.join(MODES)}.",
        )
    return mode


def _check_names(changes: Mapping[str, Any], known: Mapping[str, Any]) -> None:
    """Refuse a name that is not a setting, and say which one is meant."""
    names = [name for name, _ in flattened(known)]
    tables = {name.rpartition(".")[0] for name in names} - {""}
    for name, _ in flattened(changes):
        if name in names or name in tables:
            continue
        table, _, word = name.rpartition(".")
        fields = [other for other in names if other.rpartition(".")[0] == table]
        close = nearest(name, [*names, *tables, "mode"], cutoff=0.75)
        if not close and not (table and fields):
            # The name may be that of a field without its table.
            lasts = {other.rpartition(".")[2]: other for other in names}
            close = [lasts[last] for last in nearest(word, lasts)]
        everything = ["mode", *known] if not table else fields or [*known]
        raise BadMethod(
            "is not a setting of this method",
            where=WHERE,
            field=name[:100],
            remedy=f"Did you mean {close[0]!r}?" if close else f"Known: {', '.join(everything)}.",
        )


def _without_idle_parts(settings: WildGHandSettings) -> WildGHandSettings:
    """Switch off what has no effect in these settings."""
    dpd, pao, prepass, terms = settings.dpd, settings.pao, settings.prepass, settings.terms
    # The authors' code compares with black wherever the hand is not seen.
    black = pao.enabled and pao.variant == "released"
    return dataclasses.replace(
        settings,
        terms=dataclasses.replace(terms, leave_hidden=terms.leave_hidden and not black),
        dpd=dataclasses.replace(
            dpd,
            additions=dpd.enabled and dpd.additions,
            poses=dpd.enabled and dpd.poses and settings.heads,
        ),
        pao=dataclasses.replace(
            pao,
            regions=pao.regions if pao.by_regions else "superpixels",
            hand=pao.hand if pao.enabled else "estimated",
        ),
        prepass=dataclasses.replace(prepass, frame_poses=prepass.enabled and prepass.frame_poses),
    )
