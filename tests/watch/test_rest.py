"""Rest speeds from recordings, and what the monitor reads at slow motion."""

import json
from dataclasses import replace
from pathlib import Path

import casadi as ca
import numpy as np
import pytest
from linear_axes import Axis
from monitor_parts import Estimate, Exact, Run, by_hand, energy, of_force

from hybrid_mpc import (
    HybridModel,
    InputError,
    Signal,
    WatchLimits,
    load_scenario,
    load_trajectories,
    make_monitor,
    replay,
    rest_speeds,
)
from hybrid_mpc.data.scales import noise_of, time_unit
from hybrid_mpc.records import plain, record
from hybrid_mpc.watch.lengths import NOTHING_STICKS

SHARED = Path(__file__).parents[3] / "shared" / "data"
FIVE_CM = Axis(0.01, mass=2.0, viscous=10.0, dry=0.1)
"""A linear axis of 5 cm: half a second from end to end, 0.25 m/s at most."""
PUSH = 0.5


@pytest.fixture(scope="module")
def strokes():
    """Ten seconds over the axis, with a sensor of 1 um."""
    return FIVE_CM.run(FIVE_CM.swings(1.2, 1000, size=2.0), step=1e-6)


def test_the_rest_speed_of_a_small_axis_is_a_twentieth_of_its_own(strokes):
    (rest,) = rest_speeds([strokes], FIVE_CM.model())
    top = np.quantile(np.abs(strokes.x[:, 1]), 0.99)
    assert 0.1 < top < 0.4
    assert rest == pytest.approx(0.05 * top, rel=0.05)  # what the window of 0.2 s flattens of 1 s swings


def test_of_a_slow_one_it_is_no_less_than_what_its_sensor_makes_of_standing():
    """1 mm/s, 60 s from end to end and back; resolution 1 um, then 0.1 mm."""
    t = 0.02 * np.arange(12_000)
    exact = np.column_stack(
        [6e-2 / (2 * np.pi) * np.sin(2 * np.pi * t / 60.0), 1e-3 * np.cos(2 * np.pi * t / 60.0)]
    )

    def measured(step):
        return Run(t, step * np.round(exact[:, :1] / step), 0 * t[:, None], exact)

    unit = time_unit([measured(1e-6)], 0.02)
    assert unit == pytest.approx(15.0, rel=0.1)  # so many times slower than 4 s
    fine, coarse = (rest_speeds([measured(s)], Axis(0.02, time_unit=unit).model())[0] for s in (1e-6, 1e-4))
    assert fine == pytest.approx(5e-5, rel=0.05)
    # of standing still over 3 s such a sensor makes speeds, three deviations of which are not passed
    standing = Run(
        t, measured(1e-4).y[:1] + 1e-4 * np.random.default_rng(0).choice([-0.5, 0.5], (12_000, 1)), 0, 0
    )
    readings = make_monitor(Axis(0.02, time_unit=unit).model(), rest_speed=coarse).readings
    noise = noise_of([standing])[0]
    assert coarse >= 5e-5
    assert noise * 0.25 < coarse < 1e-3  # far from the speed at work
    assert readings.rest_speed == (coarse,)


MACHINES = {
    "golf_robot": (0.15, 0.25), "pendulum": (0.3, 0.45), "torque_pendulum": (0.35, 0.55),
    "unbalanced_disk": (0.6, 0.75), "xl330_pendulum": (0.3, 0.5), "emps": (0.005, 0.0075),
}  # fmt: skip
"""Where the rule leads [rad/s, m/s]: golf robot to what it had; the carriage, 0.125 m/s at most, to 6 mm/s."""
FRICTION_SPEED = {"golf_robot": 0.02, "torque_pendulum": 0.1, "unbalanced_disk": 0.05,
                  "xl330_pendulum": 0.1, "emps": 2e-3}  # fmt: skip
"""Speeds over which the priors smooth their dry friction [rad/s, m/s]."""


@pytest.mark.parametrize("name", MACHINES)
def test_the_rule_is_right_on_all_machines(name, tmp_path):
    scenario = load_scenario(name)
    prior, folder = scenario.prior(), SHARED / name
    if name in ("golf_robot", "pendulum"):
        files = scenario.make_data(tmp_path, 0, "quick")
    elif folder.is_dir():
        files = sorted(p for p in folder.iterdir() if p.suffix in (".csv", ".npz", ".mat"))
    else:
        pytest.skip("the real recordings are not on this machine")
    data = load_trajectories(files, prior, scenario.data, needed=())
    known = [t for t in data.trajectories if t.role in ("train", "valid", "nominal")]
    (rest,) = rest_speeds(known, Axis(scenario.data.dt).model())
    low, high = MACHINES[name]
    assert low < rest < high
    # the smoothed step has risen to 99 % (tanh 2.65), so what is held at rest can be told
    if name in FRICTION_SPEED:
        assert rest > 2.65 * FRICTION_SPEED[name]


@pytest.mark.parametrize("dry", [0.0, 0.1])
@pytest.mark.parametrize("speed", [0.22, 0.02, 0.002, -0.002])
@pytest.mark.parametrize("push", [-PUSH, PUSH])
def test_a_push_at_any_speed_reads_as_what_it_is(strokes, dry, speed, push):
    """On the axis of 5 cm, rest speed 12 mm/s; nobody told the monitor of the push."""
    axis = Axis(0.01, mass=2.0, viscous=10.0, dry=dry)
    run = axis.cruise(speed, 60, push=push)
    monitor = energy(axis.model(), window=21, rest_speed=rest_speeds([strokes], FIVE_CM.model()))
    trace = replay(monitor, Exact(run), run)
    # below the rest speed dry friction may act either way: a push along the motion must exceed twice of it; from there
    # to twice the speed ever less so
    near = np.clip(2 - abs(speed) / monitor.readings.rest_speed[0], 0.0, 1.0)
    expected = PUSH - (2 * dry * near if push * speed > 0 else 0.0)
    # within its own step the model is slowed by less than dt d / 2 m = 2.5 % of what it lacks
    np.testing.assert_allclose(np.abs(trace.of("force of q"))[40:], expected, rtol=0.03)


@pytest.mark.parametrize(("pull", "excess"), [(0.09, 0.0), (-0.09, 0.0), (0.3, 0.2)])
def test_dry_friction_raises_nothing_at_rest(strokes, pull, excess):
    n = 80
    run = Run(0.01 * np.arange(n), np.zeros((n, 1)), np.full((n, 1), pull), np.zeros((n, 2)))
    monitor = energy(FIVE_CM.model(), window=21, rest_speed=rest_speeds([strokes], FIVE_CM.model()))
    # dry friction holds 0.1 N; the rest is what nobody holds
    np.testing.assert_allclose(
        np.abs(replay(monitor, Exact(run), run).of("force of q"))[40:], excess, atol=1e-6
    )


def test_every_consumer_takes_the_stored_value():
    force = of_force(9.0)
    limits = by_hand(
        type(force)("force of q", "N", 0, 9.0, 4.5, (1.0, 0, 0, 0)),
        dt=0.01,
        rest_speed=(0.003,),
        time_unit=2.0,
    )
    model = FIVE_CM.model()
    assert make_monitor(replace(model, time_unit=2.0), limits).readings.rest_speed == (0.003,)
    with pytest.raises(InputError, match=r"time.*HM-WATCH-008"):
        make_monitor(model, limits)
    assert record(WatchLimits, json.loads(json.dumps(plain(limits))), "") == limits
    # nobody gave one: no number of any unit stands for it, and nothing is taken to stick
    unknown = energy(model)
    assert unknown.readings.rest_speed == (NOTHING_STICKS,)
    pulled = Run(0.01 * np.arange(40), np.zeros((40, 1)), np.full((40, 1), 0.3), np.zeros((40, 2)))
    # dry friction of 0.1 N would hold a third of it; all of it counts
    np.testing.assert_allclose(
        np.abs(replay(unknown, Exact(pulled), pulled).of("force of q"))[10:], 0.3, atol=1e-6
    )


def test_bad_input_speaks(strokes):
    model = FIVE_CM.model()
    short = Run(strokes.t[:5], strokes.y[:5], strokes.u[:5], strokes.x[:5])
    with pytest.raises(InputError, match=r"21.*HM-WATCH-027"):
        rest_speeds([short], model)
    still = Run(strokes.t, 0 * strokes.y, strokes.u, 0 * strokes.x)
    with pytest.raises(InputError, match="HM-WATCH-028"):
        rest_speeds([still], model)
    with pytest.raises(InputError, match="HM-WATCH-029"):
        energy(model, rest_speed=[0.1, 0.1])


def two_joints(push=(0.0, 0.0)):
    """Two joints with coupled inertia: an angle with 0.2 N m of dry friction, and a slide with 0.1 N."""
    x, u, rate = ca.MX.sym("x", 4), ca.MX.sym("u", 2), ca.MX.sym("rate", 4)
    inertia = ca.DM([[2.0, 0.5], [0.5, 1.0]])

    def force(x):
        dry = ca.vertcat(0.2 * ca.tanh(x[2] / 1e-3), 0.1 * ca.tanh(x[3] / 1e-5))
        return u + ca.DM(push) - ca.DM([0.3, 5.0]) * x[2:] - dry

    def rhs(x):
        return ca.vertcat(x[2:], ca.solve(inertia, force(x)))

    names = [Signal("phi", "rad"), Signal("q", "m"), Signal("phi_dot", "rad/s"), Signal("v", "m/s")]
    return HybridModel.of(
        "joints", 0.02, tuple(names), (Signal("tau", "N m"), Signal("F", "N")), tuple(names[:2]),
        x=x, u=u, x_next=x + 0.02 * rhs(x), xdot=rhs(x), y=x[:2],
        rate=rate, energy=ca.dot(x[2:], inertia @ rate[2:] - force(x)),
    )  # fmt: skip


class Resting(Exact):
    """Knows that two joints stand."""

    def _at(self):
        return Estimate(self.run.x[self.k], np.zeros(0), np.zeros(2))

    def start(self, y, t):
        self.k = 0
        return self._at()

    def update(self, estimate, y, u_prev):
        self.k += 1
        return self._at()


@pytest.mark.parametrize(
    ("pull", "excess"), [((0.15, -0.08), (0.0, 0.0)), ((0.5, 0.0), (0.3, 0.0)), ((0.0, -0.3), (0.0, -0.2))]
)
def test_each_of_two_coupled_joints_has_a_rest_speed_and_a_dead_band_of_its_own(pull, excess):
    n = 60
    run = Run(0.02 * np.arange(n), np.zeros((n, 2)), np.tile(pull, (n, 1)), np.zeros((n, 4)))
    monitor = energy(two_joints(), window=11, rest_speed=[0.1, 1e-3])
    assert monitor.readings.rest_speed == (0.1, 1e-3)
    named = [(channel.name, channel.unit) for channel in monitor.readings.channels]
    assert named == [("violation", "W"), ("force of phi", "N m"), ("force of q", "N")]
    trace = replay(monitor, Resting(run), run)
    # the machine stands, so that what nobody holds is unexplained, with its sign
    np.testing.assert_allclose(trace.values[-1, 1:3], -np.array(excess), atol=1e-9)
