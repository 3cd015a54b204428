"""Settings of WildGHand: what is fitted, how, and for how long.

One table for each component. `read_settings` makes the settings of a mode with some of them
changed. What it returns says plainly what runs: no setting overrules another one.
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
from wildghand.evidence import EvidenceSettings
from wildghand.light import LightSettings
from wildghand.model.former_settings import current_names
from wildghand.model.terms import PAPER_TERMS, TermWeights
from wildghand.network.settings import NetworkSettings, network_settings
from wildghand.pao.pao import PAPER_PAO, PaoSettings
from wildghand.poses.settings import PoseSettings
from wildghand.prepass import PrepassSettings
from wildghand.shadows import ShadowSettings
from wildghand.subject import SubjectSettings

#: Where messages place a wrong setting.
WHERE = "wildghand"


@dataclass(frozen=True)
class HeadSettings:
    """Heads iii and iv of the network, and the corrections of single frames."""

    #: Component: template offsets (head iii) and refinement of the hand parameters (head iv).
    enabled: bool = True
    #: Head iii acts; without it the template stands.
    template: bool = True
    #: Head iv acts; without it the given hand parameters stand.
    refinement: bool = True


@dataclass(frozen=True)
class Rates:
    """Adam's step for each group of parameters at the start of a fit."""

    #: The latent identity map.
    identity: float = number(0.015)
    #: The matrix that adds the map to the attributes.
    direct: float = number(1e-3)
    #: The linear part of the shadow head.
    light: float = number(0.01)
    #: Head iv.
    refinement: float = number(1e-3)
    #: The other layers of the network.
    network: float = number(0.01)
    #: DPD.
    dpd: float = number(1e-3)
    #: Thresholds of PAO.
    thresholds: float = number(1e-6)
    #: Log gain of each frame.
    gains: float = number(0.01)
    #: Pose of each frame, rad.
    pose: float = number(5e-4)
    #: Translation of each frame, m.
    transl: float = number(5e-5)


@dataclass(frozen=True)
class ScheduleSettings:
    """Steps of the optimizer."""

    #: Optimizer steps unless the budget says otherwise.
    steps: int = number(2_000, 1, 10_000_000)
    #: Frames in each step.
    batch: int = number(1, 1, 64)
    #: Steps that share one evaluation of the texture branch, which moves at the last of them.
    texture_every: int = number(8, 1, 64)
    #: Norm that the gradient is clipped to; 0 leaves it as it is.
    clip_gradient: float = number(1.0)
    #: `geometric`: rates fall smoothly to `final_rate`; `halving`: by half, `halvings` times.
    decay: str = choice("geometric", "halving")
    #: Rates at the end of the budget, as a share of those at its start.
    final_rate: float = number(0.3, 1e-6, 1.0)
    #: How often `halving` halves.
    halvings: int = number(10, 0, 100)
    #: After t steps, rates are also divided by sqrt(1 + t / root_steps); 0: they are not. A long
    #: fit ends with lower rates than a short one.
    root_steps: float = number(200.0, 0.0, 1e7)
    #: The fit ends with a mean of its steps, nearly all of it from this share of them, the last
    #: ones; 0: with the last step.
    average_share: float = number(0.1, 0.0, 1.0)
    #: Addition: after the last step, go back to an earlier state of the fit where that draws the
    #: validation frames better. With fewer than four of these frames it ends with the last state.
    validated: bool = True
    #: Most training frames for each second of a budget in seconds, evenly spread; 0: all. Every
    #: frame is judged before the first step, at a cost.
    frames_per_second: float = number(4.0, 0.0, 1e6)
    #: Stop when the loss has not fallen by 0.1 % over this many steps; 0 never stops early.
    plateau_steps: int = number(0, 0, 10_000_000)
    #: Adam's steps.
    rates: Rates = field(default_factory=Rates)


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
    #: `auto` (CUDA where both a GPU and gsplat are there), `cpu` or `cuda`.
    device: str = choice("auto", "cpu", "cuda")
    #: Mixed precision of the network; CUDA only.
    mixed_precision: bool = False
    #: Component: dynamic perturbation disentanglement.
    dpd: DpdSettings = field(default_factory=DpdSettings)
    #: Component: perturbation-aware optimization.
    pao: PaoSettings = field(default_factory=PaoSettings)
    #: Component: heads iii and iv.
    heads: HeadSettings = field(default_factory=HeadSettings)
    #: Addition: given poses are corrected by what the clip's poses have in common.
    poses: PoseSettings = field(default_factory=PoseSettings)
    #: Addition: the template is bent to the person before the fit.
    subject: SubjectSettings = field(default_factory=SubjectSettings)
    #: Addition: a light for normals that no frame has shown.
    light: LightSettings = field(default_factory=LightSettings)
    #: Addition: shadows that the hands cast on themselves and on each other.
    shadows: ShadowSettings = field(default_factory=ShadowSettings)
    #: Addition: Gaussians that few frames show are discs on the skin.
    evidence: EvidenceSettings = field(default_factory=EvidenceSettings)
    #: Addition: the judge of the frames. It says where the temporal weights start, which pixels are
    #: covered, and which poses need refining. It leaves the biases out of every clean
    #: frame, not out of three in ten: what little they took from these, the avatar lacked
    #: (docs/wildghand.md).
    prepass: PrepassSettings = field(
        default_factory=lambda: PrepassSettings(weight_floor=0.2, omega_dropout=1.0)
    )
    #: The network.
    network: NetworkSettings = field(default_factory=NetworkSettings)
    #: Weights of the terms of the loss.
    terms: TermWeights = field(default_factory=TermWeights)
    #: The perceptual distance of the loss, where `terms.perceptual` is above 0: `filter-bank`, or
    #: `vgg19:PATH`, torchvision's weights.
    perceptual: str = "filter-bank"
    #: Steps of the optimizer.
    schedule: ScheduleSettings = field(default_factory=ScheduleSettings)

    def __post_init__(self) -> None:
        check_source(self.perceptual, "perceptual", ("filter-bank",), ("vgg19",))


#: What the paper and the authors' code have in common, in place of the defaults.
_PUBLISHED: Mapping[str, Any] = MappingProxyType(
    {
        "dpd": {"rank": 0, "gains": False},
        "pao": {
            "variant": PAPER_PAO.variant,
            "errors": "batch",
            "alpha": PAPER_PAO.alpha,
            "beta": PAPER_PAO.beta,
            "error_threshold": PAPER_PAO.error_threshold,
            "share_threshold": PAPER_PAO.share_threshold,
            "spare_clean": False,
        },
        "start_colors": False,
        "poses": {"enabled": False},
        "subject": {"enabled": False},
        "light": {"enabled": False},
        "shadows": {"enabled": False},
        "evidence": {"enabled": False},
        "prepass": {"enabled": False},
        "schedule": {
            "batch": 4,
            "texture_every": 1,
            "decay": "halving",
            "root_steps": 0.0,
            "average_share": 0.0,
            "validated": False,
            "rates": {"dpd": 1e-4},
        },
        "terms": {
            item.name: getattr(PAPER_TERMS, item.name)
            for item in dataclasses.fields(TermWeights)
            if item.name != "outside_weight"
        },
    }
)

#: The modes: settings by name, in place of the defaults. `default`: what measurements keep.
#: `paper`: the formulas as printed, in the reading that works. `released`: what the authors' code
#: does, where the temporal factor is a constant 1. docs/dpd_pao.md compares the three.
MODES: Mapping[str, Mapping[str, Any]] = MappingProxyType(
    {
        "default": {},
        "paper": merged(_PUBLISHED, {"pao": {"temporal": "all"}}),
        "released": merged(_PUBLISHED, {"pao": {"temporal": "none"}}),
    }
)


#: What the mode `paper` of version 1 overruled.
_PAPER_OF_VERSION_1: Mapping[str, Any] = MappingProxyType(
    {
        "dpd": {"gains": False},
        "poses": {"enabled": False},
        "subject": {"enabled": False},
        "light": {"enabled": False},
        "shadows": {"enabled": False},
        "evidence": {"enabled": False},
        "prepass": {"enabled": False},
        "terms": {
            name: value for name, value in _PUBLISHED["terms"].items() if name != "dssim_weight"
        },
    }
)


#: What settings that came later were before there were any.
_BEFORE: Mapping[str, Any] = MappingProxyType(
    {
        "start_colors": False,
        "dpd": {"rank": 0},
        "pao": {"errors": "median", "mismatch": 0.0, "spare_clean": False},
        "poses": {"enabled": False},
        "subject": {"enabled": False},
        "light": {"enabled": False},
        "shadows": {"enabled": False},
        "evidence": {
            "enabled": False,
            "validated": False,
            "color_share": 0.0,
            "fill_share": 0.0,
        },
        "prepass": {"clean_scale": 1.0, "validated": False},
        "schedule": {"root_steps": 0.0, "average_share": 0.0, "validated": False},
        "terms": {
            "surface": 0.0,
            "surface_inexact": 0.0,
            "leave_hidden": False,
            "dssim_inexact": 1.0,
        },
    }
)


def read_settings(values: Mapping[str, Any]) -> WildGHandSettings:
    """Make the settings of a mode with some of them changed.

    A setting that is given wins over the mode's. Parts of a component that is off are off in what
    is returned.

    Args:
        values: `mode`, a name of `MODES` (without it `default`); and any of the fields of
            `WildGHandSettings`, as tables or as `table.field`. `network.size` chooses the network,
            its other fields change it. Names that settings had before
            (`wildghand.model.former_settings`) are read too.

    Raises:
        BadMethod: an unknown name (the message says which one is close), a wrong type, or a value
            outside its range.
    """
    changes = current_names(values)
    mode = _mode_of(changes)
    start = dataclasses.asdict(WildGHandSettings())
    _check_names(changes, start)
    network = changes.get("network")
    if isinstance(network, Mapping) and network.get("size") == "paper":
        start["network"] = network_settings("paper").to_json()
    chosen = merged(merged(start, MODES[mode]), changes)
    return _without_idle_parts(settings_from(WildGHandSettings, chosen, WHERE))


def read_stored(values: Mapping[str, Any]) -> WildGHandSettings:
    """Read the settings that an avatar of today's version stores.

    They are complete, but for settings that came later: what these name was as it is here.

    Raises:
        BadMethod: as for `read_settings`.
    """
    tree = current_names(values)
    heads = tree.get("heads", {})
    if isinstance(heads, Mapping) and "template" not in heads:
        # Without heads iii and iv, the third acted.
        acting = heads.get("enabled", True) and heads.get("refinement", True)
        tree["heads"] = {**heads, "enabled": True, "template": True, "refinement": acting}
    return read_settings(merged(_BEFORE, tree))


def read_version_1(values: Mapping[str, Any]) -> WildGHandSettings:
    """Read the settings that an avatar of version 1 stores.

    They are complete and have their former names. Their mode overruled them: with `paper` the
    additions were off, whatever they said.

    Raises:
        BadMethod: as for `read_settings`.
    """
    tree = current_names(values)
    paper = _mode_of(tree) == "paper"
    if paper:
        named = tree.get("prior")
        tree = merged(tree, _PAPER_OF_VERSION_1)
        tree["prior"] = "" if named in (None, "shipped") else named
    # In the mode `default`, `weights.variant` had no effect.
    weights = values.get("weights")
    printed = weights.get("variant") if isinstance(weights, Mapping) else None
    binary = values.get("binary_mask") is True or (paper and printed == "binary")
    variant = "binary" if binary else "printed" if paper else "scaled"
    weighed = {"variant": variant, "temporal": "regions" if paper else "teaching"}
    return read_stored(merged(tree, {"pao": weighed}))


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
    """The same settings; what could not act is off."""
    dpd, pao, heads, prepass = settings.dpd, settings.pao, settings.heads, settings.prepass
    return dataclasses.replace(
        settings,
        dpd=dataclasses.replace(
            dpd,
            rank=dpd.rank if dpd.enabled and dpd.biases else 0,
            gains=dpd.enabled and dpd.gains,
            pay_back=dpd.pay_back if dpd.enabled and dpd.biases else 0.0,
        ),
        pao=dataclasses.replace(
            pao,
            regions=pao.regions if pao.enabled else "superpixels",
            hand=pao.hand if pao.enabled else "estimated",
        ),
        heads=HeadSettings(
            enabled=heads.enabled,
            template=heads.enabled and heads.template,
            refinement=heads.enabled and heads.refinement,
        ),
        prepass=dataclasses.replace(prepass, frame_poses=prepass.enabled and prepass.frame_poses),
    )
