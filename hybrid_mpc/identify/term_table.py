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

GROUPS: Mapping[str, str] = {
    "Axes": "coulomb asymmetric viscous viscous_by_direction quadratic stribeck loaded coulomb_by_position offset "
    "gravity_error cogging spring elastic_end inertia",
    "Processes": "loss storage radiation overflow coupling product",
    "Inputs": "input_gain input_offset input_curve saturation input_lag input_delay gain_by_direction dead_zone",
    "Measured disturbances": "disturbance_gain disturbance_offset disturbance_lag",
    "Sensors": "output_gain output_offset output_curve output_lag",
}
"""The laws by the kind of signal ``of``."""
REMARKS: Mapping[str, str] = {
    "Axes": "`of` is the speed `v`, `q` its position. Units are those of a turning axis. For a sliding axis, read N"
    " for N m, and m for rad.\n\n- A potential `V` acts as the force `-dV/dq`. It needs a `MechanicalPrior`.\n- `load`"
    ' is `"driven"` (by the inputs), `"resting"` (gravity, springs) or `"both"`.\n- `turning=False`: `q - centre`'
    " and its square replace sine and cosine.\n- `upper=False`: the stop acts below `edge`.\n- `offset` also adds to"
    " the rate of a state that is no speed.",
    "Processes": "`of` is a state `x`, in m or degC here.\n\n- `reference` is a number, or a state or disturbance of"
    " the same unit.\n- `kelvin` is 273.15 for degC and 0 for K.\n- `source`, `one` and `two` name states, inputs or"
    " disturbances.",
    "Inputs": "`of` is an input `u`, in V here. The value of the equation acts instead of `u`.",
    "Measured disturbances": "`of` is a measured disturbance `w`, in degC here.",
    "Sensors": "`of` is an output `y`, in rad here.",
}
"""Meaning of ``of`` and of arguments in a table."""
SYMBOLS: Mapping[str, Mapping[str, str]] = {
    "coulomb": {"F": "level"}, "asymmetric": {"A": "more"}, "stribeck": {"F": "more"},
    "coulomb_by_position": {"a": "one", "b": "two"}, "gravity_error": {"a": "sine", "b": "cosine"},
    "cogging": {"a": "sine", "b": "cosine", "n": "periods"}, "spring": {"k": "stiffness"},
    "elastic_end": {"k": "stiffness"}, "loss": {"r": "reference"},
    "product": {"c1": "centres[0]", "c2": "centres[1]"}, "input_offset": {"offset": "value"},
    "disturbance_offset": {"offset": "value"}, "output_offset": {"offset": "value"},
}  # fmt: skip
"""Arguments by the symbol of the docstring's equation, where they differ."""
HEAD = """# Terms

Physical terms for [a prior of your own](mechanical-priors.md#friction-and-other-terms).
[`hybrid-mpc explain`](explain.md) searches the same terms; `--terms NAME` limits the search.

```python
from hybrid_mpc import Parameter, terms

dry = terms.coulomb("phi_dot", Parameter("F", 0.2, "N m", 0.0, 1.0), width=0.05)
```

| argument | meaning |
| --- | --- |
| `of` | name of the signal that the term changes |
| others without `=` | a `Parameter` each, which is fitted; the column *units* has their units |
| with `=` | not fitted: a name, or a number in the unit of its signal |
| `width` | range over which a switch is smooth |
| `state` | `Signal` of the term's own state `s` |
| `place` | of axes, but not of potentials: `place="rate"` if the prior is not mechanical |

Angles have no unit within an equation. This page is generated:
`python -m hybrid_mpc.identify.term_table > docs/terms.md`.
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
            f"## {title}\n\n{REMARKS[title]}\n\n| call | effect | equation | units |\n| --- | --- | --- | --- |"
        )
        for law in laws.split():
            effect = terms.EXPLANATIONS[law].removesuffix(".")
            cells = [f"`{call(law)}`", effect, equation(law), units[law]]
            parts.append(f"| {' | '.join(cells)} |")
        parts.append("")
    return "\n".join(parts)


def call(law: str) -> str:
    """Call of a law without values; an argument with ``=`` is given by name, one with a value has that default.

    Example:
        >>> call("coulomb"), call("coupling")
        ('coulomb(of, level, width=)', 'coupling(of, k, source=, centre=0.0)')
    """
    given = []
    for one in inspect.signature(getattr(terms, law)).parameters.values():
        if one.kind != one.KEYWORD_ONLY:
            given.append(one.name)
        elif one.name != "place":
            given.append(f"{one.name}={'' if one.default is one.empty else one.default}")
    return f"{law}({', '.join(given)})"


def equation(law: str) -> str:
    """Equation of a law in the names of its arguments, from its docstring.

    Example:
        >>> equation("viscous_by_direction"), equation("spring"), equation("input_lag")
        ('`-a abs(v)`', '`V = stiffness (q - centre)^2 / 2`', "`s` with `tau s' = u - s`")
    """
    words = inspect.getdoc(getattr(terms, law)) or ""
    spans = re.findall(r"``(.*?)``", words, re.DOTALL)
    # a bar ends a cell of a table
    plain = [re.sub(r"\|([^|]+)\|", r"abs(\1)", " ".join(span.split())) for span in spans]
    names = SYMBOLS.get(law, {})
    found = [re.sub(r"\w+", lambda word: names.get(word[0], word[0]), span) for span in plain]
    kind = "V = " if "potential" in words.partition("``")[0] else ""
    if not found:
        return "`value`"
    more = [f"`{span}`" for span in found[1:2] if "s' =" in span]
    lag = ["`s`"] if "s' =" in found[0] else []
    return " with ".join([*lag, f"`{kind}{found[0]}`", *more])


def _units() -> Mapping[str, str]:
    """Units of the parameters by law, of the first example that has it."""
    found: dict[str, str] = {}
    for one in _examples():
        for form in one.forms:
            assert form.made is not None
            written = ", ".join(p.unit for p in form.parameters)
            for twice, square in (("s s/rad/rad", "s^2/rad^2"), ("/V/V", "/V^2")):
                written = written.replace(twice, square)
            found.setdefault(form.made.maker, written)
    return found


def _examples() -> Iterator[Candidate]:
    rng = np.random.default_rng(0)
    for prior in (_Turning(), _Process()):
        x = rng.uniform(0.1, 2.0, (50, 2)) * (1.0 if prior.disturbances else rng.choice([-1.0, 1.0], (50, 1)))
        u = rng.uniform(0.1, 2.0, (50, 1)) * (1.0 if prior.disturbances else rng.choice([-1.0, 1.0], (50, 1)))
        yield from library(prior, (x, u, rng.uniform(10.0, 20.0, (50, len(prior.disturbances)))), 0.01, 5.0)


if __name__ == "__main__":
    sys.stdout.write(document())
