"""The schema of results.json names the key that is wrong."""

import copy
import dataclasses
import json
import math
import re
import typing
from pathlib import Path

import pytest

from hybrid_mpc import InputError
from hybrid_mpc.workflow.stages.results import Results, read_results

PAGE = Path(__file__).parents[2] / "docs" / "results-schema.md"

PER_MODEL = {"phy_nominal": 1.0, "phy": 0.2, "rnn": 0.4, "pgrnn": 0.17, "mopgrnn": 0.15}
RESULTS = {
    "schema_version": 11,
    "scenario": "golf_robot",
    "seed": 0,
    "budget": "quick",
    "versions": {"python": "3.11.9", "numpy": "2.1.0"},
    "data": {
        "files": ["a.csv"],
        "hash": "sha256:00ff",
        "cuts": [{"file": "a.csv", "start_s": 1.0, "end_s": 1.5}],
        "details": {"seconds": {"train": 30.0}, "why_cut": ["a gap"], "warnings": []},
    },
    "identification": {
        "error": dict(PER_MODEL),
        "rmse": {name: {"phi [rad]": value} for name, value in PER_MODEL.items()},
        "fit_percent": {name: {"phi [rad]": 100 - value} for name, value in PER_MODEL.items()},
        "e_sim": dict(PER_MODEL),
        "balance_violation": {name: {"energy [W]": value} for name, value in PER_MODEL.items()},
        "details": {
            "prior_parameters": {
                "values": {"m": 1.0},
                "standard_errors": {},
                "nominal": {"m": 1.0},
                "warnings": [],
                "stages": [],
            },
            "scores_of_all_networks": {},
            "by_file": {},
            "smoother": {"sigma": [0.1], "walk": [1.0]},
            "hybrid_over_phy": {"error": 0.75, "e_sim": 0.8},
            "choice": {
                "recommended": "mopgrnn",
                "hybrid": "mopgrnn",
                "reason": "mopgrnn is recommended.",
                "candidates": {"phy": {"error": 0.2, "ratio": 1.0, "upper": 1.0, "share": 1.0}},
            },
            "bands": {
                "phy": {
                    "share": 0.9,
                    "coverage": 0.88,
                    "width": {"phi [rad]": 0.1},
                    "score": {"phi [rad]": 0.2},
                    "score_of_constant": {"phi [rad]": 0.25},
                }
            },
            "baselines": {
                "ARX": {
                    "errors": {
                        "error": 0.4,
                        "rmse": {"phi [rad]": 0.3},
                        "fit_percent": {"phi [rad]": 60.0},
                    },
                    "chosen": "order 2",
                },
                "N4SID": {"reason": "too short"},
            },
        },
    },
    "export": {"parity_max_abs_error": 2e-16, "jacobian_max_abs_error": 1e-15},
    "control": {
        "prior": {"cost": 3.0, "tracking_rmse": {"phi [rad]": 0.1}},
        "hybrid": {"cost": 2.0, "tracking_rmse": {"phi [rad]": 0.05}},
        "oracle": {"cost": 1.5, "tracking_rmse": {"phi [rad]": 0.04}},
        "gap_closed": 0.67,
    },
    "on_model": {
        "plants": {"prior_observer": "hybrid"},
        "left_out": {"hybrid_observer": "one network was trained"},
        "default_tasks": True,
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
    "promises": {
        "rows": [
            {"name": "horizon", "verdict": "shown", "evidence": "it holds 99 % of the cost", "remedy": ""}
        ]
    },
    "timing": {
        "controller_step_ms": {"median": 2.0, "p95": 3.0, "p99": 4.0, "max": 9.0},
        "period_ms": 20.0,
        "misses": 0,
    },
    "watch": {
        "kind": "energy",
        "wanted_per_hour": 2.0,
        "hours": 0.05,
        "false_alarms_per_hour": 0.0,
        "alarms": [
            {"file": "a", "start_s": 1.0, "end_s": 2.0, "channels": ["force of phi"], "diagnosis": ""}
        ],
        "faults": [
            {
                "fault": "friction",
                "title": "friction doubles",
                "task": "sine",
                "start_s": 3.0,
                "delay_s": None,
                "channels": [],
                "diagnosis": "",
                "false_alarms": 0,
                "switches": [],
            }
        ],
        "details": {"sources": {"energy": "loops"}, "limits": {}, "clean": None},
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


def leaves(values=RESULTS, prefix=""):
    for key, inner in values.items():
        if (
            isinstance(inner, dict)
            and not set(inner) & {"phy", "python", "phi [rad]", "energy [W]"}
            and key != "details"
        ):
            yield from leaves(inner, f"{prefix}{key}.")
        else:
            yield prefix + key


DEFAULTS = (
    "on_model.",
    "estimation.",
    "promises.",
    "timing.controller_step_ms.",
    "watch.",
    "analysis.",
)
"""Groups whose values may be left out."""


def test_complete_results_are_read_and_written_back():
    results = read_results(RESULTS)
    assert results == read_results(json.loads(json.dumps(results.plain())))
    again = results.plain()
    assert set(leaves(RESULTS)) <= set(leaves(again))


@pytest.mark.parametrize("path", [path for path in leaves() if not path.startswith(DEFAULTS)])
def test_a_missing_key_is_named(path):
    results = copy.deepcopy(RESULTS)
    *groups, key = path.split(".")
    place = results
    for group in groups:
        place = place[group]
    del place[key]
    with pytest.raises(InputError, match=f"{key} is missing"):
        read_results(results)


@pytest.mark.parametrize("path", list(leaves()))
def test_a_wrong_kind_is_named(path):
    with pytest.raises(InputError, match=rf"results: (.*; )?{path}: .*needed"):
        read_results(put(path, object()))


@pytest.mark.parametrize("value", [math.nan, math.inf, True, -math.inf])
def test_only_finite_numbers_are_errors_of_a_model(value):
    with pytest.raises(InputError, match=r"identification\.e_sim\.phy"):
        read_results(put("identification.e_sim", PER_MODEL | {"phy": value}))


def test_null_needs_a_reason():
    with pytest.raises(InputError, match=r"control.*gap_closed.*HM-WORKFLOW-041"):
        read_results(put("control.gap_closed", None))
    results = put("control.gap_closed", None)
    results["control"]["gap_closed_reason"] = "no oracle"
    assert read_results(results).control.gap_closed_reason == "no oracle"


def test_another_version_and_unknown_keys_are_refused():
    with pytest.raises(InputError, match=r"11.*HM-WORKFLOW-040"):
        read_results(put("schema_version", 4))
    with pytest.raises(InputError, match=r"field.*'programs'.*HM-RECORDS-011"):
        read_results(put("export.programs", 3))


def test_an_interval_that_ends_before_it_starts_is_refused():
    with pytest.raises(InputError, match="HM-WORKFLOW-043"):
        read_results(put("watch.alarms", [{"file": "a.csv", "start_s": 2.0, "end_s": 1.0}]))


def keys_of(kind):
    """Keys of an object and of the objects in it; lists, reasons and details are said in a sentence each."""
    found = set()
    for name, hint in typing.get_type_hints(kind).items():
        if not name.endswith("reason") and name != "details":
            inner = [t for t in (hint, *typing.get_args(hint)) if dataclasses.is_dataclass(t)]
            found |= {name}.union(*(keys_of(t) for t in inner if typing.get_origin(hint) is not tuple))
    return found


def test_the_page_names_the_keys_that_the_dataclasses_have():
    lines = [line for line in PAGE.read_text().splitlines() if line.startswith("|")]
    page = {key for line in lines for key in re.findall(r"`([a-z_0-9]+)`", line.split("|")[1])} - {"details"}
    assert page - keys_of(Results) == set()
    assert keys_of(Results) - page == {"median", "p95", "p99", "max"}  # in the line of controller_step_ms
