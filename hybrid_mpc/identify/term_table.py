"""The table of terms as a document: ``python -m hybrid_mpc.identify.term_table > docs/terms.md``."""

from __future__ import annotations

import inspect
import re
import sys
from collections.abc import Iterator, Mapping
from typing import Any, ClassVar

import casadi as ca
import numpy as np

from hybrid_mpc.identify.term_library import Candidate, library
from hybrid_mpc.machine import terms
from hybrid_mpc.machine.mechanical import MechanicalPrior
from hybrid_mpc.machine.prior import Prior
from hybrid_mpc.machine.signals import Parameter, Signal

AXIS, ENDS = "axes", "axes of a `MechanicalPrior` that do not turn fully"
TURNING = "turning axes of a `MechanicalPrior`"
OTHER = "other rates"
INPUT, BOTH = "inputs that change", "inputs of both signs"
GROUPS: Mapping[str, Mapping[str, str]] = {
    "Axes": {
        "coulomb": AXIS, "asymmetric": AXIS, "viscous": AXIS, "viscous_by_direction": AXIS, "quadratic": AXIS,
        "stribeck": AXIS, "loaded": AXIS, "coulomb_by_position": AXIS, "offset": "axes, other rates",
        "gravity_error": TURNING, "cogging": TURNING, "spring": ENDS, "elastic_end": ENDS,
    },
    "Processes": {
        "loss": f"{OTHER}, not of angles", "storage": f"{OTHER}, not of angles", "radiation": "temperatures",
        "overflow": "states that are never negative, not temperatures", "coupling": OTHER, "product": OTHER,
    },
    "Inputs": {
        "input_gain": INPUT, "input_offset": INPUT, "input_curve": INPUT, "saturation": INPUT, "input_lag": INPUT,
        "input_delay": INPUT, "gain_by_direction": BOTH, "dead_zone": BOTH,
    },
    "Measured disturbances": {
        "disturbance_gain": "disturbances that change", "disturbance_offset": "all disturbances",
        "disturbance_lag": "disturbances that change",
    },
    "Sensors": dict.fromkeys(("output_gain", "output_offset", "output_curve", "output_lag"), "outputs that change"),
}  # fmt: skip
"""Laws by kind, and what each is tried for (:func:`~hybrid_mpc.identify.term_library.library`)."""
UNITS = 3
"""Units of a parameter that a cell shows at most."""
HEAD = """# Terms

The laws that [`hybrid-mpc explain`](explain.md) chooses from. `--terms LAW` limits a search. `hm.terms.LAW(...)` makes
a term for [a prior of your own](mechanical-priors.md#friction-and-other-terms).

| symbol | meaning |
| --- | --- |
| `q`, `v` | position and its speed |
| `x`, `u`, `w`, `y` | state, input, measured disturbance, output |
| `s` | state of the term itself |

An *axis* is a pair of states, a position and its speed. *Other rates* are those of other states that a network may
correct. A potential acts as the force `-dV/dq`. Units are examples; angles have no unit within a term.

This page is generated: `python -m hybrid_mpc.identify.term_table > docs/terms.md`.
"""


class _Turning(MechanicalPrior):
    states: ClassVar[tuple[Signal, ...]] = (Signal("q", "rad", -9.0, 9.0), Signal("v", "rad/s"))
    inputs: ClassVar[tuple[Signal, ...]] = (Signal("u", "V"),)
    outputs: ClassVar[tuple[Signal, ...]] = states[:1]
    parameters: ClassVar[tuple[Parameter, ...]] = (Parameter("k", 1.0, "N m/V", 0.1, 9.0),)

    def mass_matrix(self, q: Any, p: Any) -> Any:
        return 1.0

    def force(self, q: Any, v: Any, u: Any, w: Any, p: Any) -> Any:
        return p.k * u.u - ca.sin(q.q)


class _Sliding(_Turning):
    states: ClassVar[tuple[Signal, ...]] = (Signal("q", "m", -9.0, 9.0), Signal("v", "m/s"))
    outputs: ClassVar[tuple[Signal, ...]] = states[:1]


class _Process(Prior):
    states: ClassVar[tuple[Signal, ...]] = (Signal("x", "m", 0.0, 9.0), Signal("T", "degC", 0.0, 99.0))
    inputs: ClassVar[tuple[Signal, ...]] = (Signal("u", "V", 0.0, 9.0),)
    disturbances: ClassVar[tuple[Signal, ...]] = (Signal("w", "degC", 0.0, 99.0),)
    outputs: ClassVar[tuple[Signal, ...]] = (states[0], states[1])
    parameters: ClassVar[tuple[Parameter, ...]] = (Parameter("k", 1.0, "1/s", 0.1, 9.0),)

    def xdot(self, x: Any, u: Any, w: Any, p: Any) -> Any:
        return u.u - p.k * x.x, p.k * (w.w - x.T)


def document() -> str:
    """The page as Markdown."""
    units, parts = _units(), [HEAD]
    for title, laws in GROUPS.items():
        parts.append(
            f"## {title}\n\n{_tried(laws)}\n\n| law | what it is | equation | units |\n| --- | --- | --- | --- |"
        )
        for law in laws:
            cells = [f"`{law}`", terms.EXPLANATIONS[law], equation(law), "; ".join(units[law])]
            parts.append(f"| {' | '.join(cells)} |")
        parts.append("")
    return "\n".join(parts)


def _tried(laws: Mapping[str, str]) -> str:
    """What the laws of a table are tried for, the most common one first."""
    by: dict[str, list[str]] = {}
    for law, where in laws.items():
        by.setdefault(where, []).append(f"`{law}`")
    common = max(by, key=lambda where: len(by[where]))
    others = [f"{', '.join(names)} for {where}" for where, names in by.items() if where != common]
    exceptions = f" Exceptions: {'; '.join(others)}." if others else ""
    return f"`explain` tries these laws for {common}.{exceptions}"


def equation(law: str) -> str:
    """Equation of a law, from its docstring.

    Example:
        >>> equation("viscous_by_direction"), equation("storage")
        ('`-a abs(v)`', "`k (s - x)` with `tau s' = x - s`")
    """
    words = inspect.getdoc(getattr(terms, law)) or ""
    spans = re.findall(r"``(.*?)``", words, re.DOTALL)
    # a bar ends a cell of a table
    plain = [re.sub(r"\|([^|]+)\|", r"abs(\1)", " ".join(span.split())) for span in spans]
    found = [f"`{span}`" for span in plain]
    more = [span for span in found[1:2] if "s' =" in span]
    kind = "potential " if "potential" in words.partition("``")[0] else ""
    return kind + " with ".join([*found[:1], *more]) if found else "constant"


def _units() -> Mapping[str, list[str]]:
    """Units of the parameters by law, in three examples."""
    found: dict[str, list[str]] = {law: [] for laws in GROUPS.values() for law in laws}
    for one in _examples():
        for form in one.forms:
            assert form.made is not None
            own = ", ".join(dict.fromkeys(p.unit for p in form.parameters))
            if own not in found[form.made.maker]:
                found[form.made.maker].append(own)
    return {law: units[:UNITS] for law, units in found.items()}


def _examples() -> Iterator[Candidate]:
    rng = np.random.default_rng(0)
    for prior in (_Turning(), _Sliding(), _Process()):
        x = rng.uniform(0.1, 2.0, (50, 2)) * (1.0 if prior.disturbances else rng.choice([-1.0, 1.0], (50, 1)))
        u = rng.uniform(0.1, 2.0, (50, 1)) * (1.0 if prior.disturbances else rng.choice([-1.0, 1.0], (50, 1)))
        yield from library(prior, (x, u, rng.uniform(10.0, 20.0, (50, len(prior.disturbances)))), 0.01, 5.0)


if __name__ == "__main__":
    sys.stdout.write(document())
