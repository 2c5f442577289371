"""Which observer when: errors of the kinds of ``kit.observer`` over those of the extended Kalman filter.

    python benchmarks/observers.py [--machines two_tanks] [--seeds 10] [--periods 200] [--z 8 32]

The machine is the model with the assumed process and sensor noise (so the Kalman filter is right, up to curvature),
under random steps of its inputs. Each case changes one thing:

- ``clean``: nothing.
- ``outliers``: 2 % of the samples are off by 5 to 50 standard deviations of the sensor, to either side.
- ``missing``: 20 % of the samples are missing.
- ``bound``: the tanks run empty, with a pulse of the pump now and then; only for the machine with a bound. A third
  table has the Kalman filter whose states are clipped into their ranges after each sample.
- ``load``: an unmeasured load of 10 % of the inputs' range begins in the middle.
- ``poor start``: the first sample is off by 100 standard deviations, and states without a sensor by 3 of their first
  ones.

The error is the root mean square over periods and states, each state over its size. A ratio is the geometric mean over
seeds (paired: the same machine, noise and inputs) with its 95 % interval, by Student's t of the logarithms. All filters
but ``switching`` have the same noise; ``switching`` is the default observer of a kit. The second table is the median
processor time of a period, all cases together, and that of the golf robot with a network of ``z`` units.
"""

from __future__ import annotations

import tempfile
import zlib
from dataclasses import replace
from pathlib import Path
from time import thread_time

import numpy as np
from parts import arguments, deployed, hybrid_step, report
from scipy.stats import t as student

import hybrid_mpc as hm
from hybrid_mpc.control.sizes import Sizes
from hybrid_mpc.identify.prior_model import prior_programs

KINDS = ("ekf", "ukf", "mhe", "switching")
CASES = ("clean", "outliers", "missing", "bound", "load", "poor start")
NOISE = {"two_tanks": 1e-3, "unbalanced_disk": 1e-3, "double_pendulum": 3e-4}
"""Standard deviation of the process noise per period, over the states' sizes."""
CLIPPED = "clipped ekf"
HELD = 20
"""Periods between steps of the inputs."""


def kit_of(name: str) -> hm.Kit:
    """A kit of the machine's prior with nominal parameters."""
    scenario = hm.load_scenario(name)
    prior, dt = scenario.prior(), scenario.data.dt
    with tempfile.TemporaryDirectory() as folder:
        where = Path(folder) / "model"
        hm.save_artifact(where, {"prior": prior_programs(prior, dt)}, hm.model_info(prior, dt))
        kit = hm.load(where).on(scenario)
    sizes = Sizes(kit.models["prior"], kit.problem()).states
    return kit.with_noise({"prior_observer": NOISE[name] * sizes})


def experiment(kit: hm.Kit, case: str, seed: int, periods: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """True states ``(n, n_x)``, samples ``(n, n_y)`` and inputs ``(n, n_u)``."""
    model, ocp = kit.models["prior"], kit.problem()
    rng = np.random.default_rng([zlib.crc32(case.encode()), seed])
    span, sigma_y, sigma_x = ocp.input_range, np.array(kit.sensor_sigma), kit.noise("prior_observer")
    steps = rng.uniform(-0.2, 0.2, (periods // HELD + 1, model.n_u)) * span
    us = model.u0 + np.repeat(steps, HELD, axis=0)[:periods]
    if case == "bound":  # a pulse in every third step
        us = np.where((np.arange(periods) // HELD % 3 == 1)[:, None], np.abs(us - model.u0), 0.0)
    us = np.clip(us, ocp.u_min, ocp.u_max)
    load = np.where(np.arange(periods)[:, None] >= periods // 2, 0.1 * span, 0.0) * (case == "load")
    low = np.array([s.lower for s in model.states])
    x = model.x0.copy()
    if case == "poor start":
        first = np.sqrt(kit.observer("prior", kind="ekf").first[: model.n_x])
        seen = np.abs(model.output.jacobian()(x, model.u0, model.w, model.p, 0)[0].full()).max(axis=0) > 0
        x += np.where(seen, 0.0, 3.0 * first * rng.choice([-1.0, 1.0], model.n_x))
    xs, ys = [], []
    for u, d in zip(us, load, strict=True):
        xs.append(x)
        y = model.output(x, u, model.w, model.p).full().ravel()
        ys.append(y + sigma_y * rng.standard_normal(model.n_y))
        x = model.step(x, [], u + d, model.w, model.p)[0].full().ravel()
        x = np.maximum(x + sigma_x * rng.standard_normal(model.n_x), low)
    y = np.array(ys)
    if case == "outliers":
        off = rng.uniform(5.0, 50.0, y.shape) * rng.choice([-1.0, 1.0], y.shape)
        y += np.where(rng.random(y.shape) < 0.02, off * sigma_y, 0.0)
    if case == "missing":
        y[rng.random(len(y)) < 0.2] = np.nan
    if case == "poor start":
        y[0] += 100.0 * sigma_y
    return np.array(xs), y, us


def errors_of(
    kit: hm.Kit, case: str, seeds: int, periods: int, spent: dict[str, list]
) -> dict[str, np.ndarray]:
    """Errors by kind of observer ``(seeds,)``."""
    sizes = Sizes(kit.models["prior"], kit.problem()).states
    found: dict[str, list] = {kind: [] for kind in KINDS}
    observers = {kind: kit.observer("prior", kind=kind) for kind in KINDS}
    low, high = np.full(len(sizes), -np.inf), np.full(len(sizes), np.inf)
    if case == "bound":
        observers[CLIPPED] = observers["ekf"]
        found[CLIPPED], spent[CLIPPED] = [], []
        low, high = observers["mhe"].lower, observers["mhe"].upper
    for seed in range(seeds):
        xs, ys, us = experiment(kit, case, seed, periods)
        for kind, observer in observers.items():
            estimate = observer.start(ys[0])
            squares = [np.mean(((estimate.x - xs[0]) / sizes) ** 2)]
            for k in range(1, periods):
                begin = thread_time()
                estimate = observer.update(estimate, ys[k], us[k - 1])
                spent[kind].append(1e3 * (thread_time() - begin))
                if kind == CLIPPED:
                    estimate = replace(estimate, x=np.clip(estimate.x, low, high))
                squares.append(np.mean(((estimate.x - xs[k]) / sizes) ** 2))
            found[kind].append(np.sqrt(np.mean(squares)))
    return {kind: np.array(values) for kind, values in found.items()}


def times_of(z: int) -> dict[str, list]:
    """Processor times [ms] of periods of the golf robot with a network of ``z`` units, without outliers."""
    model, rng = deployed(hybrid_step(z)), np.random.default_rng(0)
    sigmas = {
        "sigma_y": [5e-4],
        "sigma_x": [1e-4, 5e-3],
        "sigma_x0": [5e-4, 0.1],
        "sigma_d": [3e-4],
        "sigma_d0": [1e-3],
    }
    filters = hm.ExtendedKalmanFilter, hm.UnscentedKalmanFilter, hm.MovingHorizonEstimator
    found: dict[str, list] = {}
    for kind, make in zip(KINDS, filters, strict=False):
        observer = make(model, **sigmas)
        estimate, found[kind], x = observer.start([0.0]), [], np.zeros(2)
        h = estimate.h
        for _ in range(200):
            x, h = (v.full().ravel() for v in model.step(x, h, [0.02], model.w, model.p))
            y = x[:1] + 5e-4 * rng.standard_normal(1)
            begin = thread_time()
            estimate = observer.update(estimate, y, [0.02])
            found[kind].append(1e3 * (thread_time() - begin))
    return found


def ratio(mine: np.ndarray, other: np.ndarray) -> str:
    """Geometric mean of the paired ratios with its 95 % interval."""
    logs = np.log(mine / other)
    half = student.ppf(0.975, len(logs) - 1) * logs.std(ddof=1) / np.sqrt(len(logs))
    middle = logs.mean()
    return "{:.2f} ({:.2f} to {:.2f})".format(*np.exp([middle, middle - half, middle + half]))


def main() -> None:
    """Print both tables."""
    parser = arguments(__doc__)
    parser.add_argument("--machines", nargs="+", default=[*NOISE], choices=[*NOISE])
    parser.add_argument("--seeds", type=int, default=10)
    parser.add_argument("--periods", type=int, default=200)
    parser.add_argument("--z", type=int, nargs="+", default=[8, 32])
    asked = parser.parse_args()
    rows, times, clipped = [], [], []
    for name in asked.machines:
        kit, spent = kit_of(name), {kind: [] for kind in KINDS}
        for case in CASES:
            if case == "bound" and name != "two_tanks":
                continue
            found = errors_of(kit, case, asked.seeds, asked.periods, spent)
            ratios = {kind: ratio(found[kind], found["ekf"]) for kind in KINDS[1:]}
            if CLIPPED in found:
                over = {f"{CLIPPED} / ekf": ratio(found[CLIPPED], found["ekf"])}
                clipped.append(
                    {"machine": name, **over, f"mhe / {CLIPPED}": ratio(found["mhe"], found[CLIPPED])}
                )
            rows.append({"case": case, "machine": name, **ratios})
            print(rows[-1], flush=True)
        times.append({"machine": name, **{f"{kind} [ms]": float(np.median(spent[kind])) for kind in KINDS}})
    for z in asked.z:
        found = times_of(z)
        own = {f"{kind} [ms]": float(np.median(values)) for kind, values in found.items()}
        times.append({"machine": f"golf_robot, {z} units", **own, f"{KINDS[-1]} [ms]": float("nan")})
    rows.sort(key=lambda row: CASES.index(row["case"]))
    report([*rows, *clipped, *times], asked.out)


if __name__ == "__main__":
    main()
