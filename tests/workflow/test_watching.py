"""The table of all that watches: channels with thresholds, false alarms with intervals, faults with delays."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

from hybrid_mpc import ChannelLimit, InputError, WatchLimits, load_scenario
from hybrid_mpc.kit.parts import WatchFile
from hybrid_mpc.watch.readings import Channel
from hybrid_mpc.workflow.stages.report import _watch_tables, _watch_words, rate_words, watching_table
from hybrid_mpc.workflow.stages.watch import CleanAlarms, FaultedLoop, WatchResult, rates

LIMITS = WatchLimits(
    "residuals",
    1.0,
    (
        ChannelLimit("level", "m", 3, 0.2, 0.1),
        ChannelLimit("level", "m", 30, 0.1, 0.1),
        ChannelLimit("mass", "kg/s", 0, 9.0, 4.5, (1.0,)),
    ),
    (0.5,),
    (3,),
)
FAULTS = (
    FaultedLoop("weak_pump", "the pump weakens", "hold", 50.0, 4.0, ("mass", "level"), "pump -21 %", 0),
    FaultedLoop("freeze_level", "the sensor freezes", "hold", 50.0, 2.0, ("level frozen",), "frozen", 0),
    FaultedLoop("load", "a load", "hold", 50.0, None, (), "", 0),
)
HOUR = 3600.0
FOUND = WatchResult(
    {"prior": WatchFile({"residuals": LIMITS})}, "residuals", faults=FAULTS, clean=CleanAlarms(HOUR, 2),
    channels=(Channel("level", "m"), Channel("mass", "kg/s"), Channel("violation", "W")),
    by_channel={
        "level": CleanAlarms(HOUR, 2), "mass": CleanAlarms(HOUR, 0), "violation": CleanAlarms(HOUR, 0),
        "level frozen": CleanAlarms(HOUR, 0),
    },
)  # fmt: skip


def test_every_channel_with_a_limit_has_a_row_and_each_fault_stands_where_it_was_seen_first():
    level, mass, frozen, all_of_them = watching_table(FOUND, FOUND.limits).rows
    assert level == ("level", "0.2 m, mean over 3 s; 0.1 m, mean over 30 s", "2 (0.24 to 7.2)", "", "")
    assert mass == ("mass", "9 deviations, summed", "0 (0 to 3.7)", "weak_pump 4 s", "weak_pump: pump -21 %")
    assert frozen[0] == "level frozen"
    assert frozen[3:] == ("freeze_level 2 s", "freeze_level: frozen")
    assert (all_of_them[2], all_of_them[3], all_of_them[4]) == ("2 (0.24 to 7.2)", "load never", "")


def test_without_limits_there_is_no_table():
    assert _watch_tables(replace(FOUND, watch={})) == []
    assert _watch_tables(replace(FOUND, watch={"prior": WatchFile({}, "too little")})) == []


def test_the_interval_of_a_count():
    """Garwood's exact limits of one event: 0.0253 and 5.572."""
    assert rate_words(1, 3600.0) == "1 (0.025 to 5.6)"
    assert rate_words(0, 0.0) == "not watched"
    assert np.isclose(CleanAlarms(HOUR, 2).expected(2.0), 2.0)


def test_a_scenario_sets_the_rates_of_false_alarms():
    scenario = load_scenario("golf_robot")
    own, slow = replace(scenario, false_alarms_per_hour=(0.01, 0.1)), SimpleNamespace(time_unit=10.0)
    assert rates(own, slow) == (0.01, 0.1)
    assert rates(scenario, slow) == (0.1, 0.2, 0.5, 1.0)
    for bad in ((1.0, 1.0), (2.0, 1.0), (0.0, 1.0), (-1.0,)):
        with pytest.raises(InputError, match=r"false_alarms_per_hour.*HM-"):
            replace(scenario, false_alarms_per_hour=bad)


def test_the_report_names_a_rate_that_the_data_are_too_short_for():
    rated = replace(LIMITS, rated=True, false_alarms_per_hour=0.1)
    found = replace(
        FOUND,
        watch={"prior": WatchFile({"residuals": rated})},
        sources={"residuals": "recordings"},
        wanted=0.01,
    )
    assert "0.01 an hour" in _watch_words(found)[0]
    assert "too short" not in _watch_words(replace(found, wanted=0.1))[0]
