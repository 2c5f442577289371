"""Stages monitor and guard on linear axes: slow ones are calibrated, and where nothing can be, the run goes on."""

import shutil
from dataclasses import dataclass, replace

import numpy as np
import pytest
from typer.testing import CliRunner

from hybrid_mpc import (
    OCP,
    DataSpec,
    InputError,
    RunSettings,
    Scenario,
    load,
    save_artifact,
    set_process_noise,
    write_csv,
)
from hybrid_mpc.cli.main import app
from hybrid_mpc.identify.prior_result import PriorFit
from hybrid_mpc.job.context import Context
from hybrid_mpc.job.stage import Absent
from hybrid_mpc.job.stages.export import NOISE, NoiseResult
from hybrid_mpc.job.stages.figures import _monitor as monitor_figures
from hybrid_mpc.job.stages.figures import guard_figures
from hybrid_mpc.job.stages.guard import GUARD, guard_stage
from hybrid_mpc.job.stages.identify import PRIOR, PriorResult
from hybrid_mpc.job.stages.monitor import MONITOR, monitor_stage
from hybrid_mpc.job.stages.report import guard_tables, guard_words
from hybrid_mpc.job.stages.residuals import put_residuals, residuals_stage
from hybrid_mpc.job.stages.results import _guard as guard_results
from hybrid_mpc.job.stages.results import _monitor as monitor_results
from hybrid_mpc.kit.parts import ENERGY, set_residuals
from hybrid_mpc.kit.parts import GUARD as GUARD_FILE

AXIS = """
from hybrid_mpc import MechanicalPrior, Parameter, Signal


class Axis(MechanicalPrior):
    states, inputs = (Signal("q", "m"), Signal("v", "m/s")), (Signal("F", "N", -5, 5),)
    outputs = (Signal("q", "m"),)
    parameters = (Parameter("m", {mass}, "kg", {mass}, {mass}), Parameter("d", {damping}, "N s/m", 0, 1e9))

    def mass_matrix(self, q, p):
        return p.m

    def friction(self, q, v, p):
        return p.d * v.v + {dry} * (v.v / {width}).tanh()
"""


@dataclass(frozen=True)
class Machine:
    """An axis: period [s], top speed [m/s], swing [s], sensor noise [m]; 1 N swings it, 0.1 N of it is dry friction."""

    dt: float
    speed: float
    swing: float
    noise: float

    @property
    def source(self):
        mass = self.swing / (2 * np.pi) / (2 * self.speed)
        numbers = {"mass": mass, "damping": 0.5 / self.speed, "dry": 0.1, "width": 0.01 * self.speed}
        return AXIS.format(**{key: repr(float(value)) for key, value in numbers.items()})

    def recording(self, seed, n):
        """Columns of a recording, by semi-implicit Euler in fiftieths of a period."""
        rng, t = np.random.default_rng(seed), self.dt * np.arange(n)
        u = np.sin(2 * np.pi * t / self.swing + seed) + 0.6 * np.sin(2 * np.pi * 0.37 * t / self.swing)
        mass, damping = self.swing / (2 * np.pi) / (2 * self.speed), 0.5 / self.speed
        q, v, out, h = 0.0, 0.0, np.zeros(n), self.dt / 50
        for k in range(n):
            out[k] = q
            for _ in range(50):
                v += h * (u[k] - damping * v - 0.1 * np.tanh(v / (0.01 * self.speed))) / mass
                q += h * v
        return {"t": t, "F": u, "q": out + self.noise * rng.standard_normal(n)}


SLOW = Machine(dt=0.5, speed=1e-3, swing=40.0, noise=1e-7)
"""Some millimetres a second."""
QUICK = Machine(dt=1e-3, speed=0.1, swing=0.5, noise=1e-7)


def context(machine, samples, out, warm_up):
    """A run that has come to stage monitor: its model is the prior that made the recordings."""
    from hybrid_mpc import PriorStep, model_info, trace_model

    room = {}
    exec(machine.source, room)
    spec = DataSpec(
        "t",
        ("F",),
        ("q",),
        dt=machine.dt,
        max_gap=2.5 * machine.dt,
        smoothing=10 * machine.dt,
        warm_up=warm_up,
    )
    control = OCP(
        20,
        q=(1.0, 1.0),
        r=(1.0,),
        r_delta=(1.0,),
        u_min=(-2.0,),
        u_max=(2.0,),
    )
    scenario = Scenario(
        "axis", "An axis", "", prior=room["Axis"], data=spec, control=control, sensor_sigma=(machine.noise,)
    )
    for i, n in enumerate(samples):
        write_csv(out / "data" / f"run{i}.csv", machine.recording(i, n))
    made = Context(RunSettings("axis"), scenario, out)
    prior = scenario.prior()
    programs = trace_model(PriorStep(prior, machine.dt).requires_grad_(False))
    info = replace(model_info(prior, machine.dt), time_unit=made.time_unit)
    save_artifact(out / "model", {"hybrid": programs, "prior": programs}, info)
    noise = [machine.noise, 1e-3 * machine.speed]
    found = {"hybrid_observer": tuple(noise), "prior_observer": tuple(noise)}
    set_process_noise(out / "model", found)
    made.keep(NOISE, {}, NoiseResult(found))
    train = made.trajectories("train")
    states = {f"{t.name}/{key}": getattr(t, key) for t in train for key in ("x", "xdot")}
    made.keep(PRIOR, {}, PriorResult(PriorFit({}, {}, (), ()), {}, {}, {}, (), (), {}, "", {}, None, states))
    return made


@pytest.fixture(scope="module")
def slow(tmp_path_factory):
    run = context(SLOW, (1200, 900), tmp_path_factory.mktemp("slow"), warm_up=10.0)
    for stage, compute in ((MONITOR, monitor_stage), (GUARD, guard_stage)):
        run.keep(stage, {}, compute(run))
    return run


@pytest.mark.full
def test_an_axis_of_millimetres_a_second_is_calibrated(slow):
    found = slow.read(MONITOR)
    assert found.reason == ""
    (rest,) = found.calibration.rest_speed
    top = max(np.abs(t.x[:, 1]).max() for t in slow.dataset.whole)
    assert top < 5e-3
    assert 0.03 * top < rest < 0.07 * top
    # what dry friction may hold is 0.1 N: a residual that is always within the dead band would leave a threshold of 0
    assert 0 < found.calibration.residual_threshold < 0.5
    assert monitor_results(slow).threshold["energy [W]"] > 0
    model = load(slow.out / "model").models["hybrid"]
    assert model.time_unit == slow.time_unit > 5.0
    covered = found.recordings[0]
    assert covered["valid_s"] > 500
    assert covered["not_finite_s"] == covered["missing_s"] == 0.0


def test_monitor_and_guard_take_the_same_rest_speed(slow):
    artifact = load(slow.out / "model")
    (rest,) = slow.read(MONITOR).calibration.rest_speed
    assert artifact.rest_speed == (rest,)
    # 17 min are too little for the slowest rate of so slow a machine
    block = 5 * slow.time_unit
    assert f"in whole blocks of {block:g} s are too little" in guard_results(slow).reason


def test_limits_of_residuals_are_learned_kept_and_put_back(slow):
    found = residuals_stage(slow)
    (name,) = found.limits
    assert name == "hybrid"
    assert found.limits[name].channels == ("q", "energy", "free run of q")
    assert found.faults is None  # the energy is watched
    assert found.clean.alarms == 0  # thresholds are above the highest level of these very recordings
    assert found.clean.seconds > 0
    kit = load(slow.out / "model")
    assert dict(kit.residuals) == dict(found.limits)
    assert kit.monitor(kind="residuals").limits == found.limits[name]
    assert kit.monitor(kind="energy").calibration is not None
    set_residuals(slow.out / "model", {})
    assert put_residuals(slow, found) == ""
    assert dict(load(slow.out / "model").residuals) == dict(found.limits)


@pytest.fixture(scope="module")
def short(tmp_path_factory):
    """Recordings of 0.18 s, whose parts are shorter than the guard's window; training needs 20 ms for each part."""
    run = context(QUICK, (180, 180), tmp_path_factory.mktemp("short"), warm_up=0.01)
    for stage, compute in ((MONITOR, monitor_stage), (GUARD, guard_stage)):
        run.keep(stage, {}, compute(run))
    return run


def test_recordings_shorter_than_the_windows_give_a_reason_and_the_run_goes_on(short):
    found = short.read(MONITOR)
    assert found.calibration.threshold_w is None
    window = 2 * round(0.1 * short.time_unit / QUICK.dt) + 1
    assert f"no recording has the {window} samples ({window * QUICK.dt:g} s)" in found.reason
    assert found.recordings[0]["valid_s"] == 0.0
    residuals = residuals_stage(short)
    assert isinstance(residuals, Absent)
    assert "no recording is longer than" in residuals.reason
    said = monitor_results(short)
    assert said.alarms is None
    assert found.reason == said.reason
    assert said.details.recordings[1]["warm_up_s"] == pytest.approx(0.179)
    assert list(monitor_figures(short)) == []


def test_the_guard_copes_without_a_calibration(short):
    said = guard_results(short)
    assert "too little" in said.reason
    assert guard_tables(said) == []
    assert guard_words(said)[0].startswith("No detector could be learned")
    captions = [caption for *_, caption in guard_figures(short)]
    assert captions == [
        "The recording run0, of which test data come, by the monitor, which has no thresholds."
    ]
    artifact = load(short.out / "model")
    assert artifact.calibration.threshold_w is None
    assert artifact.rest_speed is None  # a detector that is learned later takes it from its own recordings
    with pytest.raises(
        InputError, match="holds no detector"
    ):  # what control --guard says before its first loop
        artifact.detector()


@pytest.mark.parametrize("stored", ["without thresholds", "none"])
def test_the_command_watches_with_an_artifact_without_calibration(short, tmp_path, monkeypatch, stored):
    model = shutil.copytree(short.out / "model", tmp_path / "model")
    if stored == "none":
        (model / ENERGY).unlink()
        (model / GUARD_FILE).unlink()
    write_csv(tmp_path / "long.csv", QUICK.recording(5, 900))
    monkeypatch.setattr("hybrid_mpc.scenario.scenario_of", lambda *given: short.scenario)
    done = CliRunner().invoke(
        app, ["monitor", str(model), str(tmp_path / "long.csv"), "--scenario", "axis",
              "--out", str(tmp_path / "out")],
    )  # fmt: skip
    assert done.exit_code == 0, done.output
    assert "the artifact holds no detector and no thresholds" in done.output
    warm_up = 2 * round(0.15 * short.time_unit / QUICK.dt) * QUICK.dt
    assert f"long: 0.9 s, 0 alarms; no valid reading for {warm_up:.2f} s warm-up" in done.output
