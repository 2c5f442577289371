"""All that the golden tests know of the library: models, observers, controllers and loops from plain frozen data.

Nothing here reads an artifact or a scenario's control problem, whose forms may change: a machine's folder holds what
is needed as plain numbers (``golden.json``) beside the programs. When a name of the library moves or a signature
changes, this file changes and no other.
"""

from __future__ import annotations

import json
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path

import numpy as np
from scipy.stats import t as student

import nn_export
from hybrid_mpc import (
    OCP,
    CondensedController,
    DelayCompensation,
    Estimate,
    ExtendedKalmanFilter,
    Fault,
    Guard,
    Limits,
    Mode,
    ModelInfo,
    Runner,
    SafeController,
    SQPController,
    Status,
    SwitchingFilter,
    WatchLimits,
    load,
    load_scenario,
    make_monitor,
    parameter_filter,
    simulate,
    with_parameter_states,
)
from hybrid_mpc.kit.artifact import build_model, save_artifact
from hybrid_mpc.records import record

HERE = Path(__file__).parent
MACHINES = ("golf_robot", "unbalanced_disk")
PERIODS = 300
"""Of every replay and closed loop."""
POINTS = slice(5, PERIODS, 16)
"""Periods of a replay at which the models' Jacobians are held: each is a matrix of hundreds of numbers."""
PLANS = slice(0, PERIODS, 60)
"""Periods of a replay of which whole plans are held."""
OPTIONAL = ("du_max", "x_min", "x_max", "slack_linear", "slack_quadratic")


@dataclass(frozen=True)
class Machine:
    """A machine's frozen folder."""

    name: str
    folder: Path

    @cached_property
    def data(self):
        """What ``golden.json`` holds."""
        return json.loads((self.folder / "golden.json").read_text())

    @cached_property
    def arrays(self):
        """Frozen inputs and what came of them, by name."""
        with np.load(self.folder / "arrays.npz", allow_pickle=False) as file:
            return {name: file[name] for name in file.files}

    @cached_property
    def info(self):
        return record(ModelInfo, self.data["model"], "golden.json: model")

    @cached_property
    def models(self):
        """Models by name, built from the programs."""
        programs = nn_export.load_programs(self.folder)
        return {name: build_model(name, programs, self.info) for name in self.data["models"]}

    @cached_property
    def limits(self):
        return record(WatchLimits, self.data["limits"], "golden.json: limits")

    @property
    def replay(self):
        """Name of the replay that every kernel is fed with; others are for the controller alone."""
        return next(iter(self.data["replays"]))

    @property
    def hybrid(self):
        return self.models["hybrid"]

    @property
    def dt(self):
        return self.info.dt

    @cached_property
    def filters(self):
        """The quiet filter, and the switching one of quiet, slip and jump."""
        noise = self.data["observer"]
        modes = [
            ExtendedKalmanFilter(
                self.hybrid, sigma_y=noise["sigma_y"], sigma_x=mode["sigma_x"], sigma_x0=noise["sigma_x0"],
                sigma_d=mode["sigma_d"], sigma_d0=noise["sigma_d0"],
            )
            for mode in noise["modes"]
        ]  # fmt: skip
        return {"single": modes[0], "switching": SwitchingFilter(modes, noise["transition"])}

    def reference(self, name):
        """Reference of a problem, ``t (n,) -> (n, n_x)``, from its frozen samples; the last one is held."""
        return self._sampled(self.arrays[f"reference/{name}"])

    def weight(self, name):
        """Weight factors alike, or None."""
        rows = self.arrays.get(f"weight/{name}")
        return None if rows is None else self._sampled(rows)

    def _sampled(self, rows):
        def at(t):
            k = np.round(np.asarray(t) / self.dt).astype(int)
            return rows[np.clip(k, 0, len(rows) - 1)]

        return at

    def problem(self, name, terminal=None):
        """The optimal control problem of that name, by default with its frozen terminal weight."""
        p = self.data["problems"][name]
        terminal = p["terminal"] if terminal is None else terminal
        more = {key: p[key] for key in OPTIONAL if p[key] is not None}
        return OCP(
            p["horizon"], p["q"], p["r"], p["r_delta"], p["u_min"], p["u_max"], terminal=terminal,
            working_point=(p["x_work"], p["u_work"]), **more,
        )  # fmt: skip

    def safe_controller(self, name, wrap=lambda controller: controller):
        """Real-time iteration on the hybrid behind its safeguards; the first plan is the frozen one."""
        rti = CondensedController(self.hybrid, self.problem(name))
        first = FrozenFirst(rti, self.arrays[f"first/{name}"])
        return SafeController(wrap(rti), self.models["prior"], first=first, safe_input=[0.0])

    def sqp(self, name):
        """The converging solver on the hybrid."""
        return SQPController(self.hybrid, self.problem(name))

    def terminal_weight(self, name):
        """The terminal weight as the problem finds it for the hybrid."""
        return self.problem(name, "riccati").terminal_weight(self.hybrid)

    def monitor(self):
        """The monitor of forces, free runs and frozen sensors."""
        return make_monitor(self.hybrid, self.limits, input_range=self.data["input_range"])

    def guard(self, kind, problem):
        """``adapt``: a backup that estimates parameters; ``limit``: tighter limits; either rests without sensor."""
        times = self.data["guard"]
        if kind == "limit":
            limits = Limits(times["u_min"], times["u_max"])
            return Guard(Mode.LIMITED, Mode.REST, limits=limits, dwell=times["dwell"], quiet=times["quiet"])
        adaptive = with_parameter_states(self.hybrid, times["groups"], prior=self.models["prior"])
        plain = CondensedController(adaptive, self.problem(problem))
        backup = SafeController(plain, self.models["prior"], safe_input=[0.0])
        noise, quiet = self.data["observer"], self.data["observer"]["modes"][0]
        estimator = parameter_filter(
            adaptive, len(times["groups"]), sigma_y=noise["sigma_y"], sigma_x=quiet["sigma_x"],
            sigma_x0=noise["sigma_x0"], sigma_d=quiet["sigma_d"], sigma_d0=noise["sigma_d0"],
        )  # fmt: skip
        return Guard(
            Mode.BACKUP, Mode.REST, backup=backup, backup_estimator=estimator, dwell=times["dwell"],
            quiet=times["quiet"], patience=times["patience"],
        )  # fmt: skip


class FrozenFirst:
    """What a loop begins with: a plan that was found once.

    A stroke from rest has many local optima, and which of them SQP finds is a matter of rounding: another number of
    threads gives another one (README.md). So SQP is held by itself, where there is one optimum, and loops begin alike.
    """

    def __init__(self, controller, u):
        self._controller, self._u = controller, u

    def __getattr__(self, name):
        return getattr(self._controller, name)

    def solve(self, previous, estimate, reference, weight=None, *, limits=None):
        return replace(self._controller.initial(estimate, self._u), status=Status.SOLVED)


def under(arrays, prefix):
    """Arrays right under a prefix, by the rest of their names."""
    return {
        key.rpartition("/")[2]: values for key, values in arrays.items() if key.rpartition("/")[0] == prefix
    }


def machine(name):
    """The frozen machine of that name."""
    return Machine(name, HERE / name)


def artifact_of(m, out):
    """Models by name and limits, as the library's own reader finds them in an artifact ``out`` of the programs."""
    programs = {name: {} for name in m.data["models"]}
    for key, program in nn_export.load_programs(m.folder).items():
        model, _, function = key.partition("/")
        programs[model][function] = program
    save_artifact(out, programs, m.info, limits={"hybrid": [m.limits]})
    found = load(out)
    return found.models, found.limits("hybrid")


# ---- kernels: fed with frozen inputs, no plant


def model_values(m):
    """Step, Jacobian, rates, output and energy balance of both models along the replay's estimates."""
    replay = m.replay
    x, h, u = m.arrays[f"{replay}/switching/x"], m.arrays[f"{replay}/switching/h"], m.arrays[f"{replay}/u"]
    found = {}
    for name, model in m.models.items():
        own = h[:, : model.n_h]  # inputs on their way come first: the prior has these alone
        given = model.w, model.p
        rows = [
            [v.full().ravel() for v in model.step(*point, *given)] for point in zip(x, own, u, strict=True)
        ]
        xdot = np.array([model.xdot(*point, *given).full().ravel() for point in zip(x, own, u, strict=True)])
        found[f"{name}/x_next"] = np.array([row[0] for row in rows])
        found[f"{name}/h_next"] = np.array([row[1] for row in rows[POINTS]])
        found[f"{name}/xdot"] = xdot
        found[f"{name}/y"] = np.array(
            [model.output(*p, *given).full().ravel() for p in zip(x, u, strict=True)]
        )
        # the rates one period on, held against this state: the balance is not zero
        late = zip(x[:-1], xdot[1:], u[:-1], strict=True)
        found[f"{name}/balance"] = np.array([float(model.balances[0].residual(*p, *given)) for p in late])
        points = x[POINTS], own[POINTS], u[POINTS]
        slopes = [model.with_jacobian(*p, *given)[2:] for p in zip(*points, strict=True)]
        found[f"{name}/A"] = np.array([a.full() for a, _ in slopes])
        found[f"{name}/B"] = np.array([b.full() for _, b in slopes])
    return found


def many_points(m, name):
    """Values and Jacobians at the same points in one call: ``(x_next, h_next, A, B)``."""
    replay, model = m.replay, m.models[name]
    x, h, u = m.arrays[f"{replay}/switching/x"], m.arrays[f"{replay}/switching/h"], m.arrays[f"{replay}/u"]
    points = [np.ascontiguousarray(v[POINTS]) for v in (x, h[:, : model.n_h], u)]
    points += [np.tile(values, (len(points[0]), 1)) for values in (model.w, model.p)]
    return model.side_by_side(len(points[0]), {"A": ("x", "h"), "B": ("u",)})(*points)


def estimates(m, replay, kind):
    """What a filter makes of a replay's samples and inputs; of the single filter's hidden state some rows."""
    estimator, y, u = m.filters[kind], m.arrays[f"{replay}/y"], m.arrays[f"{replay}/u"]
    rows = [estimator.start(y[0])]
    for k in range(1, len(y)):
        rows.append(estimator.update(rows[-1], y[k], u[k - 1]))
    found = {
        name: np.array([getattr(e, name) for e in rows]) for name in ("x", "h", "d", "innovation", "nis")
    }
    found["trace_P"] = np.array([np.trace(e.P) for e in rows])
    found["sigma"] = np.array([np.sqrt(np.diag(e.P)[[*range(m.hybrid.n_x), -1]]) for e in rows])
    if kind == "single":
        found["h"] = found["h"][POINTS]
    else:
        found["probability"] = np.array([e.probability for e in rows])
    return found


def frozen_estimates(m, replay):
    """The switching filter's estimates as they were frozen."""
    x, h, d = (m.arrays[f"{replay}/switching/{name}"] for name in ("x", "h", "d"))
    size = x.shape[1] + h.shape[1] + d.shape[1]
    none = np.full(len(m.info.outputs), np.nan)
    return [
        Estimate(k * m.dt, x[k], h[k], d[k], np.zeros((size, size)), none, float("nan"))
        for k in range(len(x))
    ]


def previews(m, problem):
    """``t -> (reference, weight factors or None)`` over the horizon."""
    ahead = m.dt * np.arange(m.data["problems"][problem]["horizon"] + 1)
    reference, weight = m.reference(problem), m.weight(problem)
    return lambda t: (reference(t + ahead), None if weight is None else weight(t + ahead))


def first_name(source):
    """The name that a source of inputs had when all was frozen."""
    return {"SAFE": "ZERO"}.get(source, source)


def decisions(m, replay):
    """What the controller decides on frozen estimates; its plan goes on from its own last one."""
    problem = m.data["replays"][replay]["problem"]
    safe, preview = m.safe_controller(problem), previews(m, problem)
    known = frozen_estimates(m, replay)[: m.data["replays"][replay]["decided"]]
    decision, rows = safe.initial(known[0], None, *preview(0.0)), []
    first = decision.solution
    for k, estimate in enumerate(known):
        decision = safe.decide(decision, estimate, *preview(k * m.dt))
        rows.append(decision)
    plans = rows[PLANS]
    return {
        "first/u": first.u,
        "first/x": first.x,
        "u": np.array([r.u for r in rows]),
        "cost": np.array([r.solution.cost for r in rows]),
        "excess": np.array([r.solution.excess for r in rows]),
        "age": np.array([r.age for r in rows]),
        "source": np.array([first_name(r.source.name) for r in rows]),
        "status": np.array([r.status.name for r in rows]),
        "plan/u": np.array([r.solution.u for r in plans]),
        "plan/x": np.array([r.solution.x for r in plans]),
    }


def converged(m, name):
    """What SQP converges to in one of its frozen cases: at rest at an angle, from no input or a frozen plan."""
    case = m.data["sqp"][name]
    solver, estimate = m.sqp(case["problem"]), m.filters["single"].start(np.array(case["y0"]))
    guess = solver.initial(estimate, m.arrays.get(case["guess"]))
    plan = solver.solve(guess, estimate, *previews(m, case["problem"])(0.0))
    return {"u": plan.u, "x": plan.x, "cost": np.array(plan.cost), "status": np.array(plan.status.name)}


READ = ("values", "terms", "travel")
SAID = ("alarm", "frozen", "blind", "validity")


def readings(m):
    """What the monitor reads of the replay with its frozen estimates."""
    monitor = m.monitor()
    y, u = m.arrays[f"{m.replay}/y"], m.arrays[f"{m.replay}/u"]
    before = np.vstack([np.zeros((1, u.shape[1])), u[:-1]])
    state, rows = monitor.initial(), []
    for k, estimate in enumerate(frozen_estimates(m, m.replay)):
        state, reading = monitor.update(state, y[k], before[k], estimate)
        rows.append(reading)
    found = {name: np.array([getattr(r, name) for r in rows]) for name in READ}
    found |= {name: np.array([int(getattr(r, name)) for r in rows]) for name in SAID}
    found["scores"] = scores_of(m, [r.levels for r in rows])
    return found


def scores_of(m, levels):
    """Levels as shares of their thresholds."""
    return np.abs(np.array(levels)) / [limit.threshold for limit in m.limits.channels]


def detections(m):
    """What the detector makes of the monitor's frozen values."""
    monitor = m.monitor()
    state, levels, rows = monitor.detector.initial(), [], []
    for values, terms in zip(
        m.arrays["guard/values"].tolist(), m.arrays["guard/terms"].tolist(), strict=True
    ):
        state, level, _ = monitor.detector.update(state, values, terms, True)
        levels.append(level)
        rows.append((*state.sums, any(state.on)))
    found = np.array(rows, dtype=float)
    return {"scores": scores_of(m, levels), "sums": found[:, :-1], "alarm": found[:, -1].astype(int)}


# ---- closed loops


def faults_of(loop):
    """Faults of a loop or replay from plain data; what has no end never ends."""
    return tuple(Fault(f["start"], f["end"] or np.inf, f["target"], f["value"]) for f in loop["faults"])


@dataclass(frozen=True)
class Parts:
    """What loops of one problem are made of; made once, since none of it remembers anything between loops."""

    machine: Machine
    problem: str
    guard: str | None

    @cached_property
    def made(self):
        m = self.machine
        guard = None if self.guard is None else m.guard(self.guard, self.problem)
        return m.filters["switching"], m.safe_controller(self.problem), m.monitor(), guard


def run_loop(parts, loop, seed):
    """A closed loop of a machine's plant; ``loop`` is plain data: x0, faults, delays, periods with late solves."""
    m, late = parts.machine, loop.get("late", ())
    estimator, safe, monitor, guard = parts.made
    delays = {name: loop[name] for name in ("sensor_delay", "input_delay") if name in loop}
    estimator = DelayCompensation(estimator, **delays) if delays else estimator
    return simulate(
        load_scenario(m.name).plant(), estimator, safe, m.reference(parts.problem), weight=m.weight(parts.problem),
        dt=m.dt, duration=PERIODS * m.dt, x0=loop["x0"], seed=seed, monitor=monitor, guard=guard,
        faults=faults_of(loop), late=lambda t: round(t / m.dt) in late, **delays,
    )  # fmt: skip


def loop_values(result):
    """What is held of a closed loop: arrays, and the guard's switches in words."""
    names = ("x", "y", "u", "x_hat", "d", "stage_cost", "violation")
    found = {name: getattr(result, name) for name in names}
    found |= {name: getattr(result, name).astype(int) for name in ("alarm", "valid")}
    found |= {name: np.array(getattr(result, name)) for name in ("status", "mode")}
    found["source"] = np.array([first_name(name) for name in result.source])
    return found


def switches_of(result):
    """The guard's switches as plain data."""
    return [[round(s.t, 9), s.before.name, s.after.name, s.why] for s in result.switches]


def paired(m, name, seeds):
    """Costs of a closed loop by seed, and of how many loops the monitor alarmed, found the fault, the guard switched.

    An alarm is one before anything is broken, a detection one from then on.
    """
    loop = m.data["loops"][name]
    made, broken = Parts(m, loop["problem"], loop["guard"]), loop.get("broken_s", np.inf)
    results = [run_loop(made, loop, seed) for seed in seeds]
    whole = [r.t < broken - 1e-9 for r in results]
    costs = np.array([r.cost for r in results])
    return {
        "cost": costs.tolist(),
        "mean": float(costs.mean()),
        "ci95": float(student.ppf(0.975, len(costs) - 1) * costs.std(ddof=1) / np.sqrt(len(costs))),
        "loops": len(results),
        "alarms": sum(bool(r.alarm[w].any()) for r, w in zip(results, whole, strict=True)),
        "detections": sum(bool(r.alarm[~w].any()) for r, w in zip(results, whole, strict=True)),
        "switched": sum(bool(r.switches) for r in results),
    }


# ---- the real-time runner on a virtual clock


class VirtualClock:
    """Stands still but for sleeping and what the machine adds."""

    def __init__(self):
        self.t = 5.0

    def now(self):
        return self.t

    def sleep_until(self, t):
        self.t = max(self.t, t)


class Rig:
    """A plant behind two callbacks on a virtual clock: some samples get lost, some readings and solves take long."""

    def __init__(self, m, loop, seed=0):
        self._plant, self._dt, self._loop = load_scenario(m.name).plant(), m.dt, loop
        self.clock, self._rng = VirtualClock(), np.random.default_rng(seed)
        self._state = self._plant.reset(np.array(loop["x0"]), seed)
        self._inputs, self._begun, self._k, self._slow = [], 0.0, 0, 0.0

    def measure(self):
        """The sample of the present period; None where it got lost."""
        if not self._inputs:
            return self._plant.measure(self._state, self._rng)
        now = int(np.floor((self.clock.t - self._begun) / self._dt + 1e-6))
        for k in range(self._k, now):
            acting = min(k - self._loop["input_delay"], len(self._inputs) - 1)
            u = self._inputs[acting] if acting >= 0 else np.zeros_like(self._inputs[0])
            self._state = self._plant.step(self._state, u, self._dt)
        self._k, y = now, self._plant.measure(self._state, self._rng)
        self.clock.t += self._loop["slow_samples"].get(str(now), 0.0) * self._dt
        self._slow = self._loop["slow_solves"].get(str(now), 0.0) * self._dt
        return None if now in self._loop["lost"] else y

    def actuate(self, u):
        """Held from the present period on."""
        if not self._inputs:
            self._begun = self.clock.t
        self._inputs += [self._inputs[-1]] * (self._k - len(self._inputs)) if self._inputs else []
        self._inputs.append(u)

    def wrap(self, controller):
        """The controller whose next solve after some samples takes long."""
        return _Slow(self, controller)

    def pause(self):
        self.clock.t, self._slow = self.clock.t + self._slow, 0.0


class _Slow:
    def __init__(self, rig, controller):
        self._rig, self._controller = rig, controller

    def __getattr__(self, name):
        return getattr(self._controller, name)

    def solve(self, *arguments, **others):
        self._rig.pause()
        return self._controller.solve(*arguments, **others)


def run_real_time(m):
    """A run of the runner: what is held of every period, and the counts."""
    loop = m.data["runner"]
    rig, steps, delay = Rig(m, loop), [], loop["input_delay"]
    estimator = m.filters["switching"]
    estimator = DelayCompensation(estimator, input_delay=delay) if delay else estimator
    runner = Runner(
        rig.measure, rig.actuate, estimator, m.safe_controller(loop["problem"], rig.wrap),
        m.reference(loop["problem"]), weight=m.weight(loop["problem"]), monitor=m.monitor(),
        deadline=loop["deadline"] * m.dt, clock=rig.clock, guard=m.guard(loop["guard"], loop["problem"]),
        on_step=steps.append, input_delay=delay,
    )  # fmt: skip
    report = runner.run(duration=loop["periods"] * m.dt)
    found = {name: getattr(report, name) for name in ("t", "y", "u", "x_hat", "applied_ms", "lateness_ms")}
    found["status"] = np.array(report.status)
    found["source"] = np.array([first_name(name) for name in report.source])
    found["d"] = np.array([s.estimate.d for s in steps])
    found["h"] = np.array([s.estimate.h for s in steps])
    found["violation_w"] = np.array([s.reading.violation_w for s in steps])
    for name in SAID:
        found[name] = np.array([int(getattr(s.reading, name)) for s in steps])
    counts = {name: getattr(report, name) for name in ("periods", "missing", "late", "overruns", "skipped")}
    sources = {first_name(name): count for name, count in report.sources.items()}
    return found, counts | {"sources": sources, "stopped": report.stopped}


# ---- comparison


def held(found, frozen, tolerance):
    """Arrays are as they were frozen: words and counts exactly, numbers within a share of their signal's largest value.

    A signal is a column (the last axis): a rate near zero is a difference of large ones, so its own size says nothing.

    Args:
        found: Arrays by name.
        frozen: The same, frozen.
        tolerance: The share.
    """
    assert found.keys() == frozen.keys()
    for name, values in found.items():
        values, wanted = np.asarray(values), frozen[name]
        assert values.shape == wanted.shape, name
        if wanted.dtype.kind in "Ui" or not wanted.size:
            np.testing.assert_array_equal(values, wanted, err_msg=name)
            continue
        np.testing.assert_array_equal(np.isnan(values), np.isnan(wanted), err_msg=name)
        columns = wanted.reshape(-1, wanted.shape[-1]) if wanted.ndim > 1 else wanted.reshape(-1, 1)
        size = np.max(np.nan_to_num(np.abs(columns)), axis=0)
        off = np.nan_to_num(np.abs(values - wanted)).reshape(columns.shape) / np.where(size > 0, size, 1.0)
        assert np.max(off) <= tolerance, f"{name}: off by {np.max(off):.1e} of its size"
