"""How fast the golf robot's rig is simulated, and by which integrator: ``python benchmarks/golf_rig.py``.

One core, processor time. Every integrator runs 20 s of the same four motions with the torque held over 20 ms;
the error is the largest of the angle against RK4 with sub-steps of 31 us.
"""

from __future__ import annotations

import os

os.environ.setdefault("OMP_NUM_THREADS", "1")

from time import process_time

import casadi as ca
import numpy as np
from scipy.integrate import solve_ivp

from scenarios.golf_robot.dynamics import N_STATES, RigParameters, rhs
from scenarios.golf_robot.rig import Rig

DT, SECONDS = 0.02, 20.0
MOTIONS = ((0.1, 0.3), (0.14, 0.6), (0.15, 0.6), (0.5, 1.5))  # N m, Hz: with stops, far, very far, fast


def torques(amplitude, frequency):
    """A sine of torques [N m], one for each period."""
    return amplitude * np.sin(2 * np.pi * frequency * DT * np.arange(round(SECONDS / DT)))


def rk4(sub_step):
    """The rig itself."""
    rig = Rig(sub_step=sub_step)

    def run(u):
        state, phi = rig.reset(np.array([0.3, 0.0]), 0), []
        for value in u:
            state = rig.step(state, np.array([value]), DT)
            phi.append(state.z[0])
        return np.array(phi)

    return run


def casadi_integrator(name, options):
    """One of CasADi's integrators, restarted each period."""
    s, u = ca.SX.sym("s", N_STATES), ca.SX.sym("u")
    dae = {"x": s, "p": u, "ode": rhs(s, u, RigParameters())[0]}
    step = ca.integrator("step", name, dae, 0.0, DT, options)

    def run(torque):
        z, phi = ca.DM([0.3, 0, 0, 0, 0, 0]), []
        for value in torque:
            z = step(x0=z, p=value)["xf"]
            phi.append(float(z[0]))
        return np.array(phi)

    return run


def scipy_integrator(method, seconds):
    """One of scipy's, with CasADi's right-hand side and Jacobian."""
    s, u = ca.SX.sym("s", N_STATES), ca.SX.sym("u")
    ds = rhs(s, u, RigParameters())[0]
    f, jac = ca.Function("f", [s, u], [ds]), ca.Function("j", [s, u], [ca.densify(ca.jacobian(ds, s))])

    def run(torque):
        z, phi = np.array([0.3, 0, 0, 0, 0, 0]), []
        for value in torque[: round(seconds / DT)]:
            z = solve_ivp(
                lambda _, z, v=value: f(z, v).full().ravel(), (0.0, DT), z, method=method, rtol=1e-6, atol=1e-8,
                jac=lambda _, z, v=value: jac(z, v).full(),
            ).y[:, -1]  # fmt: skip
            phi.append(z[0])
        return np.array(phi)

    return run


def main():
    """Print the table."""
    tolerances = {"reltol": 1e-6, "abstol": 1e-8}
    rivals = {
        "RK4 in CasADi's VM, 1 ms": (rk4(1e-3), SECONDS),
        "RK4 in CasADi's VM, 0.5 ms (the rig's)": (rk4(0.5e-3), SECONDS),
        "RK4 in CasADi's VM, 0.25 ms": (rk4(0.25e-3), SECONDS),
        "CasADi cvodes, BDF, 1e-6": (casadi_integrator("cvodes", tolerances), SECONDS),
        "CasADi collocation, 20 x order 3": (
            casadi_integrator("collocation", {"number_of_finite_elements": 20, "simplify": False}), 2.0
        ),
        "scipy BDF on the CasADi rhs, 1e-6": (scipy_integrator("BDF", 1.0), 1.0),
    }  # fmt: skip
    reference = [rk4(31.25e-6)(torques(*motion)) for motion in MOTIONS]
    print("| integrator | times real time, each motion | largest error [rad] |\n| --- | --- | --- |")
    for name, (run, seconds) in rivals.items():
        speeds, worst = [], 0.0
        for motion, exact in zip(MOTIONS, reference, strict=True):
            u = torques(*motion)[: round(seconds / DT)]
            start = process_time()
            phi = run(u)
            speeds.append(seconds / (process_time() - start))
            worst = max(worst, np.abs(phi - exact[: len(phi)]).max())
        print(f"| {name} | {', '.join(f'{speed:.0f}' for speed in speeds)} | {worst:.1e} |", flush=True)


if __name__ == "__main__":
    main()
