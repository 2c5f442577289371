"""The interface of every deployed model: shapes are checked, disturbances and parameters are inputs as any other."""

from dataclasses import replace

import casadi as ca
import numpy as np
import pytest
from online_models import pendulum_model

from hybrid_mpc import (
    OCP,
    CondensedController,
    ExtendedKalmanFilter,
    HybridModel,
    InputError,
    IpoptController,
    Parameter,
    Signal,
    TrueState,
    longer_period,
    with_input_delay,
)
from hybrid_mpc.model.model import Balance, prior_acceleration, step_symbols
from hybrid_mpc.model.stages import Stages, VectorisedStages

DT = 0.1
STATES = Signal("q", "m"), Signal("v", "m/s")
WIND, MASS = Signal("wind", "N"), Parameter("m", 2.0, "kg", 1.0, 4.0)


def sled(kind=ca.MX, nominal_w=(0.5,)) -> HybridModel:
    """A mass that force and wind push; its hidden state counts periods, its output is shifted by the wind."""
    x, h, u, w, p = (kind.sym(name, n) for name, n in zip("xhuwp", (2, 1, 1, 1, 1), strict=True))
    rate, a = kind.sym("rate", 2), (u + w) / p
    return HybridModel.of(
        "sled", DT, STATES, (Signal("F", "N"),), STATES[:1],
        x=x, h=h, u=u, w=w, p=p, x_next=ca.vertcat(x[0] + DT * x[1], x[1] + DT * a), h_next=h + 1,
        xdot=ca.vertcat(x[1], a), y=x[0] + 0.01 * w, rate=rate, energy=(p * rate[1] - u - w) * x[1],
        disturbances=(WIND,), nominal_w=nominal_w, parameters=(MASS,),
    )  # fmt: skip


@pytest.mark.parametrize("kind", [ca.MX, ca.SX])
def test_disturbances_and_parameters_are_inputs_of_everything(kind):
    model = sled(kind)
    assert (model.n_x, model.n_h, model.n_u, model.n_y, model.n_w, model.n_p) == (2, 1, 1, 1, 1, 1)
    assert (model.w.tolist(), model.p.tolist()) == ([0.5], [2.0])
    x_next, h_next = model.step([1.0, 2.0], 3.0, 1.5, model.w, model.p)
    assert (x_next.full().ravel().tolist(), float(h_next)) == ([1.2, 2.1], 4.0)
    assert model.step([1.0, 2.0], 3.0, 1.5, -1.5, 4.0)[0].full().ravel().tolist() == [1.2, 2.0]
    assert float(model.output([1.0, 2.0], 0.0, -1.0, 4.0)) == pytest.approx(0.99)
    point = [1.0, 2.0], 3.0, 1.5, 0.5, 4.0
    a, b = model.with_jacobian(*point)[2:]
    np.testing.assert_allclose(a.full(), [[1, 0.1, 0], [0, 1, 0], [0, 0, 1]])
    np.testing.assert_allclose(b.full(), [[0], [0.1 / 4], [0]])
    rate = model.xdot(*point)
    assert float(model.balances[0].residual([1.0, 2.0], rate, 1.5, 0.5, 4.0)) == pytest.approx(0.0)
    assert float(model.balances[0].residual([1.0, 2.0], rate, 1.5, 0.5, 2.0)) == pytest.approx(-2.0)
    assert (model.balances[0].name, model.balances[0].rate_unit) == ("energy", "W")


def test_a_longer_period_and_a_late_input_hand_them_on():
    model, point = sled(), ([1.0, 2.0], [3.0], [1.5], [-0.5], [4.0])
    x, h = point[:2]
    for _ in range(3):
        x, h = model.step(x, h, *point[2:])
    slow, late = longer_period(model, 3), with_input_delay(model, DT)
    for found in (slow.step(*point), slow.with_jacobian(*point)[:2]):
        np.testing.assert_allclose(np.vstack([m.full() for m in found]), np.vstack([x.full(), h.full()]))
    delayed = late.step([1.0, 2.0], [1.5, 3.0], [9.0], *point[3:])
    np.testing.assert_allclose(delayed[0].full(), model.step(*point)[0].full())
    np.testing.assert_allclose(
        late.xdot([1.0, 2.0], [9.0, 3.0], *point[2:]).full(), model.xdot(*point).full()
    )
    assert (slow.w, slow.p, late.w, late.p) == (model.w, model.p, model.w, model.p)


def test_what_has_no_disturbance_of_its_own_takes_the_usual_one():
    """Estimators, controllers and their linearizations of the model are those of one with the numbers inside."""
    model = sled()
    point = step_symbols(model)
    x, h, u = point[:3]
    x_next, h_next = model.step(x, h, u, model.w, model.p)
    inside = HybridModel.of(
        "inside", DT, STATES, model.inputs, STATES[:1], x=x, h=h, u=u, x_next=x_next, h_next=h_next,
        xdot=model.xdot(x, h, u, model.w, model.p), y=model.output(x, u, model.w, model.p),
    )  # fmt: skip
    estimates, plans, runs = [], [], []
    ocp = OCP(5, [10.0, 1.0], [0.1], [0.0], [-4.0], [4.0], terminal=np.eye(2))
    z, inputs = np.tile([1.0, 2.0, 3.0], (5, 1)), np.linspace(-1, 1, 5)[:, None]
    for m in (model, inside):
        ekf = ExtendedKalmanFilter(m, sigma_y=[0.1], sigma_x=[0.1, 0.1], sigma_x0=[0.1, 0.1])
        estimates.append(ekf.update(ekf.start([1.0]), [1.2], [0.3]))
        known = TrueState(m).start([1.0, 2.0, 0.0])
        for solver in (CondensedController(m, ocp), IpoptController(m, ocp)):
            plans.append(solver.solve(solver.initial(known), known, np.zeros((1, 2))).u)
        acting = m.acting(inputs, np.zeros(1), m.w)
        runs += [Stages(m, 5).run(z[0], acting), *Stages(m, 5).at(z, acting)]
    np.testing.assert_allclose(estimates[0].x, estimates[1].x, rtol=1e-12)
    np.testing.assert_allclose(plans[0], plans[2], atol=1e-9)
    np.testing.assert_allclose(plans[1], plans[3], atol=1e-6)
    for found, wanted in zip(runs[:4], runs[4:], strict=True):
        np.testing.assert_allclose(found, wanted, rtol=1e-12)
    asked = []

    def beside(n, blocks):
        def evaluate(*points):
            asked.append([p.shape for p in points] + [points[3][-1, 0], points[4][-1, 0]])
            rows = [[v.full() for v in model.with_jacobian(*row)] for row in zip(*points, strict=True)]
            return tuple(np.stack([np.squeeze(r[k]) if k < 2 else r[k] for r in rows]).reshape(n, *shape)
                         for k, shape in enumerate(((2,), (1,), (3, 3), (3, 1))))  # fmt: skip

        return evaluate

    acting = model.acting(inputs, np.zeros(1), model.w)
    many = VectorisedStages(replace(model, side_by_side=beside), 5).at(z, acting)
    assert asked == [[(5, 2), (5, 1), (5, 1), (5, 1), (5, 1), 0.5, 2.0]]
    np.testing.assert_allclose(many[0], runs[1], rtol=1e-12)


def test_what_does_not_fit_is_refused():
    model = sled()
    x, h, u = step_symbols(model)[:3]
    bare = ca.Function("step", [x, h, u], list(model.step(x, h, u, model.w, model.p)))
    with pytest.raises(InputError, match=r"sled.*step.*\[\(2, 1\), \(1, 1\), \(1, 1\)\].*HM-MODEL-038"):
        replace(model, step=bare, with_jacobian=None)
    with pytest.raises(InputError, match=r"nominal_w.*HM-MODEL-033"):
        sled(nominal_w=(0.1, 0.2))
    assert sled(nominal_w=()).w.tolist() == [0.0]
    with pytest.raises(InputError, match="HM-MODEL-035"):
        replace(model, covariance=((1.0, 0.0), (0.0, 1.0)))
    with pytest.raises(InputError, match=r"balances.*energy, energy.*HM-MODEL-036"):
        replace(model, balances=2 * model.balances)
    silent = Balance("heat", "J", "W", ca.Function("r", [x, u], [x[0]]))
    with pytest.raises(InputError, match=r"balance heat.*HM-MODEL-038"):
        replace(model, balances=(silent,))
    given = {"x": ca.MX.sym("s"), "u": u, "x_next": u, "xdot": u, "y": u}
    for changed in ({"xdot": ca.MX.sym("stranger")}, {"x": x[0]}):
        with pytest.raises(InputError, match="HM-MODEL-027"):
            HybridModel.of("odd", DT, STATES[:1], model.inputs, STATES[:1], **(given | changed))


def test_the_acceleration_of_the_prior_behind_a_model():
    model = replace(sled(), name="hybrid")
    x, u = ca.MX.sym("x", 2), ca.MX.sym("u")
    p, w = ca.MX.sym("p"), ca.MX.sym("w")
    prior = HybridModel.of(
        "prior", DT, STATES, model.inputs, STATES[:1], x=x, u=u, w=w, p=p, x_next=x,
        xdot=ca.vertcat(x[1], u / p - x[0]), y=x[0], disturbances=(WIND,), parameters=(MASS,),
    )  # fmt: skip
    assert float(prior_acceleration(model, prior)([0.5, 1.0], 3.0, 0.0, 1.5)) == 1.5
    assert float(prior_acceleration(prior)([0.5, 1.0], 3.0, 0.0, 1.5)) == 1.5
    late = with_input_delay(prior, DT)  # it takes the input that acts
    assert float(prior_acceleration(late)([0.5, 1.0], 3.0, 0.0, 1.5)) == 1.5
    with pytest.raises(InputError, match=r"hybrid.*HM-MODEL-029"):
        prior_acceleration(model)
    with pytest.raises(InputError, match="HM-MODEL-030"):
        prior_acceleration(pendulum_model())
