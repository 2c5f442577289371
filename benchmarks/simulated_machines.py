"""The six simulated machines: free runs, offset under a constant load, and cost against PI(D) and linear MPC.

    hybrid-mpc run two_tanks --budget quick --out runs/two_tanks   (and the other five)
    python benchmarks/simulated_machines.py --runs runs [--machines lever] [--seeds 10] [--loads] [--workers 2]

Reads the runs and closes loops on the plants, every controller with the same seeds, limits and measurements:

- ``hybrid``, ``prior``: MPC with the observer of unknown loads, as the run has left it;
- ``linear``: the same MPC and observer on the fitted prior, linearized at the operating point: offset-free linear MPC;
- ``pid``: one PI(D) a controlled output, on the input of the same place, tuned on the linearized prior one loop after
  the other: largest integral gain with a largest sensitivity of at most 1.7 (Astrom, Haegglund, *Revisiting the
  Ziegler-Nichols step response method*, J. Process Control 14 (2004)). The derivative acts on the measurement through a
  lag of an eighth of its time; the integral stops where the input is at a limit. It sees the operating point's input,
  not the reference ahead.

The cost counts what all pay for alike: weighed outputs without noise, weighed speeds, changes of the input. A ratio is
the geometric mean over seeds with its 95 % interval (paired, by Student's t of the logarithms). The offset is the mean
error of the controlled outputs over the last 20 % of the task with a constant load, the largest of the seeds, over what
is allowed: the larger of two steps of the sensor (of a sensor of steps with the same noise) and 0.5 % of the range that
the training recordings cover.
"""

from __future__ import annotations

import math
from concurrent.futures import ProcessPoolExecutor
from functools import cache
from pathlib import Path

import casadi as ca
import numpy as np
from parts import arguments, report
from scipy.optimize import differential_evolution
from scipy.stats import t as student

import hybrid_mpc as hm
from hybrid_mpc.files import read_json
from hybrid_mpc.loop.plant import SimulatedMachine
from hybrid_mpc.model.model import output_with_jacobian

MACHINES = ("two_tanks", "dc_motor", "lever", "two_heaters", "two_link_arm", "cart_pole")
CONTROLLERS = ("hybrid", "prior", "linear", "pid")
SENSITIVITY, LAG_SHARE = 1.7, 8.0


def linear_model(model: hm.HybridModel) -> hm.HybridModel:
    """The model linearized at its operating point, exactly as it steps."""
    x, u, w = ca.MX.sym("x", model.n_x), ca.MX.sym("u", model.n_u), ca.MX.sym("w", model.n_w)
    moved, a, b, e = step_slopes(model)
    y0, c, d = (m.full() for m in output_with_jacobian(model)(model.x0, model.u0, model.w))
    dx, du, dw = x - model.x0, u - model.u0, w - model.w
    x_next = moved + a @ dx + b @ du + (e @ dw if model.n_w else 0)
    return hm.HybridModel.of(
        "linear", model.dt, model.states, model.inputs, model.outputs, x=x, u=u, w=w, x_next=x_next,
        xdot=(x_next - x) / model.dt, y=y0 + c @ dx + d @ du, disturbances=model.disturbances,
        nominal_x=model.nominal_x, nominal_u=model.nominal_u, nominal_w=model.nominal_w,
        disturbance_model=model.disturbance_model,
    )  # fmt: skip


def step_slopes(model: hm.HybridModel) -> tuple[np.ndarray, ...]:
    """One step from the operating point, and its slopes by state, input and disturbance."""
    x, u, w = ca.MX.sym("x", model.n_x), ca.MX.sym("u", model.n_u), ca.MX.sym("w", model.n_w)
    after = model.step(x, [], u, w, model.p)[0]
    slopes = ca.Function("slopes", [x, u, w], [after, *(ca.jacobian(after, v) for v in (x, u, w))])
    return tuple(m.full() for m in slopes(model.x0, model.u0, model.w))


def tuned_pid(model: hm.HybridModel, controlled: list[int]) -> list[tuple[float, float, float]]:
    """``(kp, ki, kd)`` of each controlled output with the input of the same place, one loop after the other."""
    _, a, b, _ = step_slopes(model)
    c = output_with_jacobian(model)(model.x0, model.u0, model.w)[1].full()
    found: list[tuple[float, float, float]] = []
    for j, i in enumerate(controlled):
        loop_a = a_with(a, b, c, controlled, found, model.dt)
        gain = np.abs(c[i] @ np.linalg.lstsq(1.05 * np.eye(len(a)) - a, b[:, j], rcond=None)[0])
        found.append(most_integral(loop_a, b[:, j], c[i], model.dt, 1 / max(gain, 1e-12)))
    return found


def pid_blocks(gains, dt):
    """``(A, B, C, D)`` of a PI(D) from the measured deviation to the input; states: integral, lagged measurement."""
    kp, ki, kd = gains
    lag = max(kd / kp / LAG_SHARE, dt) if kd else dt
    f = math.exp(-dt / lag)
    # u = -kp y - ki I - kd (y - l) / lag, I+ = I + y dt, l+ = f l + (1 - f) y
    a, b = np.array([[1.0, 0.0], [0.0, f]]), np.array([dt, 1 - f])
    return a, b, np.array([-ki, kd / lag]), -kp - kd / lag


def a_with(a, b, c, controlled, gains, dt):
    """The machine's state matrix and the loops that are closed so far, as one."""
    size = len(a)
    total = np.zeros((size + 2 * len(gains),) * 2)
    total[:size, :size] = a
    for j, own in enumerate(gains):
        k_a, k_b, k_c, k_d = pid_blocks(own, dt)
        at = slice(size + 2 * j, size + 2 * j + 2)
        total[:size, :size] += np.outer(b[:, j], k_d * c[controlled[j]])
        total[:size, at] += np.outer(b[:, j], k_c)
        total[at, :size] += np.outer(k_b, c[controlled[j]])
        total[at, at] += k_a
    return total


def most_integral(a, b, c, dt, scale) -> tuple[float, float, float]:
    """Largest integral gain of a stable loop whose sensitivity is nowhere larger than ``SENSITIVITY``."""
    size = len(a)
    b, c = np.append(b, np.zeros(size - len(b))), np.append(c, np.zeros(size - len(c)))
    z = np.exp(1j * np.geomspace(1e-4, np.pi, 200))
    response = np.array([c @ np.linalg.solve(v * np.eye(size) - a, b) for v in z])
    time = dt / max(1e-3, 1 - np.max(np.abs(np.linalg.eigvals(a)[np.abs(np.linalg.eigvals(a)) < 1 - 1e-6])))

    def loss(point):
        kp, ti, td = scale * 10 ** point[0], time * 10 ** point[1], time * 10 ** point[2]
        gains = kp, kp / ti, kp * td if point[2] > -2.9 else 0.0
        k_a, k_b, k_c, k_d = pid_blocks(gains, dt)
        closed = np.block([[a + np.outer(b, k_d * c), np.outer(b, k_c)], [np.outer(k_b, c), k_a]])
        radius = np.max(np.abs(np.linalg.eigvals(closed)))
        if radius >= 1:
            return 1e6 * radius
        control = k_d + (k_c[0] * k_b[0]) / (z - 1) + (k_c[1] * k_b[1]) / (z - k_a[1, 1])
        worst = np.max(1 / np.abs(1 - response * control))
        return -math.log(kp / ti / (scale / time)) + 100 * max(0.0, worst - SENSITIVITY)

    best = differential_evolution(
        loss, [(-3, 2), (-2, 1.5), (-3, 1)], seed=0, popsize=20, maxiter=150, tol=1e-6
    )
    kp, ti, td = scale * 10 ** best.x[0], time * 10 ** best.x[1], time * 10 ** best.x[2]
    return float(kp), float(kp / ti), float(kp * td) if best.x[2] > -2.9 else 0.0


def run_pid(scenario, model, gains, controlled, task, seed):
    """States ``(n, n_x)`` and inputs ``(n, n_u)`` of a loop with PI(D); anti-windup by holding the integral."""
    control, dt, n = task.control or scenario.control, model.dt, round(task.duration / model.dt)
    machine = SimulatedMachine(scenario.plant(), np.array(task.x0), seed, model.n_y, task.faults, dt, 0, 0)
    y0 = model.output(model.x0, model.u0, model.w, model.p).full().ravel()
    integral, lagged = np.zeros(len(gains)), None
    x, inputs = [], []
    for k in range(n):
        t = k * dt
        x.append(scenario.plant().truth(machine.state))
        y = machine.measure(t)[controlled]
        error = y - task.reference(np.array([t]))[0, controlled]
        lagged = y if lagged is None else lagged
        u = model.u0.copy()
        for j, own in enumerate(gains):
            a, b, _, _ = pid_blocks(own, dt)
            lag = b[1] and dt / -math.log(a[1, 1])
            u[j] -= own[0] * error[j] + own[1] * integral[j] + own[2] * (y[j] - lagged[j]) / lag
            free = control.u_min[j] < u[j] < control.u_max[j] or (u[j] - model.u0[j]) * -error[j] < 0
            integral[j] += dt * error[j] * free
            lagged[j] = a[1, 1] * lagged[j] + b[1] * y[j]
        u = np.clip(u, control.u_min, control.u_max)
        if k == 0:
            machine.rest(model.u0)
        machine.command(u)
        inputs.append(u)
        w = None if not model.n_w else (task.w(np.array([t]))[0] if task.w else model.w)
        machine.advance(t, w)
    assert y0.size == model.n_y
    return np.array(x), np.array(inputs)


@cache
def parts(name: str, runs: Path, controller: str):
    """Scenario, kit, model, controlled outputs and what the controller is made of."""
    scenario, kit = hm.load_scenario(name), hm.load(runs / name / "model")
    kit = kit.on(scenario)
    controlled = np.flatnonzero(scenario.control.q_y).tolist()
    prior = kit.models["prior"]
    if controller == "pid":
        return scenario, kit, prior, controlled, tuned_pid(prior, controlled)
    if controller == "linear":
        model = linear_model(prior)
        noise = kit.noise("prior_observer")
        made = hm.make_estimator(model, scenario, noise), hm.make_controller(model, model, scenario.control)
        return scenario, kit, model, controlled, made
    made = kit.observer(controller), kit.controller(controller)
    return scenario, kit, kit.models[controller], controlled, made


def loop(name: str, runs: Path, controller: str, place: int, seed: int) -> dict:
    """Cost, offset and largest use of limits of one loop."""
    scenario, _, model, controlled, made = parts(name, runs, controller)
    task, plant = scenario.tasks[place], scenario.plant()
    if controller == "pid":
        x, u = run_pid(scenario, model, made, controlled, task, seed)
    else:
        result = hm.simulate(
            plant, *made, task.reference, dt=model.dt, duration=task.duration, x0=task.x0, seed=seed, w=task.w,
            faults=task.faults,
        )  # fmt: skip
        x, u = result.x, result.u
    control, t = scenario.control, model.dt * np.arange(len(x))
    y = np.array(
        [
            [float(v) for v in plant.outputs(list(row), list(row_u), [], plant)]
            for row, row_u in zip(x, u, strict=True)
        ]
    )
    error = y - task.reference(t)
    du = np.diff(u, axis=0, prepend=np.clip(model.u0, control.u_min, control.u_max)[None])
    cost = (error**2 @ control.q_y + x**2 @ control.q + du**2 @ control.r_delta).sum() * model.dt
    beyond = np.maximum(u - control.u_max, control.u_min - u).max()
    last = error[len(t) * 4 // 5 :, controlled].mean(axis=0)
    return {"machine": name, "controller": controller, "task": task.name, "seed": seed, "cost": float(cost),
            "offset": last.tolist(), "beyond": float(beyond)}  # fmt: skip


def allowed(name: str, runs: Path) -> np.ndarray:
    """Largest offset of each controlled output."""
    scenario = hm.load_scenario(name)
    controlled = np.flatnonzero(scenario.control.q_y)
    files = sorted((runs / name / "data").glob("train_*.csv"))
    tables = np.vstack([np.genfromtxt(path, delimiter=",", skip_header=1) for path in files])
    n = len(scenario.sensor_sigma)
    reach = np.ptp(tables[:, -n:], axis=0)[controlled]
    return np.maximum(2 * math.sqrt(12) * np.array(scenario.sensor_sigma)[controlled], 0.005 * reach)


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
    error = {key: value["best"]["error"] for key, value in scores.items()}
    best = min((key for key in error if key in ("pgrnn", "mopgrnn")), key=error.__getitem__)
    fit = ", ".join(f"{v:.0f}" for v in scores["phy"]["best"]["fit_percent"].values())
    recommended = choice["recommended"]
    ratios = {"its error / prior": error[recommended], "best hybrid / prior": error[best]}
    return {"machine": name, "FIT of the prior [%]": fit, "recommended": recommended,
            **{key: value / error["phy"] for key, value in ratios.items()}}  # fmt: skip


def main() -> None:
    """Measure and print."""
    parser = arguments(__doc__)
    parser.add_argument("--runs", type=Path, required=True, help="folder of the runs, one a machine")
    parser.add_argument("--machines", nargs="+", default=[*MACHINES], choices=MACHINES)
    parser.add_argument("--seeds", type=int, default=10)
    parser.add_argument("--loads", action="store_true", help="only the task with a constant load of each")
    parser.add_argument("--workers", type=int, default=1)
    given = parser.parse_args()
    rows: list[dict] = []
    cells = []
    with ProcessPoolExecutor(given.workers) as pool:
        jobs = [
            pool.submit(loop, name, given.runs, controller, place, seed)
            for name in given.machines
            for place, task in enumerate(hm.load_scenario(name).tasks)
            if task.faults or not given.loads
            for controller in CONTROLLERS
            for seed in range(given.seeds)
        ]
        cells = [job.result() for job in jobs]
    rows += [free_runs(name, given.runs) for name in given.machines]
    for name in given.machines:
        scenario, bound = hm.load_scenario(name), allowed(name, given.runs)
        for task in scenario.tasks:
            if given.loads and not task.faults:
                continue
            own = {
                c: [r for r in cells if (r["machine"], r["task"], r["controller"]) == (name, task.name, c)]
                for c in CONTROLLERS
            }
            costs = {c: np.log([r["cost"] for r in found]) for c, found in own.items()}
            row = {"machine": name, "task": task.name}
            row |= {f"hybrid / {c}": interval(costs["hybrid"] - costs[c]) for c in CONTROLLERS[1:]}
            for c in CONTROLLERS:
                share = np.max(np.abs([r["offset"] for r in own[c]]) / bound)
                row[f"offset / allowed, {c}"] = f"{share:.2f}" if task.faults else "-"
            row["beyond limits"] = max(r["beyond"] for found in own.values() for r in found)
            rows.append(row)
    report(rows, given.out, loops=cells)


if __name__ == "__main__":
    main()
