"""Models whose input acts later: values, derivatives, many points at once, and what an artifact keeps of it."""

import json
from dataclasses import replace

import casadi as ca
import numpy as np
import pytest
from online_models import pendulum_model

from hybrid_mpc import InputError, load, save_artifact, with_input_delay
from hybrid_mpc.kit.parts import KIT
from hybrid_mpc.model.delay import MOST_DELAY_STATES

DT = 0.02


def step(model, x, h, u):
    return tuple(v.full().ravel() for v in model.step(x, h, u, model.w, model.p))


@pytest.mark.parametrize(("delay", "states"), [(0.4, 1), (1.0, 1), (1.6, 2), (2.0, 2)])
def test_the_input_of_a_period_is_the_mean_of_what_acts_in_it(delay, states):
    model = pendulum_model(z=3, dt=DT)
    late = with_input_delay(model, delay * DT)
    assert (late.delay_states, late.n_h) == (states, 3 + states)
    u = np.random.default_rng(0).normal(size=20)
    x, h = np.array([0.3, 0.0]), np.zeros(late.n_h)
    own_x, own_h = x, np.zeros(3)
    whole = int(delay)
    share = delay - whole
    past = np.concatenate([np.zeros(3), u])  # nothing was commanded before the start
    for k in range(20):
        acting = (1 - share) * past[3 + k - whole] + share * past[2 + k - whole]
        own_x, own_h = step(model, own_x, own_h, acting)
        x, h = step(late, x, h, u[k])
        # the same operations but for the rounding of one weighted sum
        np.testing.assert_allclose(
            np.concatenate([x, h[states:]]), np.concatenate([own_x, own_h]), atol=1e-13
        )


@pytest.mark.parametrize("delay", [0.4, 1.0, 1.6])
def test_its_jacobian_is_the_derivative_of_its_step(delay):
    late = with_input_delay(pendulum_model(z=3, dt=DT), delay * DT)
    x, h, u = ca.MX.sym("x", 2), ca.MX.sym("h", late.n_h), ca.MX.sym("u")
    after = ca.vertcat(*late.step(x, h, u, late.w, late.p))
    by_hand = ca.Function("j", [x, h, u], [ca.jacobian(after, ca.vertcat(x, h, u))])
    rng = np.random.default_rng(1)
    point = rng.normal(size=2), rng.normal(size=late.n_h), rng.normal(size=1)
    x_next, h_next, a, b = (v.full() for v in late.with_jacobian(*point, late.w, late.p))
    np.testing.assert_allclose(np.hstack([a, b]), by_hand(*point).full(), atol=1e-12)  # rounding
    np.testing.assert_allclose(
        np.vstack([x_next, h_next]).ravel(), np.concatenate(step(late, *point)), atol=1e-12
    )


def beside(model):
    """Many points of a model, one by one, with the blocks that are asked for."""
    columns = {"x": slice(0, 2), "h": slice(2, 2 + model.n_h), "u": slice(2 + model.n_h, None)}

    def make(n, blocks):
        def evaluate(*points):
            found = [[v.full() for v in model.with_jacobian(*point)] for point in zip(*points, strict=True)]
            every = np.stack([np.hstack(f[2:]) for f in found])
            slopes = [
                np.concatenate([every[:, :, columns[i]] for i in names], axis=2) for names in blocks.values()
            ]
            return *(np.stack([f[k].ravel() for f in found]) for k in (0, 1)), *slopes

        return evaluate

    return make


@pytest.mark.parametrize("delay", [0.4, 1.0, 1.6])
def test_many_points_at_once_are_the_points_one_by_one(delay):
    model = pendulum_model(z=3, dt=DT)
    late = with_input_delay(replace(model, side_by_side=beside(model)), delay * DT)
    rng, blocks = np.random.default_rng(2), {"A": ("x", "h"), "B": ("u",), "slopes": ("x", "u", "h")}
    points = [rng.normal(size=(5, n)) for n in (2, late.n_h, 1, 0, 0)]
    for given, one_by_one in zip(
        late.side_by_side(5, blocks)(*points), beside(late)(5, blocks)(*points), strict=True
    ):
        np.testing.assert_allclose(given, one_by_one, atol=1e-12)  # rounding


def test_what_cannot_be_is_refused():
    model = pendulum_model(dt=DT)
    for delay in (0.0, -0.01, np.nan):
        with pytest.raises(InputError, match="HM-MODEL-001"):
            with_input_delay(model, delay)
    with pytest.raises(InputError, match="HM-MODEL-003"):
        with_input_delay(with_input_delay(model, DT), DT)
    with pytest.raises(InputError, match="HM-MODEL-037"):
        replace(model, delay_states=1)


def test_a_delay_of_too_many_periods_is_refused_at_once():
    model = pendulum_model(dt=DT)
    for periods in (MOST_DELAY_STATES + 1, 1e9, 1e308):
        with pytest.raises(
            InputError,
            match=f"{MOST_DELAY_STATES}.*HM-MODEL-002",
        ):
            with_input_delay(model, periods * DT)
    assert with_input_delay(model, MOST_DELAY_STATES * DT).delay_states == MOST_DELAY_STATES


def test_an_artifact_keeps_the_delay(tmp_path):
    from hybrid_mpc import PriorStep, model_info, trace_model
    from scenarios.pendulum.prior import PendulumPrior

    prior = PendulumPrior()
    programs, info = {"prior": trace_model(PriorStep(prior, 0.01))}, model_info(prior, 0.01)
    for name, delay in (("none", 0.0), ("late", 0.0125), ("years", 1e9)):
        save_artifact(tmp_path / name, programs, replace(info, input_delay=delay))
    assert json.loads((tmp_path / "none" / KIT).read_text())["model"]["input_delay"] == 0.0
    at_once, late = (load(tmp_path / name).models["prior"] for name in ("none", "late"))
    assert (at_once.delay_states, late.delay_states) == (0, 2)
    x, u = np.array([0.2, 0.1]), np.array([4.0, 8.0, 9.0])  # the last one comes too late for this period
    np.testing.assert_array_equal(step(late, x, u[:2], u[2])[0], step(at_once, x, [], 0.25 * 4 + 0.75 * 8)[0])
    assert step(late, x, u[:2], u[2])[1].tolist() == [8.0, 9.0]
    with pytest.raises(InputError, match=r"1e\+09.*1e\+11.*0\.01.*HM-MODEL-002"):
        load(tmp_path / "years").models["prior"]
