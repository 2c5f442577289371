"""The schema of results.json names the key that is wrong."""

import copy
import json
import math
import re
from pathlib import Path

import pytest

from hybrid_mpc import InputError
from hybrid_mpc.job.stages.results import SCHEMA, Group, validate_results

PER_MODEL = {"phy_nominal": 1.0, "phy": 0.2, "rnn": 0.4, "pgrnn": 0.17, "mopgrnn": 0.15}
RESULTS = {
    "schema_version": 4,
    "scenario": "golf_robot",
    "seed": 0,
    "budget": "quick",
    "versions": {"python": "3.11.9", "numpy": "2.1.0"},
    "data": {
        "files": ["a.csv"],
        "hash": "sha256:00ff",
        "cuts": [{"file": "a.csv", "start_s": 1.0, "end_s": 1.5}],
    },
    "identification": {
        "e_sim_s": dict(PER_MODEL),
        "rmse": {name: {"phi [rad]": value} for name, value in PER_MODEL.items()},
        "balance_violation": {name: {"energy [W]": value} for name, value in PER_MODEL.items()},
    },
    "export": {"parity_max_abs_error": 2e-16, "jacobian_max_abs_error": 1e-15},
    "control": {
        "prior": {"cost": 3.0, "tracking_rmse": {"phi [rad]": 0.1}},
        "hybrid": {"cost": 2.0, "tracking_rmse": {"phi [rad]": 0.05}},
        "oracle": {"cost": 1.5, "tracking_rmse": {"phi [rad]": 0.04}},
        "gap_closed": 0.67,
    },
    "estimation": {
        name: {
            "mean_nis": 1.2,
            "nis_low": 0.9,
            "nis_high": 1.1,
            "nis_inside": 0.93,
            "ljung_box": 44.0,
            "ljung_box_limit": 31.4,
            "samples": 900,
        }
        for name in ("prior_observer", "hybrid_observer")
    },
    "timing": {
        "controller_step_ms": {"median": 2.0, "p95": 3.0, "p99": 4.0, "max": 9.0},
        "period_ms": 20.0,
        "misses": 0,
    },
    "monitor": {"threshold": {"energy [W]": 0.06}, "false_alarms_per_hour": 0.0, "alarms": []},
    "guard": {
        "false_alarms_per_hour": 2.0,
        "hours": 0.05,
        "force_threshold": 20.0,
        "energy_threshold": 5.0,
        "data_hash": "00ff",
        "test_seconds": 76.0,
        "test_alarms": 0,
        "faults": [{"fault": "friction", "start_s": 3.0, "delay_s": None, "diagnosis": ""}],
    },
    "analysis": {"eigenvalues": [[0.99, 0.01]], "stabilisable": True, "detectable": True},
}


def put(path, value):
    results = copy.deepcopy(RESULTS)
    *groups, key = path.split(".")
    place = results
    for group in groups:
        place = place[group]
    place[key] = value
    return results


def leaves(group=SCHEMA, prefix=""):
    for key, inner in group.keys.items():
        if isinstance(inner, Group):
            yield from leaves(inner, f"{prefix}{key}.")
        else:
            yield prefix + key


def test_complete_results_pass_also_after_json():
    validate_results(RESULTS)
    validate_results(json.loads(json.dumps(RESULTS)))


@pytest.mark.parametrize("path", list(leaves()))
def test_a_missing_key_is_named(path):
    results = copy.deepcopy(RESULTS)
    *groups, key = path.split(".")
    place = results
    for group in groups:
        place = place[group]
    del place[key]
    with pytest.raises(InputError, match=f"'{re.escape(path)}' is missing"):
        validate_results(results)


@pytest.mark.parametrize("path", list(leaves()))
def test_a_wrong_kind_is_named(path):
    with pytest.raises(InputError, match=f"'{re.escape(path)}' is .*must be"):
        validate_results(put(path, object()))


@pytest.mark.parametrize("value", [math.nan, math.inf, True, "0.1", -0.1])
def test_only_finite_numbers_are_errors_of_a_model(value):
    with pytest.raises(InputError, match=r"identification\.e_sim_s\.phy"):
        validate_results(put("identification.e_sim_s", PER_MODEL | {"phy": value}))


def test_null_needs_a_reason():
    with pytest.raises(InputError, match=r"'control\.gap_closed' is null without a reason"):
        validate_results(put("control.gap_closed", None))
    results = put("control.gap_closed", None)
    results["control"]["gap_closed_reason"] = "no oracle"
    validate_results(results)


def test_a_whole_group_may_be_null_with_its_reason():
    results = put("control", None)
    with pytest.raises(InputError, match="'control' is null"):
        validate_results(results)
    validate_results(results | {"control_reason": "the scenario has no plant"})
    nulls = {"prior": None, "hybrid": None, "oracle": None, "gap_closed": None}
    validate_results(put("control", nulls | {"reason": "the scenario has no plant"}))


def test_identity_and_data_are_never_null():
    for key in ("scenario", "seed", "data", "versions"):
        with pytest.raises(InputError, match=f"'{key}' is None"):
            validate_results(put(key, None) | {f"{key}_reason": "none"})


def test_further_keys_lie_under_details():
    validate_results(put("export.details", {"programs": 3}) | {"details": {"host": "x"}})
    with pytest.raises(InputError, match=r"'export\.programs' is no key"):
        validate_results(put("export.programs", 3))


def test_an_interval_that_ends_before_it_starts_is_refused():
    with pytest.raises(InputError, match=r"monitor\.alarms"):
        validate_results(put("monitor.alarms", [{"file": "a.csv", "start_s": 2.0, "end_s": 1.0}]))


def test_the_document_names_every_key():
    text = (Path(__file__).parents[2] / "docs" / "results-schema.md").read_text(encoding="utf-8")
    for path in leaves():
        assert f"`{path.rpartition('.')[2]}`" in text, path
