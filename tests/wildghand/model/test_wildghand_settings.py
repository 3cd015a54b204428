"""Settings: modes, dotted names, former names. Oracles: the settings as they were, the paper."""

from __future__ import annotations

import dataclasses
from typing import Any

import pytest

from hwp_bench.base.errors import BadMethod
from hwp_bench.base.records import flattened
from hwp_bench.methods.manifest import find_method, read_manifest
from wildghand.model.former_settings import NAMES, TABLES
from wildghand.model.settings import (
    MODES,
    WildGHandSettings,
    read_settings,
    read_version_1,
)
from wildghand.model.terms import PAPER_TERMS
from wildghand.network import network_settings

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
        "dpd.enabled": {"dpd.gains"},
        "heads.enabled": {"heads.refinement", "heads.frame_poses"},
    }
    assert changed == idle.get(name, set())


def test_stored_settings_are_read_as_they_were() -> None:
    for changes in ({}, {"mode": "paper"}, {"network.size": "paper"}, {"dpd.enabled": False}):
        made = read_settings(changes)
        assert read_settings(dataclasses.asdict(made)) == made


def test_the_mode_paper_has_no_addition() -> None:
    made = read_settings({"mode": "paper"})
    assert made.terms == PAPER_TERMS
    assert made.pao.variant == "paper"
    assert made.prior == ""
    assert not made.prepass.enabled
    assert not made.dpd.gains
    assert not made.heads.frame_poses
    assert made.dpd.enabled
    assert made.pao.enabled
    assert made.heads.refinement
    differing = {name for name in EVERY if value_of(made, name) != EVERY[name]}
    assert differing == {name for name, _ in flattened(MODES["paper"])}


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
    assert made.prepass.omega_dropout == 1.0


def test_the_prepass_is_off_where_nothing_reads_it() -> None:
    off = {"dpd.enabled": False, "pao.enabled": False}
    assert not read_settings(off).prepass.enabled
    for name in off:
        assert read_settings({name: False}).prepass.enabled


def test_residuals_decide_in_one_variant_only() -> None:
    assert read_settings({"pao.robust": True}).pao.robust
    for changes in ({"mode": "paper"}, {"pao.variant": "binary"}, {"pao.enabled": False}):
        assert not read_settings({"pao.robust": True, **changes}).pao.robust


def test_the_size_chooses_the_network() -> None:
    made = read_settings({"network": {"size": "paper"}, "network.head_width": 64})
    assert made.network == network_settings("paper", head_width=64)


@pytest.mark.parametrize(
    ("values", "message"),
    [
        ({"robus": True}, r"robus: is not a setting.*Did you mean 'pao\.robust'\?"),
        ({"dpd.omega_scle": 1}, r"dpd\.omega_scle.*Did you mean 'dpd\.omega_scale'\?"),
        ({"dpd": {"omega_scle": 1}}, r"dpd\.omega_scle.*Did you mean 'dpd\.omega_scale'\?"),
        ({"network.sizes": "paper"}, r"network\.sizes.*Did you mean 'network\.size'\?"),
        ({"moed": "paper"}, "moed.*Did you mean 'mode'"),
        ({"dpd.rank": 4}, r"dpd\.rank: is not a setting.*Known: dpd\.enabled"),
        ({"zzz": 4}, "zzz: is not a setting.*Known: mode, prior"),
        ({"mode": "papr"}, "mode: is 'papr'.*default, paper"),
        ({"mode": 3}, "mode: is '3'"),
        ({"schedule": 3}, "schedule: must be a table"),
        ({"dpd": 1}, "dpd: must be a table"),
        ({"prior.name": "x"}, r"prior\.name: is not a setting"),
        ({"dpd.omega_dropout": 1.5}, r"dpd\.omega_dropout: is 1\.5"),
        ({"pao.variant": "printed"}, r"pao\.variant: is 'printed'"),
        ({"pao.alpha": -1}, r"pao\.alpha: is -1"),
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


@pytest.mark.parametrize("former", NAMES)
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
        ({"weights": {"variant": "weights"}}, {}),
        ({"weights": {"variant": "binary"}}, {"pao.variant": "binary"}),
        (
            {"weights.background_threshold": 4.0},
            {"pao.background_threshold": 4.0, "pao.background_threshold_both": 4.0},
        ),
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
    stored: dict[str, Any] = {former: EVERY[name] for former, name in NAMES.items()}
    for former, table in TABLES.items():
        stored[former] = {
            name.rpartition(".")[2]: value
            for name, value in EVERY.items()
            if name.rpartition(".")[0] == table
        }
    for name in ("enabled", "robust", "robust_start", "background_threshold_both"):
        stored["weights"].pop(name)
    stored["judge"].pop("enabled")
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


@pytest.mark.parametrize(
    ("changes", "today"),
    [
        ({}, {}),
        ({"mode": "paper"}, {"mode": "paper"}),
        ({"mode": "paper", "robust": True}, {"mode": "paper"}),
        ({"mode": "paper", "prior": "/p"}, {"mode": "paper", "prior": "/p"}),
        ({"mode": "paper", "binary_mask": True}, {"mode": "paper", "pao.variant": "binary"}),
        ({"mode": "paper", "pao": False}, {"mode": "paper", "pao.enabled": False}),
        ({"mode": "paper", "dssim_weight": 0.0}, {"mode": "paper", "terms.dssim_weight": 0.0}),
        ({"prepass": False, "prior": ""}, {"prepass.enabled": False, "prior": ""}),
        ({"dpd": False, "pao": False}, {"dpd.enabled": False, "pao.enabled": False}),
        ({"weights": {"variant": "binary"}}, {}),
        (
            {"weights": {"variant": "binary"}, "mode": "paper"},
            {"mode": "paper", "pao.variant": "binary"},
        ),
    ],
    ids=str,
)
def test_stored_settings_of_version_1_say_what_ran(
    changes: dict[str, Any], today: dict[str, Any]
) -> None:
    assert read_version_1(version_1(**changes)) == read_settings(today)


@pytest.mark.parametrize("name", ["wildghand", "interaction-gaussian"])
def test_the_manifest_lists_every_setting_and_every_former_name(name: str) -> None:
    listed = read_manifest(find_method(name)).settings
    assert list(listed) == ["mode", *EVERY, *NAMES, "binary_mask", *TABLES]
