"""The table of all that watches: channels with thresholds, false alarms with intervals, faults with delays."""

from dataclasses import replace

import pytest

from hybrid_mpc import Calibration, ResidualLimits
from hybrid_mpc.job.stage import Absent
from hybrid_mpc.job.stages.guard import GuardResult, GuardTest
from hybrid_mpc.job.stages.monitor import CleanAlarms, MonitorResult
from hybrid_mpc.job.stages.residuals import FaultedChannel, ResidualsResult
from hybrid_mpc.job.stages.watching import rate_words, watching_table

NONE = Absent("left out")
CHANNELS = ("level", "mass")
LIMITS = ResidualLimits(
    CHANNELS, 1.0, ((0.2, 0.1), (3.0, 2.0)), ((0.1, 0.1), (1.0, 1.0)), (1.0,), (3,), 1.0, 1.0
)
FAULTS = (
    FaultedChannel("input_gain", "pump", 0.8, "hold", 50.0, 4.0, ("mass", "level"), "pump -21 %", 0),
    FaultedChannel("measurement_freeze", "level", 0.0, "hold", 50.0, None, (), "", 0),
)
RESIDUALS = ResidualsResult(
    {"prior": LIMITS}, "", (), CleanAlarms(3600.0, 2), FAULTS,
    by_channel={"level": CleanAlarms(3600.0, 2), "mass": CleanAlarms(3600.0, 0)}, units=("m", "kg/s"),
)  # fmt: skip


def test_every_channel_has_a_row_and_each_fault_stands_at_the_channel_that_saw_it_first():
    table = watching_table(NONE, NONE, RESIDUALS, "")
    assert [row[0] for row in table.rows] == ["level", "mass", "frozen sensor, or no channel"]
    level, mass, frozen = table.rows
    assert level[1:] == ("0.2, lasting 0.1 m", "2 (0.24 to 7.2)", "", "")
    assert mass[1:] == (
        "3, lasting 2 kg/s",
        "0 (0 to 3.7)",
        "input_gain of pump 4 s",
        "input_gain of pump: pump -21 %",
    )
    assert frozen[3] == "measurement_freeze of level never"


def test_energy_and_guard_stand_in_the_same_table():
    energy = MonitorResult(
        Calibration(0.2, 0.1, 1.0, 1000, 0.1, "by hand", "", 0.3, 0.1), (), clean=CleanAlarms(300.0, 0)
    )
    without = GuardResult("", (), GuardTest(0.0, 0, ()), None, "too little")
    table = watching_table(energy, without, NONE, "N m")
    assert [row[:2] for row in table.rows] == [("energy", "0.2 W"), ("residual force", "0.3 N m")]
    assert "0 (0 to 44)" in table.rows[0][2]


@pytest.mark.parametrize("empty", [NONE, MonitorResult(Calibration.without("too little"), ())])
def test_without_limits_there_is_no_table(empty):
    assert watching_table(empty, NONE, replace(RESIDUALS, limits={}), "") is None


def test_the_interval_of_a_count():
    """Garwood's exact limits of one event: 0.0253 and 5.572."""
    assert rate_words(1, 3600.0) == "1 (0.025 to 5.6)"
