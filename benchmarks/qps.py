"""The QPs of all machines' loops, recorded, and who solves them fastest.

    python benchmarks/qps.py record --runs runs       (writes benchmarks/qps.npz from runs of `hybrid-mpc run`)
    python -m pip install daqp==0.11.0 piqp==0.7.0 proxsuite==0.8.0
    python benchmarks/qps.py compare

``record`` closes every task's loop of every run with the model that it recommends, those of ``limits.py`` with hard
bounds too, and keeps the QP that took our solver longest and one with the median of changes, among those in which a row
acts: of each machine those of its three tasks with the slowest. Numbers are kept in single precision where the
Hessian allows it; what is read is exactly that.

``compare`` gives each solver the same QPs: bounds of the unknowns, changes of inputs, and rows that are penalised, to
the other solvers with a slack for each side that is finite, which is the same problem. Every call counts as the loop
would pay it: setting up, factoring and solving, from Python. Ours and DAQP begin with the last period's active rows as
the loop does (``warm``) and without (``cold``); the others cannot be told. Times are medians of ``--rounds`` calls in
random order. ``objective``: the largest of the objectives' excess over the best found, relative to the QP's own size
(gradient times step); ``worst``: the slowest QP; ``failed``: no answer, or an excess above 1e-5.
"""

from __future__ import annotations

import importlib.util
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from time import perf_counter
from typing import Any, ClassVar

import numpy as np
from limits import CASES, parts
from limits import loop as limits_loop
from parts import arguments, report

import hybrid_mpc as hm
from hybrid_mpc.control import qp as controls
from hybrid_mpc.loop.simulate import Step
from hybrid_mpc.model.active_set import ActiveSet, RowQP

STORE = Path(__file__).with_suffix(".npz")
FIELDS = ("h", "g", "a", "lower", "upper", "linear", "give", "start", "later", "earlier")
TASKS = 3
"""Tasks of a machine of which QPs are kept, those with the slowest."""
STIFF = 1e5
"""Condition of a Hessian from which its numbers are kept in double precision."""
WRONG = 1e-5
"""Excess of an objective, relative to the QP's size, from which an answer is none."""


@dataclass(frozen=True)
class Recorded:
    """A QP of a loop, where our solver began, and which rows follow each other in time."""

    name: str
    qp: RowQP
    start: np.ndarray | None
    later: np.ndarray
    earlier: np.ndarray


# ---------------------------------------------------------------------------------------------------------------------
# record
# ---------------------------------------------------------------------------------------------------------------------


class Tap(ActiveSet):
    """Our solver, which remembers what it solved."""

    seen: ClassVar[list[tuple[float, int, RowQP, Any, Any, Any]]] = []

    def solve(self, active=None):
        """As ever."""
        started = perf_counter()
        found = super().solve(active)
        spent = perf_counter() - started
        answered = (
            max(self._qp.residuals(found.s, found.multipliers)) < WRONG
        )  # hard rows may contradict each other
        if answered and np.any(found.active):
            none = np.zeros(found.active.size, dtype=np.int8)
            begun = none if active is None or active.size != none.size else active
            changed = int(np.count_nonzero(begun != found.active))
            Tap.seen.append((spent, changed, self._qp, begun, self._later, self._earlier))
        return found


def begin(step: Step) -> None:
    """Forgets what the first plan took, which is made before the loop runs."""
    if step.k == 0:
        Tap.seen.clear()


def kept(name: str) -> list[tuple[float, list[Recorded]]]:
    """How long the slowest QP took that was seen, with it and that with the median of changes; empty without any."""
    seen, Tap.seen = Tap.seen, []
    if not seen:
        return []
    slowest = max(seen, key=lambda s: s[0])
    middle = sorted(seen, key=lambda s: s[1])[len(seen) // 2]
    rows = [(f"{name}, slowest", slowest), (f"{name}, median", middle)]
    return [(slowest[0], [Recorded(label, row[2], *row[3:]) for label, row in rows])]


def record(runs: Path) -> list[Recorded]:
    """QPs of all runs in a folder."""
    controls.ActiveSet, found = Tap, []
    for folder in sorted(p for p in runs.iterdir() if (p / "model").is_dir()):
        scenario, of_tasks = hm.load_scenario(folder.name), []
        kit = hm.load(folder / "model").on(scenario)
        for task in scenario.tasks:
            made = kit.observer(task=task.name), kit.controller(task=task.name)
            hm.simulate(
                scenario.plant(), *made, task.reference, dt=kit.models["prior"].dt, duration=task.duration,
                x0=task.x0, seed=0, weight=task.weight, w=task.w, faults=task.faults, on_step=begin,
            )  # fmt: skip
            of_tasks += kept(f"{folder.name}, {task.name}")
        of_tasks = sorted(of_tasks, key=lambda task: -task[0])[:TASKS]
        if folder.name in CASES:
            parts.cache_clear()
            limits_loop(runs, folder.name, "hard", 0, begin)
            of_tasks += kept(f"{folder.name}, hard limit")
        found += [qp for _, qps in of_tasks for qp in qps]
        print(f"  {folder.name}: {len(found)}", flush=True)
    return found


def write(found: list[Recorded]) -> None:
    """Into the store, in single precision where that leaves the Hessian what it is."""
    arrays: dict[str, np.ndarray] = {"names": np.array([r.name for r in found])}
    for i, r in enumerate(found):
        start = np.zeros(r.qp.lower.size, np.int8) if r.start is None else r.start
        rows = (np.tril(r.qp.h), r.qp.g, r.qp.a, r.qp.lower, r.qp.upper, r.qp.linear, r.qp.give)
        short = np.linalg.cond(r.qp.h) < STIFF
        values = [np.asarray(v, dtype=np.float32 if short else np.float64) for v in rows]
        values += [start, r.later.astype(np.int16), r.earlier.astype(np.int16)]
        arrays |= {f"{i}/{name}": v for name, v in zip(FIELDS, values, strict=True)}
    np.savez_compressed(STORE, **arrays)


def read() -> list[Recorded]:
    """What is in the store."""
    found = []
    with np.load(STORE, allow_pickle=False) as store:
        for i, name in enumerate(store["names"]):
            h, g, a, lower, upper, linear, give = (store[f"{i}/{k}"].astype(float) for k in FIELDS[:7])
            start, later, earlier = (store[f"{i}/{k}"] for k in FIELDS[7:])
            h = h + np.tril(h, -1).T
            qp = RowQP(h, g, a, lower, upper, linear, give)
            found.append(Recorded(str(name), qp, start, later.astype(np.int64), earlier.astype(np.int64)))
    return found


# ---------------------------------------------------------------------------------------------------------------------
# compare
# ---------------------------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Slacked:
    """The same QP with a slack for each finite side of a penalised row: ``lower <= a v <= upper``, bounds on ``v``."""

    h: np.ndarray
    g: np.ndarray
    a: np.ndarray
    lower: np.ndarray
    upper: np.ndarray
    low: np.ndarray
    up: np.ndarray
    rows: np.ndarray
    sides: np.ndarray


def slacked(qp: RowQP) -> Slacked:
    """With slacks. A penalised row of two sides becomes two rows of one side each."""
    n, m = qp.g.size, len(qp.a)
    soft = np.isfinite(qp.linear[n:])
    lower, upper = qp.lower[n:], qp.upper[n:]
    firm = np.flatnonzero(~soft & (np.isfinite(lower) | np.isfinite(upper)))
    over, under = np.flatnonzero(soft & np.isfinite(upper)), np.flatnonzero(soft & np.isfinite(lower))
    rows, count = np.concatenate([firm, over, under]), over.size + under.size
    sides = np.concatenate([np.zeros(firm.size), np.ones(over.size), -np.ones(under.size)])
    slack = np.zeros((rows.size, count))
    slack[firm.size :] = np.diag(-sides[firm.size :])
    own = n + rows[firm.size :]
    h = np.zeros((n + count, n + count))
    h[:n, :n] = qp.h
    h[range(n, n + count), range(n, n + count)] = 1.0 / qp.give[own]
    a = np.hstack([qp.a[rows], slack]) if m else np.zeros((0, n))
    return Slacked(
        h, np.concatenate([qp.g, qp.linear[own]]), np.ascontiguousarray(a), np.where(sides > 0, -np.inf, lower[rows]),
        np.where(sides < 0, np.inf, upper[rows]), np.concatenate([qp.lower[:n], np.zeros(count)]),
        np.concatenate([qp.upper[:n], np.full(count, np.inf)]), n + rows, sides,
    )  # fmt: skip


def objective(qp: RowQP, s: np.ndarray) -> float:
    """Cost of unknowns, penalties included, bounds of the unknowns and hard rows as they are after clipping."""
    s = np.clip(s, qp.lower[: s.size], qp.upper[: s.size])
    over = np.maximum(qp.excess(qp.values(s)), 0.0)
    soft = np.isfinite(qp.linear)
    if np.any(over[~soft] > 1e-6):
        return np.inf
    pays = over[soft]
    return float(
        0.5 * s @ qp.h @ s + qp.g @ s + qp.linear[soft] @ pays + (pays**2 / (2 * qp.give[soft])).sum()
    )


def ours(r: Recorded, q: Slacked, warm: bool) -> np.ndarray:
    """The library's own."""
    return ActiveSet(r.qp, r.later, r.earlier).solve(r.start if warm else None).s


def by_daqp(r: Recorded, q: Slacked, warm: bool) -> np.ndarray:
    """DAQP, a dual active-set method in C."""
    import daqp

    n, v = r.qp.g.size, q.g.size
    sense = np.zeros(v + len(q.a), dtype=np.int32)
    if warm and r.start is not None:  # its flags: 1 acts, 2 on the lower side
        own, rows = r.start[:n], r.start[q.rows]
        fits = (rows != 0) & ((q.sides == 0) | (np.sign(rows) == q.sides))
        sense[:n] = (own != 0) + 2 * (own < 0)
        sense[v:] = fits * (1 + 2 * (rows < 0))
        slack = np.flatnonzero(q.sides)
        sense[n:v] = np.where(fits[slack] & (np.abs(rows[slack]) == 1), 3, 0)
    big = 1e30
    upper, lower = (
        np.minimum(np.concatenate([q.up, q.upper]), big),
        np.maximum(np.concatenate([q.low, q.lower]), -big),
    )
    return daqp.solve(q.h, q.g, q.a, upper, lower, sense)[0][:n]


def by_piqp(r: Recorded, q: Slacked, warm: bool) -> np.ndarray:
    """PIQP, a proximal interior-point method in C++."""
    import piqp

    solver = piqp.DenseSolver()
    solver.settings.eps_abs, solver.settings.eps_rel = 1e-8, 1e-9
    rows = {"G": q.a, "h_l": q.lower, "h_u": q.upper} if len(q.a) else {}
    solver.setup(q.h, q.g, x_l=q.low, x_u=q.up, **rows)
    solver.solve()
    return np.array(solver.result.x)[: r.qp.g.size]


def by_proxqp(r: Recorded, q: Slacked, warm: bool) -> np.ndarray:
    """ProxQP, a proximal augmented Lagrangian method in C++."""
    from proxsuite import proxqp

    solver = proxqp.dense.QP(q.g.size, 0, len(q.a), True)
    solver.settings.eps_abs, solver.settings.eps_rel = 1e-8, 0.0
    rows = (q.a, q.lower, q.upper) if len(q.a) else (None, None, None)
    solver.init(q.h, q.g, None, None, *rows, q.low, q.up)
    solver.solve()
    return np.array(solver.results.x)[: r.qp.g.size]


SOLVERS: dict[str, tuple[str, Callable[..., np.ndarray]]] = {
    "ours, warm": ("", partial(ours, warm=True)),
    "ours, cold": ("", partial(ours, warm=False)),
    "DAQP, warm": ("daqp", partial(by_daqp, warm=True)),
    "DAQP, cold": ("daqp", partial(by_daqp, warm=False)),
    "PIQP": ("piqp", partial(by_piqp, warm=False)),
    "ProxQP": ("proxsuite", partial(by_proxqp, warm=False)),
}


def compare(rounds: int) -> tuple[list[dict], list[dict]]:
    """A row a solver, and a row a QP and solver."""
    solvers = {
        name: solve
        for name, (package, solve) in SOLVERS.items()
        if not package or importlib.util.find_spec(package) is not None
    }
    cells = []
    for r in read():
        q = slacked(r.qp)
        answers, times = {}, {name: [] for name in solvers}
        names, rng = list(solvers), np.random.default_rng(0)
        for _ in range(rounds):  # who comes behind a large one finds the caches cold
            for name in rng.permutation(names).tolist():
                started = perf_counter()
                answers[name] = solvers[name](r, q)
                times[name].append(1e3 * (perf_counter() - started))
        costs = {name: objective(r.qp, s) for name, s in answers.items()}
        best = min(costs.values())
        size = max(abs(best), float(np.abs(r.qp.g) @ np.abs(answers["ours, cold"])), 1e-12)
        for name in solvers:
            cells.append({"qp": r.name, "n": r.qp.g.size, "rows": len(r.qp.a), "solver": name,
                          "ms": float(np.median(times[name])), "excess": (costs[name] - best) / size})  # fmt: skip
    rows = []
    for name in solvers:
        own = [c for c in cells if c["solver"] == name]
        right = [c for c in own if c["excess"] <= WRONG]
        ms = np.array([c["ms"] for c in right])
        rows.append({"solver": name, "QPs": len(own), "failed": len(own) - len(right),
                     "median [ms]": f"{np.median(ms):.3f}",
                     "90 %": f"{np.quantile(ms, 0.9):.3f}", "worst": f"{ms.max():.3f}",
                     "objective": f"{max(c['excess'] for c in right):.0e}"})  # fmt: skip
    return rows, cells


def main() -> None:
    """Record or compare."""
    parser = arguments(__doc__)
    parser.add_argument("what", choices=["record", "compare"])
    parser.add_argument("--runs", type=Path, help="folder of runs, one a machine")
    parser.add_argument("--rounds", type=int, default=11)
    given = parser.parse_args()
    if given.what == "record":
        if given.runs is None:
            parser.error("record needs --runs")
        write(record(given.runs))
        return
    rows, cells = compare(given.rounds)
    report(
        rows, given.out, tuple(p for p, _ in SOLVERS.values() if p and importlib.util.find_spec(p)), qps=cells
    )


if __name__ == "__main__":
    main()
