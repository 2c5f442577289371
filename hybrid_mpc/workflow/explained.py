"""Result of ``hybrid-mpc explain``, and the scenario file with the found terms. No torch in this module."""

from __future__ import annotations

import os
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path

from hybrid_mpc.check.operating_point import drift_at_rest, steady_point
from hybrid_mpc.identify.explanation import Explanation, FittedParameter, FoundTerm
from hybrid_mpc.machine.prior import OperatingPoint
from hybrid_mpc.machine.terms import Made, Term, code_of, with_nominal
from hybrid_mpc.scenario import Scenario

DIGITS = 6
"""Significant digits of fitted values in a file that a user edits."""
ENDING = "_explained"


@dataclass(frozen=True)
class FreeRuns:
    """Errors of free runs of one prior over the test recordings, which the search does not use.

    Args:
        error: Root mean square over the outputs of the error over the output's spread [-].
        rmse: Root mean square error by output, ``"phi [rad]"``.
    """

    error: float
    rmse: Mapping[str, float]


@dataclass(frozen=True)
class ExplainResult:
    """Result of a search for missing terms.

    Args:
        scenario: Name of the scenario.
        explanation: Steps, terms, values and evidence.
        delay: Fitted delay of the inputs [s].
        floor: Error of a perfect model due to the sensor noise [-], as estimated by the fitted prior's smoother.
        tests: Errors over the test recordings by model: ``"nominal"``, ``"fitted"``, ``"explained"``. Empty without
            test recordings.
        file: Name of the scenario file with the found terms; empty without a found term.
        run_length: Length [s] of the free runs over the test recordings. Default: whole recordings.
    """

    scenario: str
    explanation: Explanation
    delay: float
    floor: float
    tests: Mapping[str, FreeRuns] = field(default_factory=dict)
    file: str = ""
    run_length: float | None = None

    @property
    def tests_title(self) -> str:
        """Title of the table of ``tests``."""
        length = "" if self.run_length is None else f" of {self.run_length:.3g} s"
        return f"free runs{length} over the test recordings"


def explained_name(scenario: str) -> str:
    """Name of a scenario whose prior has the found terms.

    Example:
        >>> explained_name("emps"), explained_name("emps_explained")
        ('emps_explained', 'emps_explained')
    """
    return scenario.removesuffix(ENDING) + ENDING


def scenario_code(scenario: Scenario, where: str, found: Explanation, folder: Path) -> str:
    """Code of a scenario file: the given scenario with the found terms in its prior, fitted values as nominal values.

    Args:
        scenario: The given scenario.
        where: Its registered name, or the path of its file.
        found: Result of the search.
        folder: Folder of the new file, which refers to ``where`` by a relative path.
    """
    values = {p.name: p for p in found.parameters}
    point = _moved_point(scenario, found)
    own = [term for term in found.found if term.made is None]
    made = [term for term in found.found if term.made is not None]
    of_made = {p.name for term in made if term.made for p in term.made.parameters}
    signals = any(state_of(term) for term in made)
    names = [
        *(["OperatingPoint"] if point else []),
        "Parameter",
        *(["Signal"] if signals else []),
        "load_scenario",
        "terms",
        "with_terms",
    ]
    found_from = (
        f"str(Path(__file__).parent / {_way(folder, where)!r})" if where.endswith(".py") else repr(where)
    )
    lines = [
        f'"""{_plain(scenario.title)}: the prior with the terms that the recordings support.',
        "",
        f"Written by hybrid-mpc explain, evaluated on {found.evidence.text}.",
        f"Held-out error with the terms over that without: {found.after.ratio:.2f} ({found.averaged}).",
        "You may edit this file.",
        '"""',
        "",
        *(["from pathlib import Path", ""] if where.endswith(".py") else []),
        f"from hybrid_mpc import {', '.join(names)}",
        "",
        f"machine = load_scenario({found_from})",
    ]
    if own:
        lines.append("own = {term.name: term for term in machine.terms if not isinstance(term, str)}")
    lines += ["", "TERMS = ("]
    for term in found.found:
        lines.append(f"    # {_plain(term.explanation)} {_plain(term.formula)}")
        lines += [f"    own[{term.name!r}],"] if term.made is None else _call(term.made, values)
    lines += [")", '"""The terms that were found, with their fitted values."""', "", "FITTED = {"]
    lines += [
        f"    {p.name!r}: {_rounded(p.value)!r},  # {_error(p)}"
        for p in found.parameters
        if p.name not in of_made
    ]
    lines += [
        "}", '"""Fitted values of the other parameters."""', "",
        *([
            f"POINT = OperatingPoint(x={point.x!r}, u={point.u!r}, w={point.w!r})",
            '"""Equilibrium with the found terms and the fitted values."""', "",
        ] if point else []),
        "scenario = with_terms(", "    machine,", "    TERMS,", "    FITTED,", *(["    POINT,"] if point else []),
        f"    name={explained_name(scenario.name)!r},", f"    title={scenario.title + ', with found terms'!r},",
    ]  # fmt: skip
    return "\n".join([*lines, ")", ""])


def _moved_point(scenario: Scenario, found: Explanation) -> OperatingPoint | None:
    """The equilibrium of the prior with the found terms, where these moved it; None: the scenario's stays.

    Values are those of the file, with its digits.
    """
    own = [term for term in scenario.terms if isinstance(term, Term)]
    values = {name: _rounded(value) for name, value in found.values.items()}
    prior = with_nominal(found.prior(type(scenario.prior()), own), values)()
    second = max(10 * scenario.data.dt, scenario.data.warm_up)
    return steady_point(prior) if drift_at_rest(prior, second) else None


def _way(folder: Path, file: str) -> str:
    """Relative path from a folder to a file; the absolute path if they lie on different drives."""
    try:
        return Path(os.path.relpath(file, folder)).as_posix()
    except ValueError:
        return str(Path(file).resolve())


def state_of(term: FoundTerm) -> bool:
    """Whether a found term has a state of its own."""
    return term.made is not None and "state" in term.made.options


def _call(made: Made, values: Mapping[str, FittedParameter]) -> Iterator[str]:
    """Lines of the call that makes a term, with fitted values."""
    yield f"    terms.{made.maker}("
    yield f"        {made.of!r},"
    for p in made.parameters:
        fitted = values[p.name]
        own = replace(p, value=_rounded(fitted.value), lower=_rounded(p.lower), upper=_rounded(p.upper))
        yield f"        {code_of(own)},  # {_error(fitted)}"
    for key, value in made.options.items():
        yield f"        {key}={code_of(_rounded(value) if isinstance(value, float) else value)},"
    yield "    ),"


def _rounded(value: float) -> float:
    """A number as a user writes it; rounding keeps the order of numbers, so values stay within bounds."""
    return float(f"{value:.{DIGITS}g}")


def _error(p: FittedParameter) -> str:
    if p.standard_error == 0.0:
        return f"{p.unit}, fixed"
    return f"{p.unit}, standard error {p.standard_error:.2g}" + (", at its bound" if p.at_bound else "")


def _plain(text: str) -> str:
    """A text on one line without characters that would end a comment or docstring."""
    return " ".join(text.replace("\\", "/").replace('"""', "'''").split())
