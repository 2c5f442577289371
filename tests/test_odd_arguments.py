"""Public functions with an argument of a wrong kind or size: an InputError, whatever it is."""

import math

import numpy as np
import pytest
from online_models import pendulum_model

import hybrid_mpc as hm

KINDS = ["abc", "", b"1", {}, set(), object(), lambda: 1.0, int, [[1.0], [1.0, 2.0]], 1 + 2j, np.array(["a"])]
NO_LENGTH = [*KINDS, math.nan, math.inf, -1.0, 0.0, None, True, 10**400, np.zeros(5)]
T = np.arange(0, 5, 0.01)
Y = np.sin(T)


@pytest.mark.parametrize(
    "call",
    [
        lambda v: hm.differentiate(Y, v, hm.LocalPolynomial(0.1)),
        lambda v: hm.differentiate(Y, 0.01, hm.LocalPolynomial(v)),
        lambda v: hm.differentiate(Y, 0.01, hm.SmoothingSpline(v)),
        lambda v: hm.differentiate(Y, 0.01, hm.ZeroPhaseFilter(v)),
        lambda v: hm.differentiate(Y, 0.01, hm.CausalPolynomial(v)),
        lambda v: hm.differentiate(Y, 0.01, v),
    ],
)
def test_lengths_and_methods(call):
    for value in NO_LENGTH:
        with pytest.raises(hm.InputError):
            call(value)


@pytest.mark.parametrize(
    "call",
    [
        lambda v: hm.differentiate(v, 0.01, hm.LocalPolynomial(0.1)),
        lambda v: hm.dare(v, [[1.0]], [[1.0]], [[1.0]]),
        lambda v: hm.dare([[1.0]], [[1.0]], [[1.0]], v),
        lambda v: hm.write_csv("never.csv", {"a": v}),
        lambda v: hm.write_csv("never.csv", v) if not isinstance(v, dict) else hm.write_csv("", v),
    ],
)
def test_numbers(call):
    for value in KINDS:
        with pytest.raises(hm.InputError):
            call(value)


def test_files(tmp_path):
    for path in [*KINDS[1:], math.nan, None, 3]:
        with pytest.raises(hm.InputError):
            hm.write_csv(path, {"a": T})
    for decimals in [*KINDS, -1, 0.5, True, 10**400, 18]:
        with pytest.raises(hm.InputError):
            hm.write_csv(tmp_path / "a.csv", {"a": T}, decimals=decimals)
    spec = hm.DataSpec("t", ("u",), ("y",), 0.1, 0.3, 1.0, 1.0)
    for paths in ["a.csv", b"a.csv", tmp_path, [3], [None], [b"a.csv"]]:
        with pytest.raises(hm.InputError):
            hm.load_trajectories(paths, pendulum_model(z=2), spec)
    assert not list(tmp_path.iterdir())


def test_parts_of_a_safeguard():
    model = pendulum_model(z=2)
    controller = hm.CondensedController(model, hm.OCP(10, [1.0, 0.1], [0.1], [0.01], [-1.0], [1.0]))
    for value in [*KINDS, math.nan, -1, 0.5, None, 10**400]:
        with pytest.raises(hm.InputError):
            hm.SafeController(controller, max_age=value)
    for value in [*KINDS, math.nan]:
        with pytest.raises(hm.InputError):
            hm.SafeController(value)
        with pytest.raises(hm.InputError):
            hm.SafeController(controller, value)
    with pytest.raises(hm.InputError):
        hm.OCP(10**400, [1.0, 0.1], [0.1], [0.01], [-1.0], [1.0])
