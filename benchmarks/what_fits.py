"""What fits into hybrid-mpc and what does not: asked of the pre-flight, and timed.

python benchmarks/what_fits.py            # all tables of docs/fits.md
python benchmarks/what_fits.py refused    # one of: refused, cells, period
"""

from __future__ import annotations

import sys
import time

import casadi as ca
import numpy as np

from hybrid_mpc import (
    OCP,
    CondensedController,
    DataSpec,
    InputError,
    OperatingPoint,
    Parameter,
    Prior,
    Scenario,
    Signal,
)
from hybrid_mpc.check.preflight import check_scenario
from hybrid_mpc.control.sizes import Sizes
from hybrid_mpc.identify.prior_model import model_info, prior_programs
from hybrid_mpc.kit.artifact import build_model
from hybrid_mpc.kit.assembly import make_estimator
from hybrid_mpc.kit.parts import loop_settings
from hybrid_mpc.loop.loop import Loop
from hybrid_mpc.model.model import HybridModel

PERIODS = 400
CELLS = (5, 10, 20, 40, 80)
SPEC = DataSpec("t", ("u",), ("y",), dt=1.0, max_gap=3.0, smoothing=10.0, warm_up=10.0)


class Base(Prior):
    """A lag, which each case changes."""

    states = outputs = (Signal("y", "m", 0.0, 1.0),)
    inputs = (Signal("u", "V", 0.0, 10.0),)
    parameters = (Parameter("k", 0.05, "m/V", 0.01, 0.1), Parameter("tau", 20.0, "s", 5.0, 50.0))
    operating_point = OperatingPoint(x=(0.25,), u=(5.0,))

    def xdot(self, x, u, w, p):
        """Rate of the level."""
        return ((p.k * u.u - x.y) / p.tau,)


class Algebraic(Base):
    """A pressure that is what the flow through two valves makes of it: an equation, no rate."""

    algebraic = (Signal("z", "Pa"),)


class TooFewRates(Base):
    """Two states, one rate: the other is meant to follow from an equation."""

    states = (Signal("y", "m", 0.0, 1.0), Signal("z", "m", 0.0, 1.0))
    outputs = (Signal("y", "m", 0.0, 1.0),)
    operating_point = OperatingPoint(x=(0.25, 0.25), u=(5.0,))


class Switch(Base):
    """A heater that is on or off."""

    def xdot(self, x, u, w, p):
        """It counts in whole volts."""
        return ((p.k * ca.floor(u.u) - x.y) / p.tau,)


class Jump(Base):
    """Dry friction by its sign."""

    def xdot(self, x, u, w, p):
        """A jump in the rate."""
        return ((p.k * u.u - x.y + 0.01 * ca.sign(u.u - 5.0)) / p.tau,)


class Clock(Base):
    """It ages with the time of day."""

    def xdot(self, x, u, w, p, t):
        """The time is no argument."""
        return ((p.k * u.u * (1 + 0.1 * ca.sin(t)) - x.y) / p.tau,)


class Stiff(Base):
    """A mode a thousand times faster than the period."""

    states = (Signal("y", "m", 0.0, 1.0), Signal("fast", "m", 0.0, 1.0))
    outputs = (Signal("y", "m", 0.0, 1.0), Signal("fast", "m", 0.0, 1.0))
    operating_point = OperatingPoint(x=(0.25, 0.25), u=(5.0,))

    def xdot(self, x, u, w, p):
        """The second one follows within a millisecond."""
        return (x.fast - x.y) / p.tau, 1e3 * (p.k * u.u - x.fast)


class Hidden(Base):
    """A state that no output tells of."""

    states = (Signal("y", "m", 0.0, 1.0), Signal("wear", "-", 0.0, 1.0))
    outputs = (Signal("y", "m", 0.0, 1.0),)
    operating_point = OperatingPoint(x=(0.25, 0.5), u=(5.0,))

    def xdot(self, x, u, w, p):
        """Wear does nothing to the level."""
        return (p.k * u.u - x.y) / p.tau, 0.01 * (0.5 - x.wear)


REFUSED = {
    "an algebraic variable, declared": Algebraic, "a state without a rate": TooFewRates,
    "an input that switches": Switch, "a rate that jumps": Jump, "a rate of the time": Clock,
    "a mode far faster than the period": Stiff, "a state that no output tells of": Hidden,
}  # fmt: skip


def machine(prior: type[Prior], dt: float = 1.0, control: OCP | None = None) -> Scenario:
    """A scenario around a prior of one input ``u``."""
    columns = tuple(s.name for s in prior.outputs)
    data = DataSpec("t", ("u",), columns, dt=dt, max_gap=3 * dt, smoothing=10 * dt, warm_up=10 * dt)
    sigma = () if control is None else (1e-3,) * len(columns)
    return Scenario("case", "A case", "", prior=prior, data=data, control=control, sensor_sigma=sigma)


def refused() -> None:
    """What the pre-flight says of each case."""
    for name, prior in REFUSED.items():
        try:
            check_scenario(machine(prior))
            print(f"{name}: taken")
        except InputError as error:
            print(f"{name}: {str(error).removeprefix('scenario case: ')}")


def rod(n: int) -> type[Prior]:
    """A heated rod of 1 m, cut into ``n`` cells: heated at one end, measured at both."""

    class Rod(Prior):
        """Heat conduction by finite volumes."""

        states = tuple(Signal(f"T{i}", "degC", 0.0, 300.0) for i in range(n))
        inputs = (Signal("u", "W", 0.0, 100.0),)
        outputs = states[0], states[-1]
        parameters = (
            Parameter("diffusion", 1e-4, "m^2/s", 3e-5, 3e-4), Parameter("loss", 1e-3, "1/s", 1e-4, 1e-2),
            Parameter("gain", 2e-3, "m K/J", 5e-4, 1e-2),
        )  # fmt: skip
        operating_point = OperatingPoint(x=(20.0,) * n, u=(0.0,))

        def xdot(self, x, u, w, p):
            """Each cell gets from its neighbours, and loses to the room."""
            size, rates = 1.0 / n, []
            for i in range(n):
                near = [x[j] - x[i] for j in (i - 1, i + 1) if 0 <= j < n]
                heat = p.gain * u.u / size if i == 0 else 0.0
                rates.append(p.diffusion / size**2 * sum(near) - p.loss * (x[i] - 20.0) + heat)
            return tuple(rates)

    return Rod


def cells() -> None:
    """The rod in more and more cells: what the pre-flight takes, and how long a step of the loop takes."""
    print("| cells | pre-flight | a step, median | 99 % within |\n| ---: | --- | ---: | ---: |")
    for n in CELLS:
        weights = (1.0, *(0.0,) * (n - 2), 1.0)
        control = OCP(30, q=weights, r=(1e-4,), r_delta=(1e-3,), u_min=(0.0,), u_max=(100.0,))
        case, start = machine(rod(n), 2.0, control), time.perf_counter()
        try:
            check_scenario(case)
        except InputError as error:
            print(
                f"| {n} | refused: {str(error).removeprefix('scenario case: ').splitlines()[0][:150]} | | |"
            )
            continue
        taken = time.perf_counter() - start
        print("| {} | {:.1f} s | {:.2f} ms | {:.2f} ms |".format(n, taken, *times(case, control)))


def times(case: Scenario, control: OCP) -> tuple[float, float]:
    """Median and 99th percentile of whole periods of a loop on the prior itself [ms]: estimate, decide, prepare."""
    model = deployed(case)
    settings = loop_settings(case)
    loop = Loop(
        make_estimator(model, settings, 1e-4 * Sizes(model, control).states, control),
        CondensedController(model, control),
    )
    rng, x = np.random.default_rng(0), model.x0
    u, spent = loop.start(model.output(x, model.u0, model.w, model.p).full().ravel()), []
    for _ in range(PERIODS):
        loop.finish()
        x = model.step(x, [], u, model.w, model.p)[0].full().ravel()
        y = model.output(x, u, model.w, model.p).full().ravel() + 1e-3 * rng.standard_normal(model.n_y)
        start = time.perf_counter()
        u = loop.step(y)
        loop.finish()
        spent.append(1e3 * (time.perf_counter() - start))
    return float(np.median(spent)), float(np.quantile(spent, 0.99))


def deployed(case: Scenario) -> HybridModel:
    """The prior as a deployed model."""
    prior = case.prior()
    programs = {f"prior/{name}": p for name, p in prior_programs(prior, case.data.dt).items()}
    return build_model("prior", programs, model_info(prior, case.data.dt))


def period() -> None:
    """How short a period may be: steps of a loop of one state and one input, by the horizon."""
    print("| horizon [periods] | a step, median | 99 % within |\n| ---: | ---: | ---: |")
    for horizon in (10, 30, 100):
        control = OCP(horizon, q=(100.0,), r=(0.0,), r_delta=(1.0,), u_min=(0.0,), u_max=(10.0,))
        print("| {} | {:.2f} ms | {:.2f} ms |".format(horizon, *times(machine(Base, 1.0, control), control)))


def main() -> None:
    """Print what was asked for, or everything."""
    parts = {"refused": refused, "cells": cells, "period": period}
    for name in sys.argv[1:] or parts:
        print(f"\n{name}")
        parts[name]()


if __name__ == "__main__":
    main()
