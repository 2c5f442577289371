"""Stage watch on linear axes: limits are learned of slow ones, and where none can be, the run goes on."""

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
from hybrid_mpc.data.scales import Sizes
from hybrid_mpc.identify.prior_result import PriorFit
from hybrid_mpc.kit.parts import write_watch
from hybrid_mpc.workflow.context import Context
from hybrid_mpc.workflow.stages.export import NOISE, NoiseResult
from hybrid_mpc.workflow.stages.figures import _watch as watch_figures
from hybrid_mpc.workflow.stages.identify import PRIOR, PriorResult
from hybrid_mpc.workflow.stages.report import _watch_tables, _watch_words
from hybrid_mpc.workflow.stages.watch import WATCH, put_limits, watch_stage

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
    """A run that has come to stage watch: its model is the prior that made the recordings."""
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
    control = OCP(20, q=(1.0, 1.0), r=(1.0,), r_delta=(1.0,), u_min=(-2.0,), u_max=(2.0,))
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
    fit = PriorFit({}, {}, (), (), sigma=(), walk=(), sizes=Sizes((), (), (), ()))
    made.keep(PRIOR, {}, PriorResult(fit, {}, {}, {}, (), (), {}, "", {}, None, states))
    return made


@pytest.fixture(scope="module")
def slow(tmp_path_factory):
    run = context(SLOW, (1200, 900), tmp_path_factory.mktemp("slow"), warm_up=10.0)
    run.keep(WATCH, {}, watch_stage(run))
    return run


def test_limits_of_an_axis_of_millimetres_a_second_are_learned_kept_and_put_back(slow):
    found = slow.read(WATCH)
    assert (found.reason, found.kind) == ("", "energy")
    assert list(found.watch) == ["prior", "hybrid"]
    own = found.watch["hybrid"]
    assert set(own.limits) == {"energy", "residuals"}
    (rest,) = own.rest_speed
    top = max(np.abs(t.x[:, 1]).max() for t in slow.dataset.whole)
    assert top < 5e-3
    assert 0.03 * top < rest < 0.07 * top
    limits = own.limits["energy"]
    assert limits.rest_speed == (rest,)
    # what dry friction may hold is 0.1 N: a force that is always within the dead band would leave no scale
    assert 0 < np.sqrt(limits.of("force of q")[0].scale[0]) < 0.5
    # 17 min are too little for the slowest rate of so slow a machine
    assert not limits.rated
    assert "false alarms an hour need" in limits.method
    assert [one.channel for one in own.limits["residuals"].channels] == [
        "q", "q", "energy", "energy", "free run of q", "free run of q",
    ]  # fmt: skip
    assert found.faults is None  # there is no plant
    assert found.clean.alarms == 0  # thresholds are above the highest level of these very recordings
    assert found.clean.seconds > 0
    covered = found.recordings[0]
    assert covered.valid_s > 500
    assert covered.not_finite_s == covered.missing_s == 0.0
    kit = load(slow.out / "model")
    assert kit.models["hybrid"].time_unit == slow.time_unit > 5.0
    assert kit.rest_speed == (rest,)
    assert kit.monitor().limits == limits
    assert kit.monitor(kind="residuals").limits == own.limits["residuals"]
    write_watch(slow.out / "model", {})
    assert load(slow.out / "model").watch == {}
    assert put_limits(slow, found) == ""
    assert dict(load(slow.out / "model").watch) == dict(found.watch)


def test_the_report_says_what_limits_were_learned_from(slow):
    found = slow.read(WATCH)
    assert (found.kind, found.alarms, found.clean.alarms) == ("energy", (), 0)
    assert "1.5 x the highest nominal level" in _watch_words(found)[0]
    table, alarms = _watch_tables(found)
    assert [row[0] for row in table.rows] == [
        "force of q", "power of the free run", "q frozen", "all together",
    ]  # fmt: skip
    assert alarms.rows == []
    drawn = [name for _, name, _, _ in watch_figures(slow)]
    assert drawn == ["monitor_run0", "monitor_run1"]


@pytest.fixture(scope="module")
def short(tmp_path_factory):
    """Recordings of 0.18 s, whose parts are shorter than the guard's window; training needs 20 ms for each part."""
    run = context(QUICK, (180, 180), tmp_path_factory.mktemp("short"), warm_up=0.01)
    run.keep(WATCH, {}, watch_stage(run))
    return run


def test_recordings_shorter_than_the_windows_give_a_reason_and_the_run_goes_on(short):
    found = short.read(WATCH)
    assert found.limits is None
    window = 2 * round(0.1 * short.time_unit / QUICK.dt) + 1
    assert f"window of {window} samples ({window * QUICK.dt:g} s)" in found.reason
    assert "HM-WATCH-018" in found.reason
    assert found.limits is None
    assert list(watch_figures(short)) == []
    assert _watch_tables(found) == []
    assert _watch_words(found)[0].startswith("The monitor was not examined: no rest speeds")
    kit = load(short.out / "model")
    assert kit.rest_speed is None
    with pytest.raises(InputError, match="HM-WATCH-027"):
        kit.monitor()


@pytest.mark.parametrize("stored", ["without limits", "none"])
def test_the_command_watches_with_a_kit_without_limits(short, tmp_path, monkeypatch, stored):
    model = shutil.copytree(short.out / "model", tmp_path / "model")
    if stored == "none":
        (model / "watch" / "hybrid.json").unlink()
    write_csv(tmp_path / "long.csv", QUICK.recording(5, 900))
    monkeypatch.setattr("hybrid_mpc.scenario.scenario_of", lambda *given: short.scenario)
    done = CliRunner().invoke(
        app, ["monitor", str(model), str(tmp_path / "long.csv"), "--scenario", "axis",
              "--out", str(tmp_path / "out")],
    )  # fmt: skip
    assert done.exit_code == 0, done.output
    assert "the kit has no limits of energy" in done.output
    warm_up = 2 * round(0.1 * short.time_unit / QUICK.dt) * QUICK.dt
    assert f"long: 0.9 s, 0 alarms; no valid reading for {warm_up:.2f} s warm-up" in done.output
