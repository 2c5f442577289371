"""Warnings about recordings name the place; sound recordings have none."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from machine_signals import machine

from hybrid_mpc import DataSpec, InputError, Signal, load_scenario, load_trajectories, write_csv
from hybrid_mpc.data.findings import still_stretches, unwrap
from hybrid_mpc.data.recording import read_recording

RECORDINGS = Path(__file__).parents[3] / "shared" / "data"
SPEC = DataSpec("t", ("tau",), ("phi",), dt=0.02, max_gap=0.05, smoothing=0.1, warm_up=0.2)
PHI, PHI_DOT = Signal("phi", "rad", -80, 80), Signal("phi_dot", "rad/s", -20, 20)
SIGNALS = {"outputs": (PHI,), "inputs": (Signal("tau", "N m"),), "states": (PHI, PHI_DOT)}
FREE = {**SIGNALS, "states": ()}
TURNS = {**SIGNALS, "outputs": (replace(PHI, periodic=True),)}
T = np.arange(0, 20, 0.01)
TAU = np.sin(1.3 * T) + 0.5 * np.sign(np.sin(0.9 * T))
SWING = 1.2 * np.sin(1.3 * T) + 0.4 * np.sin(3.1 * T)
NOISE = 2e-4 * np.random.default_rng(0).standard_normal(len(T))
STEP = 2 * np.pi / 4096


def quantised(y):
    return STEP * np.round(y / STEP)


def findings(tmp_path, phi, tau=TAU, signals=SIGNALS, name="run", spec=SPEC, t=T):
    file = write_csv(tmp_path / f"{name}.csv", {"t": t, "tau": tau, "phi": phi})
    return load_trajectories([file], machine(**signals), spec).findings


SENSORS = {"encoder": quantised, "noisy": lambda y: y + NOISE, "exact": np.copy}


@pytest.fixture(params=SENSORS)
def sensor(request):
    return SENSORS[request.param]


def test_sound_sensors_are_not_doubted(tmp_path, sensor):
    assert findings(tmp_path, sensor(SWING)) == ()
    # rest, where an encoder repeats itself for long, between a stop and a start by friction
    still = 1.2 * np.cos(np.minimum(2 * T, 3 * np.pi)) + 0.6 * np.cos(np.clip(2 * T - 24, 0, None))
    assert findings(tmp_path, sensor(still), tau=np.where(np.abs(T - 8) < 4, 0.1, TAU)) == ()


def test_frozen_sensors(tmp_path, sensor):
    phi = sensor(SWING)
    phi[500:620] = phi[500]
    phi[900:930] = phi[900]
    (one,) = findings(tmp_path, phi, signals=FREE)  # where it ends its speed is beyond all bounds, too
    told = one.kind, one.file, one.channel, one.count, one.start, one.refused
    assert told == ("frozen", "run.csv", "phi", 150, 5.0, False)
    for words in (
        "run.csv: column 'phi' repeats", "from 5 to 6.19 s, 120 samples (1 more such interval, 150", "deleting",
    ):  # fmt: skip
        assert words in str(one)


def test_a_sensor_that_stops_at_rest_is_told_by_the_inputs(tmp_path):
    """It never moves again, so nothing is abrupt: the inputs go on as before."""
    resting = quantised(SWING * np.clip((10 - T) / 3, 0, 1) ** 2)  # comes to rest at 10 s
    (one,) = findings(tmp_path, resting)
    assert (one.kind, "while the inputs keep moving" in one.message) == ("frozen", True)
    assert one.start == pytest.approx(10.0, abs=0.3)
    assert findings(tmp_path, resting, tau=np.where(T > 9.5, 0.2 * TAU, TAU)) == ()  # too little to move it
    # a file that stands still from its begin to its end, among others that move
    good = write_csv(tmp_path / "good.csv", {"t": T, "tau": TAU, "phi": quantised(SWING)})
    dead = write_csv(tmp_path / "dead.csv", {"t": T, "tau": TAU, "phi": 0 * T + 0.3})
    found = load_trajectories([good, dead], machine(**SIGNALS), SPEC).findings
    assert [(one.kind, one.file, one.count) for one in found] == [("frozen", "dead.csv", len(T))]


def test_clipped_sensors(tmp_path, sensor):
    phi = np.clip(sensor(SWING), -2.0, 1.0)
    (one,) = findings(tmp_path, phi)
    assert (one.kind, one.channel, one.count) == ("clipped", "phi", int((phi == 1.0).sum()))
    assert one.start == pytest.approx(T[np.argmax(phi == 1.0)])
    for words in ("largest value, 1 rad", "clipped", "mechanical stop"):
        assert words in str(one)
    both = findings(tmp_path, np.clip(sensor(SWING), -0.8, 1.0))
    assert [one.message.split("its ")[1].split(" ")[0] for one in both] == ["largest", "smallest"]


def test_wrapped_angles_count_on_where_the_signal_is_periodic(tmp_path):
    turning = 3.0 * T + 0.8 * np.sin(2 * T)  # ten turns
    wrapped = (turning + np.pi) % (2 * np.pi) - np.pi
    jumps = int((np.abs(np.diff(wrapped)) > np.pi).sum())
    (one,) = findings(tmp_path, wrapped, signals=TURNS)
    assert (one.kind, one.count, one.refused) == ("wrapped", jumps, False)
    assert one.start == pytest.approx(T[1 + np.argmax(np.abs(np.diff(wrapped)) > np.pi)])
    assert f"jumps {jumps} times by about a full turn" in str(one)
    file = tmp_path / "run.csv"
    read = read_recording(file, machine(**TURNS), SPEC)
    np.testing.assert_allclose(read.y[:, 0], turning, atol=1e-8)  # ten digits in the file
    # the same in degrees, and from 0 to 360
    spec = replace(SPEC, units={"phi": "deg"})
    (same,) = findings(tmp_path, np.rad2deg(turning) % 360, signals=TURNS, spec=spec)
    assert same.kind == "wrapped"
    match = r"run.csv: column 'phi' jumps \d+ times .* declare Signal.*periodic=True"
    with pytest.raises(InputError, match=match):
        findings(tmp_path, wrapped)
    near = replace(PHI, periodic=True, lower=-8, upper=8)
    match = r"8\.\d+ is outside .* of phi, with \d+ jumps of a full turn removed"
    with pytest.raises(InputError, match=match):
        findings(tmp_path, wrapped, signals={**TURNS, "outputs": (near,)})


def test_angles_that_count_on_are_left_as_they_are(tmp_path):
    fast = {**TURNS, "outputs": (Signal("phi", "rad", periodic=True),), "states": ()}
    t = T[::2]
    for speed in (1.0, 2 * np.pi / 0.02):  # a whole turn from sample to sample
        phi = speed * t + 0.1 * np.sin(t)
        spec = replace(SPEC, smoothing=0.2)
        assert findings(tmp_path, phi, t=t, tau=TAU[::2], signals=fast, spec=spec) == ()
        read = read_recording(tmp_path / "run.csv", machine(**fast), SPEC)
        np.testing.assert_allclose(read.y[:, 0], phi, rtol=1e-9)
    # an angle that trembles about where it is wrapped, and one that jumps by a turn over a gap in time
    upright = np.pi + 0.01 * np.sin(9 * T)
    (one,) = findings(tmp_path, (upright + np.pi) % (2 * np.pi) - np.pi, signals=TURNS)
    assert one.kind == "wrapped"
    (whole,) = load_trajectories([tmp_path / "run.csv"], machine(**TURNS), SPEC).whole
    np.testing.assert_allclose(np.ptp(whole.y), 0.02, rtol=1e-2)
    gap = np.r_[T[:900], T[1000:]]
    jumping = np.where(gap < 9.5, SWING[0] + gap, gap - 6.28)
    assert findings(tmp_path, jumping, t=gap, tau=np.sin(gap), signals=TURNS) == ()


def test_speeds_beyond_what_is_plausible(tmp_path):
    spike = SWING + NOISE
    spike[700:703] += 3.0
    (one,) = findings(tmp_path, spike)
    assert (one.kind, one.channel, one.refused) == ("speed", "phi", False)
    assert 6.9 < one.start < 7.1
    assert 0 < one.count < 10
    for words in ("reaches", "rad/s at", "-20 to 20 rad/s", "DataSpec.units"):
        assert words in str(one)
    # degrees that a wide range of the position lets pass
    free = {**SIGNALS, "outputs": (Signal("phi", "rad"),)}
    match = r"run\.csv.*HM-DATA-100"
    with pytest.raises(InputError, match=match):
        findings(tmp_path, np.rad2deg(SWING), signals=free)
    other = (PHI, Signal("n", "rpm", -1, 1))  # no rate of a radian: nothing to compare with
    assert findings(tmp_path, SWING + NOISE, signals={**SIGNALS, "states": other}) == ()


def test_all_files_are_told_at_once(tmp_path):
    wrapped = (3.0 * T + np.pi) % (2 * np.pi) - np.pi
    files = [
        write_csv(tmp_path / "a.csv", {"t": T, "tau": TAU, "phi": wrapped}),
        write_csv(tmp_path / "b.csv", {"t": T, "tau": TAU, "phi": np.where(T == 5.0, 99.0, SWING)}),
        write_csv(tmp_path / "c.csv", {"t": T[::-1], "tau": TAU, "phi": SWING}),
        tmp_path / "d.csv",
        write_csv(tmp_path / "e.csv", {"t": T, "tau": TAU, "phi": SWING}),
        write_csv(tmp_path / "f.csv", {"t": T, "tau": TAU, "phi": 0.9 * np.rad2deg(SWING)}),
    ]
    with pytest.raises(InputError) as caught:
        load_trajectories(files, machine(**SIGNALS), SPEC)
    told = caught.value.problems
    words = (
        "a.csv: column 'phi' jumps",
        "b.csv: row 502",
        "c.csv: row 3",
        "d.csv: file not found",
        "f.csv: row",
    )
    assert len(told) == len(words)
    for problem, start in zip(told, words, strict=True):
        assert start in problem
        assert problem in str(caught.value)


REAL = {
    "unbalanced_disk": "unbalanced_disk/*.npz",
    "emps": "emps/*.mat",
    "xl330_pendulum": "xl330_pendulum/*.csv",
    "torque_pendulum": "torque_pendulum/*.csv",
}


@pytest.mark.skipif(not RECORDINGS.is_dir(), reason="the real recordings are not on this machine")
@pytest.mark.parametrize(
    "machine", ["emps", *(pytest.param(name, marks=pytest.mark.full) for name in REAL if name != "emps")]
)
def test_nothing_is_doubted_about_real_recordings(machine):
    files = sorted(RECORDINGS.glob(REAL[machine]))
    assert files
    scenario = load_scenario(machine)
    prior = scenario.prior()
    assert load_trajectories(files, prior, scenario.data, needed=()).findings == ()
    for file in files:  # alone, too
        assert load_trajectories([file], prior, scenario.data, needed=()).findings == ()


@pytest.mark.full
@pytest.mark.parametrize("machine", ["golf_robot", "unbalanced_disk", "pendulum"])
def test_nothing_is_doubted_about_simulated_recordings(tmp_path, machine):
    scenario = load_scenario(machine)
    prior = scenario.prior()
    files = scenario.make_data(tmp_path, 0, "quick")
    assert load_trajectories(files, prior, scenario.data).findings == ()


def turned(angle):
    return (angle + np.pi) % (2 * np.pi) - np.pi


@pytest.mark.parametrize("speed", [0.05, 0.1, 0.24, 0.3, 0.45])
@pytest.mark.parametrize("lost", [0, 1, 2, 7])
def test_turns_are_counted_over_missing_samples_at_any_speed(speed, lost):
    """``speed`` turns a sample; ``lost`` samples in a row are missing now and then, at wraps, too."""
    k = np.arange(600)
    angle = 2 * np.pi * speed * k + 0.2 * np.sin(k / 40)
    there = ~np.isin(k % 37, range(1, 1 + lost))
    found = unwrap(0.01 * k[there], turned(angle)[there], 2 * np.pi, 1.0)
    np.testing.assert_allclose(found.angle - found.angle[0], angle[there] - angle[0], atol=1e-9)
    assert not len(found.unclear)


def test_where_the_number_of_turns_is_not_known_the_recording_is_cut(tmp_path):
    """It reverses while a second of samples is missing, in which it may make several turns."""
    k = np.arange(1200)
    angle = np.where(k < 600, 0.5 * k, 300 - 0.5 * (k - 600))
    angle[560:640] = np.nan
    found = unwrap(0.01 * k[np.isfinite(angle)], turned(angle)[np.isfinite(angle)], 2 * np.pi, 5.0)
    assert found.unclear.tolist() == [560]
    np.testing.assert_allclose(np.diff(found.angle)[:559], 0.5)
    np.testing.assert_allclose(np.diff(found.angle)[560:], -0.5)


def test_settled_answers_to_steps_are_not_frozen(tmp_path):
    """A voltage behind a resistor and a capacitor: it settles to the digits of the file and starts at each step."""
    t = 0.01 * np.arange(6000)
    u = np.where((t // 1.0) % 2 == 0, 5.0, 0.0)
    y = np.zeros(len(t))
    for k in range(1, len(t)):
        y[k] = u[k - 1] + (y[k - 1] - u[k - 1]) * np.exp(-0.01 / 0.08)
    lag = {"inputs": (Signal("u", "V"),), "outputs": (Signal("y", "V"),), "states": ()}
    assert findings(tmp_path, np.round(y, 4), t=t, tau=u, signals=lag) == ()


def test_bursts_of_samples_are_not_frozen(tmp_path):
    """Six samples in a millisecond, then a pause: an encoder does not move within a burst."""
    t = (0.02 * np.arange(500)[:, None] + 1e-4 * np.arange(6)).ravel()
    y = np.round(np.sin(3 * t) / 0.002) * 0.002
    spec = replace(SPEC, dt=0.02, smoothing=0.2)
    lag = {"inputs": (Signal("u", "V"),), "outputs": (Signal("y", "V"),), "states": ()}
    file = write_csv(tmp_path / "run.csv", {"t": t, "tau": np.sin(7 * t), "phi": y})
    found = read_recording(file, machine(**lag), spec)
    still = still_stretches(found.t, found.y[:, 0], found.u, max_gap=0.05, patience=1.0, spreads=np.ones(1))
    assert still == ()


@pytest.mark.parametrize("code", [-9999.0, 9999.0, -999.9, 65535.0, 1e30])
def test_a_code_for_missing_values_is_refused_by_name(tmp_path, code):
    y = np.where(np.arange(len(T)) % 9 == 0, code, SWING)
    with pytest.raises(InputError, match=r"phi.*HM-DATA-072"):
        findings(tmp_path, y, signals={**SIGNALS, "outputs": (Signal("phi", "rad"),), "states": ()})


def test_the_same_recording_twice_is_refused(tmp_path):
    one = write_csv(tmp_path / "a.csv", {"t": T, "tau": TAU, "phi": SWING})
    np.savez(tmp_path / "b.npz", t=T, tau=TAU, phi=SWING)
    with pytest.raises(InputError, match=r"b\.npz.*a\.csv.*HM-DATA-064"):
        load_trajectories([one, tmp_path / "b.npz"], machine(**SIGNALS), SPEC)
