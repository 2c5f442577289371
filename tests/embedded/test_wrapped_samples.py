"""Wrapped samples of periodic outputs in C: the estimates and inputs of Python."""

import numpy as np
from embedded_parts import CLoop
from wrapped_machine import SIGMAS, boat, problem, samples, wrapped

from hybrid_mpc import CondensedController, ExtendedKalmanFilter, Loop, SafeController, SwitchingFilter
from hybrid_mpc.embedded.native import NativeController


def observer():
    model = boat()
    filters = (ExtendedKalmanFilter(model, **SIGMAS | {"sigma_d": [step]}) for step in (0.1, 3.0))
    return SwitchingFilter([*filters], [[0.98, 0.02], [0.3, 0.7]])


def test_estimates_of_wrapped_samples_are_those_of_python():
    y, u, wind = samples()
    y[:, 0], wind = wrapped(y[:, 0]), wrapped(wind)
    python, estimate = observer(), None
    c = CLoop(python.model, problem(), python)
    for k in range(len(y)):
        if estimate is None:
            estimate = python.start(y[0], w=wind[0])
            c.call("estimate_start", y[0], wind[0])
        else:
            estimate = python.update(estimate, y[k], u[k - 1], w=wind[k])
            c.call("estimate_update", y[k], u[k - 1], wind[k])
        # of degrees: rounding, in another order of operations
        np.testing.assert_allclose(c.x, estimate.x, rtol=0, atol=1e-8)
        np.testing.assert_allclose(c.d, estimate.d, rtol=0, atol=1e-8)
        np.testing.assert_allclose(c.w, estimate.w, rtol=0, atol=1e-9)


def test_the_compiled_controller_takes_the_estimate_of_a_compass():
    model, filtering = boat(), observer()
    controllers = CondensedController(model, problem()), NativeController(model, problem())
    found = []
    for controller in controllers:
        loop, x = Loop(filtering, SafeController(controller), reference=[380.0, 0.0]), np.array([350.0, 0.0])
        for k in range(40):
            y, w = [wrapped(x[0]), x[1]], [wrapped(np.array(358.0 + k))]
            u = loop.start(y, w) if k == 0 else loop.step(y, w)
            x = np.array(model.step(x, [], u, 358.0 + k, [])[0]).ravel()
        found.append(x)
    np.testing.assert_allclose(found[0], found[1], rtol=0, atol=1e-6)
    assert abs(found[0][0] - 380.0) < 1.0
