"""A heavier mass on the torque pendulum, simulated: the monitor sees it, three seconds make the prior know it."""

import numpy as np
import pytest

from hybrid_mpc import (
    PriorStep,
    fit_smoother,
    make_estimator,
    make_monitor,
    model_info,
    replay,
    trace_model,
    write_csv,
)
from hybrid_mpc.identify.prior_result import PriorFit
from hybrid_mpc.kit.artifact import build_model
from hybrid_mpc.watch.learn import limits_of
from hybrid_mpc.watch.replay import with_alarms
from hybrid_mpc.workflow.benchmark import refitted
from hybrid_mpc.workflow.benchmark_runs import pieces, read_test, run_error, run_freely
from scenarios.torque_pendulum import scenario

OLD = {"J": 0.15, "mgl": 2.98, "d": 0.01, "F_c": 0.15, "phi_0": 0.0, "k_u": 0.83}
HEAVIER = {**OLD, "J": 0.15 * 1.27, "mgl": 2.98 * 1.28}
"""30 % more of the point mass at 0.5 m, in a pendulum whose rod has a tenth of the inertia and of the weight."""
STEP = 0.0029
"""Encoder [rad]."""


def recording(path, values, *, seed, seconds):
    """Swings under a torque of up to 0.9 N m; Runge-Kutta at 1 ms, friction sharper than the prior's."""
    rng, n = np.random.default_rng(seed), round(seconds / 0.02)
    t = 0.02 * np.arange(n)
    phase = rng.uniform(0, 2 * np.pi, 3)
    u = 0.3 * sum(np.sin(w * t + p) for w, p in zip((2.0, 4.1, 5.3), phase, strict=True))

    def rate(x, torque):
        friction = values["d"] * x[1] + values["F_c"] * np.tanh(x[1] / 0.05)
        return np.array(
            [x[1], (values["k_u"] * torque - values["mgl"] * np.sin(x[0]) - friction) / values["J"]]
        )

    x, phi = np.zeros(2), []
    for torque in u:
        phi.append(x[0])
        for _ in range(20):
            one = rate(x, torque)
            two = rate(x + 0.0005 * one, torque)
            x = x + 0.001 * two
    return write_csv(path, {"time_s": t, "tau_cmd_Nm": u, "pos_rad": STEP * np.round(np.array(phi) / STEP)})


@pytest.fixture(scope="module")
def machines(tmp_path_factory):
    """A recording of the machine as it was, one of the changed one, and the model of the first."""
    folder = tmp_path_factory.mktemp("mass")
    (before,) = read_test(scenario, recording(folder / "before.csv", OLD, seed=0, seconds=160.0))
    (after,) = read_test(scenario, recording(folder / "after.csv", HEAVIER, seed=1, seconds=10.0))
    smoother = fit_smoother(scenario.prior(OLD), pieces(before, 10.0), 0.02)
    known = PriorFit(OLD, {}, (), (), **smoother.smoother_settings)
    return before, after, known


def rmse(fit, trajectory):
    prior = scenario.prior(fit.values)
    runs = run_freely(prior, fit, {}, [trajectory], warm_up=scenario.data.warm_up, length=2.5)
    return run_error(runs, "phy", prior.outputs, scenario.benchmark).rmse["phi [rad]"]


@pytest.mark.full
def test_three_seconds_make_the_prior_know_the_heavier_mass(machines):
    before, after, old = machines
    new, rest = refitted(scenario.prior, old, after, seconds=3.0, dt=0.02)
    # the inertia stays at its data-sheet value, so torque and dry friction seem smaller by what it has grown, and
    # gravity hardly changes; in 3 s viscous friction is not told from the torque (it went to zero), hence a tenth
    assert new.values["k_u"] == pytest.approx(0.83 / 1.27, rel=0.1)
    assert new.values["F_c"] == pytest.approx(0.15 / 1.27, rel=0.1)
    assert new.values["mgl"] == pytest.approx(2.98 * 1.28 / 1.27, rel=0.05)
    assert rmse(old, before) < 0.01  # the old model on the old machine: a few steps of the encoder
    assert rmse(old, rest) > 0.05  # on the new one
    assert rmse(new, rest) < 0.03  # the project's promise
    assert rest.t[0] == pytest.approx(3.0)


@pytest.mark.full
def test_the_monitor_alarms_at_once_with_the_old_model(machines):
    before, after, _ = machines
    step = PriorStep(scenario.prior(OLD), 0.02).requires_grad_(False)
    info = model_info(step.prior, 0.02)
    model = build_model("prior", {f"prior/{n}": p for n, p in trace_model(step).items()}, info)
    sigma = np.array([1e-4, 2e-2])
    clean, changed = (
        replay(make_monitor(model), make_estimator(model, scenario, sigma), t) for t in (before, after)
    )
    limits = limits_of(
        make_monitor(model).readings, [before.y], [clean], false_alarms_per_hour=30.0, trusted=True
    )
    trace = with_alarms(make_monitor(model, limits), changed)
    first = trace.t[np.argmax(trace.alarm)]
    assert trace.alarm.any()
    assert first < 1.5  # s from standing still; forces are read half a window of 0.2 s late
