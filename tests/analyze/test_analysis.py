"""Linear analysis against closed forms and python-control."""

import json

import casadi as ca
import control
import numpy as np
import pytest
from analyze_parts import response, system
from online_models import rk4
from scipy.linalg import expm

from hybrid_mpc import (
    HybridModel,
    InputError,
    Signal,
    frequency_response,
    linearize,
    linearize_at_speed,
    system_structure,
)
from hybrid_mpc.analyze.properties import Mode, modes, stabilisable_detectable
from hybrid_mpc.model.equilibrium import fixed_point
from hybrid_mpc.records import plain, record

DT, J, MGL, GAMMA = 0.02, 0.1, 1.5, 0.15


def machine(coulomb: float = 0.0, n_h: int = 0) -> HybridModel:
    """A pendulum, RK4 with 10 sub-steps; with n_h = 1 a leaky hidden state adds torque."""
    x, h, u = ca.MX.sym("x", 2), ca.MX.sym("h", n_h), ca.MX.sym("u")
    extra = 0.1 * h[0] if n_h else 0.0

    def rhs(z):
        torque = u + extra - MGL * ca.sin(z[0]) - GAMMA * z[1] - coulomb * ca.tanh(z[1] / 0.05)
        return ca.vertcat(z[1], torque / J)

    h_next = 0.8 * h + 0.1 * ca.tanh(x[1] + u) if n_h else h
    return HybridModel.of(
        "pendulum", DT, (Signal("phi", "rad"), Signal("phi_dot", "rad/s")), (Signal("tau", "N m"),),
        (Signal("phi", "rad"),),
        x=x, h=h, u=u, x_next=rk4(rhs, x, DT, 10), h_next=h_next, xdot=rhs(x), y=x[0],
    )  # fmt: skip


def continuous(phi: float) -> np.ndarray:
    return np.array([[0, 1, 0], [-MGL * np.cos(phi) / J, -GAMMA / J, 1 / J], [0, 0, 0]])


def test_fixed_points_hanging_upright_and_under_torque():
    for u, guess, expected in [(0.0, 0.3, 0.0), (0.0, 3.0, np.pi), (0.75, 0.4, np.arcsin(0.5))]:
        x, h = fixed_point(machine(), [u], [guess, 0.0])
        # residual 1e-10 over the step's sensitivity (about 1 - eig ~ 0.06 for dt = 20 ms): 1e-8.
        assert np.abs(x - [expected, 0.0]).max() < 1e-8
        assert h.size == 0


def test_fixed_point_holds_the_hidden_state_too():
    model = machine(n_h=1)
    x, h = fixed_point(model, [0.2], [0.1, 0.0])
    x_next, h_next = (m.full().ravel() for m in model.step(x, h, [0.2], model.w, model.p))
    assert np.abs(np.concatenate([x_next - x, h_next - h])).max() <= 1e-10
    assert abs(h[0] - 0.5 * np.tanh(0.2)) < 1e-8  # h = 0.8 h + 0.1 tanh(u)
    assert abs(MGL * np.sin(x[0]) - 0.2 - 0.1 * h[0]) < 1e-6


def test_no_fixed_point_is_said():
    with pytest.raises(InputError, match="HM-MODEL-008"):
        fixed_point(machine(), [5.0], [0.0, 0.0])  # more torque than gravity: it turns for ever


@pytest.mark.parametrize("phi", [0.0, np.pi])
def test_linearisation_is_the_matrix_exponential(phi):
    sys = linearize(machine(), [phi, 0.0], [0.0])
    exact = expm(continuous(phi) * DT)
    # RK4 with d = 2 ms: error 10 * (|A| d)^5 / 120 with |A| ~ 15: 2e-9 of entries up to 1/J dt.
    assert np.abs(sys.A - exact[:2, :2]).max() < 1e-8
    assert np.abs(sys.B - exact[:2, 2:]).max() < 1e-8
    assert np.array_equal(sys.C, [[1.0, 0.0]])
    assert sys.dt == DT
    assert sys.state_labels == ["phi", "phi_dot"]
    assert (sys.input_labels, sys.output_labels) == (["tau"], ["phi"])


def test_poles_frequency_and_damping_are_those_of_the_pendulum():
    result = system_structure(linearize(machine(), [0.0, 0.0], [0.0]))
    omega, zeta = np.sqrt(MGL / J), GAMMA / (2 * np.sqrt(MGL * J))
    assert np.abs(np.array([m.frequency for m in result.modes]) - omega).max() < 1e-6  # RK4's 1e-9 over dt
    assert np.abs(np.array([m.damping for m in result.modes]) - zeta).max() < 1e-6
    assert np.abs(result.poles).max() < 1.0
    upright = system_structure(linearize(machine(), [np.pi, 0.0], [0.0]))
    assert upright.stabilisable
    assert upright.detectable
    assert upright.poles[0].real > 1.0


def test_agrees_with_python_control():
    sys = linearize(machine(n_h=1), [0.1, 0.5], [0.0])
    mine = np.sort_complex(system_structure(sys).poles)
    assert np.abs(mine - np.sort_complex(control.poles(sys))).max() < 1e-12  # the same matrix
    omega = np.geomspace(0.1, 100.0, 30)
    theirs = control.frequency_response(sys, omega)
    ours = frequency_response(sys, omega)
    assert np.allclose(ours.magnitude[0, 0], theirs.magnitude, rtol=1e-9)  # two solvers, condition ~ 1e4
    assert np.allclose(np.exp(1j * ours.phase[0, 0]), np.exp(1j * theirs.phase), atol=1e-9)
    assert sys.state_labels == ["phi", "phi_dot", "h0"]


def test_working_speed_frees_the_linearisation_of_the_friction_at_rest():
    sticky, smooth = machine(coulomb=0.05), machine()
    omega = np.array([3.0])
    rest, work = (
        [abs(response(take(m), omega).item()) for m in (sticky, smooth)]
        for take in (
            lambda m: linearize(m, [0.0, 0.0], [0.0]), lambda m: linearize_at_speed(m, [0.0], [2.0], [0.0])
        )
    )  # fmt: skip
    # At 40 v_s the slope of tanh is 4 exp(-80): gone. At rest it adds 1 N m s/rad to 0.15.
    # Left is gravity's slope along the step: cos over 0.04 rad on a path 1e-4 rad shorter, 4e-6.
    assert abs(work[0] / work[1] - 1.0) < 1e-5
    assert rest[0] / rest[1] < 0.5


@pytest.mark.parametrize(
    ("a", "b", "c", "reach", "see"),
    [
        (np.diag([1.2, 0.5]), [[1.0], [0.0]], [[1.0, 0.0]], True, True),  # uncontrollable but stabilisable
        (np.diag([1.2, 0.5]), [[0.0], [1.0]], [[1.0, 1.0]], False, True),  # the unstable mode is not reached
        (np.diag([1.2, 0.5]), [[1.0], [1.0]], [[0.0, 1.0]], True, False),  # nor seen
        (1.2 * np.eye(2), [[1.0], [1.0]], [[1.0, 1.0]], False, False),  # twin modes, one input
        ([[1.0, 0.1], [0.0, 1.0]], [[0.0], [1e-9]], [[1.0, 0.0]], True, True),  # weak units do not decide
        ([[1.0, 0.1], [0.0, 1.0]], [[0.0], [1.0]], [[0.0, 1.0]], True, False),  # position not measured
    ],
)
def test_hautus_on_textbook_systems(a, b, c, reach, see):
    sys = system(a, b, c)
    assert stabilisable_detectable(modes(sys)) == (reach, see)


def test_modes_are_written_and_read_back():
    found = modes(system(np.diag([0.99, 0.0, 0.1]), np.ones((3, 1)), np.ones((1, 3))))
    assert found[2].frequency == np.inf  # of the pole at zero
    turning = modes(system([[0.5, 0.4], [-0.4, 0.5]], np.ones((2, 1)), np.ones((1, 2))))
    for one in (*found, *turning):
        assert record(Mode, json.loads(json.dumps(plain(one))), "a mode") == one
    with pytest.raises(InputError, match=r"pole: a real and an imaginary part.*HM-RECORDS-006"):
        record(Mode, plain(found[0]) | {"pole": [1.0]}, "a mode")


def test_bad_input_speaks():
    with pytest.raises(InputError, match="HM-ANALYZE-010"):
        modes(control.ss([[-1.0]], [[1.0]], [[1.0]], [[0.0]]))
    with pytest.raises(InputError, match="HM-ANALYZE-050"):
        frequency_response(system([[0.5]], [[1.0]], [[1.0]]), [100.0])
    with pytest.raises(InputError, match="HM-MODEL-017"):
        linearize(machine(), [0.0], [0.0])
