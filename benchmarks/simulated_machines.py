"""Machines on simulated plants: free runs, rest under a constant load, and cost against PI(D) and linear MPC.

    hybrid-mpc run two_tanks --budget quick --out runs/two_tanks   (and the other five)
    python benchmarks/simulated_machines.py --runs runs [--machines lever] [--tasks hold] [--seeds 10] [--workers 2]

The same of real machines, whose models are of recordings and whose loops run on a plant that no model has seen:

    hybrid-mpc run temperature_lab --data prbs.csv --budget quick --out runs/temperature_lab
    python benchmarks/simulated_machines.py --runs runs --machines temperature_lab

Reads the runs and closes loops on the plants, every controller with the same seeds, limits and measurements:

- ``hybrid``, ``prior``: MPC with the observer of unknown loads, as the run has left it;
- ``linear``: the same MPC and observer on the fitted prior, linearized at the operating point: offset-free linear MPC;
- ``pid``: one PI(D) a controlled output, on the input of the same place, all on a measurement through a filter of first
  order, on top of the input that holds set-point and measured disturbances by the fitted prior; the integral stops
  where the input is at a limit. Gains and filters are those that make *this very task* cheapest, load included: by
  differential evolution on the fitted prior with its sensors' noise, then by Nelder and Mead's method on the plant
  itself, both with seeds of their own. Nobody has so much when he tunes: it is about the best that PI(D) does here.
  A car's steering holds y and its speed x, on top of wheels that roll along the path; each torque of a double
  pendulum holds its joint.
- ``blind``, in tasks with measured disturbances: ``prior`` without their measurement;
- ``slippery``, of the double pendulum: ``prior`` without its dry friction, whose slope at rest is a strong damper's;
- ``twice``, of a double pendulum that stands: ``prior`` with two linearizations a period;
- ``punctual``, likewise: ``prior`` without the fitted delay of its inputs.

The cost counts what all pay for alike: weighed outputs without noise, weighed speeds, changes of the input. A ratio is
the geometric mean over seeds with its 95 % interval (paired, by Student's t of the logarithms). With a constant load,
*offset* is the mean error of the controlled outputs over the last 20 % of the task, the largest of the seeds, over what
is allowed: the larger of two steps of the sensor (of a sensor of steps with the same noise) and 0.5 % of the range that
the training recordings cover (real machines: the steps alone); *rest* is the root mean square error there, so that a
ripple counts. Soft limits of states cost nothing in it; PI(D) does not know them. How far they were exceeded at most is
told beside it, in the state's unit.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass, replace
from functools import cache
from pathlib import Path
from typing import Any

import casadi as ca
import numpy as np
from parts import arguments, report
from scipy.optimize import differential_evolution, minimize
from scipy.stats import t as student

import hybrid_mpc as hm
from hybrid_mpc.files import read_json
from hybrid_mpc.loop.faults import corrupt_input
from hybrid_mpc.loop.plant import SimulatedMachine
from hybrid_mpc.model.equilibrium import hidden_fixed_point
from hybrid_mpc.model.model import output_with_jacobian
from scenarios.race_car.prior import WHEELBASE

MACHINES = ("two_tanks", "dc_motor", "lever", "two_heaters", "two_link_arm", "cart_pole")
REAL = (
    "temperature_lab",
    "cascaded_tanks",
    "heat_exchanger",
    "race_car",
    "coupled_drives",
    "double_pendulum",
)
LOADS = (
    "leak",
    "brake",
    "hold",
    "draught",
    "carry",
    "push",
    "weak_heater",
    "weak_pump",
    "weak_valve",
    "crooked",
    "weak_drive",
    "pendubot_load",
)
STATES = {"race_car": [1, 0], "double_pendulum": [0, 1]}
"""Machines with references of states, and the output that each input's PI(D) holds: steering y, speed x; torques the
angles of their joints."""
CONTROLLERS = ("hybrid", "prior", "linear", "pid")
TUNED_ON = (1000, 1001)
"""Seeds of the loops that PI(D) are tuned on."""
BOUNDS = ((-3, 2), (-2.5, 2), (-4, 0.5), (-2, 0))
"""Logarithms: gain over the inverse steady gain, times of integral and derivative over the slowest time constant, share
of a new measurement in the filter."""
FACTORS, TRIALS = (4.0, 1.0, 0.4, 0.15), 25
"""Factors on the gains that the search on the plant begins with, and its loops by number of unknowns."""


def linear_model(model: hm.HybridModel, control: hm.OCP, rest: np.ndarray | None = None) -> hm.HybridModel:
    """The model linearized at its operating point, exactly as it steps; delayed inputs are hidden states as before.

    Where the control problem has a working point in motion, slopes are those there, and the state ``rest`` is the
    equilibrium: at rest the slope of dry friction would pass for strong damping.
    """
    x, h, u, w = (
        ca.MX.sym(k, n) for k, n in zip("xhuw", (model.n_x, model.n_h, model.n_u, model.n_w), strict=True)
    )
    z0, moved, a, b, e = step_slopes(model, control)
    if control.working_point is not None:
        moved = z0 = np.concatenate([rest, hidden_fixed_point(model, rest, model.u0)])
    x0 = z0[: model.n_x]
    y0, c, d = (m.full() for m in output_with_jacobian(model)(x0, model.u0, model.w))
    dz, du, dw = ca.vertcat(x, h) - z0, u - model.u0, w - model.w
    after = moved + a @ dz + b @ du + (e @ dw if model.n_w else 0)
    x_next, h_next = after[: model.n_x], after[model.n_x :]
    linear = hm.HybridModel.of(
        "linear", model.dt, model.states, model.inputs, model.outputs, x=x, h=h, u=u, w=w, x_next=x_next,
        h_next=h_next, xdot=(x_next - x) / model.dt, y=y0 + c @ (x - x0) + d @ du,
        disturbances=model.disturbances, nominal_x=model.nominal_x, nominal_u=model.nominal_u,
        nominal_w=model.nominal_w, disturbance_model=model.disturbance_model,
    )  # fmt: skip
    return replace(linear, delay_states=model.delay_states)


def step_slopes(model: hm.HybridModel, control: hm.OCP) -> tuple[np.ndarray, ...]:
    """The working point ``z = (x, h)``, one step from it, and its slopes by ``z``, input and disturbance."""
    x0 = model.x0 if control.working_point is None else control.working_point[0]
    h0 = hidden_fixed_point(model, x0, model.u0)
    z, u, w = (
        ca.MX.sym(k, n) for k, n in zip("zuw", (model.n_x + model.n_h, model.n_u, model.n_w), strict=True)
    )
    after = ca.vertcat(*model.step(z[: model.n_x], z[model.n_x :], u, w, model.p))
    slopes = ca.Function("slopes", [z, u, w], [after, *(ca.jacobian(after, v) for v in (z, u, w))])
    z0 = np.concatenate([x0, h0])
    return z0, *(m.full() for m in slopes(z0, model.u0, model.w))


def pid_law(gains, y, goal, forward, memory, low, high, dt):
    """Input and next memory ``(integral, filtered measurement)`` of one PI(D), of numbers or of CasADi's scalars."""
    kp, ki, kd, share = gains
    integral, before = memory
    seen = before + share * (y - before)
    error = seen - goal
    wanted = forward - kp * error - ki * integral - kd * (seen - before) / dt
    winds_up = (wanted > high) * (ki * error < 0) + (wanted < low) * (ki * error > 0)
    return ca.fmin(ca.fmax(wanted, low), high), (integral + dt * error * (1 - winds_up), seen)


def courses(scenario, model, task):
    """What a task brings, by period: set-points, inputs that hold them by the model, measured disturbances, loads."""
    t = model.dt * np.arange(round(task.duration / model.dt))
    goals = task.reference(t)
    w = np.tile(model.w, (len(t), 1)) if task.w is None else task.w(t)
    if scenario.name == "race_car":
        forward = along_path(model, goals)
    elif scenario.name in STATES:  # no torque at the top
        forward = np.tile(model.u0, (len(t), 1))
    else:
        forward = held_inputs(scenario, model, task, goals, w)
    names = [s.name for s in model.inputs]
    load = np.array([corrupt_input(task.faults, now, np.zeros(model.n_u), names) for now in t])
    return t, goals, forward, w, load


def held_inputs(scenario, model, task, goals, w) -> np.ndarray:
    """Inputs ``(n, n_u)`` that hold set-points and measured disturbances by the model."""
    targets, steady, found = hm.Targets(model, task.control or scenario.control), None, []
    for goal, now in zip(goals, w, strict=True):
        steady = targets.at(goal, w=now, start=steady)
        found.append(steady.u)
    return np.array(found)


def along_path(car, goals) -> np.ndarray:
    """Steering and speed ``(n, 2)`` of a car's wheels that roll along a path, by its fitted gain and offset."""
    values = {p.name: p.value for p in car.parameters}
    rate, speed = np.gradient(np.unwrap(goals[:, 2]), car.dt), goals[:, 3]
    angle = np.arctan(WHEELBASE * rate / np.maximum(speed, 0.1))
    return np.column_stack([(angle - values["offset"]) / values["k"], speed])


def tuned_pid(scenario, model, controlled, task) -> list[tuple[float, ...]]:
    """``(kp, ki, kd, filter's share)`` of each controlled output, all together, for this task."""
    control, dt, m = task.control or scenario.control, model.dt, len(controlled)
    t, goals, forward, w, load = courses(scenario, model, task)
    # a period: the prior, its PI(D) and their cost
    z0, _, a, b, _ = step_slopes(model, control)
    z, held, memory, own = (
        ca.SX.sym(n, k) for n, k in (("z", len(z0)), ("u", model.n_u), ("m", 2 * m), ("g", 4 * m))
    )
    x = z[: model.n_x]
    sizes = goals.shape[1], model.n_u, model.n_y, model.n_w, model.n_u
    goal, ahead, noise, now, off = (ca.SX.sym(n, k) for n, k in zip("rfnwo", sizes, strict=True))
    y, u, after = model.output.expand()(x, held, now, model.p), ca.SX(model.u0), []
    for j, i in enumerate(controlled):
        u[j], kept = pid_law(
            ca.vertsplit(own[4 * j : 4 * j + 4]), (y + noise)[i], goal[i], ahead[j],
            ca.vertsplit(memory[2 * j : 2 * j + 2]), control.u_min[j], control.u_max[j], dt,
        )  # fmt: skip
        after += kept
    z_next = ca.vertcat(*model.step.expand()(x, z[model.n_x :], u + off, now, model.p))
    astray = (
        ca.dot(control.q_y, (y - goal) ** 2) + ca.dot(control.q, x**2)
        if control.n_y
        else ca.dot(control.q, (x - goal) ** 2)
    )
    stage = dt * (astray + ca.dot(control.r_delta, (u - held) ** 2))
    period = ca.Function(
        "period", [z, held, memory, own, goal, ahead, noise, now, off], [z_next, u, ca.vertcat(*after), stage]
    )
    course = period.mapaccum("course", len(t), 3)
    y0, c, _ = (v.full() for v in output_with_jacobian(model)(np.array(task.x0), model.u0, w[0]))
    poles, modes = np.linalg.eig(a.T)
    slow = 1.05 * max(1.0, np.abs(poles).max())  # of a machine that falls, faster than it does
    answer = np.linalg.lstsq(slow * np.eye(len(a)) - a, b, rcond=None)[0]
    steady = np.diag(c[controlled] @ answer[: model.n_x])
    moved = (
        np.linalg.norm(modes.T @ b, axis=1) > 1e-9
    )  # a room that comes back in a day is no time constant of these
    poles = np.abs(poles)[moved]
    slowest = dt / max(1e-3, 1 - np.max(poles[poles < 1 - 1e-6]))
    start = np.concatenate([task.x0, z0[model.n_x :]])
    noises = [
        np.random.default_rng(s).standard_normal((len(t), model.n_y)) * scenario.sensor_sigma
        for s in TUNED_ON
    ]
    u0 = np.clip(model.u0, control.u_min, control.u_max)

    def gains(point):
        found = []
        for (p, i, d, f), size in zip(10.0 ** np.reshape(point, (m, 4)), steady, strict=True):
            kp = p / size
            found.append((kp, kp / (i * slowest), kp * d * slowest, f))
        return found

    def loss(point):
        own, total = np.ravel(gains(point)), 0.0
        for noise in noises:
            first = np.ravel([[0.0, v] for v in (y0.ravel() + noise[0])[controlled]])
            own_all = np.tile(own[:, None], len(t))
            total += float(
                ca.sum2(course(start, u0, first, own_all, goals.T, forward.T, noise.T, w.T, load.T)[3])
            )
        return math.log(total) if np.isfinite(total) and total > 0 else 1e3

    best = differential_evolution(loss, BOUNDS * m, seed=0, popsize=10, maxiter=40, tol=1e-4, polish=False)
    best = minimize(loss, best.x, method="Nelder-Mead", bounds=BOUNDS * m, options={"maxfev": 200 * m})

    def on_plant(point):
        course = t, goals, forward, w
        loops = [run_pid(scenario, model, gains(point), controlled, task, s, course) for s in TUNED_ON]
        costs = [cost_of(scenario, model, task, *loop) for loop in loops]
        return float(np.log(np.mean(costs))) if np.all(np.isfinite(costs)) else 1e3

    firsts = [best.x + np.tile([math.log10(f), 0, 0, 0], m) for f in FACTORS]
    first = min((np.clip(v, *np.array(BOUNDS * m).T) for v in firsts), key=on_plant)
    limits = {
        "maxfev": TRIALS * first.size,
        "initial_simplex": np.vstack([first, first + 0.15 * np.eye(first.size)]),
    }
    return gains(minimize(on_plant, first, method="Nelder-Mead", options=limits).x)


def run_pid(scenario, model, gains, controlled, task, seed, course=None):
    """States ``(n, n_x)`` and inputs ``(n, n_u)`` of a loop with PI(D); ``course`` is what :func:`courses` says."""
    control, dt = task.control or scenario.control, model.dt
    times, goals, forward, w = course or courses(scenario, model, task)[:4]
    names = [[s.name for s in group] for group in (model.outputs, model.inputs)]
    machine = SimulatedMachine(scenario.plant(), np.array(task.x0), seed, *names, task.faults, dt, 0, 0)
    memory, x, inputs = None, [], []
    for t, goal, ahead, now in zip(times, goals, forward, w, strict=True):
        x.append(scenario.plant().truth(machine.state))
        y, u = machine.measure(t)[controlled], model.u0.copy()
        memory = [(0.0, v) for v in y] if memory is None else memory
        for j, own in enumerate(gains):
            u[j], memory[j] = pid_law(
                own, y[j], goal[controlled[j]], ahead[j], memory[j], control.u_min[j], control.u_max[j], dt
            )
        if t == 0:
            machine.rest(model.u0)
        machine.command(u)
        inputs.append(u)
        machine.advance(t, now if model.n_w else None)
    return np.array(x), np.array(inputs)


def shown(plant, x, u):
    """What the sensors would show without noise ``(n, n_y)``; in MuJoCo they show the states."""
    if not hasattr(plant, "outputs"):
        return x
    return np.array(
        [
            [float(v) for v in plant.outputs(list(plant.start(a)), list(b), [], plant)]
            for a, b in zip(x, u, strict=True)
        ]
    )


def cost_of(scenario, model, task, x, u) -> float:
    """What all pay for alike."""
    control = task.control or scenario.control
    goals = task.reference(model.dt * np.arange(len(x)))
    du = np.diff(u, axis=0, prepend=np.clip(model.u0, control.u_min, control.u_max)[None])
    if not control.n_y:
        counts = 1.0 if task.weight is None else task.weight(model.dt * np.arange(len(x)))
        return float(((counts * (x - goals) ** 2) @ control.q + du**2 @ control.r_delta).sum() * model.dt)
    error = shown(scenario.plant(), x, u) - goals
    return float((error**2 @ control.q_y + x**2 @ control.q + du**2 @ control.r_delta).sum() * model.dt)


def controlled_of(scenario) -> list[int]:
    """Places of the outputs that are held, in the order of the inputs that hold them by PI(D)."""
    return STATES.get(scenario.name) or np.flatnonzero(scenario.control.q_y).tolist()


@cache
def parts(name: str, runs: Path, controller: str, place: int):
    """Scenario, model, controlled outputs and what the controller of a task is made of."""
    scenario, kit = hm.load_scenario(name), hm.load(runs / name / "model")
    kit = kit.on(scenario)
    controlled = controlled_of(scenario)
    prior = kit.models["prior"]
    task = scenario.tasks[place]
    if controller == "pid":
        return scenario, prior, controlled, tuned_pid(scenario, prior, controlled, task)
    if controller == "linear":
        control = task.control or scenario.control
        model = linear_model(prior, control, task.reference(np.array([task.duration]))[0])
        noise = kit.noise("prior_observer")
        made = hm.make_estimator(model, scenario, noise, control), hm.make_controller(model, model, control)
        return scenario, model, controlled, made
    if controller == "slippery":
        control, noise = task.control or scenario.control, kit.noise("prior_observer")
        values = [replace(p, value=0.0) if p.name.startswith("F_") else p for p in prior.parameters]
        model = replace(prior, parameters=tuple(values))
        made = hm.make_estimator(model, scenario, noise, control), hm.make_controller(model, model, control)
        return scenario, model, controlled, made
    if controller == "punctual":
        control, noise = task.control or scenario.control, kit.noise("prior_observer")
        model = punctual(prior)
        made = hm.make_estimator(model, scenario, noise, control), hm.make_controller(model, model, control)
        return scenario, model, controlled, made
    planned = "prior" if controller in ("blind", "twice") else controller
    iterations = 2 if controller == "twice" else None
    made = (
        kit.observer(planned, task=task.name),
        kit.controller(planned, task=task.name, iterations=iterations),
    )
    return scenario, kit.models[planned], controlled, made


def punctual(model: hm.HybridModel) -> hm.HybridModel:
    """The model whose inputs act at once: its delay states take the input of now."""
    x, h, u, w, p = (
        ca.MX.sym(k, n) for k, n in zip("xhuwp", (model.n_x, 0, model.n_u, model.n_w, model.n_p), strict=True)
    )
    late = ca.repmat(u, model.delay_states // model.n_u, 1)
    point, none = [x, h, u, w, p], ca.MX(0, 1)
    x_next = model.step(x, late, u, w, p)[0]
    step = ca.Function("step", point, [x_next, none])
    xdot = ca.Function("xdot", point, [model.xdot(x, late, u, w, p)])
    return replace(model, step=step, xdot=xdot, with_jacobian=None, side_by_side=None, delay_states=0)


@dataclass(frozen=True)
class Unseen:
    """A plant whose measured disturbances act as they do, and nobody measures them: a loop is told the usual ones."""

    plant: Any
    w: Callable[[np.ndarray], np.ndarray]

    def __getattr__(self, name: str) -> Any:
        """All else is the plant's."""
        return getattr(self.plant, name)

    def step(self, state: Any, u: np.ndarray, dt: float, w: np.ndarray) -> Any:
        """A period on, with the disturbances of the time; ``w`` is not looked at."""
        return self.plant.step(state, u, dt, self.w(np.array([state.t]))[0])


def controllers_of(name: str, task: hm.Task) -> tuple[str, ...]:
    """Those of all tasks, and without measurement where there is one; no PI(D) where the way is free (a swing-up)."""
    found = CONTROLLERS[:-1] if task.weight is not None else CONTROLLERS
    found += () if task.w is None else ("blind",)
    if name != "double_pendulum":
        return found
    return (*found, "slippery") if task.weight is not None else (*found, "slippery", "twice", "punctual")


def loop(name: str, runs: Path, controller: str, place: int, seed: int) -> dict:
    """Cost, rest and largest use of limits of one loop."""
    scenario, model, controlled, made = parts(name, runs, controller, place)
    task, plant = scenario.tasks[place], scenario.plant()
    control = task.control or scenario.control
    if controller == "pid":
        x, u = run_pid(scenario, model, made, controlled, task, seed)
    else:
        blind = controller == "blind"
        result = hm.simulate(
            Unseen(plant, task.w) if blind else plant, *made, task.reference, dt=model.dt, duration=task.duration,
            x0=task.x0, seed=seed, w=None if blind else task.w, faults=task.faults, weight=task.weight,
        )  # fmt: skip
        x, u = result.x, result.u
    error = shown(plant, x, u) - task.reference(model.dt * np.arange(len(x)))[:, : model.n_y]
    last = error[len(x) * 4 // 5 :, controlled]
    beyond = np.maximum(u - control.u_max, control.u_min - u).max()
    low, high = control.state_range
    soft = np.where(np.isfinite(low) | np.isfinite(high), np.maximum(x - high, low - x), 0.0).max(axis=0)
    return {"machine": name, "controller": controller, "task": task.name, "seed": seed,
            "cost": cost_of(scenario, model, task, x, u), "offset": last.mean(axis=0).tolist(),
            "rest": np.sqrt((last**2).mean(axis=0)).tolist(), "beyond": float(beyond),
            "soft": np.maximum(soft, 0.0).tolist()}  # fmt: skip


def allowed(name: str, runs: Path) -> np.ndarray:
    """Largest offset of each controlled output."""
    scenario = hm.load_scenario(name)
    controlled = controlled_of(scenario)
    steps = 2 * math.sqrt(12) * np.array(scenario.sensor_sigma)[controlled]
    files = sorted((runs / name / "data").glob("train_*.csv"))
    if not files:
        return steps
    tables = np.vstack([np.genfromtxt(path, delimiter=",", skip_header=1) for path in files])
    n = len(scenario.sensor_sigma)
    reach = np.ptp(tables[:, -n:], axis=0)[controlled]
    return np.maximum(steps, 0.005 * reach)


def interval(logs: np.ndarray) -> str:
    """Geometric mean with its 95 % interval."""
    half = (
        student.ppf(0.975, len(logs) - 1) * logs.std(ddof=1) / math.sqrt(len(logs))
        if len(logs) > 1
        else math.nan
    )
    return " ".join(f"{v:.2f}" for v in np.exp([logs.mean(), logs.mean() - half, logs.mean() + half]))


def free_runs(name: str, runs: Path) -> dict:
    """Fitted prior's FIT [%] by output, recommended model, its error on unseen recordings over the prior's."""
    folder = runs / name / "checkpoints"
    scores = read_json(folder / "evaluation.json")
    scores = scores.get("result", scores)["scores"]
    choice = read_json(folder / "choice.json")
    choice = choice.get("result", choice)["choice"]
    error = {key: value["model"]["error"] for key, value in scores.items()}
    best = min((key for key in error if key in ("pgrnn", "mopgrnn")), key=error.__getitem__)
    fit = ", ".join(f"{v:.0f}" for v in scores["phy"]["model"]["fit_percent"].values())
    recommended = choice["recommended"]
    ratios = {"its error / prior": error[recommended], "best hybrid / prior": error[best]}
    return {"machine": name, "FIT of the prior [%]": fit, "recommended": recommended,
            **{key: value / error["phy"] for key, value in ratios.items()}}  # fmt: skip


def row_of(name: str, runs: Path, task, cells: list[dict]) -> dict:
    """Ratios of cost, offsets, and how the hybrid rests against its prior, of one task."""
    own = {
        c: [r for r in cells if (r["machine"], r["task"], r["controller"]) == (name, task.name, c)]
        for c in controllers_of(name, task)
    }
    own = {c: found for c, found in own.items() if found}
    costs = {c: np.log([r["cost"] for r in found]) for c, found in own.items()}
    row = {"machine": name, "task": task.name}
    for first, others in (("hybrid", CONTROLLERS[1:]), ("prior", controllers_of(name, task)[2:])):
        if first in own:
            row |= {f"{first} / {c}": interval(costs[first] - costs[c]) for c in others if c in own}
    row["cost, prior"] = f"{np.exp(costs['prior'].mean()):.4g}"
    if any(math.isinf(fault.end) for fault in task.faults):
        bound = allowed(name, runs)
        share = {c: np.max(np.abs([r["offset"] for r in found]) / bound) for c, found in own.items()}
        row |= {f"offset, {c}": f"{share[c]:.2f}" for c in own}
        rest = {
            c: np.log(np.linalg.norm([r["rest"] for r in own[c]] / bound, axis=1))
            for c in ("hybrid", "prior")
            if c in own
        }
        if "hybrid" in own:
            row["rest, hybrid / prior"] = interval(rest["hybrid"] - rest["prior"])
    if np.isfinite(np.hstack(hm.load_scenario(name).control.state_range)).any():
        row |= {
            f"over a soft limit, {c}": f"{np.max([r['soft'] for r in found]):.3g}" for c, found in own.items()
        }
    row["beyond limits"] = max(0.0, *(r["beyond"] for found in own.values() for r in found))
    return row


def main() -> None:
    """Measure and print."""
    parser = arguments(__doc__)
    parser.add_argument("--runs", type=Path, required=True, help="folder of the runs, one a machine")
    parser.add_argument("--machines", nargs="+", default=[*MACHINES], choices=MACHINES + REAL)
    parser.add_argument("--seeds", type=int, default=10)
    parser.add_argument(
        "--first-seed", type=int, default=0, help="develop on others than those of the tables"
    )
    parser.add_argument(
        "--tasks", nargs="+", help="only these; those with a constant load: " + " ".join(LOADS)
    )
    parser.add_argument("--controllers", nargs="+", help="only these, prior among them (default: all)")
    parser.add_argument("--workers", type=int, default=1)
    given = parser.parse_args()
    tasks = [
        (name, place, task)
        for name in given.machines
        for place, task in enumerate(hm.load_scenario(name).tasks)
        if not given.tasks or task.name in given.tasks
    ]
    with ProcessPoolExecutor(given.workers) as pool:
        jobs = [
            pool.submit(loop, name, given.runs, controller, place, seed)
            for name, place, task in tasks
            for controller in controllers_of(name, task)
            if not given.controllers or controller in given.controllers
            for seed in range(given.first_seed, given.first_seed + given.seeds)
        ]
        cells = [job.result() for job in jobs]
    rows = [free_runs(name, given.runs) for name in given.machines]
    rows += [row_of(name, given.runs, task, cells) for name, _, task in tasks]
    report(rows, given.out, loops=cells)


if __name__ == "__main__":
    main()
