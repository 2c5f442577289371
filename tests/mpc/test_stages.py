"""The model along a horizon, in CasADi's machine and compiled."""

import shutil

import numpy as np
import pytest
from online_models import pendulum_model

from hybrid_mpc.errors import InputError
from hybrid_mpc.estimation.kalman import Estimate
from hybrid_mpc.mpc import OCP, CondensedController, SQPController
from hybrid_mpc.mpc.condensing import Condenser, adjoint, propagate
from hybrid_mpc.mpc.stages import Stages

OCP_ = OCP(8, [50.0, 0.5], [0.5], [0.2], [-2.0], [2.0], working_point=([0.0, 1.0], [0.0]))


def test_a_run_is_the_models_own_with_the_jacobians_along_it():
    model, rng = pendulum_model(z=3), np.random.default_rng(0)
    stages, z0, u = Stages(model, 6), rng.normal(size=5), rng.normal(size=(6, 1))
    z_next, a_t, b = stages.run(z0, u)
    z = np.vstack([z0, z_next])
    for k in range(6):
        x, h, a, by_u = (m.full() for m in model.with_jacobian(z[k, :2], z[k, 2:], u[k]))
        np.testing.assert_allclose(z[k + 1], np.vstack([x, h]).ravel(), rtol=1e-14, atol=1e-15)
        np.testing.assert_allclose(a_t[k].T, a, rtol=1e-13, atol=1e-14)
        np.testing.assert_allclose(b[k], by_u, rtol=1e-13, atol=1e-14)
    for got, want in zip(stages.at(z[:-1], u), (z_next, a_t, b), strict=True):
        np.testing.assert_array_equal(got, want)


@pytest.mark.parametrize(("n", "n_u"), [(1, 1), (5, 1), (4, 2)])
def test_condensing_and_its_adjoint_are_sums_of_products(n, n_u):
    rng = np.random.default_rng(n)
    a, b, condenser = rng.normal(size=(n, 3, 3)), rng.normal(size=(n, 3, n_u)), Condenser(n, 3, n_u, 2)
    a_t = np.ascontiguousarray(a.transpose(0, 2, 1))
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
    e = Estimate(0.0, np.array([0.4, 0.0]), np.zeros(3), np.zeros(1), np.eye(6), np.zeros(1), 0.0)
    plans = [
        c.solve(c.initial(e), e, np.zeros((1, 2)))
        for c in (kind(model, OCP_, compiled=v) for v in (True, False))
    ]
    # The same operations; compilers may contract a product and a sum, and 1e-16 grows along the iterations.
    np.testing.assert_allclose(plans[0].u, plans[1].u, rtol=1e-7, atol=1e-9)
    assert list(tmp_path.rglob("*.so")) or list(tmp_path.rglob("*.dylib"))  # it was compiled


def test_without_a_compiler_compiled_is_refused_and_the_default_works(monkeypatch, tmp_path):
    monkeypatch.setenv("PATH", str(tmp_path))
    monkeypatch.delenv("CC", raising=False)
    model = pendulum_model()
    with pytest.raises(InputError, match="leave compiled out"):
        CondensedController(model, OCP_, compiled=True)
    assert CondensedController(model, OCP_).ocp is OCP_
