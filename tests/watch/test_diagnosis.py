"""What broke on any machine: parameters, an actuator and sensors of heated bodies, and what is none of these."""

from dataclasses import replace

import casadi as ca
import numpy as np
import pytest
from machines import MachinePlant
from online_models import rk4

from hybrid_mpc import (
    Diagnoser,
    ExtendedKalmanFilter,
    HybridModel,
    InputError,
    Monitor,
    Parameter,
    ResidualReadings,
    Signal,
    learn_limits,
    replay,
)
from hybrid_mpc.data.trajectories import Trajectory
from hybrid_mpc.watch.diagnose import Window

SIGMA, START = 0.02, 250
"""Deviation of the sensors [K], and the sample from which on something is broken."""


def bodies(gain=0.05, loss=0.04, shift=0.0):
    """Two bodies, of which the first is heated; both temperatures are measured, and that of the room."""
    x, u, w, p = ca.SX.sym("x", 2), ca.SX.sym("u", 1), ca.SX.sym("w", 1), ca.SX.sym("p", 2)

    def rates(z):
        across = 0.05 * (z[0] - z[1])
        return ca.vertcat(p[0] * u[0] - across, across - p[1] * (z[1] - w[0]) + shift)

    states = Signal("hot", "degC"), Signal("cold", "degC")
    own = Parameter("gain", 0.05, "K/s/W", 0.02, 0.2), Parameter("loss", 0.04, "1/s", 0.01, 0.1)
    made = HybridModel.of(
        "bodies", 2.0, states, (Signal("power", "W"),), states, x=x, u=u, w=w, p=p, x_next=rk4(rates, x, 2.0),
        xdot=rates(x), y=x, disturbances=(Signal("room", "degC"),), nominal_w=(20.0,), parameters=own,
        nominal_x=(76.25, 51.25), nominal_u=(25.0,),
    )  # fmt: skip
    values = (gain, loss)
    return replace(made, parameters=tuple(replace(q, value=v) for q, v in zip(own, values, strict=True)))


def observer(model):
    return ExtendedKalmanFilter(
        model, sigma_y=[SIGMA] * 2, sigma_x=[0.02] * 2, sigma_x0=[SIGMA] * 2, sigma_d=[0.02], sigma_d0=[0.1]
    )


def recording(n, seed, *, broken=None, sensor=(0.0, 0.0), actuator=(1.0, 0.0), room=20.0):
    """Steps of the power; from ``START`` on another model, offsets of the sensors, gain and offset of the actuator."""
    rng, sound = np.random.default_rng(seed), MachinePlant(bodies(), sigma=SIGMA)
    faulty = MachinePlant(broken or bodies(), sigma=SIGMA)
    x, u = np.array([76.25, 51.25]), np.array([25.0])
    y, us, w = np.empty((n, 2)), np.empty((n, 1)), np.full((n, 1), 20.0)
    for k in range(n):
        late = k >= START
        if k % 15 == 0:
            u = rng.uniform(15.0, 35.0, 1)
        w[k] = room if late else 20.0 + 0.2 * np.sin(k / 40)
        y[k] = sound.measure(x, rng) + late * np.array(sensor)
        us[k] = u
        acting = actuator[0] * u + actuator[1] if late else u
        x = (faulty if late else sound).step(x, acting, 2.0, w[k])
    zero = np.zeros((n, 2))
    return Trajectory("run", "", 2.0, 2.0 * np.arange(n), us, y, zero, zero, w)


@pytest.fixture(scope="module")
def limits():
    model = bodies()
    return learn_limits(ResidualReadings(model), observer(model), [recording(1500, seed) for seed in (0, 1)])


def seen(limits, **fault):
    model = bodies()
    monitor, run, estimates = Monitor(ResidualReadings(model), limits), recording(400, 7, **fault), []
    trace = replay(monitor, observer(model), run, on_sample=lambda k, e: estimates.append(e))
    assert not trace.alarm[:START].any()
    (k, *_) = np.flatnonzero(trace.alarm)
    return Diagnoser(model, limits).of_alarm(int(k), trace, run, estimates), int(k)


@pytest.mark.parametrize(
    ("fault", "name", "low", "high"),
    [
        ({"sensor": (0.0, 1.0)}, "offset of cold", 0.8, 1.2),
        ({"sensor": (-1.0, 0.0)}, "offset of hot", -1.2, -0.8),
        ({"actuator": (1.0, -5.0)}, "offset of power", -6.0, -4.0),
        ({"actuator": (0.7, 0.0)}, "gain of power", -36.0, -24.0),
        ({"broken": bodies(loss=0.052)}, "loss", 20.0, 40.0),
    ],
)
def test_what_breaks_is_found_and_named(limits, fault, name, low, high):
    """Sizes within a fifth: the onset is taken from a few candidates, and the first samples after it show the least."""
    text, k = seen(limits, **fault)
    assert START <= k <= START + 30
    sizes = {part.rsplit(" ", 4)[0]: part for part in text.split(", which")[0].split(" or ")}
    (found,) = (part for part in sizes.values() if part.startswith(f"{name} "))
    assert low <= float(found[len(name) :].split()[0]) <= high, text


def test_two_sensors_at_once_are_both_named(limits):
    text, _ = seen(limits, sensor=(1.5, -1.5))
    assert " and " in text
    assert "of hot" in text
    assert "of cold" in text


def test_a_measured_disturbance_out_of_its_range_is_named_and_breaks_nothing(limits):
    text, k = seen(limits, room=28.0)
    assert text == "room is outside its range in the nominal data"
    assert k <= START + 5


def test_something_else_is_not_taken_for_a_known_cause(limits):
    """A sensor that swings is neither an offset nor a gain."""
    model, run = bodies(), recording(400, 7)
    run.y[START:, 1] += 1.5 * np.sign(np.sin(np.arange(400 - START) * 1.3))
    estimates = []
    trace = replay(
        Monitor(ResidualReadings(model), limits),
        observer(model),
        run,
        on_sample=lambda k, e: estimates.append(e),
    )
    (k, *_) = np.flatnonzero(trace.alarm)
    assert Diagnoser(model, limits).of_alarm(int(k), trace, run, estimates).startswith("none of the known")


def test_samples_within_an_average_are_no_independent_evidence(limits):
    model, run, start = bodies(), recording(START + 60, 7, sensor=(0.0, 1.0)), START - 60
    # the truth at the start is not known to the test, but a fit of the first state finds it
    window = Window(
        run.y[start:], run.u[start:], run.w[start:], run.y[start], np.zeros(0), np.zeros(model.n_d), 60
    )
    sigma = {}
    for short in (2, 8):
        diagnoser = Diagnoser(model, limits)
        diagnoser.short = short
        (change,) = diagnoser.diagnose(window).causes
        assert change.name == "offset of cold"
        sigma[short] = change.sigma
    # of 120 samples 60 and 15 are independent; the size of the change takes one
    assert sigma[8] / sigma[2] == pytest.approx(np.sqrt((60 - 1) / (15 - 1)), rel=1e-6)


def test_groups_of_parameters_and_strange_ones(limits):
    model = bodies()
    together = Diagnoser(model, limits, {"machine": ("gain", "loss"), "drive": ("gain of power",)})
    assert together.names[:3] == ("machine", "gain of power", "offset of power")
    with pytest.raises(InputError, match=r"'mass'.*gain, loss.*HM-MODEL-032"):
        Diagnoser(model, limits, {"heavier": ("mass",)})
