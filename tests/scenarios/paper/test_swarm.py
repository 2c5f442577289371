import sys
from importlib.util import find_spec

import numpy as np
import pytest
import torch
from simulated_pendulum import DT, TRUTH, Pendulum, record

from hybrid_mpc import InputError, fit_prior
from hybrid_mpc.identify.dataset import cut_windows
from hybrid_mpc.identify.fit import ParameterFit
from scenarios.paper.swarm import SwarmSettings, errors_of, particle_swarm, swarm_values

needs_pymoo = pytest.mark.skipif(find_spec("pymoo") is None, reason="pymoo (extra swarm) is not installed")


@pytest.fixture(scope="module")
def fit():
    return ParameterFit(Pendulum, DT)


@pytest.fixture(scope="module")
def windows():
    return cut_windows([record(seed, seconds=3.0) for seed in range(2)], 0, 50, 25)


def test_without_pymoo_the_remedy_is_told(fit, windows, monkeypatch):
    monkeypatch.setitem(sys.modules, "pymoo.algorithms.soo.nonconvex.pso", None)
    with pytest.raises(InputError, match=r"pip install 'hybrid-mpc\[swarm\]'"):
        particle_swarm(fit, windows, SwarmSettings())


def test_errors_side_by_side_are_those_one_by_one(fit, windows):
    rng = np.random.default_rng(0)
    thetas = fit.lower + rng.random((6, 3)) * (fit.upper - fit.lower)
    together = errors_of(fit, thetas, windows)
    alone = [fit.error(theta, windows) for theta in thetas]
    np.testing.assert_allclose(together, alone, rtol=1e-12)  # another order of the sums


def test_what_is_too_stiff_or_diverges_is_infinitely_bad(windows):
    class Stiff(Pendulum):
        def acceleration(self, x, u):
            steep = torch.where(self.d > 0.2, 1e6, 0.0)
            return super().acceleration(x, u) - steep * x[..., 1:2]

    fit = ParameterFit(Stiff, DT)
    d = fit.unit[2]
    errors = errors_of(fit, np.array([[1.0, 1.0, 0.1 / d], [1.0, 1.0, 0.4 / d]]), windows)
    assert np.isfinite(errors[0])
    assert errors[1] == np.inf


@pytest.mark.parametrize("settings", [{"particles": 1}, {"generations": 0}])
def test_too_small_a_swarm_is_refused(settings):
    with pytest.raises(InputError, match="24 and 40"):
        SwarmSettings(**settings)


@needs_pymoo
def test_the_swarm_finds_the_parameters_and_repeats(fit, windows):
    settings, seen = SwarmSettings(20, 30, seed=1), []
    theta = particle_swarm(fit, windows, settings, lambda done, total: seen.append((done, total)))
    assert seen[0] == (1, 30)
    assert seen[-1] == (30, 30)
    for name, truth in TRUTH.items():
        # a search without derivatives stops somewhere near: bounds of J are a factor of 5 and 3 away
        assert fit.values(theta)[name] == pytest.approx(truth, rel=0.1)
    assert np.array_equal(theta, particle_swarm(fit, windows, settings))
    assert (theta >= fit.lower).all()
    assert (theta <= fit.upper).all()


@needs_pymoo
def test_a_fit_goes_on_from_what_the_swarm_found():
    train = [record(seed, seconds=2.0) for seed in range(2)]
    start = swarm_values(Pendulum, train, DT, SwarmSettings(8, 6))
    found = fit_prior(Pendulum, train, train, dt=DT, methods=("output_error",), start=start)
    names = [row["stage"] for row in found.stages]
    assert names[:2] == ["nominal", "start"]
    assert found.stages[1]["validation_error"] < found.stages[0]["validation_error"]
    assert found.best.startswith("output error")  # derivatives go on from where the swarm stopped
