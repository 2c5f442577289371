"""Priors with a planted mistake: is the right one named, and none where there is none?

    python benchmarks/planted_mistakes.py

Five priors of each of the twelve machines of :mod:`unknown`: as a user would have written it, and with one mistake of a
kind that users make. Plants differ from the right prior, too, as they do there. Each prior is fitted and judged as in a
run (:func:`hybrid_mpc.identify.structure.causes`, and ``causes_of_refusal`` where the fit refuses the prior). ``first``
is what is named first; where two explanations are equal to 25 %, any of those named counts. A mistake that leaves the
errors of fitted free runs, short and long, as they were (to 10 %) counts as none: nothing may be named. Prints a
Markdown table, and with ``--out FILE.json`` writes it.
"""

from __future__ import annotations

import os

os.environ.setdefault("OMP_NUM_THREADS", "1")  # before numpy is loaded

import argparse
import inspect
import math
import sys
import tempfile
import time
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from unknown.common import Machine, report
from unknown.motion import MOTION
from unknown.processes import PROCESSES
from unknown_machines import read

from hybrid_mpc import InputError, Prior, fit_prior
from hybrid_mpc.data.scales import time_unit
from hybrid_mpc.data.trajectories import Trajectory
from hybrid_mpc.identify.delay import shifted
from hybrid_mpc.identify.fit import with_states
from hybrid_mpc.identify.output_fit import OutputFit
from hybrid_mpc.identify.prior_result import PriorFit
from hybrid_mpc.identify.shooting import Shooting
from hybrid_mpc.identify.simulation import visited
from hybrid_mpc.identify.smooth import rough_smoother
from hybrid_mpc.identify.structure import Cause, causes, causes_of_refusal
from hybrid_mpc.identify.windows import cut_outputs


@dataclass(frozen=True)
class Mistake:
    """A text of a prior that is replaced by a wrong one.

    Args:
        machine: Its name.
        kind: What users do wrong.
        old: Text of the prior's source. Empty: the prior is right.
        new: What replaces it; for ``swapped column`` the data specification is changed instead.
        named: Texts of which the named cause must contain all of one entry.
        factor: Of a unit, the factor by which the text is too large: the factor that is named must mend it to a factor
            of two, since parameters with wide bounds take the rest.
    """

    machine: str
    kind: str
    old: str = ""
    new: str = ""
    named: tuple[tuple[str, ...], ...] = ()
    factor: float = math.nan

    def names(self, cause: Cause) -> bool:
        """Whether a cause is this mistake."""
        said = str(cause)
        off = 1.0 if math.isnan(self.factor) else cause.factor * self.factor
        return 0.5 <= off <= 2.0 and any(all(text in said for text in texts) for texts in self.named)


SIGN = "sign"
PLANTED: dict[str, tuple[tuple[Any, ...], ...]] = {
    "heat_exchanger_2": (
        (
            "sign",
            "- k * (x.hot_1 - x.cold_2)) / p.V_h",
            "+ k * (x.hot_1 - x.cold_2)) / p.V_h",
            (("(hot_1 - cold_2)", "rate of hot_1", SIGN),),
        ),
        ("unit", "qh, qc = u.hot_flow / 60, u", "qh, qc = u.hot_flow, u", (("hot_flow",),), 60),
        (
            "sign",
            "+ k * (x.hot_1 - x.cold_2)) / p.V_c",
            "- k * (x.hot_1 - x.cold_2)) / p.V_c",
            (("(hot_1 - cold_2)", "rate of cold_2", SIGN),),
        ),
        ("swapped column", "outputs", "", (("outputs", "exchanged"),)),
    ),
    "quadruple_tank": (
        (
            "sign",
            "p.g1 * p.k1 * u.v1 + p.a34 * q[2]",
            "p.g1 * p.k1 * u.v1 - p.a34 * q[2]",
            (("a34", "rate of h1", SIGN),),
        ),
        ("swapped column", "inputs", "", (("inputs", "exchanged"), ("outputs", "exchanged"))),
        (
            "unit",
            "p.g1 * p.k1 * u.v1 +",
            "p.g1 * p.k1 * u.v1 * 100 +",
            (("v1", "rate of h1"), ("input v1",)),
            100,
        ),
        (
            "sign",
            "(1 - p.g2) * p.k2 * u.v2 - p.a34 * q[2]",
            "(1 - p.g2) * p.k2 * u.v2 + p.a34 * q[2]",
            (("rate of h3", SIGN),),
        ),
    ),
    "bioreactor": (
        ("sign", "(mu - u.D) * x.X", "(mu + u.D) * x.X", (("D in the rate of X", SIGN),)),
        ("sign", "- mu * x.X / p.Y", "+ mu * x.X / p.Y", (("rate of S", SIGN),)),
        ("unit", "(mu - u.D) * x.X / 3600", "(mu - u.D) * x.X", (("rate of X",),), 3600),
        (
            "unit",
            "(mu - u.D) * x.X / 3600, (u.D * (p.S_f - x.S) - mu * x.X / p.Y) / 3600",
            "(mu - u.D) * x.X / 3600, (u.D * (p.S_f - x.S) - mu * x.X / p.Y) / 60",
            (("rate of S",),),
            60,
        ),
    ),
    "evaporator": (
        ("sign", "(w.F1 - f4 - u.F2)", "(w.F1 - f4 + u.F2)", (("F2 in the rate of L", SIGN),)),
        ("sign", "(f4 - f5)", "(f5 - f4)", (("rate of P", SIGN),)),
        (
            "unit",
            "(w.F1 - f4 - u.F2) / p.A / 60",
            "(w.F1 - f4 - u.F2) / p.A",
            (("rate of L",), ("output L",)),
            60,
        ),
        ("sign", "(w.F1 - f4 - u.F2)", "(w.F1 + f4 - u.F2)", (("rate of L", SIGN),)),
    ),
    "column": (
        (
            "sign",
            "(below - u.boil_up) * x.x_B - u.boil_up * y(x.x_B)",
            "(below - u.boil_up) * x.x_B + u.boil_up * y(x.x_B)",
            (("boil_up", "rate of x_B", SIGN),),
        ),
        ("swapped column", "inputs", "", (("inputs", "exchanged"),)),
        (
            "sign",
            "u.boil_up * (y(x.x_2) - x.x_D)",
            "u.boil_up * (x.x_D - y(x.x_2))",
            (("rate of x_D", SIGN),),
        ),
        (
            "unit",
            "u.boil_up * (y(x.x_2) - x.x_D) / p.M_e / 60",
            "u.boil_up * (y(x.x_2) - x.x_D) / p.M_e",
            (("rate of x_D",),),
            60,
        ),
    ),
    "building": (
        ("sign", "p.H_mo * (x.T_m - w.T_o)", "p.H_mo * (x.T_m + w.T_o)", (("T_o", SIGN),)),
        ("sign", "(flow - p.H_mo", "(-flow - p.H_mo", (("H_im * (T_i - T_m)", "rate of T_m", SIGN),)),
        ("sign", "+ p.A_w * w.sun - flow", "- p.A_w * w.sun - flow", (("sun", SIGN),)),
        ("unit", "(u.heat + p.A_w", "(1000 * u.heat + p.A_w", (("heat",),), 1000),
    ),
    "flexible_shaft": (
        ("sign", "- shaft) / p.J_m", "+ shaft) / p.J_m", (("c * twist", "rate of motor", SIGN),)),
        ("swapped column", "outputs", "", (("outputs", "exchanged"),)),
        ("sign", "x.motor - x.load\n", "x.load - x.motor\n", (("rate of twist", SIGN),)),
        (
            "unit",
            "shaft / p.J_l, x.motor - x.load",
            "shaft / p.J_l, (x.motor - x.load) * 57.29578",
            (("rate of twist",), ("twist in",)),
            57.29578,
        ),
    ),
    "magnetic_levitation": (
        ("sign", "9810.0 - p.k *", "9810.0 + p.k *", (("rate of gap_dot", SIGN), ("9810", SIGN))),
        ("unit", "9810.0 - p.k", "9.81 - p.k", (("9.81",),), 0.001),
        ("sign", "(u.u - p.R * x.i)", "(u.u + p.R * x.i)", (("R * i", SIGN), ("input u", SIGN))),
        (
            "missing factor",
            "x.gap_dot, 9810",
            "0.001 * x.gap_dot, 9810",
            (("gap_dot in the rate of gap:",),),
            0.001,
        ),
    ),
    "inverted_pendulum": (
        (
            "angle",
            "return p.m * G * p.l * ca.cos(q.phi)",
            "return -p.m * G * p.l * ca.cos(q.phi)",
            (("potential", SIGN), ("phi", "another zero")),
        ),
        (
            "sign",
            "return u.F, 0.0",
            "return -u.F, 0.0",
            (("F", SIGN), ("output s", "other way"), ("output phi", "other way")),
        ),
        (
            "sign",
            "c = p.m * p.l * ca.cos(q.phi)",
            "c = -p.m * p.l * ca.cos(q.phi)",
            (("(s, phi)", SIGN), ("output phi", "other way"), ("output s", "other way")),
        ),
        ("swapped column", "outputs", "", (("outputs", "exchanged"), ("phi", "s"))),
    ),
    "ship": (
        (
            "sign",
            "(u.delta - x.rudder)",
            "(-u.delta - x.rudder)",
            (("delta", SIGN), ("psi", "other way"), ("psi", SIGN)),
        ),
        (
            "unit",
            "return x.r, (p.K",
            "return x.r * 57.29578, (p.K",
            (("rate of psi",), ("output psi",), ("input delta",), ("rate of r:",)),
            57.29578,
        ),
        (
            "sign",
            "x.r, (p.K * (x.rudder - p.bias) - x.r)",
            "x.r, (p.K * (x.rudder - p.bias) + x.r)",
            (("r in the rate of r", SIGN),),
        ),
        ("sign", "(u.delta - x.rudder)", "(u.delta + x.rudder)", (("rudder", SIGN),)),
    ),
    "ball_and_beam": (
        (
            "sign",
            "-p.k * ca.sin(x.beam - p.off)",
            "p.k * ca.sin(x.beam - p.off)",
            (("rate of s_dot", SIGN), ("command", SIGN), ("output s", "other way")),
        ),
        (
            "unit",
            "ca.sin(x.beam - p.off)",
            "ca.sin((x.beam - p.off) * 0.01745329)",
            (("rate of s_dot",), ("s_dot in the rate of s",), ("output s",)),
            1 / 57.29578,
        ),
        ("sign", "(u.command - x.beam)", "(u.command + x.beam)", (("beam", SIGN),)),
        ("unit", "(u.command - x.beam)", "(u.command * 57.29578 - x.beam)", (("command",),), 57.29578),
    ),
    "hydraulic_cylinder": (
        ("sign", "- p.b * x.s_dot) / p.m", "+ p.b * x.s_dot) / p.m", (("b * s_dot", SIGN),)),
        ("sign", "(flow - p.A * x.s_dot)", "(flow + p.A * x.s_dot)", (("s_dot", "p_L", SIGN),)),
        ("unit", "(1e5 * p.A * x.p_L", "(p.A * x.p_L", (("p_L",),), 1e-5),
        ("unit", "flow = p.k_q * u.u *", "flow = 1000 * p.k_q * u.u *", (("flow",), ("k_q",)), 1000),
    ),
}
"""By machine, the further arguments of its mistakes."""
MISTAKES = (
    *(Mistake(m.name, "none") for m in (*PROCESSES, *MOTION)),
    *(Mistake(name, *given) for name, mistakes in PLANTED.items() for given in mistakes),
)
HARMLESS = 1.1
"""Ratio of the fitted errors with and without a mistake up to which recordings cannot tell the mistake."""
MACHINES = {m.name: m for m in (*PROCESSES, *MOTION)}


def mistaken(machine: Machine, mistake: Mistake) -> Machine:
    """The machine as the user with this mistake has it."""
    if not mistake.old:
        return machine
    if mistake.kind == "swapped column":
        columns = getattr(machine.spec, mistake.old)
        return replace(
            machine, spec=replace(machine.spec, **{mistake.old: (columns[1], columns[0], *columns[2:])})
        )
    source = inspect.getsource(machine.prior)
    if mistake.old not in source:
        raise ValueError(f"{machine.name}: its prior has no {mistake.old!r}")
    own: dict[str, Any] = {}
    exec(source.replace(mistake.old, mistake.new, 1), dict(vars(sys.modules[machine.prior.__module__])), own)
    made: type[Prior] = own[machine.prior.__name__]
    return replace(machine, prior=made)


@dataclass(frozen=True)
class Fitted:
    """A machine's prior after the fit.

    Args:
        train: Recordings for training.
        fit: What was fitted; ``None`` where the fit refuses the prior.
        reason: Why it does.
        seconds: Processor time [s].
    """

    train: Sequence[Trajectory]
    fit: PriorFit | None
    reason: str
    seconds: float


def fitted(machine: Machine, folder: Path) -> Fitted:
    """The prior of a machine, fitted to its recordings."""
    began, dt = time.process_time(), machine.spec.dt
    train, valid, _ = read(machine.write(folder / machine.name), machine.prior, machine.spec)
    try:
        fit = fit_prior(machine.prior, train, valid, dt=dt, length=machine.length)
    except InputError as error:
        return Fitted(train, None, str(error), time.process_time() - began)
    return Fitted(train, fit, "", time.process_time() - began)


def harmless(machine: Machine, mistaken: Machine, wrong: Fitted, right: Fitted) -> bool:
    """Whether a prior follows the recordings with the mistake as well as without, in short and in long free runs."""
    if wrong.fit is None or right.fit is None or mistaken.spec != machine.spec:
        return False
    dt, train = machine.spec.dt, shifted(right.train, right.fit.delay)
    unit = time_unit(train, dt)
    smoother = rough_smoother(machine.prior(right.fit.values), train, dt, time_unit=unit)
    known = with_states(train, smoother, 0.0)
    for length in (0.5 * unit, 2 * unit, machine.length):
        periods = min(max(2, round(length / dt)), max(len(t.t) for t in known) - 1)
        windows = cut_outputs(known, periods, 0, 24, machine.prior().states)
        errors = []
        for one, fit in ((mistaken, wrong.fit), (machine, right.fit)):
            own = OutputFit(one.prior, dt)
            own.points = visited(known)
            errors += Shooting(own, windows, np.array(smoother.sizes.x)).explained([own.scaled(fit.values)])
        if errors[0] > HARMLESS * errors[1]:
            return False
    return True


def judged(mistake: Mistake, folder: Path, right: Fitted) -> dict[str, Any]:
    """A row: what is named of one prior; ``right`` is the machine's prior without a mistake."""
    machine = mistaken(MACHINES[mistake.machine], mistake)
    row = {"machine": mistake.machine, "kind": mistake.kind, "planted": mistake.new or mistake.old}
    dt = machine.spec.dt
    try:
        own = fitted(machine, folder) if mistake.old else right
    except InputError as error:  # recordings that contradict the ranges are refused when they are read
        said = str(error)
        named = any(all(text in said for text in texts) for texts in mistake.named)
        return {
            **row,
            "right": "yes" if named else "no",
            "first": said[:200],
            "seconds": "–",
            "of the fit": "–",
        }
    began, unit = time.process_time(), time_unit(own.train, dt)
    if own.fit is None:
        found = causes_of_refusal(machine.prior, own.train, dt, machine.length, unit)
    else:
        acting = shifted(own.train, own.fit.delay)
        found = causes(machine.prior, own.fit.values, acting, dt, machine.length, unit)
    seconds = time.process_time() - began
    if mistake.old and harmless(MACHINES[mistake.machine], machine, own, right):
        row["kind"] = f"none ({mistake.kind} without effect)"
    hit = not found if row["kind"].startswith("none") else any(mistake.names(one) for one in found)
    first = " OR ".join(str(one) for one in found) or own.reason[:80] or "nothing"
    return {
        **row, "right": "yes" if hit else "no", "first": first,
        "seconds": f"{seconds:.1f}", "of the fit": f"{own.seconds:.1f}",
    }  # fmt: skip


def main(arguments: Sequence[str] | None = None) -> None:
    """All of them, or those of some machines."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--names", nargs="+", default=(), help="some machines alone")
    parser.add_argument("--out", type=Path, help="JSON file to write")
    given = parser.parse_args(arguments)
    rows = []
    with tempfile.TemporaryDirectory() as folder:
        for name in given.names or MACHINES:
            right = fitted(MACHINES[name], Path(folder))
            for mistake in (one for one in MISTAKES if one.machine == name):
                rows.append(judged(mistake, Path(folder), right))
                print(rows[-1], flush=True)
    report(rows, given.out)
    planted = [r for r in rows if not r["kind"].startswith("none")]
    sound = [r for r in rows if r["kind"].startswith("none")]
    print(
        f"\nplanted: {sum(r['right'] == 'yes' for r in planted)} of {len(planted)} named right; none: "
        f"{sum(r['right'] == 'yes' for r in sound)} of {len(sound)} left alone"
    )


if __name__ == "__main__":
    main()
