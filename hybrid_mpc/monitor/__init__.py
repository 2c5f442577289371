"""Online plausibility: the energy violation, its calibrated alarm, what broke, and replay on recordings."""

from hybrid_mpc.monitor.calibration import (
    Calibration,
    alarm_intervals,
    calibrate,
    count_alarms,
    with_residual,
)
from hybrid_mpc.monitor.detection import METHODS, Judges, learn_judges
from hybrid_mpc.monitor.detector import Detector
from hybrid_mpc.monitor.diagnosis import Change, Diagnoser, Diagnosis
from hybrid_mpc.monitor.energy import EnergyMonitor
from hybrid_mpc.monitor.held_out import HeldOut, leave_one_out
from hybrid_mpc.monitor.learning import learn_detector
from hybrid_mpc.monitor.plausibility import (
    Plausibility,
    excess_bound,
    learn_plausibility,
    plan_distance,
    region_bound,
)
from hybrid_mpc.monitor.reading import MonitorReading, MonitorState, Verdict
from hybrid_mpc.monitor.replay import MonitorTrace, judge, replay
from hybrid_mpc.monitor.rest import rest_speeds
from hybrid_mpc.monitor.standard import guard_monitor, learn_from

__all__ = [
    "EnergyMonitor",
    "MonitorState",
    "MonitorReading",
    "Verdict",
    "rest_speeds",
    "Detector",
    "learn_detector",
    "METHODS",
    "Judges",
    "learn_judges",
    "learn_from",
    "guard_monitor",
    "leave_one_out",
    "HeldOut",
    "Diagnoser",
    "Diagnosis",
    "Change",
    "Plausibility",
    "learn_plausibility",
    "excess_bound",
    "region_bound",
    "plan_distance",
    "Calibration",
    "calibrate",
    "with_residual",
    "count_alarms",
    "alarm_intervals",
    "MonitorTrace",
    "judge",
    "replay",
]
