"""Online plausibility: the energy violation, its calibrated alarm, and replay on recordings."""

from hybrid_mpc.monitor.calibration import (
    Calibration,
    alarm_intervals,
    calibrate,
    count_alarms,
    with_residual,
)
from hybrid_mpc.monitor.energy import EnergyMonitor, MonitorReading, MonitorState
from hybrid_mpc.monitor.replay import MonitorTrace, judge, replay

__all__ = [
    "EnergyMonitor",
    "MonitorState",
    "MonitorReading",
    "Calibration",
    "calibrate",
    "with_residual",
    "count_alarms",
    "alarm_intervals",
    "MonitorTrace",
    "judge",
    "replay",
]
