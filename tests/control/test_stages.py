"""The model along a horizon, in CasADi's machine and compiled."""

import shutil
from dataclasses import replace
from functools import cache

import numpy as np
import pytest
import torch
from control_parts import estimate_of, pendulum_problem, plan_of
from online_models import pendulum_model

from hybrid_mpc import (
    CondensedController,
    GRUNetwork,
    HybridStep,
    InputError,
    PriorStep,
    Scaling,
    SQPController,
    model_info,
    n_features,
    trace_model,
)
from hybrid_mpc.control.rti import Condenser, adjoint, propagate
from hybrid_mpc.kit.artifact import build_model
from hybrid_mpc.model.stages import Stages, VectorisedStages, stages
from scenarios.golf_robot import scenario

OCP_ = pendulum_problem(8)


def test_a_run_is_the_models_own_with_the_jacobians_along_it():
    model, rng = pendulum_model(z=3), np.random.default_rng(0)
    stages, z0, u = Stages(model, 6), rng.normal(size=5), rng.normal(size=(6, 1))
    z = stages.run(z0, u)
    z_next, a_t, b = stages.at(z[:-1], u)
    for k in range(6):
        x, h, a, by_u = (m.full() for m in model.with_jacobian(z[k, :2], z[k, 2:], u[k], model.w, model.p))
        np.testing.assert_allclose(z[k + 1], np.vstack([x, h]).ravel(), rtol=1e-14, atol=1e-15)
        np.testing.assert_allclose(a_t[k].T, a, rtol=1e-13, atol=1e-14)
        np.testing.assert_allclose(b[k], by_u, rtol=1e-13, atol=1e-14)
    # Values of the Jacobian's function and of the step alone: the same operations, perhaps in another order.
    np.testing.assert_allclose(z_next, z[1:], rtol=1e-14, atol=1e-15)


@cache
def golf_robot(z):
    """The golf robot's model as it is loaded from an artifact: the hybrid, or with z = 0 the prior alone."""
    torch.manual_seed(z)
    prior, dt = scenario.prior(), scenario.data.dt
    step = PriorStep(prior, dt)
    if z:
        scaling = Scaling(x=(0.5, 1.5), u=(0.2,), rate=(5.0,), correction=(0.5,))
        step = HybridStep(prior, GRUNetwork(n_features(prior, True), z, prior.n_q), scaling, dt)
    program = trace_model(step.requires_grad_(False))
    return build_model("m", {f"m/{name}": p for name, p in program.items()}, model_info(prior, dt))


@pytest.mark.parametrize("z", [0, 1, 6])
def test_all_periods_at_once_are_as_one_after_the_other(z):
    model, rng, n = golf_robot(z), np.random.default_rng(z), 7
    at_once, mapped = stages(model, n), Stages(model, n)
    assert isinstance(at_once, VectorisedStages)
    for size in (0.1, 1.0, 30.0):
        states, u = size * rng.normal(size=(2 * n, 2 + z)), size * rng.normal(size=(2 * n, 1))
        pairs = [
            *zip(at_once.at(states[:n], u[:n]), mapped.at(states[:n], u[:n]), strict=True),
            (at_once.run(states[0], u[:n]), mapped.run(states[0], u[:n])),
            (at_once.slopes(2)(states, u), mapped.slopes(2)(states, u)),
            (at_once.slopes(2, hidden=True)(states, u), mapped.slopes(2, hidden=True)(states, u)),
        ]
        for got, want in pairs:
            # The same real function in another order of a few hundred roundings.
            np.testing.assert_allclose(got, want, rtol=1e-12, atol=1e-12 * max(1.0, np.abs(want).max()))
        _, a_t, b = mapped.at(states[:n], u[:n])
        by_state_and_input = np.concatenate([a_t[:, :2].transpose(0, 2, 1), b], axis=2)
        np.testing.assert_array_equal(mapped.slopes(1)(states[:n], u[:n]), by_state_and_input)
        by_hidden = mapped.slopes(1, hidden=True)(states[:n], u[:n])[:, :, 3:]
        np.testing.assert_array_equal(by_hidden, a_t[:, 2:].transpose(0, 2, 1))


@pytest.mark.parametrize("kind", [CondensedController, SQPController])
def test_plans_are_the_same_either_way(kind):
    model = golf_robot(6)
    ocp, e = OCP_.changed(u_min=[-0.5], u_max=[0.5]), estimate_of(model, [0.4, 0.0])
    models = model, replace(model, side_by_side=None)
    plans = [plan_of(kind(m, ocp), e, np.zeros((1, 2))) for m in models]
    # Roundings of 1e-16, which grow along the iterations and through differences of steps of 1e-5.
    np.testing.assert_allclose(plans[0].u, plans[1].u, rtol=1e-7, atol=1e-9)
    assert kind is CondensedController or plans[0].defect == 0.0  # it is a run of the model itself


@pytest.mark.parametrize("rows", ["transposed", "as they are"])  # in memory
@pytest.mark.parametrize(("n", "n_u"), [(1, 1), (5, 1), (4, 2)])
def test_condensing_and_its_adjoint_are_sums_of_products(n, n_u, rows):
    rng = np.random.default_rng(n)
    a, b, condenser = rng.normal(size=(n, 3, 3)), rng.normal(size=(n, 3, n_u)), Condenser(n, 3, n_u, 2)
    a_t = np.ascontiguousarray(a.transpose(0, 2, 1)) if rows == "transposed" else a.transpose(0, 2, 1)
    condenser(np.full_like(a_t, np.nan), np.full_like(b, np.nan))  # nothing of a call stays for the next
    from_u, step = condenser(a_t, b), rng.normal(size=(n, n_u))
    drift, z = (b @ step[:, :, None])[:, :, 0], [np.zeros(3)]
    for k in range(n):
        z.append(a[k] @ z[k] + drift[k])
    np.testing.assert_allclose(propagate(a_t, drift, np.zeros(3)), z, rtol=1e-12, atol=1e-12)
    np.testing.assert_allclose(from_u @ step.ravel(), np.array(z)[:, :2].ravel(), rtol=1e-12, atol=1e-12)
    weights = rng.normal(size=(n + 1, 2))
    multipliers = adjoint(a_t, weights[-1], weights[:-1])
    by_u = (multipliers[:, None, :] @ b).ravel()
    np.testing.assert_allclose(by_u, weights.ravel() @ from_u, rtol=1e-10, atol=1e-12)


@pytest.mark.skipif(not shutil.which("cc"), reason="no C compiler on this machine")
@pytest.mark.parametrize("kind", [CondensedController, SQPController])
def test_compiled_and_interpreted_models_give_the_same_plans(kind, tmp_path, monkeypatch):
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    model = pendulum_model(z=3)
    e = estimate_of(model, [0.4, 0.0])
    plans = [plan_of(kind(model, OCP_, compiled=v), e, np.zeros((1, 2))) for v in (True, False)]
    # The same operations; compilers may contract a product and a sum, and 1e-16 grows along the iterations.
    np.testing.assert_allclose(plans[0].u, plans[1].u, rtol=1e-7, atol=1e-9)
    assert list(tmp_path.rglob("*.so")) or list(tmp_path.rglob("*.dylib"))  # it was compiled


def test_without_a_compiler_compiled_is_refused_and_the_default_works(monkeypatch, tmp_path):
    monkeypatch.setenv("PATH", str(tmp_path))
    monkeypatch.delenv("CC", raising=False)
    model = pendulum_model()
    with pytest.raises(InputError, match="HM-MODEL-043"):
        CondensedController(model, OCP_, compiled=True)
    assert CondensedController(model, OCP_).ocp is OCP_


def test_what_was_prepared_outlives_what_is_prepared_after_it():
    """The condenser's memory is shared; a plan made of an older preparation is the same but for rounding."""
    model = pendulum_model(z=3)
    controller, e, goal = (
        CondensedController(model, OCP_),
        estimate_of(model, [0.4, 0.0]),
        np.array([[0.2, 0.0]]),
    )
    plan = controller.solve(controller.initial(e), e, goal)
    prepared = controller.prepare(plan)
    want = controller.feedback(prepared, e, goal)
    controller.prepare(controller.initial(e, np.full((OCP_.horizon, 1), 0.3)))
    got = controller.feedback(prepared, e, goal)
    for name in ("u", "x", "h"):
        np.testing.assert_allclose(getattr(got, name), getattr(want, name), rtol=1e-11, atol=1e-12)
    assert got.cost == pytest.approx(want.cost, rel=1e-11)
