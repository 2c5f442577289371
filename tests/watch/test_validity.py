"""Time without a valid reading is reported: warm-up, missing samples, and readings that are no numbers."""

import json
from dataclasses import replace

import casadi as ca
import numpy as np
import pytest
from closed_loop_parts import DT as LOOP_DT
from closed_loop_parts import make_ekf, make_safe
from closed_loop_parts import run as closed_loop
from monitor_parts import DT, Exact, by_hand, energy, of_force, pendulum, simulate
from online_models import pendulum_model
from typer.testing import CliRunner

from hybrid_mpc import Fault, Guard, InputError, Mode, replay, write_csv
from hybrid_mpc.cli.main import app
from hybrid_mpc.model.model import step_symbols
from hybrid_mpc.watch.readings import Validity
from hybrid_mpc.watch.replay import with_alarms

WINDOW, AVERAGE = 5, 5
"""The window, and how long beyond it a reading may be missing: 0.1 s."""
NEVER = by_hand(of_force(1e9))


def monitor(model=None, limits=None):
    return energy(model, limits, window=WINDOW)


class Lost(Exact):
    """An estimator that gives no number from a sample on."""

    def __init__(self, run, at):
        super().__init__(run)
        self.at = at

    def update(self, estimate, y, u_prev):
        found = super().update(estimate, y, u_prev)
        return replace(found, x=np.full(2, np.nan)) if self.k >= self.at else found


def test_a_whole_recording_is_judged_but_for_the_warm_up():
    run = simulate(200)
    trace = replay(monitor(), Exact(run), run)
    assert trace.validity.tolist() == [Validity.WARM_UP] * (WINDOW - 1) + [Validity.VALID] * (201 - WINDOW)
    assert trace.coverage(DT) == pytest.approx(
        {"valid_s": 196 * DT, "warm_up_s": 4 * DT, "missing_s": 0.0, "not_finite_s": 0.0}
    )
    assert not trace.blind.any()


def test_an_estimator_that_gives_no_number_is_an_alarm_and_not_quiet():
    run = simulate(200)
    trace = replay(monitor(limits=NEVER), Lost(run, 100), run)
    # the estimate of sample 100 is that of the period after it
    assert (trace.validity[101:] == Validity.NOT_FINITE).all()
    assert (trace.validity[WINDOW - 1 : 101] == Validity.VALID).all()
    # longer than both windows: from the 11th sample without a valid reading on
    first = 101 + WINDOW + AVERAGE
    assert trace.intervals() == [(pytest.approx(first * DT), pytest.approx(199 * DT))]
    assert np.array_equal(with_alarms(monitor(limits=NEVER), trace).alarm, trace.alarm)


@pytest.mark.parametrize("broken", ["step", "xdot", "balances"])
def test_a_model_that_gives_no_number_is_an_alarm(broken):
    model = pendulum()
    (x, h, u, w, p), rate, no = step_symbols(model), ca.MX.sym("rate", 2), ca.MX(float("nan"))
    residual = ca.Function("e", [x, rate, u, w, p], [(rate[1] - u) * x[1] + 0 * no])
    functions = {
        "step": ca.Function("f", [x, h, u, w, p], [x * no, h]),
        "xdot": ca.Function("g", [x, h, u, w, p], [x * no]),  # asked near rest alone
        "balances": (replace(model.balances[0], residual=residual),),
    }
    run = simulate(100, kind="rest")
    trace = replay(monitor(replace(model, **{broken: functions[broken]})), Exact(run), run)
    assert (trace.validity[WINDOW - 1 :] == Validity.NOT_FINITE).all()
    assert trace.coverage(DT)["valid_s"] == 0.0
    assert trace.alarm[WINDOW + AVERAGE :].all()


def test_missing_samples_are_counted_and_alarm_where_they_last():
    run = simulate(300)
    y = run.y.copy()
    y[50], y[100:140] = np.nan, np.nan
    trace = replay(monitor(limits=NEVER), Exact(run), replace(run, y=y))
    missing = np.flatnonzero(trace.validity == Validity.MISSING)
    # a sample is gone until it has left the window
    assert missing.tolist() == [*range(50, 55), *range(100, 144)]
    assert np.flatnonzero(trace.blind).tolist() == list(range(100 + WINDOW + AVERAGE, 144))
    assert np.array_equal(trace.alarm, trace.blind)


def test_in_the_loop_a_blind_monitor_is_no_quiet_one():
    """The sensor is gone for a second: the guard hands over, and says why; then it goes back."""
    model, prior = pendulum_model(3), pendulum_model()
    gone = Fault(0.4, 1.0, "measurement_dropout")
    guard = Guard(backup=make_safe(prior), backup_estimator=make_ekf(prior), dwell=0.1, quiet=0.1)
    watching = energy(model)
    result = closed_loop(model, make_safe(model), guard=guard, monitor=watching, faults=(gone,), duration=1.6)
    assert [(s.before.name, s.after.name, s.why) for s in result.switches] == [
        ("NORMAL", "BACKUP", "the monitor has no valid reading"),
        ("BACKUP", "NORMAL", "no alarm for 0.1 s"),
    ]
    first, last = result.switches[0].t, result.switches[1].t
    # longer than its windows, then the next period
    assert first == pytest.approx(0.4 + (5 + 5 + 1) * LOOP_DT)
    assert 1.0 < last < 1.3
    dark = ~result.valid
    assert dark[:4].all()  # warm-up
    assert dark[round(0.4 / LOOP_DT) : round(1.0 / LOOP_DT)].all()
    assert result.valid.sum() == len(result.t) - 4 - (round(0.6 / LOOP_DT) + 4)
    # a guard that only records leaves the loop as it is, and the alarm stands in the record
    quiet = closed_loop(
        model, make_safe(model), guard=Guard(Mode.NORMAL, Mode.REST), monitor=watching, faults=(gone,), duration=1.6
    )  # fmt: skip
    assert quiet.switches == ()
    assert quiet.alarm.any()


@pytest.fixture(scope="module")
def recordings(tmp_path_factory):
    """Ten seconds and one of the golf robot's columns, and the filters' noise."""
    out = tmp_path_factory.mktemp("validity")
    for name, n in (("long", 500), ("short", 50), ("tiny", 8)):
        t = 0.02 * np.arange(n)
        phi = 0.3 * np.sin(2 * np.pi * 0.6 * t)
        write_csv(out / f"{name}.csv", {"time_s": t, "u_nm": 0.1 * np.sin(3 * t), "phi_rad": phi})
    return out


def command(recordings, model, out, *names):
    files = [str(recordings / f"{name}.csv") for name in names]
    options = ["--scenario", "golf_robot", "--out", str(out)]
    return CliRunner().invoke(app, ["monitor", str(model), *files, *options])


def diverging(folder):
    """An artifact whose network's correction is beyond all numbers."""
    import torch

    from hybrid_mpc import (
        HybridStep,
        LoopSettings,
        PriorStep,
        Scaling,
        model_info,
        n_features,
        save_artifact,
        trace_model,
    )
    from hybrid_mpc.identify.networks import StackedGRU
    from scenarios.golf_robot.prior import GolfRobotPrior

    prior = GolfRobotPrior()
    stack = StackedGRU(1, n_features(prior, True), 8, 1, seed=3)
    with torch.no_grad():
        stack.w_out.mul_(1e307)
    scaling = Scaling(x=(0.5, 1.5), u=(0.2,), rate=(5.0,), correction=(0.5,))
    steps = {"hybrid": HybridStep(prior, stack.member(0), scaling, 0.02), "prior": PriorStep(prior, 0.02)}
    programs = {name: trace_model(step.requires_grad_(False)) for name, step in steps.items()}
    loop = LoopSettings(process_noise={"hybrid_observer": (1e-4, 1e-2)})
    save_artifact(folder, programs, model_info(prior, 0.02), loop=loop)
    return folder


@pytest.mark.full
def test_the_command_fails_where_no_reading_is_valid(recordings, tmp_path):
    model = diverging(tmp_path / "model")
    done = command(recordings, model, tmp_path / "out", "long")
    assert done.exit_code == 1, done.output
    assert "long: 10.0 s, 1 alarm; NO VALID READING" in done.output
    assert "results of model or estimator are not finite" in done.output
    found = json.loads((tmp_path / "out" / "monitor.json").read_text())["recordings"][0]
    assert found["valid_s"] == 0.0
    assert found["not_finite_s"] > 9.0
    assert "non-finite value" in found["alarms"][0]["diagnosis"]


@pytest.mark.full
def test_a_recording_of_a_second_is_watched_and_the_replay_shows_how_far_it_is(
    recordings, noisy_artifact, tmp_path
):
    done = command(recordings, noisy_artifact, tmp_path / "out", "short", "long")
    assert done.exit_code == 0, done.output
    assert (
        "short: 1.0 s, 0 alarms; no valid reading for 0.20 s warm-up" in done.output
    )  # a window of 11 samples
    assert "replaying the recordings ..." in done.output
    header, first, *_ = (tmp_path / "out" / "short.csv").read_text().splitlines()
    assert header.endswith("phi_frozen,share,valid,alarm")
    assert first.endswith(",0,nan,0,0")


def test_one_too_short_for_any_window_is_refused_with_what_it_needs(recordings, noisy_artifact, tmp_path):
    done = command(recordings, noisy_artifact, tmp_path / "out", "tiny")
    assert isinstance(done.exception, InputError)
    assert "8 samples" in str(done.exception)
