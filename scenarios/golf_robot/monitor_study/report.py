"""Report, table and figures of the study ``monitor``."""

from __future__ import annotations

import math
import shlex
from collections.abc import Mapping
from pathlib import Path
from typing import Any, Literal

from hybrid_mpc.compare.study_log import StudyNote
from hybrid_mpc.errors import InputError
from hybrid_mpc.files import write_text
from hybrid_mpc.plots.style import save
from hybrid_mpc.report.page import KeyFigure, Report, Section, Table, write_report
from scenarios.golf_robot.monitor_study.detection import METHODS
from scenarios.golf_robot.monitor_study.plan import ARMS, CASES
from scenarios.golf_robot.monitor_study.plots import delays, method_name, operating_curves

TITLES = {case.name: case.title for case in CASES}
NOMINAL_TEXT = (
    "Nominal loops on seeds that nothing was learned from; in a third of them friction drifts slowly by 10 % both "
    "ways. A false alarm is an alarm that begins. The bound is the upper 95 % one of a Poisson rate.",
)
DELAY_TEXT = (
    "A fault begins at a random instant of the sinusoidal task. Only time at a true speed above 0.3 rad/s counts, a "
    "miss counts as infinite. In brackets the 95 % interval of the median (order statistics), then the misses.",
)
ROC_TEXT = (
    "All thresholds of a method grow together. Counted are blocks of 5 s with an alarm, and faults found within a "
    "second in motion. The dotted line is the wanted rate.",
)
GUARD_TEXT = (
    "The same loops with a guard: 'rest' records faults of the model and rests when the sensor freezes, 'backup' goes "
    "over to the fitted prior's MPC as well, 'adapt' to an MPC whose filter estimates mass and friction, once the "
    "alarm has lasted for 0.8 s. Ratio of mean costs to those without a guard, with a paired 95 % "
    "bootstrap interval.",
)


def write_monitor_report(out: Path, results: Mapping[str, Any], note: StudyNote) -> Path:
    """Write ``report.html``, ``table.md``, ``delays.png`` and ``roc.png``."""
    delay_tables = [*(delay_table(results, rate) for rate in results["delays"]), _miss_table(results)]
    sections = [
        Section("False alarms", NOMINAL_TEXT, (), [alarm_table(results)]),
        Section("Delays", DELAY_TEXT, _figure(_delays, results, out), delay_tables),
        Section("Found against false alarms", ROC_TEXT, _figure(_roc, results, out)),
        Section("Reaction", GUARD_TEXT, (), [guard_table(results), limit_table(results)]),
        _setup(results, note),
    ]
    tables = [t for section in sections[:4] for t in section.tables]
    write_text(out / "table.md", "\n\n".join(f"{t.caption}\n\n{markdown(t)}" for t in tables) + "\n")
    report = Report(
        f"Study {note.study['name']}", note.title, note.description,
        f"python -m scenarios.golf_robot.monitor_study run MODEL --out {shlex.quote(out.name)}", _head(results),
        sections,
        f"hybrid-mpc {note.versions['hybrid-mpc']}",
    )  # fmt: skip
    return write_report(out / "report.html", report)


def alarm_table(results: Mapping[str, Any]) -> Table:
    """False alarms of each method, by wanted rate."""
    rows = []
    for rate, methods in results["false_alarms"].items():
        for method, f in methods.items():
            drifting = f"{f['drifting']['count']} in {f['drifting']['hours']:.2f} h"
            rows.append((float(rate), method_name(method), f["count"], f["hours"], f["upper_95"], drifting))
    columns = (
        "wanted [1/h]",
        "method",
        "false alarms",
        "hours",
        "at most [1/h], 95 %",
        "where friction drifts",
    )
    return Table(columns, rows, "False alarms on nominal loops.")


def delay_table(results: Mapping[str, Any], rate: str) -> Table:
    """Median delay, its interval and the share of misses, by fault and method."""
    rows = []
    for case, methods in results["delays"][rate].items():
        rows.append((TITLES[case], *(_delay(methods[m]) for m in METHODS)))
    columns = "fault", *(method_name(m) for m in METHODS)
    return Table(columns, rows, f"Median delay [s] at a wanted rate of {rate} false alarms an hour.")


def guard_table(results: Mapping[str, Any]) -> Table:
    """Ratio of costs with and without a guard."""
    rows = []
    for case, arms in results["guard"].items():
        for arm, f in arms.items():
            ratio = f"{f['ratio']:.3g} [{f['low']:.3g}, {f['high']:.3g}]"
            rows.append(
                (TITLES[case], arm, f["n"], f["off"], f["on"], ratio, f["switches"], f["early_switches"])
            )
    columns = (
        "fault",
        "reaction",
        "loops",
        "cost without",
        "cost with",
        "ratio",
        "switches",
        "before the fault",
    )
    return Table(columns, rows, "Mean costs without and with a guard, on common seeds.")


def limit_table(results: Mapping[str, Any]) -> Table:
    """Loops that left a limit, and by how much at most, without and with a guard."""
    rows = []
    for case, arms in results["guard"].items():
        found = {"without": next(iter(arms.values()))["violations_off"]} if arms else {}
        found |= {arm: arms[arm]["violations_on"] for arm in ARMS if arm in arms}
        rows += [
            (TITLES[case], arm, *(_limit(limits, name) for name in LIMITS)) for arm, limits in found.items()
        ]
    columns = "fault", "reaction", *LIMITS.values()
    return Table(columns, rows, "Loops beyond a limit, and by how much at most.")


LIMITS = {"x0": "angle [rad]", "x1": "speed [rad/s]", "u": "input [N m]", "du": "change of input [N m]"}


def markdown(table: Table) -> str:
    """A table in Markdown.

    Example:
        >>> print(markdown(Table(("a", "b"), [("x", 0.12345)])))
        | a | b |
        | --- | --- |
        | x | 0.123 |
    """
    lines = [table.columns, ["---"] * len(table.columns), *table.rows]
    return "\n".join("| " + " | ".join(_text(v) for v in row) + " |" for row in lines)


def _text(value: Any) -> str:
    if value is None:
        return "-"
    return f"{value:.3g}" if isinstance(value, float) else str(value)


def _limit(limits: Mapping[str, Any], name: str) -> str:
    if name not in limits:
        return "-"
    found = limits[name]
    return f"{found['loops']} ({found['largest']:.3g})" if found["loops"] else "0"


def _delay(f: Mapping[str, Any]) -> str:
    if not f["n"]:
        return "-"
    early = f", {f['early']} early" if f["early"] else ""
    return f"{f['median']:.2f} [{f['low']:.2f}, {f['high']:.2f}], {100 * f['miss_rate']:.0f} %{early}"


def _miss_table(results: Mapping[str, Any]) -> Table:
    rate = next(iter(results["delays"]))
    rows = []
    for case, methods in results["delays"][rate].items():
        cells = [
            f"{f['misses']} of {f['n']} [{100 * f['miss_low']:.0f}, {100 * f['miss_high']:.0f}] %"
            if f["n"]
            else "-"
            for f in (methods[m] for m in METHODS)
        ]
        rows.append((TITLES[case], *cells))
    columns = "fault", *(method_name(m) for m in METHODS)
    return Table(
        columns,
        rows,
        f"Misses with the 95 % interval of their share (Wilson), at {rate} false alarms an hour.",
    )


def _head(results: Mapping[str, Any]) -> list[KeyFigure]:
    rate = next(iter(results["false_alarms"]))
    guard = results["false_alarms"][rate]["guard"]
    bound = guard["upper_95"] if math.isfinite(guard["upper_95"]) else None
    good: Literal["good", "bad"] = "good" if bound is not None and bound <= 1.0 else "bad"
    text = f"{guard['count']} in {guard['hours']:.3g} h; upper 95 % bound, wanted: at most 1"
    figures = [KeyFigure("False alarms of the guard", bound, "1/h", text, good)]
    for case, methods in results["delays"][rate].items():
        f = methods["guard"]
        if f["n"]:
            median = f["median"] if math.isfinite(f["median"]) else "never"
            figures.append(KeyFigure(f"Delay: {TITLES[case]}", median, "s", f"median of {f['n']}, guard"))
    return figures


def _setup(results: Mapping[str, Any], note: StudyNote) -> Section:
    rows = [(key, str(value)) for key, value in results["study"].items()]
    rows += [
        ("learned from", f"{results['learned']['hours']:.3g} h, {results['learned']['blocks']} blocks of 5 s")
    ]
    rows += [("jobs", f"{results['jobs']['done']} done, {results['jobs']['failed']} failed, of {note.runs}")]
    return Section("Setup", (), (), [Table(("setting", "value"), rows)])


def _figure(draw: Any, results: Mapping[str, Any], out: Path) -> list[tuple[Path, str]]:
    try:
        figure, name, caption = draw(results)
    except InputError:  # nothing to show yet
        return []
    return [(save(figure, out / name), caption)]


def _delays(results: Mapping[str, Any]) -> tuple[Any, str, str]:
    rate, found = next(iter(results["delays"].items()))
    rows = {TITLES[c]: {m: f["delays"] for m, f in methods.items()} for c, methods in found.items()}
    return delays(rows), "delays.png", f"Distribution of the delays at {rate} false alarms an hour."


def _roc(results: Mapping[str, Any]) -> tuple[Any, str, str]:
    wanted = float(next(iter(results["delays"])))
    curves = {
        TITLES[c]: {m: (f["per_hour"], f["found"]) for m, f in methods.items()}
        for c, methods in results["roc"].items()
    }
    return operating_curves(curves, wanted), "roc.png", "Faults found within a second against false alarms."
