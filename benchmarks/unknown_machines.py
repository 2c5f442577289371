"""Machines that the library has not seen: does the fit of the prior do what an independent one does, or say why not?

    python benchmarks/unknown_machines.py machines              # 12 textbook machines, and the cases where these are
    python benchmarks/unknown_machines.py coverage --draws 200  # 95 % intervals of five machines
    python benchmarks/unknown_machines.py order                 # files in another order, other units, files cut in two
    python benchmarks/unknown_machines.py random --priors 50    # random priors

An error is the root mean square of free runs over held-out windows, over the outputs' spreads, from the first states
that suit a model best (:mod:`unknown.independent`). Prints a Markdown table, and with ``--out FILE.json`` writes it.
"""

from __future__ import annotations

import os

os.environ.setdefault("OMP_NUM_THREADS", "1")  # before numpy is loaded

import argparse
import tempfile
import time
import traceback
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from unknown.cases import Case, cases
from unknown.common import Machine, report
from unknown.coverage import MACHINES as SIMULATED
from unknown.coverage import Simulated, cramer_rao
from unknown.independent import Runs, cut, fit, free_run_errors
from unknown.motion import MOTION
from unknown.processes import PROCESSES
from unknown.random_priors import Drawn, drawn

from hybrid_mpc import InputError, Prior, Trajectory, fit_prior, load_trajectories
from hybrid_mpc.data.scales import time_unit
from hybrid_mpc.identify.delay import shifted
from hybrid_mpc.identify.fit import smoothed
from hybrid_mpc.identify.prior_result import PriorFit
from hybrid_mpc.identify.sound import bound_costs, trial_length
from hybrid_mpc.identify.structure import causes, named

MACHINES = (*PROCESSES, *MOTION)
WITHIN = 1.05
HELD_OUT = 16
"""Windows of held-out recordings at most."""
Parts = tuple[tuple[Trajectory, ...], tuple[Trajectory, ...], tuple[Trajectory, ...]]


def read(files: Sequence[Path], prior: type[Prior], spec: Any) -> Parts:
    """Training, validation and held-out recordings: the last of three files or more is held out as a whole."""
    if len(files) < 3:
        data = load_trajectories(files, prior(), spec)
        return data.by_role("train"), data.by_role("valid"), data.by_role("test")
    known = replace(spec, fractions=(0.8, 0.2, 0.0))
    data = load_trajectories(files[:-1], prior(), known, needed=("train", "valid"))
    held = load_trajectories(files[-1:], prior(), replace(spec, fractions=(0.0, 0.0, 1.0)), needed=("test",))
    return data.by_role("train"), data.by_role("valid"), held.by_role("test")


def substeps(dt: float, prior: Prior) -> int:
    """Runge-Kutta steps a period of the independent integration."""
    from hybrid_mpc.identify.simulation import required_substeps

    return max(2, 2 * required_substeps(prior, dt))


def judged(
    make: type[Prior],
    parts: Parts,
    dt: float,
    length: float,
    others: Sequence[Mapping[str, float]],
    steps: int,
) -> list[float]:
    """Errors of held-out free runs of the nominal values and of others."""
    held = parts[2]
    prior = make()
    spread = np.nanstd(np.concatenate([t.y for t in held]), axis=0)
    periods = min(round(length / dt), max(len(t.t) for t in held) - 1)
    runs = Runs(prior, dt, spread, steps)
    return free_run_errors(runs, cut(prior, held, periods, HELD_OUT), [prior.values, *others])


def said(make: type[Prior], found: PriorFit, parts: Parts, dt: float, longest: float) -> list[str]:
    """What a run would say of a fit: its warnings, bounds that cost something, terms that are wrong."""
    unit = time_unit(parts[0], dt)
    known = smoothed(make, found, parts[0], dt)
    length = trial_length(make, found, known, dt, None, unit)
    reasons = list(found.warnings)
    reasons += [str(one) for one in bound_costs(make, found, known, dt, length) if one.costs]
    acting = shifted(parts[0], found.delay)
    wrong = named(causes(make, found.values, acting, dt, longest, unit))
    return [*reasons, *([wrong] if wrong else [])]


def compared(
    name: str,
    make: type[Prior],
    parts: Parts,
    dt: float,
    length: float,
    truth: Mapping[str, float],
    windows: int,
) -> dict[str, Any]:
    """A row: the fit of the library against the better of two independent ones to so many ``windows`` at most, from the
    nominal values and the plant's; where these are not known, from what the library found.
    """
    began = time.process_time()
    try:
        found = fit_prior(make, parts[0], parts[1], dt=dt, length=length)
    except InputError as error:
        return _row(name, time.process_time() - began, None, None, None, f"refused: {error}")
    except Exception:
        return _row(name, time.process_time() - began, None, None, None, traceback.format_exc(limit=-3))
    seconds = time.process_time() - began
    held, prior = parts[2], make()
    steps = max(substeps(dt, make(found.values)), substeps(dt, prior), found.substeps)
    spread = np.nanstd(np.concatenate([t.y for t in parts[0]]), axis=0)
    runs = Runs(prior, dt, spread, steps)
    periods = min(round(length / dt), max(len(t.t) for t in (*parts[0], *held)) - 1)
    independent = [
        fit(runs, parts[0], periods, start, windows)
        for start in (prior.values, {**prior.values, **(truth or found.values)})
    ]
    nominal, ours, *theirs = judged(make, parts, dt, length, [found.values, *independent], steps)
    return _row(name, seconds, ours, min(theirs), nominal, "; ".join(said(make, found, parts, dt, length)))


def _row(
    name: str, seconds: float, ours: float | None, theirs: float | None, nominal: float | None, text: str
) -> dict[str, Any]:
    known = ours is not None and theirs is not None
    return {
        "machine": name,
        "nominal": "–" if nominal is None else f"{nominal:.3f}",
        "independent": "–" if theirs is None else f"{theirs:.4f}",
        "fitted": "–" if ours is None else f"{ours:.4f}",
        "ratio": f"{ours / max(theirs, 1e-9):.3f}" if known else "–",
        "seconds": f"{seconds:.1f}",
        "said": text.replace("\n", " "),
    }


def machines(given: argparse.Namespace) -> list[dict[str, Any]]:
    """Textbook machines, and the cases where their folder is."""
    rows = []
    with tempfile.TemporaryDirectory() as folder:
        scratch = Path(folder)
        own: list[Machine | Case] = [
            m for m in MACHINES if given.only in ("all", "seen" if m.seen else "unseen")
        ]
        if given.only in ("all", "unseen"):
            found, missing = cases(given.cases, given.data, scratch)
            own += found
            print(*(f"left out: {why}" for why in missing), sep="\n")
        for one in own:
            if given.names and one.name not in given.names:
                continue
            if isinstance(one, Machine):
                make, spec, files = one.prior, one.spec, one.write(scratch / one.name)
            else:
                make, spec, files = one.scenario.prior, one.scenario.data, list(one.files)
            parts = read(files, make, spec)
            rows.append(compared(one.name, make, parts, spec.dt, one.length, one.truth, given.windows))
            print(rows[-1], flush=True)
    return rows


def coverage(given: argparse.Namespace) -> list[dict[str, Any]]:
    """How often 95 % intervals hold the truth, and how wide they are."""
    return [_coverage(one, given.draws) for one in SIMULATED if not given.names or one.name in given.names]


def _coverage(machine: Simulated, draws: int) -> dict[str, Any]:
    inside, ratios, began = [], [], time.process_time()
    for draw in range(draws):
        runs = [machine.record(10_000 + 4 * draw + i) for i in range(4)]
        found = fit_prior(machine.prior, [t for t, _ in runs[:3]], [runs[3][0]], dt=machine.dt)
        off = np.array([found.values[name] - value for name, value in machine.truth.items()])
        error = np.array([found.standard_errors[name] for name in machine.truth])
        inside.append(np.abs(off) < 1.96 * error)
        ratios.append(error / cramer_rao(machine, runs[:3]))
    median = np.median(ratios, axis=0)
    row = {
        "machine": machine.name,
        "draws": draws,
        "inside [%]": f"{100 * np.mean(inside):.1f}",
        "by parameter [%]": ", ".join(f"{100 * v:.1f}" for v in np.mean(inside, axis=0)),
        "width / Cramér-Rao": ", ".join(f"{v:.2f}" for v in median),
        "seconds": f"{time.process_time() - began:.0f}",
    }
    print(row, flush=True)
    return row


def in_other_units(make: type[Prior], factors: Mapping[str, float]) -> type[Prior]:
    """The same prior with states and outputs of these names counted in units that are so much smaller."""
    of = [factors[s.name] for s in make.states]
    shown = [factors[s.name] for s in make.outputs]
    signals = {
        key: tuple(
            replace(s, lower=s.lower * factors[s.name], upper=s.upper * factors[s.name])
            for s in getattr(make, key)
        )
        for key in ("states", "outputs")
    }

    def plain(self: Prior, x: Any) -> Any:
        return type(x)(*(v / f for v, f in zip(x, of, strict=True)))

    def xdot(self: Prior, x: Any, u: Any, w: Any, p: Any) -> Any:
        return tuple(v * f for v, f in zip(make.xdot(self, plain(self, x), u, w, p), of, strict=True))

    def output(self: Prior, x: Any, u: Any, w: Any, p: Any) -> Any:
        found = make.output(self, plain(self, x), u, w, p)
        return tuple(v * f for v, f in zip(found, shown, strict=True))

    return type(f"{make.__name__}InOtherUnits", (make,), {**signals, "xdot": xdot, "output": output})


def order(given: argparse.Namespace) -> list[dict[str, Any]]:
    """What must not change a fit: files in another order, other units; and recordings cut in two."""
    rows = []
    for machine in SIMULATED:
        if given.names and machine.name not in given.names:
            continue
        runs = [machine.record(500 + i, 1200)[0] for i in range(4)]
        rows.append(invariance(machine.name, machine.prior, runs[:3], runs[3:], machine.dt))
        print(rows[-1], flush=True)
    for seed in range(given.priors):
        d = drawn(seed)
        rows.append(invariance(f"random {seed}", d.prior, d.train, d.valid, d.train[0].dt))
        print(rows[-1], flush=True)
    return rows


def invariance(
    name: str, make: type[Prior], train: Sequence[Trajectory], valid: Sequence[Trajectory], dt: float
) -> dict[str, Any]:
    """Largest change of a parameter: by order and units over its value, by cutting over its standard error."""
    found = fit_prior(make, train, valid, dt=dt)
    turned = fit_prior(make, [*train[1:], train[0]][::-1], valid, dt=dt)
    factors = dict(
        zip(
            (s.name for s in make.states), np.resize([1e3, 7e-3, 0.3], len(make.states)).tolist(), strict=True
        )
    )
    of = np.array([factors[s.name] for s in make.outputs])
    moved = [[replace(t, y=t.y * of) for t in part] for part in (train, valid)]
    scaled = fit_prior(in_other_units(make, factors), *moved, dt=dt)
    later = [replace(t, t=t.t + 2 * k * t.dt * len(t.t)) for k, t in enumerate(train)]
    halves = [
        t.part(keep, f"{k} {i}")
        for k, t in enumerate(later)
        for i, keep in enumerate((slice(0, len(t.t) // 2), slice(len(t.t) // 2, None)))
    ]
    apart = [replace(t, t=t.t - t.t[0]) for t in halves]
    pieces, strangers = (fit_prior(make, some, valid, dt=dt) for some in (halves, apart))

    def change(other: PriorFit) -> float:
        return max(abs(other.values[k] - v) / max(abs(v), 1e-9) for k, v in found.values.items())

    cut_in_two, without_time = (
        max(abs(other.values[k] - found.values[k]) / e for k, e in found.standard_errors.items())
        for other in (pieces, strangers)
    )
    return {
        "machine": name, "order": f"{change(turned):.1e}", "units": f"{change(scaled):.1e}",
        "cut in two [standard errors]": f"{cut_in_two:.2f}", "both from zero on": f"{without_time:.2f}",
    }  # fmt: skip


def random_row(d: Drawn) -> dict[str, Any]:
    """A random prior: its error over that of the true parameters, and what the fit says."""
    dt, began = d.train[0].dt, time.process_time()
    row: dict[str, Any] = {"prior": d.prior.__name__, "states": len(d.prior.states), "stable": d.stable}
    nothing = {"fitted": float("nan"), "true": float("nan"), "ratio": float("nan")}
    try:
        found = fit_prior(d.prior, d.train, d.valid, dt=dt)
    except InputError as error:
        return {
            **row,
            **nothing,
            "kind": "refused",
            "seconds": time.process_time() - began,
            "said": str(error),
        }
    except Exception:
        text = traceback.format_exc(limit=-3).replace("\n", " ")
        return {**row, **nothing, "kind": "exception", "seconds": time.process_time() - began, "said": text}
    seconds = time.process_time() - began
    _, ours, true = judged(d.prior, (d.train, d.valid, d.test), dt, d.length, [found.values, d.truth], 4)
    ratio = ours / true
    kind = "within" if ratio <= WITHIN else "reason" if _tells(found) else "silent"
    return {
        **row, "fitted": ours, "true": true, "ratio": ratio, "kind": kind, "seconds": seconds,
        "said": "; ".join(found.warnings),
    }  # fmt: skip


def _tells(found: PriorFit) -> bool:
    """Whether a warning says that the fit itself is in doubt; those of single parameters and of feedback do not."""
    return any(
        key in text for text in found.warnings for key in ("improve", "ends at a bound", "wrong optimum")
    )


def random(given: argparse.Namespace) -> list[dict[str, Any]]:
    """Random priors with recordings made from them."""
    rows = []
    for seed in range(given.first, given.first + given.priors):
        rows.append(random_row(drawn(seed)))
        print(rows[-1], flush=True)
    found = []
    for name, own in (
        ("all", rows), ("stable", [r for r in rows if r["stable"]]), ("unstable", [r for r in rows if not r["stable"]])
    ):  # fmt: skip
        kinds = [r["kind"] for r in own]
        n = max(len(own), 1)
        found.append({
            "priors": f"{name}: {len(own)}", "exceptions": kinds.count("exception"),
            "within 5 % [%]": f"{100 * kinds.count('within') / n:.1f}",
            "with a reason [%]": f"{100 * (kinds.count('refused') + kinds.count('reason')) / n:.1f}",
            "neither [%]": f"{100 * kinds.count('silent') / n:.1f}",
        })  # fmt: skip
    return found


def main() -> None:
    """One of the four."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("what", choices=("machines", "coverage", "order", "random"))
    parser.add_argument("--names", nargs="+", default=(), help="some machines alone")
    parser.add_argument(
        "--only", choices=("all", "seen", "unseen"), default="all", help="machines known to the fit, or not"
    )
    parser.add_argument("--cases", type=Path, default=Path("../shared/cases"), help="folder of the cases")
    parser.add_argument(
        "--data", type=Path, default=Path("../shared/data"), help="folder of measured recordings"
    )
    parser.add_argument(
        "--windows", type=int, default=24, help="windows of the independent fit at most (machines)"
    )
    parser.add_argument("--draws", type=int, default=20, help="recordings drawn of each machine (coverage)")
    parser.add_argument("--priors", type=int, default=None, help="random priors (random: 50, order: 5)")
    parser.add_argument("--first", type=int, default=0, help="seed of the first random prior")
    parser.add_argument("--out", type=Path, help="JSON file to write")
    given = parser.parse_args()
    if given.priors is None:
        given.priors = 50 if given.what == "random" else 5
    rows = {"machines": machines, "coverage": coverage, "order": order, "random": random}[given.what](given)
    report(rows, given.out)


if __name__ == "__main__":
    main()
