"""The loop itself, driven by hand: the order of a period, and what is remembered from one to the next."""

from dataclasses import replace

import casadi as ca
import numpy as np
import pytest
from closed_loop_parts import DT, Rig, ScriptedMonitor, hold, make_ekf, make_safe, run, sine
from monitor_parts import by_hand, energy, of_force
from online_models import PendulumPlant, pendulum_model

from hybrid_mpc import (
    OCP,
    CondensedController,
    Fault,
    Guard,
    InputError,
    Loop,
    Mode,
    SafeController,
    SoftBound,
    TrueState,
)

N = 30
X, U = ca.MX.sym("x", 2), ca.MX.sym("u")
POWER = ca.Function("power", [X, U], [U * X[1]])


def make_loop(model, safe, **options):
    options.setdefault("reference", sine)
    return Loop(options.pop("estimator", None) or make_ekf(model), safe, **options)


def drive(loop, rig=None, n=N, finish=lambda k: True, begun=False):
    """The loop that a user writes: ``(n, n_u)`` inputs."""
    rig = rig or Rig()
    if not begun:
        loop.start(rig.measure())
        rig.actuate(loop.decision.u)
        loop.finish()
        n -= 1
    for k in range(n):
        rig.actuate(loop.step(rig.measure()))
        if finish(k):
            loop.finish()
    return np.array(rig.u)


def monitored(model):
    return energy(model, by_hand(of_force(1e9), dt=model.dt))


def test_ten_lines_are_simulate(model, safe):
    loop = make_loop(model, safe, monitor=monitored(model))
    want = run(model, safe, monitor=monitored(model))
    np.testing.assert_array_equal(drive(loop), want.u)
    np.testing.assert_array_equal(loop.estimate.x, want.x_hat[-1])
    assert loop.reading.share == want.share[-1] > 0.0
    assert loop.t == want.t[-1]


def test_what_is_left_undone_the_next_step_does(model, safe):
    guard = Guard(limits=None, dwell=0.1, quiet=0.1)
    every, some = (make_loop(model, safe, monitor=ScriptedMonitor([(8, 10)]), guard=guard) for _ in range(2))
    np.testing.assert_array_equal(drive(every), drive(some, finish=lambda k: k % 3 == 0))
    some.finish()
    for name in ("k", "guard", "monitor", "inputs", "finished"):
        assert getattr(every.state, name) == getattr(some.state, name), name
    assert [s.after for s in every.switches] == [Mode.FALLBACK, Mode.NORMAL]


def test_a_missing_sample_is_none_or_nan(model, safe):
    gaps = (7, 8, 20)
    faults = [Fault(k * DT, (k + 1) * DT, "measurement_dropout") for k in gaps]
    want = run(model, safe, faults=faults)
    np.testing.assert_array_equal(drive(make_loop(model, safe), Rig(gaps=gaps)), want.u)


@pytest.mark.parametrize(
    "ocp",
    [
        OCP(9, (30.0, 1.0), [0.05], [0.05], [-6.0], [6.0], terminal=np.eye(2)),
        OCP(9, (30.0, 1.0), [0.05], [0.05], [-6.0], [6.0], terminal=np.eye(2), x_max=[0.3, 9.0],
            soft=[SoftBound(POWER, [-1.0], [1.0], [10.0], [10.0])]),
    ],
    ids=["plain", "soft bounds"],
)  # fmt: skip
@pytest.mark.parametrize("z", [0, 2])
def test_loops_that_share_their_parts_do_not_notice(ocp, z):
    """What is prepared for one lies untouched while the other goes on."""
    model = pendulum_model(z=z)
    safe, ekf = SafeController(CondensedController(model, ocp)), make_ekf(model)
    references = sine, hold
    alone = [drive(Loop(ekf, safe, reference=r), Rig(seed=i)) for i, r in enumerate(references)]
    loops, rigs = [Loop(ekf, safe, reference=r) for r in references], [Rig(seed=i) for i in range(2)]
    for k in range(N):
        for loop, rig in zip(loops, rigs, strict=True):
            y = rig.measure()
            rig.actuate(loop.step(y) if k else loop.start(y))
        for loop in loops:
            loop.finish()
    for rig, want in zip(rigs, alone, strict=True):
        np.testing.assert_array_equal(np.array(rig.u), want)


def test_it_goes_on_from_a_state(model, safe):
    guard = Guard(backup=make_safe(pendulum_model(), horizon=10), backup_estimator=make_ekf(pendulum_model()))
    options = {"monitor": ScriptedMonitor([(8, 40)]), "guard": guard}
    loop, rig = make_loop(model, safe, **options), Rig()
    drive(loop, rig, 12)
    state, at = loop.state, rig.state
    drive(loop, rig, 10, begun=True)
    again, second = make_loop(model, safe, **options), Rig()
    drive(Loop(make_ekf(model), safe, reference=hold), second, 12)  # so much noise has been drawn
    second.state = at
    u = again.restore(state)
    second.u[-1] = u
    np.testing.assert_array_equal(u, rig.u[11])
    np.testing.assert_array_equal(drive(again, second, 10, begun=True)[12:], np.array(rig.u)[12:])
    assert again.switches == loop.switches
    assert [s.after for s in loop.switches] == [Mode.BACKUP]


def test_the_input_that_acted_is_believed(model):
    """An actuator that saturates at 1: if it says so, the observer takes nothing of it for a load."""
    safe, goal = make_safe(model, horizon=10, bound=6.0), [0.6, 0.0]

    def estimate_load(reported):
        loop, rig = make_loop(model, safe, reference=goal), Rig()
        u = loop.start(rig.measure())
        for _ in range(40):
            acting = np.clip(u, -1.0, 1.0)
            rig.actuate(acting)
            u = loop.step(rig.measure(), applied=acting if reported else None)
        return loop.estimate.d[0]

    # the plant is heavier by 0.5 sin(0.6) and rubs 0.04 more than the model: 0.32 at most
    assert abs(estimate_load(True)) < 0.32
    # of the 5 that the limits of 6 promise and the actuator does not give
    assert abs(estimate_load(False)) > 4.0


def test_the_monitor_gets_the_input_that_acted(model, safe):
    seen = []

    class Noting(ScriptedMonitor):
        def update(self, state, y, u_prev, estimate):
            seen.append(u_prev.copy())
            return super().update(state, y, u_prev, estimate)

    loop, rig = make_loop(model, safe, monitor=Noting()), Rig()
    u, wanted, acted = loop.start(rig.measure()), [], []
    for _ in range(5):
        wanted.append(u)
        acted.append(np.clip(u, -0.1, 0.1))
        rig.actuate(acted[-1])
        u = loop.step(rig.measure(), applied=acted[-1])
    loop.finish()
    assert not np.array_equal(acted, wanted)
    np.testing.assert_array_equal(seen[1:], acted)  # the first is what acts before any sample


def test_manual_and_back_without_bump_or_wind_up(model):
    """An operator holds the pendulum for long; automatic then goes on from his input, at rest."""
    safe, ocp_du = make_safe(model, horizon=10, du_max=0.5), 0.5
    loop, rig = make_loop(model, safe, reference=hold), Rig(PendulumPlant(noise=0.0))
    drive(loop, rig, 150)
    steady, load = rig.u[-1].copy(), loop.estimate.d.copy()
    loop.mode = "manual"
    for _ in range(100):
        rig.actuate(steady)
        u = loop.step(rig.measure(), applied=steady)
        np.testing.assert_array_equal(u, steady)
        assert loop.decision.source.name == "MANUAL"
    np.testing.assert_allclose(loop.estimate.d, load, atol=0.02)  # nothing has wound up
    loop.mode = "automatic"
    first = loop.step(rig.measure())
    assert abs(first - steady).max() < 0.02  # of a range of 12: no bump
    # far away from the reference the limit of the input's change holds from the operator's input on
    loop.mode = "manual"
    away = steady - 1.5
    for _ in range(30):
        rig.actuate(away)
        loop.step(rig.measure(), applied=away)
    loop.mode = "automatic"
    first = loop.step(rig.measure(), applied=away)
    assert abs(first - away).max() <= ocp_du * (1 + 1e-9)
    assert loop.decision.source.name == "MPC"
    with pytest.raises(InputError, match="HM-LOOP-020"):
        loop.mode = "off"


def test_a_late_solve_is_dropped(model, safe):
    loop, rig = make_loop(model, safe), Rig()
    drive(loop, rig, 10)
    plan = loop.decision.solution.u[1]
    solved = loop.step(rig.measure())
    np.testing.assert_array_equal(loop.late(), plan)
    assert not np.array_equal(solved, plan)
    assert loop.decision.status.name == "LATE"
    loop.finish()
    assert loop.late() is loop.decision.u  # the input is out: nothing to drop


def test_skipped_periods_are_periods_without_a_sample(model, safe):
    loop, other = make_loop(model, safe), make_loop(model, safe)
    drive(loop, rig := Rig(), 10)
    drive(other, Rig(), 10)
    loop.skip(3)
    y, e = rig.measure(), other.estimate
    loop.step(y)
    for sample in (*[[np.nan]] * 3, y):
        e = make_ekf(model).update(e, np.asarray(sample), other.decision.u)
    np.testing.assert_array_equal(loop.estimate.x, e.x)
    assert loop.state.k == 13
    loop.skip(1000)  # so long that nothing is known any more
    loop.step(y)
    np.testing.assert_allclose(loop.estimate.x, [y[0], 0.0], atol=1e-12)
    with pytest.raises(InputError, match=r"skip.*HM-MODEL-025"):
        loop.skip(-1)


def test_a_reference_for_one_step(model, safe):
    goal = np.array([0.4, 0.0])
    by_function, by_step = (
        make_loop(model, safe, reference=hold),
        make_loop(model, safe, reference=[0.0, 0.0]),
    )
    rigs = Rig(), Rig()
    drive(by_function, rigs[0], 5)
    rigs[1].actuate(by_step.start(rigs[1].measure(), reference=goal))
    for _ in range(4):
        rigs[1].actuate(by_step.step(rigs[1].measure(), reference=goal))
    np.testing.assert_array_equal(rigs[0].u, rigs[1].u)


@pytest.mark.parametrize("bad", [np.nan, np.inf, -1e300])
def test_no_number_raises(model, safe, bad):
    loop, rig = make_loop(model, safe, monitor=monitored(model)), Rig()
    drive(loop, rig, 5)
    for given in ({"applied": [bad]}, {"reference": [bad, bad]}, {}):
        u = loop.step(rig.measure() if given else [bad], **given)
        assert np.isfinite(u).all()
        assert abs(u).max() <= 6.0
        loop.finish()
        assert np.isfinite(loop.late()).all()


def test_what_cannot_be_is_refused(model, safe):
    with pytest.raises(InputError, match="HM-LOOP-021"):
        make_loop(model, safe).step([0.0])
    with pytest.raises(InputError, match="HM-LOOP-019"):
        make_loop(model, safe, guard=Guard())
    with pytest.raises(InputError, match=r"reference \(states: phi .*HM-MODEL-019"):
        make_loop(model, safe, reference=[0.0])
    with pytest.raises(InputError, match=r"sensor_delay.*HM-MODEL-025"):
        make_loop(model, safe, sensor_delay=0.5)
    with pytest.raises(InputError, match="HM-LOOP-025"):
        make_loop(pendulum_model(), safe)
    with pytest.raises(InputError, match=r"0\.01.*HM-LOOP-026"):
        make_loop(replace(model, dt=0.01), safe)
    loop = make_loop(model, safe)
    loop.start([0.0])
    with pytest.raises(InputError, match=r"measured disturbances.*HM-MODEL-019"):
        loop.step([0.0], [1.0])
    with pytest.raises(InputError, match=r"the measurement.*HM-MODEL-019"):
        loop.step([0.0, 1.0])
    with pytest.raises(InputError, match=r"applied.*HM-MODEL-019"):
        loop.step([0.0], applied=[1.0, 2.0])
    oracle = make_loop(model, safe, estimator=TrueState(model))
    with pytest.raises(InputError, match="HM-LOOP-023"):
        oracle.start([0.0])
