"""Stage report: figures, ``report.html`` and ``results.json``."""

from __future__ import annotations

import shlex
from collections.abc import Mapping, Sequence
from typing import Any

from hybrid_mpc.files import write_json
from hybrid_mpc.job.contenders import CONTENDERS
from hybrid_mpc.pipeline.context import Context
from hybrid_mpc.pipeline.figures import OBSERVER_TITLES, Figures, draw_all
from hybrid_mpc.pipeline.guard_report import guard_tables, guard_words
from hybrid_mpc.pipeline.identify import training_settings
from hybrid_mpc.pipeline.results import collect
from hybrid_mpc.plots.style import name_of
from hybrid_mpc.report import KeyFigure, Report, Section, Table, write_report
from hybrid_mpc.report.schema import CONTROLLERS, MODELS, OBSERVERS
from hybrid_mpc.report.texts import TITLES, paragraphs


def report_stage(context: Context) -> None:
    """Draw, write the report, and last the results."""
    results = collect(context)
    figures = draw_all(context)
    write_report(context.out / "report.html", _report(context, results, figures))
    write_json(context.out / "results.json", results)
    context.save("report", results)


def command(context: Context) -> str:
    """The command line that makes this run."""
    s = context.settings
    words = ["hybrid-mpc", "run", s.scenario, *(w for f in s.data for w in ("--data", f.name))]
    for option, values in (("--input-column", s.inputs), ("--output-column", s.outputs)):
        words += [w for v in values for w in (option, v)]
    words += ["--time-column", s.time] if s.time else []
    words += ["--settings", s.network_file.name] if s.network_file else []
    return shlex.join([*words, "--seed", str(s.seed), "--budget", s.budget])


def _report(context: Context, results: dict[str, Any], figures: Figures) -> Report:
    tables: dict[str, Table | None] = {
        "data": _data_table(results),
        "models": _prior_table(context),
        "free_run": _score_table(results),
        "export": _export_table(results),
        "control": _control_table(results),
        "estimation": _observer_table(results),
        "timing": _timing_table(results),
        "monitor": _alarm_table(results),
        "analysis": _pole_table(results),
    }
    notes, several = _notes(context, results), {"guard": guard_tables(results)}
    sections = tuple(
        Section(
            TITLES[key],
            notes["instead"].get(key, paragraphs(key)),
            figures.get(key, ()),
            [t for t in (tables.get(key), *several.get(key, ())) if t is not None and t.rows],
            notes["after"].get(key, ()),
        )
        for key in TITLES
    )
    versions = ", ".join(f"{name} {v}" for name, v in results["versions"].items())
    return Report(
        f"hybrid-mpc: {context.scenario.name}",
        context.scenario.title,
        context.scenario.description,
        command(context),
        _summary(context, results),
        sections,
        f"seed {results['seed']}, budget {results['budget']}; {versions}",
    )


def _summary(context: Context, results: dict[str, Any]) -> list[KeyFigure]:
    identification, timing = results["identification"], results["timing"]
    output = context.scenario.prior().outputs[0]
    rmse = {m: _first(value) for m, value in identification["rmse"].items() if m in MODELS}
    ratio = identification["details"]["hybrid_over_phy"]
    e_sim = identification["e_sim_s"]
    summary = [
        KeyFigure(
            "Free-run error (RMSE) of the hybrid on unseen data", rmse["mopgrnn"], output.unit,
            f"fitted prior: {_text(rmse['phy'])} {output.unit}", _verdict(ratio["rmse"], 1.0),
        ),
        KeyFigure(
            "Simulation error E_sim of the hybrid", e_sim["mopgrnn"], "s",
            f"fitted prior: {_text(e_sim['phy'])}, RNN: {_text(e_sim['rnn'])}", _verdict(ratio["e_sim_s"], 1.0),
        ),
    ]  # fmt: skip
    control = results["control"]
    if control["gap_closed"] is not None:
        costs = ", ".join(f"{n} {_text(control[n]['cost'])}" for n in CONTROLLERS)
        gap = control["gap_closed"]
        summary.append(
            KeyFigure(
                "Gap from prior to oracle closed by the hybrid",
                gap,
                "",
                f"mean over the tasks that tell controllers apart; summed costs: {costs}",
                "good" if gap > 0 else "bad",
            )
        )
    if timing["misses"] is not None:
        p99 = timing["controller_step_ms"]["p99"]
        summary.append(
            KeyFigure("Controller step, 99th percentile", p99, "ms", f"period: {timing['period_ms']:g} ms",
                      _verdict(p99 / timing["period_ms"], 1.0))
        )  # fmt: skip
    if results["monitor"]["alarms"] is not None:
        clean = results["monitor"]["details"]["clean"]
        summary.append(
            KeyFigure("Alarms of the energy monitor", len(results["monitor"]["alarms"]), "",
                      f"{clean['alarms']} of them in {clean['seconds']:.0f} s known to be undisturbed",
                      "good" if clean["alarms"] == 0 else "bad")
        )  # fmt: skip
    return summary


def _verdict(ratio: float | None, most: float) -> Any:
    return "plain" if ratio is None else "good" if ratio < most else "bad"


def _text(value: float | None) -> str:
    return "diverged" if value is None else f"{value:.3g}"


def _notes(context: Context, results: dict[str, Any]) -> dict[str, dict[str, tuple[str, ...]]]:
    instead: dict[str, tuple[str, ...]] = {}
    after: dict[str, tuple[str, ...]] = {}
    if results["control"]["gap_closed"] is None:
        reason = results["control"]["gap_closed_reason"]
        if results["control"]["hybrid"]["cost"] is None:
            instead["control"] = (f"There is no closed loop here: {reason}. The controller was built and timed "
                                  "on recorded states instead.",)  # fmt: skip
        else:
            after["control"] = (f"The gap closed is not defined: {reason}.",)
    tested = results["estimation"]
    without = [r["reason"] for r in (tested, *(tested[n] for n in OBSERVERS)) if r and "reason" in r]
    if without:
        after["estimation"] = (f"Not tested: {'; '.join(dict.fromkeys(without))}.",)
    if results["data"]["details"]["warnings"]:
        after["data"] = tuple(f"Warning: {text}" for text in results["data"]["details"]["warnings"])
    after["training"] = _anchor_words(training_settings(context, "mopgrnn").anchors)
    warnings = context.result("prior")["warnings"]
    if warnings:
        after["models"] = ("Warnings of the fit: " + "; ".join(warnings) + ".",)
    if results["monitor"]["alarms"] is not None:
        method = results["monitor"]["details"]["calibration"]["method"]
        after["monitor"] = (_monitor_words(context, results), f"Calibration: {method}.")
    else:
        after["monitor"] = (f"No alarms here: {results['monitor']['reason'].rstrip('.')}.",)
    after["monitor"] += coverage_words(results["monitor"]["details"].get("recordings", ()))
    after["guard"] = guard_words(results)
    points = results["analysis"]["details"]
    if "reason" in results["analysis"]:
        instead["analysis"] = (f"There is no analysis here: {results['analysis']['reason'].rstrip('.')}.",)
    reasons = [
        f"{m}: {points[m]['fixed_point_reason']}" for m in points if "fixed_point_reason" in _dict(points[m])
    ]
    if reasons:
        after["analysis"] = tuple(reasons)
    return {"instead": instead, "after": after}


def _anchor_words(weight: float) -> tuple[str, ...]:
    """What the report says of anchors.

    Example:
        >>> _anchor_words(0.0), len(_anchor_words(10.0))
        ((), 1)
    """
    words = "Corrections were asked to fade where no recording comes near; the prior stands alone there"
    return (f"{words} (anchors, weight {weight:g}).",) if weight else ()


def _dict(value: Any) -> dict[str, Any]:
    return value if isinstance(value, dict) else {}


def _monitor_words(context: Context, results: dict[str, Any]) -> str:
    clean = results["monitor"]["details"]["clean"]
    words = (
        f"In {clean['seconds']:.0f} s known to be undisturbed there were {clean['alarms']} alarms, "
        f"in the {clean['test_seconds']:.0f} s of test data among them {clean['test_alarms']}."
    )
    load = context.result("monitor").get("load")
    if load is None:
        return words
    seen = "never" if load["delay_s"] is None else f"after {load['delay_s']:.2f} s"
    return f"{words} The unknown load in the closed loop was reported {seen}."


def coverage_words(recordings: Sequence[Mapping[str, Any]]) -> tuple[str, ...]:
    """What the monitor could not judge, in a sentence; nothing if that is but the warm-up.

    Args:
        recordings: Of each the seconds that were judged and that were not, by reason.

    Example:
        >>> coverage_words([{"judged_s": 4.0, "warm_up_s": 0.3, "missing_s": 0.0, "not_finite_s": 2.0}])
        ('Not judged: 2 s in which model or estimator gave no finite number.',)
    """
    why = {
        "missing_s": "with missing samples",
        "not_finite_s": "in which model or estimator gave no finite number",
    }
    sums = {key: sum(float(row[key]) for row in recordings) for key in why}
    told = [f"{sums[key]:.3g} s {words}" for key, words in why.items() if sums[key] > 0]
    return (f"Not judged: {', '.join(told)}.",) if told else ()


def _data_table(results: dict[str, Any]) -> Table:
    data = results["data"]
    rows: list[tuple[Any, ...]] = [(role, seconds) for role, seconds in data["details"]["seconds"].items()]
    rows += [
        (f"cut: {c['file']}, {c['start_s']:.2f} to {c['end_s']:.2f} s: {why}", c["end_s"] - c["start_s"])
        for c, why in zip(data["cuts"], data["details"]["why_cut"], strict=True)
    ]
    caption = f"{len(data['files'])} files; content hash {data['hash'][:16]}."
    return Table(("part", "length [s]"), rows, caption)


def _prior_table(context: Context) -> Table:
    prior = context.result("prior")
    rows = [
        (p.label, p.description, prior["nominal"][p.name], prior["values"][p.name],
         prior["standard_errors"].get(p.name, "fixed"))
        for p in context.scenario.prior().parameters_spec
    ]  # fmt: skip
    caption = "Parameters of the prior. Standard errors suppose that the prior's structure is right."
    return Table(("parameter", "meaning", "nominal", "fitted", "standard error"), rows, caption)


def _score_table(results: dict[str, Any]) -> Table:
    found = results["identification"]
    groups = [{m: _first(found[key][m]) for m in MODELS} for key in ("e_sim_s", "rmse", "balance_violation")]
    unit = next((k for m in MODELS for k in found["rmse"][m] or ()), "[-]").partition(" ")[2]
    base = [group["phy"] for group in groups]
    rows = [
        (name_of(m), *(g[m] for g in groups), *(_percent(g[m], b) for g, b in zip(groups, base, strict=True)))
        for m in MODELS
    ]
    columns = ("model", "E_sim [s]", f"RMSE {unit}", "violation [W]", "E_sim", "RMSE", "violation")
    return Table(columns, rows, "Free runs on unseen data; the last columns against the fitted prior.")


def _first(value: Any) -> float | None:
    """The first number of an object by name, or the number itself."""
    return next(iter(value.values())) if isinstance(value, Mapping) else value


def _percent(value: float | None, base: float | None) -> str:
    return "–" if value is None or not base else f"{100 * (value / base - 1):+.0f} %"


def _export_table(results: dict[str, Any]) -> Table:
    e = results["export"]
    rows = [
        ("values", e["parity_max_abs_error"], "1e-12"),
        ("Jacobians", e["jacobian_max_abs_error"], "1e-10"),
    ]
    caption = "Largest difference between the exported models and PyTorch, relative to the outputs' scale."
    return Table(
        ("compared", "largest difference", "allowed"), [(a, f"{b:.1e}", c) for a, b, c in rows], caption
    )


def _control_table(results: dict[str, Any]) -> Table | None:
    if results["control"]["hybrid"]["cost"] is None:
        return None
    details = results["control"]["details"]
    names = [n for n in CONTENDERS if any(n in cells for cells in details["tasks"].values())]
    rows = [
        (task, *(_cost(cells.get(name)) for name in names), _gap(details["gap_closed_by_task"][task]))
        for task, cells in details["tasks"].items()
    ]
    caption = (
        "Closed-loop cost J on the true state: mean over seeds with its 95 % interval (none for one seed). Gap: "
        "share of the distance from the better baseline to the measuring oracle that the hybrid with observer "
        "covers; a dash where baseline and oracle do not differ enough to say."
    )
    return Table(("task", *(n.replace("_", ", ") for n in names), "gap closed"), rows, caption)


def _cost(cell: dict[str, Any] | None) -> str:
    if cell is None:
        return "–"
    mean, half = cell["cost"]["mean"], cell["cost"]["ci95"]
    if mean is None:
        return "diverged"
    return f"{mean:.3g}" + (f" ± {half:.1g}" if half is not None else "")


def _gap(gap: dict[str, Any]) -> str:
    return "–" if gap["value"] is None else f"{gap['value']:.2f}"


def _observer_table(results: dict[str, Any]) -> Table:
    found = {OBSERVER_TITLES[n]: results["estimation"][n] for n in OBSERVERS}
    rows = [
        (title, r["mean_nis"], f"{r['nis_low']:.2f} to {r['nis_high']:.2f}", f"{100 * r['nis_inside']:.0f} %",
         f"{r['ljung_box']:.0f}", f"{r['ljung_box_limit']:.0f}", r["samples"])
        for title, r in found.items()
        if r is not None and r["mean_nis"] is not None
    ]  # fmt: skip
    columns = ("observer", "mean NIS", "consistent", "below 95 %", "Ljung-Box", "white below", "samples")
    return Table(columns, rows, "Innovations on test recordings, the first 25 samples of each left out.")


def _timing_table(results: dict[str, Any]) -> Table | None:
    timing = results["timing"]
    if timing["misses"] is None:
        return None
    ms = timing["controller_step_ms"]
    row = (ms["median"], ms["p95"], ms["p99"], ms["max"], timing["period_ms"], timing["misses"])
    return Table(("median [ms]", "p95 [ms]", "p99 [ms]", "max [ms]", "period [ms]", "misses"), (row,))


def _alarm_table(results: dict[str, Any]) -> Table | None:
    if results["monitor"]["alarms"] is None:
        return None
    rows = [(a["file"], a["start_s"], a["end_s"]) for a in results["monitor"]["alarms"]]
    calibration = results["monitor"]["details"]["calibration"]
    caption = (
        f"Alarms over the whole recordings; thresholds {calibration['threshold_w']:.3g} W and "
        f"{calibration['residual_threshold']:.3g} N m (N for a slider)."
    )
    return Table(("recording", "from [s]", "to [s]"), rows, caption)


def _pole_table(results: dict[str, Any]) -> Table:
    rows = []
    for model, points in results["analysis"]["details"].items():  # empty where the stage could not run
        if not isinstance(points, dict):
            continue
        for point, a in points.items():
            if point.startswith("fixed_point"):
                continue
            slow = [f"{w:.2f} ({z:.2f})" for w, z in
                    list(zip(a["frequency_rad_s"], a["damping"], strict=True))[:2] if w is not None]  # fmt: skip
            rows.append((model, point, ", ".join(slow), a["stable"], a["stabilisable"], a["detectable"]))
    columns = ("model", "point", "slowest poles: rad/s (damping)", "stable", "stabilisable", "detectable")
    return Table(columns, rows, "Linearisations at rest and at working speed.")
