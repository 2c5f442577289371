"""What hard limits do where a machine lives at them: hard against soft bounds, many seeds, on plants that differ.

    hybrid-mpc run cascaded_tanks --data estimation.csv --budget quick --out runs/cascaded_tanks   (and the others)
    python benchmarks/limits.py --runs runs [--machines temperature_lab] [--seeds 50] [--workers 2]

A case is a machine, a task whose set-points are drawn anew by each seed so that they ask for what a limit forbids, and
that limit, once as a ``HardBound`` and once soft, with the penalty that the library takes by default. Both loops have
the same seeds, observers and models (those that the run recommends), and run on the scenario's plant, which no model
equals. By case and kind of bound:

- ``input beyond``: by how much an input left its limits, at most. It never may.
- ``planned beyond``: the largest violation in any plan that does not say, in ``given_way``, that it exceeds a bound; of
  outputs by the nonlinear model along the plan's states, over the limit's range.
- ``record``: share of the periods in which a hard bound gave way.
- ``beyond``: share of the periods in which the plant itself was beyond the limit by more than half a per cent of the
  range, and ``most``, its largest excess [its unit]: the plant is not the model, and nobody measures its state.
- ``cost``: weighed errors and changes of the inputs on the plant, hard over soft: geometric mean over seeds, with its
  95 % interval (paired).
- ``solve``: median and 99th percentile of a solve [ms].

``--times`` measures instead what a bound adds to a solve. Along ``--seeds`` loops with the hard bound, three
``CondensedController`` solve each period from their own last plans, in random order: without the limit, with a soft and
with a hard one. By case and kind of bound, over the periods in which it acts in the plan:

- ``acts``: how many of all periods these are, and ``rows``, how many rows of the QP act in their median.
- ``without``, ``with``: medians of a solve [ms]; ``ratio``: of these medians.
- ``p99 / median``: the slowest 1 % of all periods over their median, with the bound; ``without``: the same without.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from time import perf_counter

import numpy as np
from parts import arguments, report
from scipy.stats import t as student

import hybrid_mpc as hm
from hybrid_mpc.loop.simulate import Step

KINDS = ("soft", "hard")
CLEAR = 0.005
"""Share of a limit's range that counts as beyond it on the plant."""


@dataclass(frozen=True)
class Case:
    """A machine at a limit.

    Args:
        machine: Its scenario.
        what: What is bounded, ``"x"`` or ``"y"``, see :class:`hybrid_mpc.HardBound`.
        lower: Of all states, or outputs.
        upper: The same.
        size: What a violation is measured by, by signal [its unit].
        x0: State in which the machine rests at first.
        duration: [s].
        drawn: Set-points over time, ``(generator, t) -> (n, n_x or n_y)``.
        task: Task of the scenario whose control problem and weights it has. Default: the common problem.
    """

    machine: str
    what: str
    lower: tuple[float, ...]
    upper: tuple[float, ...]
    size: tuple[float, ...]
    x0: tuple[float, ...]
    duration: float
    drawn: Callable[[np.random.Generator, np.ndarray], np.ndarray]
    task: str = ""


def levels(rng: np.random.Generator, t: np.ndarray) -> np.ndarray:
    """A level of the lower tank [V] that the upper one can hold only near its edge, and back."""
    high, low = rng.uniform(5.0, 6.5), rng.uniform(2.5, 4.0)
    return np.where(t < 600.0, high, low)[:, None]


def temperatures(rng: np.random.Generator, t: np.ndarray) -> np.ndarray:
    """Steps of both temperatures [degC] that take all of the power, the first up to its limit."""
    first, second = rng.uniform(58.0, 60.0), rng.uniform(44.0, 50.0)
    return np.column_stack([np.where(t > 100.0, first, 43.5), np.where(t > 500.0, second, 36.0)])


def swings(rng: np.random.Generator, t: np.ndarray) -> np.ndarray:
    """Angle and speed [rad, rad/s] of a sine that swings beyond the frame, faded in over a second."""
    size, rate = rng.uniform(0.55, 0.7), 2 * math.pi * rng.uniform(0.3, 0.45)
    fade, slope = np.clip(t, 0.0, 1.0), (t < 1.0).astype(float)
    angle = size * np.sin(rate * t)
    return np.column_stack([fade * angle, slope * angle + fade * size * rate * np.cos(rate * t)])


def upright(rng: np.random.Generator, t: np.ndarray) -> np.ndarray:
    """At rest at the top, turned one way or the other: a swing-up."""
    return np.tile([rng.choice([-1.0, 1.0]) * math.pi, 0.0, 0.0, 0.0], (len(t), 1))


INF = math.inf
CASES = {
    "cascaded_tanks": Case("cascaded_tanks", "x", (-INF, -INF), (8.0, INF), (8.0, 1.0), (4.0, 4.0), 1200.0, levels),
    "temperature_lab": Case("temperature_lab", "y", (-INF, -INF), (60.0, INF), (36.0, 1.0),
                            (43.5, 36.0, 43.5, 36.0, 24.0), 1000.0, temperatures),
    "golf_robot": Case("golf_robot", "x", (-0.5, -INF), (0.5, INF), (0.5, 1.0), (0.0, 0.0), 6.0, swings),
    "double_pendulum": Case("double_pendulum", "x", (-INF, -INF, -8.0, -INF), (INF, INF, 8.0, INF),
                            (1.0, 1.0, 8.0, 1.0), (0.0,) * 4, 3.0, upright, "pendubot_swing_up"),
}  # fmt: skip
"""The tanks' upper level below 8 V, the first temperature at most 60 degC, the golf robot within 0.5 rad, the first
joint of a pendubot that swings up below 8 rad/s, with 5 N m at most."""


def problem_of(kit: hm.Kit, case: Case, kind: str) -> hm.OCP:
    """The scenario's control problem with the case's limit alone, hard or soft, or with none."""
    free = kit.problem(case.task)
    n_x, n_y = free.n_x, len(kit.sensor_sigma)
    bare = free.changed(x_min=[-INF] * n_x, x_max=[INF] * n_x, slack_linear=None, slack_quadratic=None)
    if bare.y_min.size:
        bare = bare.changed(y_min=[-INF] * n_y, y_max=[INF] * n_y)
    if kind == "none":
        return bare
    if kind == "hard":
        return bare.changed(hard=[hm.HardBound(case.what, case.lower, case.upper)])
    names = ("x_min", "x_max") if case.what == "x" else ("y_min", "y_max")
    return bare.changed(**dict(zip(names, (case.lower, case.upper), strict=True)))


@cache
def parts(runs: Path, machine: str, kind: str):
    """Scenario, model, observer, controller and problem of a case."""
    scenario, case = hm.load_scenario(machine), CASES[machine]
    kit = hm.load(runs / machine / "model").on(scenario)
    model, prior = kit.models[kit.recommended], kit.models["prior"]
    ocp = problem_of(kit, case, kind)
    made = hm.make_controller(model, prior, ocp, safe_input=kit.safe_input)
    return scenario, model, kit.observer(task=case.task), made, ocp


def excess(case: Case, x: np.ndarray, y: np.ndarray) -> np.ndarray:
    """Violations ``(n, signals)`` [their units]; zero where the limit is kept."""
    value = x if case.what == "x" else y
    return np.maximum(0.0, np.maximum(value - case.upper, case.lower - value))


def shown(model: hm.HybridModel, x: np.ndarray, u: np.ndarray) -> np.ndarray:
    """Outputs of states and inputs ``(n, n_y)`` by a model."""
    return np.array([model.output(a, b, model.w, model.p).full().ravel() for a, b in zip(x, u, strict=True)])


def loop(runs: Path, machine: str, kind: str, seed: int, also: Callable[[Step], None] | None = None) -> dict:
    """Figures of one loop; ``also`` is called after each period."""
    case = CASES[machine]
    scenario, model, observer, controller, ocp = parts(runs, machine, kind)
    plant = scenario.plant()
    t = model.dt * np.arange(round(case.duration / model.dt) + ocp.horizon + 1)
    goals = case.drawn(np.random.default_rng(seed), t)
    planned = [0.0]
    weight = next((task.weight for task in scenario.tasks if task.name == case.task), None)

    def watch(step: Step) -> None:
        if also is not None:
            also(step)
        plan = step.decision.solution
        if not step.decision.status.ok or plan.given_way:
            return
        first = (
            2 if case.what == "x" else 1
        )  # the input of this period shows in the next state; rates need two
        x = plan.x[first:]
        y = x if case.what == "x" else shown(model, plan.x[first:-1], plan.u[first:])
        planned.append(float((excess(case, x, y) / case.size).max()))

    result = hm.simulate(
        plant, observer, controller, _held(goals, model.dt),
        dt=model.dt, duration=case.duration, x0=case.x0, seed=seed, stage_cost=ocp, on_step=watch, weight=weight,
    )  # fmt: skip
    beyond = excess(case, result.x, outputs_of(plant, result.x, result.u))
    over = np.maximum(result.u - ocp.u_max, ocp.u_min - result.u).max()
    return {"machine": machine, "kind": kind, "seed": seed, "cost": result.cost, "input": max(0.0, float(over)),
            "planned": max(planned), "record": float(np.mean([bool(g) for g in result.given_way])),
            "beyond": float(np.mean((beyond / case.size).max(axis=1) > CLEAR)), "most": float(beyond.max()),
            "failed": float(np.mean([s != "SOLVED" for s in result.status])),
            "solve": (result.timing_ms["solve"] + result.timing_ms["prepare"]).tolist()}  # fmt: skip


def _held(goals: np.ndarray, dt: float) -> Callable[[np.ndarray], np.ndarray]:
    """Rows as a function of time."""
    return lambda t: goals[np.clip(np.round(t / dt).astype(int), 0, len(goals) - 1)]


def outputs_of(plant, x: np.ndarray, u: np.ndarray) -> np.ndarray:
    """What the plant's sensors would show without noise; of states alone where it has no such function."""
    if not hasattr(plant, "outputs"):
        return x[:, :1]
    return np.array(
        [
            [float(v) for v in plant.outputs(list(plant.start(a)), list(b), [], plant)]
            for a, b in zip(x, u, strict=True)
        ]
    )


def interval(logs: np.ndarray) -> str:
    """Geometric mean with its 95 % interval."""
    half = (
        student.ppf(0.975, len(logs) - 1) * logs.std(ddof=1) / math.sqrt(len(logs))
        if len(logs) > 1
        else math.nan
    )
    return f"{np.exp(logs.mean()):.3f} ({np.exp(logs.mean() - half):.3f} to {np.exp(logs.mean() + half):.3f})"


def row_of(machine: str, kind: str, cells: list[dict]) -> dict:
    """One line of the table."""
    own, soft = ([c for c in cells if (c["machine"], c["kind"]) == (machine, k)] for k in (kind, "soft"))
    times = np.concatenate([c["solve"] for c in own])
    ratio = np.log([c["cost"] for c in own]) - np.log([c["cost"] for c in soft])
    return {"machine": machine, "bound": kind, "input beyond": max(c["input"] for c in own),
            "planned beyond": "–" if kind == "soft" else f"{max(c['planned'] for c in own):.1e}",
            "record": f"{100 * np.mean([c['record'] for c in own]):.1f} %",
            "beyond": f"{100 * np.mean([c['beyond'] for c in own]):.1f} %",
            "most": f"{max(c['most'] for c in own):.3g}", "cost": interval(ratio) if kind != "soft" else "1",
            "not solved": f"{100 * np.mean([c['failed'] for c in own]):.2f} %",
            "solve, median": f"{np.median(times):.2f}", "p99": f"{np.quantile(times, 0.99):.2f}"}  # fmt: skip


def solve_times(runs: Path, machine: str, seed: int) -> list[dict]:
    """Time of a solve with each kind of bound at every period of a loop, and how many rows of the bound act."""
    case = CASES[machine]
    scenario, model, *_ = parts(runs, machine, "hard")
    kit = hm.load(runs / machine / "model").on(scenario)
    problems = {kind: problem_of(kit, case, kind) for kind in ("none", *KINDS)}
    solvers = {kind: hm.CondensedController(model, ocp) for kind, ocp in problems.items()}
    ocp, plans, rows, rng = problems["none"], {}, [], np.random.default_rng(seed)
    t = model.dt * np.arange(round(case.duration / model.dt) + ocp.horizon + 1)
    goals = case.drawn(np.random.default_rng(seed), t)
    weight = next((task.weight for task in scenario.tasks if task.name == case.task), None)
    own = ocp.block_starts.size * ocp.n_u * (2 if ocp.du_max is not None else 1)

    def watch(step: Step) -> None:
        ahead = step.t + model.dt * np.arange(ocp.horizon + 1)
        preview, factors = _held(goals, model.dt)(ahead), weight(ahead) if weight else None
        row: dict[str, float] = {}
        for kind in rng.permutation([*solvers]).tolist():
            last = plans.get(kind) or solvers[kind].initial(step.estimate)
            started = perf_counter()
            plans[kind] = plan = solvers[kind].solve(last, step.estimate, preview, factors)
            row[kind] = 1e3 * (perf_counter() - started)
            row[f"{kind} acts"] = 0 if plan.active is None else int(np.count_nonzero(plan.active[own:]))
        if step.k:
            rows.append(row)

    loop(runs, machine, "hard", seed, watch)
    return rows


def times_of(machine: str, kind: str, cells: list[dict]) -> dict:
    """One line of the table of times."""
    free, bound, rows = (np.array([c[key] for c in cells]) for key in ("none", kind, f"{kind} acts"))
    at = rows > 0
    if not at.any():
        raise SystemExit(f"{machine}: the {kind} bound never acts; take more seeds")
    without, own = float(np.median(free[at])), float(np.median(bound[at]))
    return {"machine": machine, "bound": kind, "acts": f"{at.sum()} of {len(at)}", "rows": float(np.median(rows[at])),
            "without": f"{without:.2f}", "with": f"{own:.2f}", "ratio": f"{own / without:.2f}",
            "p99 / median": f"{np.quantile(bound, 0.99) / np.median(bound):.1f}",
            "without, p99 / median": f"{np.quantile(free, 0.99) / np.median(free):.1f}"}  # fmt: skip


def main() -> None:
    """Measure and print."""
    parser = arguments(__doc__)
    parser.add_argument("--runs", type=Path, required=True, help="folder of the runs, one a machine")
    parser.add_argument("--machines", nargs="+", default=[*CASES], choices=[*CASES])
    parser.add_argument("--seeds", type=int, default=50)
    parser.add_argument("--workers", type=int, default=1)
    parser.add_argument(
        "--times",
        action="store_true",
        help="what a bound adds to a solve; in one process, one after the other",
    )
    given = parser.parse_args()
    if given.times:
        for machine in given.machines:
            cells = [row for seed in range(given.seeds) for row in solve_times(given.runs, machine, seed)]
            report([times_of(machine, kind, cells) for kind in KINDS], given.out)
        return
    with ProcessPoolExecutor(given.workers) as pool:
        jobs = [
            pool.submit(loop, given.runs, machine, kind, seed)
            for machine in given.machines
            for kind in KINDS
            for seed in range(given.seeds)
        ]
        cells = [job.result() for job in jobs]
    rows = [row_of(machine, kind, cells) for machine in given.machines for kind in KINDS]
    report(rows, given.out, loops=[{k: v for k, v in c.items() if k != "solve"} for c in cells])


if __name__ == "__main__":
    main()
