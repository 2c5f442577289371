"""What a kit promises: each promise is shown on a good loop, and broken on purpose once, and the table says so."""

import re
import shutil
from dataclasses import replace
from time import thread_time

import casadi as ca
import numpy as np
import pytest

from hybrid_mpc import (
    OCP,
    CondensedController,
    Disturbance,
    ExtendedKalmanFilter,
    HybridModel,
    InputError,
    Kit,
    LoopSettings,
    Parameter,
    Promise,
    Provenance,
    Signal,
    Task,
    TrackedParameter,
    load,
    set_process_noise,
)
from hybrid_mpc.compare import promises as p
from hybrid_mpc.control.safeguard import SafeController
from hybrid_mpc.control.soft import HardBound
from hybrid_mpc.kit.promises import PROMISES, PromiseTable, read_promises, write_promises
from hybrid_mpc.workflow.stages.results import read_results

LEVEL, VALVE = Signal("level", "m", -5.0, 5.0), Signal("valve", "m/s", -1.0, 1.0)


def tank(a=0.9, b=0.1, dt=0.1, spread=1.0, **options):
    """``x_next = a x + b g u``: a tank with a leak, whose valve's gain a fit may move."""
    x, u, g = ca.MX.sym("x"), ca.MX.sym("u"), ca.MX.sym("g")
    nxt = a * x + b * g * u
    model = HybridModel.of(
        "tank", dt, (LEVEL,), (VALVE,), (LEVEL,), x=x, u=u, p=g, x_next=nxt, xdot=(nxt - x) / dt, y=x,
        parameters=(Parameter("g", 1.0, "-", 0.5, 2.0),), **options,
    )  # fmt: skip
    return replace(model, state_spread=(spread,))


def kit_of(model, problem=None, noise=0.002, sigma=0.01):
    """The kit of a prior alone."""
    problem = problem or OCP(20, [0.0], [0.0], [0.1], [-1.0], [1.0], q_y=[10.0])
    loop = LoopSettings(
        {"": problem}, (sigma,) * model.n_y, process_noise={"prior_observer": (noise,) * model.n_x},
        disturbance_model=model.disturbance_model,
    )  # fmt: skip
    return Kit({"prior": model}, None, Provenance("tank"), loop=loop, recommended="prior")


def hold(level=0.3, name="hold"):
    return Task(name, "Hold", 6.0, (0.0,), lambda t: np.full((len(t), 1), level))


def point_of(kit, task=None):
    (found,) = p.set_points(kit, [task or hold()])
    return found


def verdicts(rows):
    return {row.name: row.verdict for row in rows}


WHITE = p.Tested(0.1, 1.1, 500)


@pytest.fixture(scope="module")
def good():
    kit = kit_of(tank())
    end = p.TaskEnd("hold", (p.Deviation(LEVEL, 0.01, 0.002, 0.011),))
    return kit, p.examine(kit, [hold()], ends=(end,), where="on the plant", tested=WHITE)


def test_a_good_kit_promises_everything(good):
    assert verdicts(good[1]) == dict.fromkeys(
        (
            "no offset", "set-points of the tasks", "step time", "horizon", "stability margins", "late inputs",
            "limits", "process noise", "innovations", "disturbance model",
        ),
        "shown",
    )  # fmt: skip
    assert all(not row.remedy for row in good[1])


def test_a_kit_that_tracks_promises_its_tracking_loop_too(good):
    kit = good[0].with_tracked([TrackedParameter("g", 0.2, relative=True)])
    assert verdicts(p.examine_tracking(kit, [hold()])) == dict.fromkeys(
        (f"{name}, tracking" for name in ("no offset", "late inputs", "step time", "stability margins")),
        "shown",
    )
    assert p.examine_tracking(good[0], [hold()]) == ()
    # a gain that is taken to change at random within two periods: the input follows the noise of its estimate
    wild = good[0].with_tracked([TrackedParameter("g", 5.0, relative=True, time=0.2)])
    (point,) = p.set_points(wild, [hold()], tracking=True)
    assert p.margins([point]).verdict == "doubted"
    assert p.margins([point_of(wild)]).verdict == "shown"


def test_trials_are_on_wrong_models_with_loads_and_always_the_same(good):
    point = point_of(good[0])
    gains = [p.wrong_model(point.model, draw).p[0] for draw in range(8)]
    assert gains[0] == 1.0
    assert set(np.round(gains[1:], 12)) == {0.8, 1.2}
    # a fifth of the room from the input at 0.3 to the limit at -1, or 1, on the side that meets the load
    found = {round(abs(p.loads(point, draw)[0]), 6) for draw in range(8)}
    assert found == {0.26, 0.14}
    first, again = (p.trial(point, 1, 120) for _ in range(2))
    np.testing.assert_array_equal(first.result.y, again.result.y)
    assert not first.why
    # the true level, without noise, ends at the set-point: the load and the wrong gain are met
    assert np.abs(first.result.x[-40:, 0] - 0.3).max() < 0.01
    assert first.result.d[-1, 0] != pytest.approx(0.0, abs=0.05)


# No offset.


def no_offset_of(kit, task=None, draws=2):
    point = point_of(kit, task)
    trials = [p.trial(point, draw, p.LASTS * point.problem.horizon) for draw in range(draws)]
    return p.no_offset(point, trials)


def test_a_set_point_at_the_limit_of_the_input_is_no_longer_promised():
    found = no_offset_of(kit_of(tank()), hold(0.95), draws=8)
    assert found.verdict == "doubted"
    assert "valve is at its limit" in found.evidence
    assert re.search(r"level offset 0\.\d+ m \(noise 0\.01 m\)", found.evidence)


def test_a_weight_on_the_input_asks_for_an_offset():
    problem = OCP(20, [10.0], [10.0], [0.1], [-1.0], [1.0])
    found = no_offset_of(kit_of(tank(), problem), hold(0.6))
    assert found.verdict == "doubted"
    assert "weight r" in found.evidence
    assert no_offset_of(kit_of(tank(), problem.changed(r=[0.0])), hold(0.6)).verdict == "shown"


def test_an_observer_drowned_in_noise_is_slow_and_one_that_never_finds_a_load_cannot_be_made():
    bad = p.examine(kit_of(tank(), noise=3.0), [hold()], tested=WHITE)
    found = {row.name: row for row in bad}
    assert found["process noise"].verdict == "doubted"
    assert found["disturbance model"].verdict == "doubted"
    assert found["no offset"].verdict == "doubted"
    assert p.SLOW in found["no offset"].evidence
    assert "; a loop of" in found["no offset"].evidence
    for noise in (1e4, 7e16):  # as deployed once
        with pytest.raises(InputError, match="HM-KIT-013"):
            kit_of(tank(), noise=noise).observer()
    assert kit_of(tank(), noise=1e4).with_noise({"prior": [1e4]}).observer(load=False)


def test_a_disturbance_model_without_steps_does_not_move():
    point = point_of(kit_of(tank()))
    dead = ExtendedKalmanFilter(point.model, sigma_y=[0.01], sigma_x=[0.002], sigma_x0=[0.01])
    broken = replace(point, estimator=dead)
    trials = [p.trial(broken, draw, 120) for draw in range(2)]
    row = p.disturbance_model([broken], trials[:1])
    assert (row.verdict, "gain on it is zero" in row.evidence) == ("not promised", True)
    row = p.no_offset(broken, trials)
    assert (row.verdict, p.UNMOVED in row.evidence) == ("doubted", True)
    assert "process noise" in row.remedy


def test_ranks_that_lack_and_economic_costs_promise_nothing():
    x, u = ca.MX.sym("x", 2), ca.MX.sym("u")
    nxt = ca.vertcat(0.9 * x[0] + 0.1 * u, 0.8 * x[1] + 0.1 * u)
    pair = (Signal("left", "m", -5.0, 5.0), Signal("right", "m", -5.0, 5.0))
    model = HybridModel.of("two", 0.1, pair, (VALVE,), pair, x=x, u=u, x_next=nxt, xdot=(nxt - x) / 0.1, y=x)
    problem = OCP(20, [0.0, 0.0], [0.0], [0.1], [-1.0], [1.0], q_y=[1.0, 1.0])
    task = Task("hold", "Hold", 6.0, (0.0, 0.0), lambda t: np.full((len(t), 2), 0.1))
    found = no_offset_of(kit_of(model, problem), task, draws=1)
    assert found.verdict == "not promised"
    assert "2 outputs (left, right) are controlled by 1 input" in found.evidence
    level = ca.MX.sym("level")
    price = ca.Function("price", [level, u], [u])
    cheap = OCP(20, [0.0], [0.0], [0.1], [-1.0], [1.0], q_y=[10.0], economic=price)
    assert no_offset_of(kit_of(tank(), cheap), draws=1).verdict == "not promised"


@pytest.mark.parametrize(
    "where", [Disturbance("rate", "level", 0.5), Disturbance("output", "level", 0.2)], ids=["rate", "output"]
)
def test_loads_act_where_the_disturbance_model_says(where):
    kit = kit_of(tank(disturbance_model=(where,)))
    point = point_of(kit)
    size = 0.2 * where.size
    assert abs(p.loads(point, 0)[0]) == pytest.approx(size)
    found = p.trial(point, 0, 400)
    assert not found.why
    assert found.result.d[-50:, 0].mean() == pytest.approx(p.loads(point, 0)[0], abs=0.1 * size)


def failing(a, b, limit, level):
    problem = OCP(20, [0.0], [0.0], [0.1], [-limit], [limit], q_y=[10.0])
    point = point_of(kit_of(tank(a=a, b=b), problem), hold(level))
    trials = [p.trial(point, draw, 120) for draw in range(2)]
    return trials, p.failing_loop([point], [trials])


def test_a_loop_that_fails_is_one_row_with_the_cause():
    trials, row = failing(1.3, 0.1, 1.0, 0.5)  # the valve cannot hold the load
    assert (row.name, row.verdict) == ("closed loop", "not promised")
    assert "level is far outside its range" in row.evidence
    assert "inputs cannot compensate these loads" in row.remedy
    solved = sum(int(one.solved.sum()) for one in trials)
    assert 0 < solved < sum(len(one.solved) for one in trials)
    assert f"of {solved} steps" in p.step_time(trials, 100.0).evidence  # failed solves do not count
    _, row = failing(2.5, 0.3, 50.0, 0.0)  # errors grow by 2.5^20 over the horizon
    assert "8 periods" in row.remedy  # 3 ln 10 / ln 2.5 = 7.5
    assert failing(1.3, 0.1, 1.0, 0.0)[1] is None


def two_tanks(**options):
    """An upper tank with a valve, and a lower one that it feeds; both are measured, and at work at 1 m."""
    x, u, k = ca.MX.sym("x", 2), ca.MX.sym("u"), ca.MX.sym("k")
    nxt = ca.vertcat(0.9 * x[0] + 0.1 * u, 0.95 * x[1] + 0.05 * k * x[0])
    levels = tuple(replace(LEVEL, name=name) for name in ("upper", "lower"))
    valve = replace(VALVE, lower=0.0, upper=3.0)
    model = HybridModel.of(
        "tanks", 0.1, levels, (valve,), levels, x=x, u=u, p=k, x_next=nxt, xdot=(nxt - x) / 0.1, y=x,
        parameters=(Parameter("k", 1.0, "-", 0.5, 2.0),), nominal_x=(1.0, 1.0), nominal_u=(1.0,), **options,
    )  # fmt: skip
    return replace(model, state_spread=(1.0, 1.0))


TANKS = OCP(30, [0.0, 0.0], [0.0], [0.1], [0.0], [3.0], q_y=[0.0, 10.0])


def test_loads_at_other_states_are_doubted_if_rates_reject_them_better():
    """The load at the valve cannot represent one at the lower tank: 20 % of k is 0.1 m/s there."""
    chosen = (Disturbance("input", "valve"),)
    kit = kit_of(two_tanks(disturbance_model=chosen), TANKS)
    (point,) = p.set_points(kit, [])
    assert p._find_unrepresented(point) == {1: pytest.approx(0.2 * 0.05 / 0.1)}
    row = p.loads_elsewhere(kit, point)
    assert (row.name, row.verdict) == ("loads elsewhere", "doubted")
    times = float(re.search(r"squared error is (\S+) times", row.evidence)[1])
    declared = re.search(r'\("rate", "upper", ([^)]+)\), Disturbance\("rate", "lower", ([^)]+)\)', row.remedy)
    rates = tuple(Disturbance("rate", name, float(declared[i])) for i, name in ((1, "upper"), (2, "lower")))
    # what the row recommends does what it says
    other = kit.with_disturbances(rates)
    (better,) = p.set_points(other, [])
    loads = [p._load_rate(one, 1, 0.1) for one in (point, better)]
    found = p._mean_square(better, loads[1]) / p._mean_square(point, loads[0])
    assert found == pytest.approx(times, rel=0.1)
    assert found < 1.0 / p.GAINS
    assert p.loads_elsewhere(other, better) is None


def test_rates_that_the_noise_hides_are_no_remedy():
    """With process noise that explains every load no observer is possible; nothing is raised."""
    chosen = (Disturbance("input", "valve"),)
    kit = kit_of(two_tanks(disturbance_model=chosen), TANKS)
    (point,) = p.set_points(kit, [])
    row = p.loads_elsewhere(kit.with_noise({"prior_observer": (1e4, 1e4)}), point)
    assert row.verdict == "doubted"
    assert "leaves lower offset" in row.evidence
    assert "disturbance_model" not in row.remedy


def test_loads_that_the_disturbances_represent_have_no_row(good):
    assert p.loads_elsewhere(good[0], point_of(good[0])) is None
    states = OCP(30, [0.0, 10.0], [0.0], [0.1], [0.0], [3.0])
    kit = kit_of(two_tanks(), states)
    assert p.loads_elsewhere(kit, p.set_points(kit, [])[0]) is None


# Every other promise, broken once.


def test_the_error_of_the_run_s_own_hold_task_is_a_doubt():
    angle = Signal("angle", "deg")
    end = p.TaskEnd("hold", (p.Deviation(angle, 0.1, -4.4, 0.1),))
    row = p.tasks_end([end], "on the model hybrid, not the machine")
    assert row.verdict == "doubted"
    assert "hold: angle offset 4.4 deg (noise 0.1 deg)" in row.evidence
    swings = replace(end, deviations=(p.Deviation(angle, 0.1, 0.0, 2.0),))
    assert p.tasks_end([swings], "").verdict == "doubted"
    lost = replace(end, deviations=(p.Deviation(angle, 0.1, np.nan, np.nan),))
    assert "diverges" in p.tasks_end([lost], "").evidence
    assert p.tasks_end([], "").verdict == "not promised"


def test_the_end_of_a_task_is_that_of_its_measured_outputs():
    kit, n = kit_of(tank()), 60
    y = np.full((n, 1), 0.3)
    y[-20:] += 0.25
    end = p.task_end(kit, hold(), {"u": np.zeros((n, 1)), "y": y})
    assert end.deviations[0].offset == pytest.approx(0.25)
    moving = Task("ramp", "Ramp", 6.0, (0.0,), lambda t: t[:, None])
    assert p.task_end(kit, moving, {"u": np.zeros((n, 1)), "y": y}) is None


class Late(CondensedController):
    """It works for longer than a period of processor time in every step."""

    def finish(self, *given, **also):
        begin = thread_time()
        while thread_time() - begin < 1.2 * self.model.dt:
            pass
        return super().finish(*given, **also)


def falling(stiff):
    """A mass that falls away from rest, with ``k`` and ``g`` that a fit may move; its position is measured."""
    x, u, g, dt = ca.MX.sym("x", 2), ca.MX.sym("u"), ca.MX.sym("g", 2), 0.02
    rate = ca.vertcat(x[1], stiff * g[0] * x[0] + g[1] * u)
    nxt = x + dt * rate + 0.5 * dt**2 * ca.vertcat(rate[1], stiff * g[0] * x[1])
    q, v = Signal("q", "m", -1.0, 1.0), Signal("v", "m/s", -5.0, 5.0)
    model = HybridModel.of(
        "fall", dt, (q, v), (Signal("u", "m/s^2", -20.0, 20.0),), (q,), x=x, u=u, p=g, x_next=nxt, xdot=rate, y=x[0],
        parameters=tuple(Parameter(name, 1.0, "-", 0.5, 2.0) for name in "kg"),
    )  # fmt: skip
    return replace(model, state_spread=(0.2, 1.0))


def test_where_loops_do_not_settle_noise_at_the_inputs_is_named_if_it_helps():
    problem = OCP(50, [0.0, 0.0], [0.0], [1.0], [-20.0], [20.0], q_y=[400.0])
    kit = kit_of(falling(25.0), problem, noise=1e-4, sigma=1e-3)
    point = point_of(kit, Task("hold", "Hold", 4.0, (0.0, 0.0), lambda t: np.full((len(t), 1), 0.05)))
    periods = p.LASTS * problem.horizon
    trials = [p.trial(point, draw, periods) for draw in range(3)]
    row = p.no_offset(point, trials)
    assert row.verdict == "doubted"
    assert "input_noise=0.1" in p.advised(row, kit, [point], [trials]).remedy
    assert p.advised(row, kit, [point], [trials[:1]]) == row  # no loop of these is lost


def test_late_steps_are_no_promise():
    kit = kit_of(tank(dt=0.01))
    point = point_of(kit)
    slow = SafeController(Late(point.model, point.controller.controller.ocp), point.model)
    trials = [p.trial(replace(point, controller=slow), 0, 40)]
    row = p.step_time(trials, 10.0)
    assert row.verdict == "not promised"
    assert "the period is 10 ms" in row.evidence
    assert p.step_time(trials, 20.0).verdict == "doubted"  # more than half of it
    assert p.step_time(trials, 1000.0).verdict == "shown"


def test_a_horizon_shorter_than_the_slowest_mode_is_a_doubt():
    slow = tank(a=0.98, b=0.02)
    problem = OCP(5, [0.0], [0.0], [100.0], [-1.0], [1.0], q_y=[1.0])
    row = p.horizon([point_of(kit_of(slow, problem))])
    assert row.verdict == "doubted"
    assert re.search(r"the 5 periods \(0\.5 s\) contain \d+(\.\d+)? % of the cost", row.evidence)
    wanted = int(re.search(r"A horizon of (\d+) periods", row.remedy)[1])
    longer = p.horizon([point_of(kit_of(slow, problem.changed(horizon=wanted)))])
    assert longer.verdict == "shown"


def test_a_loop_with_small_margins_is_a_doubt():
    """An unstable lag under a controller that knows no limit of speed, with an observer that is slow."""
    wild = tank(a=2.5, b=0.3)
    problem = OCP(20, [0.0], [0.0], [1e-6], [-50.0], [50.0], q_y=[10.0])
    row = p.margins([point_of(kit_of(wild, problem, noise=1e-4, sigma=0.5), hold(0.0))])
    assert row.verdict == "doubted"
    assert "at valve" in row.evidence
    tame = point_of(kit_of(tank()), hold(0.0))  # a prior in whose place the network has other margins
    by_network = p.margins([point_of(kit_of(wild, problem, noise=1e-4, sigma=0.5), hold(0.0))], [tame])
    assert f"the distance is {p._margins_at(tame)[0][1].modulus:.2g}" in by_network.evidence
    assert (row.remedy, by_network.remedy) == (p.SOFTER, p.BY_NETWORK)
    stuck = p.margins([point_of(kit_of(tank(), OCP(20, [10.0], [0.0], [0.1], [0.0], [1.0])), hold(0.0))])
    assert (stuck.verdict, "lies on a bound" in stuck.evidence) == ("not promised", True)


def test_the_delay_that_the_recordings_show_is_part_of_the_margin():
    point = point_of(kit_of(tank()), hold(0.0))
    spare, dt = p._margins_at(point)[0][1].delay_periods, point.model.dt
    within, beyond = (p.margins([point], lacking_delay=share * dt) for share in (spare - 1, spare))
    assert (p.margins([point]).verdict, within.verdict, beyond.verdict) == ("shown", "shown", "doubted")
    assert f"({spare - 1:.1f})" in within.evidence


def test_inputs_that_act_as_late_as_the_recordings_show_are_a_doubt_if_the_loop_swings():
    kit = kit_of(tank())
    point = point_of(kit)
    shown = p.late_inputs(kit, point)
    assert (shown.verdict, shown.remedy) == ("shown", "")
    assert "level by 5 m" in shown.evidence
    assert "1 period late" in shown.evidence
    late = p.late_inputs(kit, point, lacking_s=0.3)
    assert late.verdict == "doubted"
    assert "3 periods late: level" in late.evidence
    assert late.evidence.endswith("inputs act 0.3 s later than in the prior")
    # the remedy's weights keep the promise
    (weight,) = re.findall(r"r_delta=\(([0-9.]+),\)", late.remedy)
    cautious = OCP(20, [0.0], [0.0], [float(weight)], [-1.0], [1.0], q_y=[10.0])
    with_weight = kit_of(tank(), cautious)
    slower = p.late_inputs(with_weight, point_of(with_weight), lacking_s=0.3)
    assert (slower.verdict, slower.remedy) == ("shown", "")
    assert "r_delta" not in p.late_inputs(kit, point, lacking_s=2.0).remedy  # no weight is large enough
    unstable = kit_of(tank(a=1.5), OCP(60, [0.0], [0.0], [0.1], [-1.0], [1.0], q_y=[10.0]))
    assert p.late_inputs(unstable, point_of(unstable)).verdict == "not promised"


def test_a_hard_bound_that_no_plan_keeps_is_a_doubt():
    escapes = tank(a=1.5)
    problem = OCP(
        10, [0.0], [0.0], [0.1], [-1.0], [1.0], q_y=[10.0], hard=[HardBound("x", [-1.0], [1.0])]
    )  # fmt: skip
    point = point_of(kit_of(escapes, problem), hold(0.0))
    assert [float(x[0]) for _, x in p.starts_near(point)] == pytest.approx([-0.95, 0.95])
    row = p.limits([point], [], {})
    assert row.verdict == "doubted"
    assert "level = 0.95 m the bound of level is relaxed" in row.evidence
    kept = point_of(kit_of(tank(), problem), hold(0.0))
    assert p.limits([kept], [], {}).verdict == "shown"
    told = p.limits([kept], [], {"hold": {"level": 0.02}})
    assert (told.verdict, "2 % of the periods" in told.evidence) == ("doubted", True)


@pytest.mark.parametrize(("beyond", "verdict"), [(0.03, "shown"), (0.2, "doubted")])
@pytest.mark.parametrize("label", ["level [m]", "output level [m]"])
def test_a_violation_of_a_soft_bound_beyond_the_noise_is_a_doubt(label, beyond, verdict):
    problem = OCP(20, [0.0], [0.0], [0.1], [-1.0], [1.0], q_y=[10.0], x_max=[0.5], y_max=[0.5])
    point = point_of(kit_of(tank(), problem))
    excess = {"step": {label: 0.001, "valve [m/s]": 9.0}, "hold": {label: beyond}}
    row = p.limits([point], [], {}, p.largest_violation(point, excess, "on the plant"))
    name = label.removesuffix(" [m]")
    assert f"{beyond} m of {name} in task hold on the plant (noise 0.01 m)" in row.evidence
    assert (row.verdict, bool(row.remedy)) == (verdict, verdict == "doubted")
    assert "no loop" in p.limits([point], [], {}, p.largest_violation(point, {})).evidence


def test_a_loop_that_leaves_its_ranges_gives_one_row_and_a_horizon_that_holds_it():
    """An unstable machine with a horizon over which errors grow 10^10 times: every solve fails."""
    unstable, weights = tank(a=1.5), ([0.0], [0.0], [0.1], [-1.0], [1.0])
    end = p.TaskEnd("hold", (p.Deviation(LEVEL, 0.01, 0.0, 0.01),))
    failing = p.examine(
        kit_of(unstable, OCP(60, *weights, q_y=[10.0])), [hold(0.0)], ends=(end,), tested=WHITE
    )
    found = {row.name: row for row in failing}
    assert found["closed loop"].verdict == "not promised"
    assert "first failed solve after 0 s" in found["closed loop"].evidence
    assert not {"no offset", "limits", "disturbance model", "set-points of the tasks"} & set(found)
    assert found["step time"].verdict == "not promised"
    (periods,) = re.findall(r"(\d+) periods", found["closed loop"].remedy)
    shorter = p.examine(kit_of(unstable, OCP(int(periods), *weights, q_y=[10.0])), [hold(0.0)], tested=WHITE)
    assert "closed loop" not in verdicts(shorter)
    assert verdicts(shorter)["limits"] == "shown"


def test_noise_beyond_the_spread_and_innovations_that_tell_of_each_other_are_doubts():
    assert p.process_noise(kit_of(tank(spread=0.001), noise=0.002)).verdict == "doubted"
    assert p.process_noise(kit_of(replace(tank(), state_spread=()))).verdict == "not promised"
    assert p.innovations(p.Tested(0.6, 1.0, 500)).verdict == "doubted"
    assert p.innovations(p.Tested(0.1, 9.0, 500)).verdict == "doubted"
    assert p.innovations("too short").verdict == "not promised"


def test_without_set_points_the_operating_point_is_examined():
    kit = kit_of(tank())
    moving = Task("ramp", "Ramp", 6.0, (0.0,), lambda t: 0.1 * t[:, None])
    assert point_of(kit, moving).reference.tolist() == [0.0]
    (alone,) = p.set_points(kit, [])
    assert alone.title == "the operating point"


# The table of a kit.


@pytest.fixture
def artifact(golf_artifact, tmp_path):
    folder = shutil.copytree(golf_artifact, tmp_path / "model")
    set_process_noise(folder, {"hybrid_observer": (1e-4, 2e-2)})
    return folder


ROW = Promise("step time", "doubted", "99 % of the steps take 19 ms", "Solver native.")


def test_a_kit_reads_its_table_and_says_where_it_does_not_fit(artifact):
    old = load(artifact)
    assert [row.verdict for row in old.promises] == ["not promised"]
    assert "contains no table" in old.promises[0].evidence
    write_promises(artifact, PromiseTable((ROW,), old.identity))
    kit = load(artifact)
    assert kit.promises == (ROW,)
    other = kit.with_noise({"hybrid_observer": (1e-3, 2e-2)})
    assert [row.name for row in other.promises] == ["promises"]
    set_process_noise(artifact, {"hybrid_observer": (1e-3, 2e-2)})
    assert "have changed since the table was made" in load(artifact).promises[0].evidence


@pytest.mark.parametrize(
    "change",
    [
        lambda text: text.replace("doubted", "shown"),
        lambda text: text[:-20],
        lambda text: text.replace('"schema_version": 1', '"schema_version": 2'),
    ],
    ids=["by hand", "cut", "version"],
)
def test_a_damaged_table_is_refused(artifact, change):
    write_promises(artifact, PromiseTable((ROW,), "x"))
    path = artifact / PROMISES
    path.write_text(change(path.read_text()))
    with pytest.raises(InputError, match=PROMISES):
        load(artifact)


def test_a_run_leaves_its_table_in_the_model_s_folder_on_the_page_and_on_the_terminal(finished):
    kit, results = load(finished), read_results(finished / "results.json")
    rows = kit.promises
    assert len(rows) >= 9
    assert results.promises.rows == rows
    assert read_promises(finished / "model").of == kit.identity
    page = (finished / "report.html").read_text()
    table, told = page.index("What this kit promises</h2>"), (finished.parent / "told.txt").read_text()
    assert table < page.index("Data</h2>")
    for row in rows:
        assert page.index(f"<td>{row.name}</td>") > table
        assert f"  {row.verdict:12}  {row.name}:" in told.replace("\n", " ").replace("  ", "  ")


def test_a_loop_that_lost_all_samples_keeps_nothing():
    lost = p.deviations((Signal("y", "m"),), (0,), np.array([0.1]), np.full((20, 1), np.nan))
    assert not lost[0].kept
