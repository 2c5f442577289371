"""Is the term found that a prior lacks? Simulated machines whose missing terms are known.

    python benchmarks/missing_terms.py [--machines pendulum axis tanks heaters] [--draws 20]

A draw has parameters of its own within their bounds, no, one or two terms that the prior lacks (in turn), six
recordings with random inputs, and sensor noise of 0.3 % of the outputs' spread. The prior is fitted to the recordings,
and the search begins there. ``right first`` is the share of the draws with missing terms in which the first added term
is one of them; ``or alternative`` counts those where it is among its alternatives too; ``all found`` is the share in
which all missing terms are among the found ones; ``none added`` is the share of the draws without missing terms in
which no term is added. A missing term has 0.3 to 0.8 of the size of what moves the machine.
"""

from __future__ import annotations

import os

os.environ.setdefault("OMP_NUM_THREADS", "1")  # before numpy is loaded

import sys
import time
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import casadi as ca
import numpy as np
from numpy.typing import NDArray
from parts import arguments, report
from textbook import AxisPrior, TanksPrior, TorquePrior

from hybrid_mpc import OperatingPoint, Parameter, Prior, Signal, Trajectory, fit_prior
from hybrid_mpc.identify.explain import explain
from hybrid_mpc.identify.fit import smoothed
from hybrid_mpc.identify.simulation import visited
from hybrid_mpc.identify.term_library import Candidate, library
from hybrid_mpc.machine.terms import Term, extended

Array = NDArray[np.float64]
RECORDINGS, SUBSTEPS = 6, 10
NOISE = 0.003
"""Noise of a sensor over the output's spread."""
SHARES = (0.3, 0.8)
"""Sizes of missing terms, of a third of their bounds: that is what moves the machine."""


class Pendulum(TorquePrior):
    """A driven pendulum with viscous friction."""

    states = (Signal("phi", "rad", -60.0, 60.0, periodic=True), Signal("phi_dot", "rad/s", -60.0, 60.0))
    inputs = (Signal("torque", "N m", -2.0, 2.0),)
    outputs = states[:1]
    parameters = (
        Parameter("J", 0.12, "kg m^2", 0.06, 0.24),
        Parameter("mgl", 1.8, "N m", 0.9, 3.6),
        Parameter("d", 0.05, "N m s/rad", 0.01, 0.2),
    )


class Axis(AxisPrior):
    """A linear axis on a viscous guide."""

    states = (Signal("q", "m", -50.0, 50.0), Signal("q_dot", "m/s", -50.0, 50.0))
    inputs = (Signal("force", "N", -100.0, 100.0),)
    outputs = states[:1]
    parameters = (Parameter("M", 20.0, "kg", 10.0, 40.0), Parameter("F_v", 30.0, "N s/m", 10.0, 90.0))


class Tanks(TanksPrior):
    """A tank above a tank, both levels measured."""

    states = (Signal("upper", "m", 0.0, 9.0), Signal("lower", "m", 0.0, 9.0))
    outputs = states
    parameters = (
        Parameter("k_1", 0.1, "m^0.5/s", 0.05, 0.2),
        Parameter("k_2", 0.1, "m^0.5/s", 0.05, 0.2),
        Parameter("k_p", 0.02, "m/s/V", 0.01, 0.04),
    )
    operating_point = OperatingPoint((1.0, 1.0), (5.0,))

    def output(self, x: Any, u: Any, w: Any, p: Any) -> Any:
        """Both levels [m]."""
        return x.upper, x.lower


class Heaters(Prior):
    """Two heated bodies with straight losses to a room whose temperature is measured."""

    states = (Signal("one", "degC", -50.0, 300.0), Signal("two", "degC", -50.0, 300.0))
    inputs = (Signal("power_one", "W", 0.0, 10.0), Signal("power_two", "W", 0.0, 10.0))
    disturbances = (Signal("room", "degC", -20.0, 50.0),)
    outputs = states
    parameters = (
        Parameter("C", 20.0, "J/K", 10.0, 40.0),
        Parameter("G", 0.15, "W/K", 0.07, 0.3),
        Parameter("G_12", 0.05, "W/K", 0.02, 0.15),
    )
    operating_point = OperatingPoint((50.0, 50.0), (5.0, 5.0), (20.0,))

    def xdot(self, x: Any, u: Any, w: Any, p: Any) -> Any:
        """Rates of the temperatures [K/s]."""
        between = p.G_12 * (x.two - x.one)
        return (
            (u.power_one - p.G * (x.one - w.room) + between) / p.C,
            (u.power_two - p.G * (x.two - w.room) - between) / p.C,
        )


@dataclass(frozen=True)
class Machine:
    """A machine, its recordings' period [s], length [samples], and what it may lack."""

    prior: type[Prior]
    dt: float
    samples: int
    hold: int
    start: tuple[float, ...]
    missing: tuple[str, ...]


MACHINES = {
    "pendulum": Machine(
        Pendulum, 0.02, 300, 15, (0.0, 0.0),
        ("Coulomb friction of phi_dot", "friction by direction of phi_dot", "quadratic drag of phi_dot",
         "cogging of phi_dot", "gain by direction of torque", "lag of torque", "dead zone of torque"),
    ),
    "axis": Machine(
        Axis, 0.02, 300, 15, (0.0, 0.0),
        ("Coulomb friction of q_dot", "friction by direction of q_dot", "quadratic drag of q_dot", "spring of q_dot",
         "dead zone of force", "lag of force"),
    ),
    "tanks": Machine(
        Tanks, 1.0, 300, 25, (1.0, 1.0),
        ("overflow of upper", "overflow of lower", "coupling from pump of lower", "input curve of pump",
         "sensor curve of lower", "lag of pump"),
    ),
    "heaters": Machine(
        Heaters, 5.0, 300, 25, (40.0, 40.0),
        ("radiation of one", "coupling from power_two of one", "input curve of power_one", "lag of power_one",
         "second capacity of two", "sensor curve of two"),
    ),
}  # fmt: skip


def recorded(
    prior: Prior,
    machine: Machine,
    noise: Sequence[float],
    rng: np.random.Generator,
    with_states: bool = False,
) -> list[Trajectory]:
    """Recordings of a simulated machine from its start under inputs that are held, each of its own size."""
    x, u, w = (
        ca.SX.sym(key, len(signals))
        for key, signals in (("x", prior.states), ("u", prior.inputs), ("w", prior.disturbances))
    )
    h, one = machine.dt / SUBSTEPS, x
    f = prior.equations.xdot
    for _ in range(SUBSTEPS):
        k1 = f(one, u, w, prior.p)
        k2 = f(one + h / 2 * k1, u, w, prior.p)
        k3 = f(one + h / 2 * k2, u, w, prior.p)
        one = one + h / 6 * (k1 + 2 * k2 + 2 * k3 + f(one + h * k3, u, w, prior.p))
    n = machine.samples
    runs = ca.Function("step", [x, u, w], [one]).mapaccum(n)
    made = []
    for k in range(RECORDINGS):
        changes = n // machine.hold + 1
        inputs = []
        for s in prior.inputs:
            middle, half = 0.5 * (s.lower + s.upper), 0.5 * (s.upper - s.lower)
            size = half * (0.4 + 0.1 * k)
            inputs.append(np.repeat(rng.uniform(middle - size, middle + size, changes), machine.hold)[:n])
        held = np.column_stack(inputs)
        room = np.tile(
            15.0 + 5.0 * np.sin(np.arange(n) / n * 6.0 + rng.uniform(0, 6.0)), (len(prior.disturbances), 1)
        ).T
        start = [*machine.start, *([float(held[0, 0])] * (len(prior.states) - len(machine.start)))]
        states = runs(start, held.T, room.T).full().T
        states = np.vstack([start, states[:-1]])
        y = prior.equations.output(states.T, held.T, room.T, prior.p).full().T
        y = y + rng.standard_normal(y.shape) * np.asarray(noise)
        nothing = np.full((n, len(machine.start)), np.nan)
        x = states if with_states else nothing
        made.append(
            Trajectory(f"run{k}", "train", machine.dt, machine.dt * np.arange(n), held, y, x, nothing, room)
        )
    return made


def planted(one: Candidate, rng: np.random.Generator) -> Term:
    """A form of a candidate with values of its own."""
    form = one.forms[int(rng.integers(len(one.forms)))]
    own = []
    for p in form.parameters:
        if p.value != 0.0 and p.unit != "s":  # an edge, an exponent
            own.append(p)
            continue
        size = rng.uniform(*SHARES) / 3.0
        value = (
            p.upper * size
            if p.value == 0.0
            else float(np.clip(p.value * rng.uniform(2.0, 4.0), p.lower, p.upper))
        )
        if p.value == 0.0 and p.lower < 0.0 and rng.random() < 0.5:
            value = -value
        own.append(replace(p, value=value))
    assert form.made is not None
    return replace(form, parameters=tuple(own))


def draw(name: str, number: int) -> dict[str, object]:
    """One machine with its missing terms, and what the search found."""
    machine, rng = MACHINES[name], np.random.default_rng([number, *name.encode()])
    base = machine.prior
    values = {p.name: p.value * float(np.exp(rng.uniform(-0.4, 0.4))) for p in base.parameters}
    plain = base(values)
    quiet = recorded(
        plain, machine, [0.0] * len(base.outputs), rng, with_states=True
    )  # for the library's scales
    spread = np.std(np.concatenate([t.y for t in quiet]), axis=0)
    length = machine.samples * machine.dt / 3
    pool = {c.name: c for c in library(plain, visited(quiet), machine.dt, length)}
    chosen = rng.choice(machine.missing, size=number % 3, replace=False).tolist()
    missing = [planted(pool[key], rng) for key in chosen]
    plant = extended(base, *missing)(values)
    runs = recorded(plant, machine, NOISE * spread, rng)
    fit = fit_prior(base, runs, [], dt=machine.dt, length=length)
    known = smoothed(base, fit, runs, machine.dt)
    began = time.process_time()
    found = explain(base, fit.values, known, dt=machine.dt, length=length, warm_up=0.1 * length)
    seconds = time.process_time() - began
    names = [term.name for term in found.found]
    first = found.steps[0] if found.steps else None
    near = [] if first is None else [t.name for trial in first.alternatives for t in trial.terms]
    kinds = [next(c.name for c in pool.values() if any(f.name == m.name for f in c.forms)) for m in missing]

    def kind(own: str) -> str:
        return next(
            (c.name for c in pool.values() if own in {f.name for f in c.forms} | {c.name}), _kind(own)
        )

    firsts = [] if first is None else [kind(t.name) for t in first.terms]
    made = {
        "machine": name, "draw": number, "missing": "; ".join(m.name for m in missing), "found": "; ".join(names),
        "right first": bool(set(firsts) & set(kinds)),
        "or alternative": bool((set(firsts) | {kind(n) for n in near}) & set(kinds)),
        "all found": set(kinds) <= {kind(n) for n in names},
        "before": round(found.before, 4), "after": round(found.after.error, 4), "seconds": round(seconds, 1),
        "reason": found.reason,
    }  # fmt: skip
    print("  ", made, file=sys.stderr, flush=True)
    return made


def _kind(name: str) -> str:
    """Name of a candidate by that of its form, whose edge or number differs with the recordings."""
    words = name.split(" ")
    for key in ("overflow", "loss", "cogging"):
        if words[0] == key:
            return f"{key} of {words[-1]}"
    return name


def summary(name: str, rows: Sequence[dict[str, object]]) -> dict[str, object]:
    """Shares of the draws of a machine."""
    lacking, whole = [r for r in rows if r["missing"]], [r for r in rows if not r["missing"]]
    return {
        "machine": name, "with missing terms": len(lacking),
        **{key: round(float(np.mean([bool(r[key]) for r in lacking])), 2) for key in
           ("right first", "or alternative", "all found")},
        "without": len(whole), "none added": round(float(np.mean([not r["found"] for r in whole])), 2),
        "seconds": max(float(str(r["seconds"])) for r in rows),
    }  # fmt: skip


def main() -> None:
    """Measure and print."""
    parser = arguments(__doc__)
    parser.add_argument("--machines", nargs="+", default=[*MACHINES], choices=[*MACHINES])
    parser.add_argument("--draws", type=int, default=20)
    parser.add_argument("--first", type=int, default=0, help="number of the first draw")
    given = parser.parse_args()
    rows = {name: [draw(name, given.first + k) for k in range(given.draws)] for name in given.machines}
    table = [summary(name, own) for name, own in rows.items()]
    if len(table) > 1:
        table.append(summary("all", [r for own in rows.values() for r in own]))
    report(table, given.out)


if __name__ == "__main__":
    main()
