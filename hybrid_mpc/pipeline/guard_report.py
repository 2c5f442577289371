"""What a run says of its energy guard: in results.json, and as a section of the report."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

from matplotlib.figure import Figure

from hybrid_mpc.pipeline.context import Context
from hybrid_mpc.pipeline.faulted_loops import read_trace
from hybrid_mpc.pipeline.judge import RATES, run_calibration
from hybrid_mpc.plots.monitor_trace import overview
from hybrid_mpc.report import Table

LEARNED = ("false_alarms_per_hour", "hours", "force_threshold", "energy_threshold", "data_hash")
"""Fields of the detector that the schema names."""


def guard_results(context: Context) -> dict[str, Any]:
    """The group ``guard`` of results.json."""
    found = context.result("guard")
    if "detector" not in found:
        none = dict.fromkeys((*LEARNED, "test_seconds", "test_alarms", "faults"))
        details = {
            key: found[key] for key in ("source", "plausibility", "plausibility_reason") if key in found
        }
        return {**none, "reason": found["reason"], "details": details}
    detector, test = found["detector"], found["test"]
    out = {key: detector[key] for key in LEARNED}
    out |= {"test_seconds": test["seconds"], "test_alarms": test["alarms"], "faults": None}
    if "faults" in found:
        keys = ("fault", "start_s", "delay_s", "diagnosis")
        out["faults"] = [{key: row[key] for key in keys} for row in found["faults"]]
    else:
        lacks = (
            "plant that could break" if context.scenario.plant is None else "task in which nothing goes wrong"
        )
        out["faults_reason"] = f"scenario {context.scenario.name} has no {lacks}"
    kept = ("source", "loops", "detector", "plausibility", "plausibility_reason", "test", "faults")
    return {**out, "details": {key: found[key] for key in kept if key in found}}


def guard_tables(results: dict[str, Any]) -> list[Table]:
    """Thresholds, faults, and alarms in the recordings with test data."""
    guard = results["guard"]
    if guard["data_hash"] is None:
        return []
    detector = guard["details"]["detector"]
    low = detector["interval"]
    rows: list[tuple[Any, ...]] = [
        ("sum of residual forces [deviations]", guard["force_threshold"], f"{low[0]:.3g} to {low[1]:.3g}"),
        ("power of the free run [deviations]", guard["energy_threshold"], f"{low[2]:.3g} to {low[3]:.3g}"),
    ]
    caption = (
        f"Thresholds for {guard['false_alarms_per_hour']:g} false alarms an hour, both together; learned from "
        f"{60 * guard['hours']:.1f} min with hash {guard['data_hash'][:16]}."
    )
    tables = [Table(("what is compared", "threshold", "5 to 95 % of a bootstrap"), rows, caption)]
    if guard["faults"] is not None:
        tables.append(_fault_table(guard["details"]["faults"]))
    alarms = guard["details"]["test"]["list"]
    if alarms:
        tables.append(
            Table(
                ("recording", "from [s]", "to [s]", "what explains it"),
                [(a["file"], a["start_s"], a["end_s"], a["diagnosis"] or None) for a in alarms],
                "Alarms over the recordings that hold test data, all of each.",
            )
        )
    return tables


def _fault_table(faults: list[dict[str, Any]]) -> Table:
    rows = [
        (
            row["title"],
            row["start_s"],
            "never" if row["delay_s"] is None else f"{row['delay_s']:.2f}",
            row["false_alarms"],
            row["diagnosis"] or None,
            ", ".join(f"{s['after'].lower()} at {s['t_s']:.2f} s" for s in row["switches"]) or "stays normal",
        )
        for row in faults
    ]
    columns = (
        "what breaks",
        "from [s]",
        "alarm after [s]",
        "alarms before",
        "what the diagnosis says",
        "guard",
    )
    return Table(columns, rows, f"Loops of the task {faults[0]['task']} in which something breaks, one each.")


def guard_words(results: dict[str, Any]) -> tuple[str, ...]:
    """What this run's detector was learned from, what it does not promise, and the plan's plausibility."""
    guard, details = results["guard"], results["guard"].get("details", {})
    if guard["data_hash"] is None:
        words = [f"{guard['reason'][0].upper()}{guard['reason'][1:]}."]
    else:
        rate, wanted = guard["false_alarms_per_hour"], RATES[0] / details["detector"].get("time_unit", 1.0)
        words = [f"The detector was learned from {details['source']}."]
        if rate > wanted:
            alarms = "one false alarm" if wanted == 1 else f"{wanted:g} false alarms"
            words[0] += (
                f" They are too short for {alarms} an hour, so the thresholds are for {rate:g}; a longer run "
                f"(budget full), or recordings of the machine with hybrid-mpc monitor --learn {wanted:g}, give better "
                "ones."
            )
        test = details["test"]
        if test["seconds"] > 0:
            words.append(
                f"In {test['seconds']:.0f} s of test recordings it alarmed {_times(test['alarms'])}; that bounds its "
                f"rate there at {test['at_most_per_hour']:.3g} an hour (95 %)."
            )
            if details["loops"]:
                words[-1] += (
                    " They were driven otherwise, and wider, than the loops: an alarm there says that the model is "
                    "less right where the loops do not go."
                )
        else:
            words.append("No test recording is long enough to try it on.")
    if "plausibility" in details:
        ordinary = details["plausibility"]
        words.append(
            f"For bounds in the plan: {100 * ordinary['quantile']:g} % of {ordinary['samples']} training samples have "
            f"a model balance within a bound of {ordinary['tolerance_w']:.3g} W in the median."
        )
    elif "plausibility_reason" in details:
        words.append(f"There is no plausibility for the plan: {details['plausibility_reason']}.")
    return tuple(words)


def _times(n: int) -> str:
    return {0: "never", 1: "once", 2: "twice"}.get(n, f"{n} times")


def guard_figures(context: Context) -> Iterator[tuple[str, str, Figure, str]]:
    """Each loop in which something breaks; of a machine without plant a recording with test data."""
    found = context.result("guard")
    if "faults" not in found and "shown" not in found:
        return
    arrays, output = context.arrays("guard"), context.scenario.prior().outputs[0]
    unit = "N m" if output.unit == "rad" else "N"
    for row in found.get("faults", ()):
        start, name = row["start_s"], row["fault"]
        marks = [
            (start, row["title"]),
            *((s["t_s"], f"guard: {s['after'].lower()}") for s in row["switches"]),
        ]
        figure = overview(
            read_trace(arrays, name), arrays[f"{name}/y"], output=output, force_unit=unit, marks=marks,
            title=f"{row['task']}: {row['title']} at {start:g} s",
        )  # fmt: skip
        seen = "without an alarm" if row["delay_s"] is None else f"alarm after {row['delay_s']:.2f} s"
        told = f"; the diagnosis: {row['diagnosis']}" if row["diagnosis"] else ""
        yield "guard", f"guard_{name}", figure, f"{row['title'].capitalize()}: {seen}{told}."
    if "faults" not in found:
        shown, limits = found["shown"], {}
        if "detector" not in found:
            stored = run_calibration(context)
            known = {"violation": stored.threshold_w, "residual": stored.residual_threshold}
            limits = {name: limit for name, limit in known.items() if limit is not None}
        figure = overview(
            read_trace(arrays, "recorded"), arrays["recorded/y"], output=output, force_unit=unit,
            thresholds=limits, title=shown,
        )  # fmt: skip
        by = "learned detector" if "detector" in found else "thresholds of the section before"
        if not (limits or "detector" in found):
            by = "monitor, which has no thresholds to judge by"
        yield (
            "guard",
            "guard_recorded",
            figure,
            f"The recording {shown}, of which test data come, by the {by}.",
        )
