"""Settings: modes, dotted names, former names. Oracles: the settings as they were, the paper."""

from __future__ import annotations

import dataclasses
from typing import Any

import pytest

from hwp_bench.base.errors import BadMethod
from hwp_bench.base.records import flattened
from hwp_bench.methods.manifest import find_method, read_manifest
from wildghand.model.former_settings import GONE, NAMES, TABLES
from wildghand.model.settings import (
    MODES,
    WildGHandSettings,
    read_settings,
    read_stored,
    read_version_1,
)
from wildghand.model.terms import PAPER_TERMS
from wildghand.network import network_settings
from wildghand.pao.pao import PerturbationAwareWeights

#: Every setting by its dotted name, with its default.
EVERY = dict(flattened(dataclasses.asdict(WildGHandSettings())))


def value_of(settings: WildGHandSettings, name: str) -> Any:
    value: Any = settings
    for part in name.split("."):
        value = getattr(value, part)
    return value


def test_the_defaults_are_those_of_the_default_mode() -> None:
    assert read_settings({}) == read_settings({"mode": "default"}) == WildGHandSettings()


@pytest.mark.parametrize("name", EVERY)
def test_a_dotted_name_reaches_every_setting(name: str) -> None:
    default = EVERY[name]
    other: Any = default
    if isinstance(default, bool):
        other = not default
    elif isinstance(default, float):
        other = default / 2.0
    if name == "network.transformer_layers":
        other = 2
    made = read_settings({name: other})
    assert value_of(made, name) == other
    *tables, field = name.split(".")
    nested: dict[str, Any] = {field: other}
    for table in reversed(tables):
        nested = {table: nested}
    assert read_settings(nested) == made
    # What a setting changes besides itself: parts of a component that it takes out.
    changed = {n for n in EVERY if value_of(made, n) != EVERY[n]} - {name}
    idle = {
        "dpd.enabled": {"dpd.gains", "dpd.rank"},
        "dpd.biases": {"dpd.rank"},
        "heads.enabled": {"heads.refinement", "heads.template"},
        "prepass.enabled": {"prepass.frame_poses"},
    }
    assert changed == idle.get(name, set())


def test_stored_settings_are_read_as_they_were() -> None:
    for changes in ({}, {"mode": "paper"}, {"network.size": "paper"}, {"dpd.enabled": False}):
        made = read_settings(changes)
        assert read_settings(dataclasses.asdict(made)) == made


@pytest.mark.parametrize(("mode", "temporal"), [("paper", "all"), ("released", "none")])
def test_the_published_modes_have_no_addition(mode: str, temporal: str) -> None:
    made = read_settings({"mode": mode})
    outside = WildGHandSettings().terms.outside_weight
    assert made.terms == dataclasses.replace(PAPER_TERMS, outside_weight=outside)
    assert made.terms.dssim_weight == 0.0
    assert (made.pao.variant, made.pao.temporal, made.pao.errors) == ("printed", temporal, "batch")
    assert (made.pao.error_threshold, made.pao.share_threshold) == (1.0, 0.3)
    assert made.pao.alpha == 100.0
    assert (made.schedule.batch, made.schedule.decay, made.schedule.rates.dpd) == (
        4,
        "halving",
        1e-4,
    )
    assert not made.prepass.enabled
    assert not made.subject.enabled
    assert not made.light.enabled
    assert not made.dpd.gains
    assert not made.dpd.rank
    assert not made.prepass.frame_poses
    assert made.dpd.enabled
    assert made.pao.enabled
    assert made.heads.refinement
    differing = {name for name in EVERY if value_of(made, name) != EVERY[name]}
    assert differing <= {name for name, _ in flattened(MODES[mode])} | {"prepass.frame_poses"}


@pytest.mark.parametrize("changes", [{}, {"pao.beta": 5.0}, {"weights": {"beta": 2.0}}])
def test_two_hands_keep_their_background_threshold(changes: dict[str, Any]) -> None:
    for mode in MODES:
        pao = read_settings({"mode": mode, **changes}).pao
        assert PerturbationAwareWeights(pao, hands=2).T_b.item() == 10.0


def test_a_setting_that_is_given_wins_over_the_modes() -> None:
    for values in (
        {"dpd.gains": True, "mode": "paper", "terms.bias": 0.5},
        {"mode": "paper", "dpd": {"gains": True}, "terms": {"bias": 0.5}},
    ):
        made = read_settings(values)
        assert made.dpd.gains
        assert made.terms == dataclasses.replace(PAPER_TERMS, bias=0.5)
    assert read_settings({"mode": "paper", "prior": "/some/prior"}).prior == "/some/prior"


def test_a_table_in_part_leaves_the_rest_of_it() -> None:
    made = read_settings({"prepass": {"weight_floor": 0.5}, "prepass.tolerance": 2})
    assert (made.prepass.weight_floor, made.prepass.tolerance) == (0.5, 2.0)


def test_the_prepass_is_a_component_of_its_own() -> None:
    made = read_settings({"dpd.enabled": False, "pao.enabled": False})
    assert made.prepass.enabled
    assert made.prepass.frame_poses
    assert not read_settings({"prepass.enabled": False}).prepass.frame_poses


def test_without_heads_the_rest_stays() -> None:
    made = read_settings({"heads.enabled": False})
    assert (made.heads.template, made.heads.refinement) == (False, False)
    assert made == dataclasses.replace(read_settings({}), heads=made.heads)


def test_the_size_chooses_the_network() -> None:
    made = read_settings({"network": {"size": "paper"}, "network.head_width": 64})
    assert made.network == network_settings("paper", head_width=64)


@pytest.mark.parametrize(
    ("values", "message"),
    [
        ({"tempral": True}, r"tempral: is not a setting.*Did you mean 'pao\.temporal'\?"),
        ({"dpd.omega_scle": 1}, r"dpd\.omega_scle.*Did you mean 'dpd\.omega_scale'\?"),
        ({"dpd": {"omega_scle": 1}}, r"dpd\.omega_scle.*Did you mean 'dpd\.omega_scale'\?"),
        ({"network.sizes": "paper"}, r"network\.sizes.*Did you mean 'network\.size'\?"),
        ({"moed": "paper"}, "moed.*Did you mean 'mode'"),
        ({"dpd.zzz": 4}, r"dpd\.zzz: is not a setting.*Known: dpd\.enabled"),
        ({"zzz": 4}, "zzz: is not a setting.*Known: mode, prior"),
        ({"mode": "papr"}, "mode: is 'papr'.*default, paper, released"),
        ({"mode": 3}, "mode: is '3'"),
        ({"schedule": 3}, "schedule: must be a table"),
        ({"dpd": 1}, "dpd: must be a table"),
        ({"prior.name": "x"}, r"prior\.name: is not a setting"),
        ({"prepass.weight_floor": 1.5}, r"prepass\.weight_floor: is 1\.5"),
        ({"pao.variant": "masks"}, r"pao\.variant: is 'masks'"),
        ({"pao.beta": -1}, r"pao\.beta: is -1"),
        ({"schedule.rates.dpd": "fast"}, r"schedule\.rates\.dpd: is 'fast'"),
        ({"network.plane_resolution": 42}, "plane_resolution: is 42"),
        ({"binary_mask": 1}, "binary_mask: is not a setting"),
    ],
    ids=str,
)
def test_what_is_wrong_is_named(values: dict[str, Any], message: str) -> None:
    with pytest.raises(BadMethod, match=message) as caught:
        read_settings(values)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize("former", [name for name in NAMES if NAMES[name] in EVERY])
def test_former_names_are_read(former: str) -> None:
    name = NAMES[former]
    default = EVERY[name]
    other: Any = "halving" if former == "decay" else default + 1
    if isinstance(default, bool):
        other = not default
    elif isinstance(default, float):
        other = default / 2.0
    assert read_settings({former: other}) == read_settings({name: other})


@pytest.mark.parametrize(
    ("former", "today"),
    [
        ({"dpd": False}, {"dpd.enabled": False}),
        ({"pao": False, "prepass": False}, {"pao.enabled": False, "prepass.enabled": False}),
        ({"heads": False}, {"heads": {"enabled": False}}),
        ({"binary_mask": True}, {"pao.variant": "binary"}),
        ({"binary_mask": True, "pao": True}, {"pao.variant": "binary"}),
        ({"pao": False, "binary_mask": True}, {"pao.variant": "binary"}),
        ({"binary_mask": False}, {}),
        ({"judge.weight_floor": 0.1}, {"prepass.weight_floor": 0.1}),
        ({"judge": {"tolerance": 2.0}}, {"prepass.tolerance": 2.0}),
        ({"weights.beta": 5.0}, {"pao.beta": 5.0}),
        ({"pao.variant": "paper"}, {"pao.variant": "printed"}),
        ({"pao.variant": "judged"}, {}),
        ({"pao.normalise_errors": True}, {"pao.errors": "batch"}),
        ({"weights.normalise_errors": False}, {"pao.errors": "absolute"}),
        ({"robust": True, "pao.robust_start": 0.5}, {}),
        ({"heads.frame_poses": False}, {"prepass.frame_poses": False}),
        ({"weights": {"variant": "weights"}}, {}),
        ({"weights": {"variant": "binary"}}, {"pao.variant": "binary"}),
        ({"rates.pose": 1e-5}, {"schedule.rates.pose": 1e-5}),
        # A preset under former names, and a command line under today's: the later one wins.
        ({"steps": 700, "schedule.steps": 5}, {"schedule.steps": 5}),
        ({"schedule": {"steps": 700}, "steps": 5}, {"schedule.steps": 5}),
        # The committed results of the leaderboard.
        (
            {"gaussians": 5000, "steps": 700, "dpd": False, "pao": False},
            {
                "gaussians": 5000,
                "schedule": {"steps": 700},
                "dpd": {"enabled": False},
                "pao": {"enabled": False},
            },
        ),
    ],
    ids=str,
)
def test_former_tables_and_switches_are_read(former: dict[str, Any], today: dict[str, Any]) -> None:
    assert read_settings(former) == read_settings(today)


def test_former_tables_hold_what_they_held() -> None:
    for former, table in TABLES.items():
        inside = [name for name in EVERY if name.rpartition(".")[0] == table]
        assert inside, former


def version_1(**changes: Any) -> dict[str, Any]:
    """Settings as avatars of version 1 store them."""
    stored: dict[str, Any] = {
        former: EVERY[name] for former, name in NAMES.items() if name in EVERY
    }
    for former, table in TABLES.items():
        stored[former] = {
            name.rpartition(".")[2]: value
            for name, value in EVERY.items()
            if name.rpartition(".")[0] == table
        }
    for name in ("enabled", "temporal", "errors"):
        stored["weights"].pop(name)
    stored["weights"] |= {"normalise_errors": True, "robust": False, "robust_start": 0.25}
    stored["judge"] = {
        name: value
        for name, value in stored["judge"].items()
        if name not in ("enabled", "frame_poses")
    }
    stored["weights"]["variant"] = "weights"
    stored |= dict.fromkeys(("dpd", "pao", "heads", "prepass"), True)
    stored |= {"mode": "default", "prior": "shipped", "binary_mask": False, "gaussians": 12_337}
    stored |= {"mixed_precision": False, "device": "auto"}
    stored["network"] = dict(network_settings().to_json())
    stored["terms"] = {
        name.partition(".")[2]: value
        for name, value in EVERY.items()
        if name.startswith("terms.") and name not in NAMES.values()
    }
    return stored | changes


#: What the mode `paper` of version 1 was, under today's names.
PAPER_1: dict[str, Any] = {
    "prior": "",
    "dpd.gains": False,
    "pao.variant": "printed",
    "pao.temporal": "regions",
    "prepass.enabled": False,
    **{
        f"terms.{item.name}": getattr(PAPER_TERMS, item.name)
        for item in dataclasses.fields(PAPER_TERMS)
        if item.name not in ("dssim_weight", "outside_weight")
    },
}


@pytest.mark.parametrize(
    ("changes", "today"),
    [
        ({}, {}),
        ({"mode": "paper"}, PAPER_1),
        ({"mode": "paper", "robust": True}, PAPER_1),
        ({"mode": "paper", "prior": "/p"}, {**PAPER_1, "prior": "/p"}),
        ({"mode": "paper", "binary_mask": True}, {**PAPER_1, "pao.variant": "binary"}),
        ({"mode": "paper", "pao": False}, {**PAPER_1, "pao.enabled": False}),
        ({"mode": "paper", "dssim_weight": 0.0}, {**PAPER_1, "terms.dssim_weight": 0.0}),
        ({"prepass": False, "prior": ""}, {"prepass.enabled": False, "prior": ""}),
        ({"dpd": False, "pao": False}, {"dpd.enabled": False, "pao.enabled": False}),
        ({"weights": {"variant": "binary"}}, {}),
        (
            {"weights": {"variant": "binary"}, "mode": "paper"},
            {**PAPER_1, "pao.variant": "binary"},
        ),
    ],
    ids=str,
)
def test_stored_settings_of_version_1_say_what_ran(
    changes: dict[str, Any], today: dict[str, Any]
) -> None:
    stored = version_1()
    stored = stored | {"weights": stored["weights"] | changes.pop("weights", {}), **changes}
    later = {"dpd.rank": 0, "subject.enabled": False, "light.enabled": False}
    later |= {"evidence.enabled": False, "start_colors": False}
    later |= {"poses.enabled": False}
    later |= {"shadows.enabled": False, "evidence.color_share": 0.0, "evidence.fill_share": 0.0}
    later |= {"schedule.root_steps": 0.0, "schedule.average_share": 0.0}
    later |= {"schedule.validated": False}
    expected = read_settings({"pao.errors": "batch", **today, **later})
    assert read_version_1(stored) == expected


def test_avatars_from_before_the_field_and_the_switch_of_head_iii_draw_as_they_did() -> None:
    stored = dataclasses.asdict(read_settings({}))
    del stored["dpd"]["rank"], stored["heads"]["template"], stored["prepass"]["frame_poses"]
    stored["heads"] |= {"enabled": False, "refinement": False, "frame_poses": False}
    made = read_stored(stored)
    assert made.dpd.rank == 0
    assert (made.heads.template, made.heads.refinement) == (True, False)
    assert not made.prepass.frame_poses
    today = read_settings({"heads.enabled": False})
    assert read_stored(dataclasses.asdict(today)) == today


def test_avatars_from_before_the_subject_the_light_and_the_places_draw_as_they_did() -> None:
    stored = dataclasses.asdict(read_settings({}))
    del stored["subject"], stored["light"], stored["pao"]["errors"]
    expected = {"subject.enabled": False, "light.enabled": False, "pao.errors": "median"}
    assert read_stored(stored) == read_settings(expected)
    stored = dataclasses.asdict(read_settings({}))
    del stored["terms"]["dssim_inexact"], stored["terms"]["surface_inexact"]
    expected = {"terms.dssim_inexact": 1.0, "terms.surface_inexact": 0.0}
    assert read_stored(stored) == read_settings(expected)
    today = read_settings({})
    assert (today.subject.enabled, today.light.enabled, today.pao.errors) == (True, True, "place")
    assert read_stored(dataclasses.asdict(today)) == today


@pytest.mark.parametrize("name", ["wildghand", "network-scratch"])
def test_the_manifest_lists_every_setting_and_every_former_name(name: str) -> None:
    listed = read_manifest(find_method(name)).settings
    assert list(listed) == ["mode", *EVERY, *NAMES, *GONE, "binary_mask", *TABLES]
