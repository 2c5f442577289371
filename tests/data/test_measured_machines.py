"""Recordings of machines that nobody here built: processes, drives, a vehicle, a chain; read as they are.

Counts, periods and ranges are those of the READMEs beside the recordings.
"""

from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pandas as pd
import pytest

from hybrid_mpc import DataSpec, Signal, load_trajectories
from hybrid_mpc.data.recording import read_recording

SHARED = Path(__file__).parents[3] / "shared" / "data"


@dataclass(frozen=True)
class Machine:
    """How a machine is read, and what its README says of one file."""

    file: str
    spec: DataSpec
    inputs: tuple[Signal, ...]
    outputs: tuple[Signal, ...]
    states: tuple[Signal, ...]
    rows: int
    period: float
    disturbances: tuple[Signal, ...] = ()
    findings: tuple[str, ...] = ()


def degrees(name):
    return Signal(name, "degC", 0, 120)


TEMPERATURES = degrees("T1"), degrees("T2")
JOINTS = Signal("q1", "rad", -10, 10), Signal("q2", "rad", -10, 10)
RATES = Signal("dq1", "rad/s", -40, 40), Signal("dq2", "rad/s", -40, 40)
TORQUES = Signal("tau1", "N m", -7, 7), Signal("tau2", "N m", -7, 7)
POSE = (
    Signal("x", "m", -2, 2), Signal("y", "m", -2, 2), Signal("heading", "rad", -4, 4), Signal("speed", "m/s", -1, 1),
)  # fmt: skip
COMMANDS = "tau1_command_nm", "tau2_command_nm"

MACHINES = {
    "tanks": Machine(
        "cascaded_tanks/estimation.csv",
        DataSpec("time_s", ("pump_v",), ("level_v",), dt=4.0, max_gap=6.0, smoothing=40.0, warm_up=20.0),
        inputs=(Signal("u", "V", 0, 10),),
        outputs=(Signal("level", "V", -1, 12, saturation=(-np.inf, 10.0)),),
        states=(Signal("h1", "V"), Signal("h2", "V")),
        rows=1024,
        period=4.0,
    ),
    "drives": Machine(
        "coupled_drives/prbs_1.csv",
        DataSpec("time_s", ("u_v",), ("speed",), dt=0.02, max_gap=0.03, smoothing=0.2, warm_up=0.2),
        inputs=(Signal("u", "V", -3, 3),),
        outputs=(Signal("speed", "-", -0.1, 7),),
        states=tuple(Signal(f"x{i}", "-") for i in range(3)),
        rows=500,
        period=0.02,
    ),
    "chain": Machine(
        "double_pendulum/sines_143339.csv",
        DataSpec(
            "time_s", COMMANDS, ("q1_rad", "q2_rad", "dq1_rad_s", "dq2_rad_s"), dt=0.002, max_gap=0.02, smoothing=0.04,
            warm_up=0.1, delays=dict.fromkeys(COMMANDS, 0.004),
        ),
        inputs=TORQUES,
        outputs=(*JOINTS, *RATES),
        states=(*JOINTS, *RATES),
        rows=4998,
        period=0.002,
    ),
    "chain, joints alone": Machine(
        "double_pendulum/acrobot_swingup_01.csv",
        DataSpec("time_s", COMMANDS, ("q1_rad", "q2_rad"), dt=0.03, max_gap=0.1, smoothing=0.25, warm_up=0.3),
        inputs=TORQUES,
        outputs=JOINTS,
        states=(*JOINTS, *RATES),
        rows=330,
        period=0.03,
    ),
    "chain, pushed": Machine(
        "double_pendulum/acrobot_pushed_01.csv",
        DataSpec(
            "time_s", COMMANDS, ("q1_rad", "q2_rad", "dq1_rad_s", "dq2_rad_s"), dt=0.005, max_gap=0.05, smoothing=0.04,
            warm_up=0.1, disturbances=("push1_nm", "push2_nm"),
        ),
        inputs=TORQUES,
        outputs=(*JOINTS, *RATES),
        states=(*JOINTS, *RATES),
        rows=4867,
        period=0.002,
        findings=("frozen", "frozen"),  # speeds that repeat themselves for ten rows at 1 and 2 rad/s
        disturbances=(Signal("push1", "N m", -5, 5), Signal("push2", "N m", -5, 5)),
    ),
    "exchanger": Machine(
        "heat_exchanger/random_steps_jun16.csv",
        DataSpec(
            "time_s", ("valve",), ("outlet_degc",), dt=2.0, max_gap=12.0, smoothing=20.0, warm_up=60.0,
            disturbances=("reservoir_degc",),
        ),
        inputs=(Signal("valve", "-", 0, 2.2),),
        outputs=(degrees("T"),),
        states=(degrees("T"),),
        rows=19067,
        period=2.0,
        disturbances=(degrees("reservoir"),),
    ),
    "car": Machine(
        "race_car/run_01.csv",
        DataSpec(
            "time_s", ("steering_rad", "speed_command_m_s"), ("x_m", "y_m", "heading_rad", "speed_m_s"), dt=0.025,
            max_gap=0.03, smoothing=0.2, warm_up=0.1,
        ),
        inputs=(Signal("steering", "rad", -0.2001, 0.2001), Signal("command", "m/s", -0.5, 0.5)),
        outputs=POSE,
        states=(*POSE, Signal("wheel", "rad")),
        rows=121,
        period=0.025,
    ),
    "lab": Machine(
        "temperature_lab/prbs.csv",
        DataSpec(
            "time_s", ("heater1_pct", "heater2_pct"), ("temperature1_degc", "temperature2_degc"), dt=1.0, max_gap=2.0,
            smoothing=20.0, warm_up=60.0,
        ),
        inputs=(Signal("Q1", "%", 0, 100), Signal("Q2", "%", 0, 100)),
        outputs=TEMPERATURES,
        states=(degrees("H1"), degrees("H2"), *TEMPERATURES),
        rows=5100,
        period=1.0,
    ),
}  # fmt: skip


def files_of(machine, pattern=None):
    found = sorted(SHARED.glob(pattern or machine.file))
    if not found:
        pytest.skip("the real recordings are not on this machine")
    return found


def read(machine, files, **more):
    return load_trajectories(files, machine, machine.spec, **more)


@pytest.mark.parametrize("name", MACHINES)
def test_a_recording_is_read_as_it_is(name):
    machine = MACHINES[name]
    (file,) = files_of(machine)
    recording = read_recording(file, machine, machine.spec)
    raw = pd.read_csv(file)
    assert len(recording.t) == len(raw) == machine.rows
    assert recording.dt == pytest.approx(machine.period, rel=0.02)  # loops of real computers
    data = read(machine, [file])
    (whole,) = data.whole
    lost = machine.spec.dt * 2 + max(machine.spec.delays.values(), default=0.0)
    assert raw.time_s.iloc[-1] - lost <= len(whole.t) * machine.spec.dt <= raw.time_s.iloc[-1] + 1e-9
    assert {piece.role for piece in data.trajectories} == {"train", "valid", "test"}
    assert tuple(finding.kind for finding in data.findings) == machine.findings
    # values between the samples of the file: nothing is invented, no column is taken for another
    for array, columns in (
        (whole.y, machine.spec.outputs), (whole.u, machine.spec.inputs), (whole.w, machine.spec.disturbances),
    ):  # fmt: skip
        assert array.shape == (len(whole.t), len(columns))
        for j, column in enumerate(columns):
            near = 1e-9 * np.abs(raw[column]).max()  # sums of impulses
            assert (
                raw[column].min() - near <= array[:, j].min() <= array[:, j].max() <= raw[column].max() + near
            )
            # what changes slowly has nearly the mean of its rows; a tenth of its spread is far less than another column
            assert abs(array[:, j].mean() - raw[column].mean()) <= 0.1 * raw[column].std() + near
    assert np.isfinite(whole.y).all()
    assert whole.x.shape == whole.xdot.shape == (len(whole.t), len(machine.states))
    positions = (
        len(machine.states) == 2 * len(machine.outputs) and machine.outputs[0].name == machine.states[0].name
    )
    assert np.isfinite(whole.x).all() == np.isfinite(whole.xdot).all() == positions


@pytest.mark.parametrize(
    ("name", "pattern", "files", "seconds"),
    [
        ("drives", "coupled_drives/*.csv", 5, (3 * 500 + 2 * 400) * 0.02),
        pytest.param("chain", "double_pendulum/sines_*.csv", 6, 6 * 10, marks=pytest.mark.full),
        pytest.param(
            "exchanger", "heat_exchanger/*.csv", 4, 38_132 + 26_180 + 24_599 + 10_194, marks=pytest.mark.full
        ),
        pytest.param("car", "race_car/*.csv", 31, 31 * 3, marks=pytest.mark.full),
        pytest.param("lab", "temperature_lab/*.csv", 5, 5 * 5100, marks=pytest.mark.full),
    ],
)
def test_all_recordings_of_a_machine_in_one_run(name, pattern, files, seconds):
    machine = MACHINES[name]
    paths = files_of(machine, pattern)
    assert len(paths) == files
    data = read(machine, paths, needed=())
    assert len({piece.file for piece in data.whole}) == files
    assert not any("gap" in cut.why for cut in data.cuts)
    # a recording ends with its last row, and loses up to a period and its delays there: 3 of 400 samples at most
    assert sum(len(whole.t) for whole in data.whole) * machine.spec.dt == pytest.approx(seconds, rel=0.01)
