"""Whole loops of the exported C beside Python's, period by period: estimator, MPC, monitor, detector and guard.

    python benchmarks/replay.py [--share 0.1] [--only "tanks"] [--out FILE.json]

Each loop of Python is run in simulation with its faults; C gets the same samples and measured disturbances and, in each
period, goes on from Python's last plan. "input", "state" and "reading" are the largest differences, of the input's
range, of the state's size and of the largest value of that reading; the script ends with an error where an alarm, a
mode, a source or a status differs in any period. With all of them more than 10,000 periods of five machines.
"""

from __future__ import annotations

import sys
import tempfile
from dataclasses import replace
from pathlib import Path

import numpy as np
from parts import arguments, report

sys.path.extend(str(Path(__file__).parents[1] / "tests" / name) for name in ("embedded", "golden", "."))

import replay_parts as replays
from replay_parts import Case, Whole, replay
from test_whole_loops import golden, prior_takes_over

from hybrid_mpc import (
    OCP,
    CondensedController,
    Fault,
    Monitor,
    ResidualReadings,
    SafeController,
    learn_limits,
    load,
    load_scenario,
    model_info,
    save_artifact,
)
from hybrid_mpc.identify.prior_model import prior_programs
from hybrid_mpc.kit.assembly import make_ocp, make_resting_guard
from hybrid_mpc.kit.parts import loop_settings


def of_prior(name, **scenario):
    """Kit of a scenario's prior with its nominal parameters, and noise that fits no recording."""
    given = replace(load_scenario(name), **scenario)
    prior, dt = given.prior(), given.data.dt
    noise = dict.fromkeys(("prior", "prior_observer"), (1e-2,) * len(prior.states))
    with tempfile.TemporaryDirectory() as folder:
        save_artifact(
            Path(folder), {"prior": prior_programs(prior, dt)}, model_info(prior, dt), loop=loop_settings(given, noise),
            recommended="prior",
        )  # fmt: skip
        return given, load(Path(folder))


def watched(kit, plant, reference, x0, periods, faults, seed, task=""):
    """A kit's loop: residuals whose limits are learned in two loops without faults, and a guard that rests."""
    model, estimator = kit.models["prior"], kit.observer(task=task)
    ocp = make_ocp(model, kit.problem(task))
    safe = SafeController(CondensedController(model, ocp), model, safe_input=kit.safe_input)
    case = Case(estimator, safe, None, None, plant, reference, x0, periods, seed=seed)
    nominal = [replays.run(replace(case, seed=seed + 50 + i, periods=max(periods, 400)))[1] for i in range(2)]
    readings = ResidualReadings(model)
    limits = learn_limits(readings, estimator, nominal)
    return replace(case, monitor=Monitor(readings, limits), guard=make_resting_guard(model), faults=faults)


def temperature_lab(periods, seed):
    """The scenario's own plant, which radiates; set-points, a frozen sensor, a weak heater."""
    scenario, kit = of_prior("temperature_lab")
    t = periods * scenario.data.dt
    faults = (
        replays.freezes(0.4 * t, 0.45 * t, "temperature1"),
        Fault(0.6 * t, 0.8 * t, "input_offset", -10.0, "power1"),
    )
    task = scenario.tasks[0]
    return watched(kit, scenario.plant(), task.reference, np.array(task.x0), periods, faults, seed, task.name)


def double_pendulum(periods, seed):
    """The prior itself with noise in its sensors; sines, a frozen sensor, a torque that nobody knows of."""
    size = (3.0, 3.0)
    control = OCP(25, (30.0, 30.0, 0.3, 0.3), (0.3, 0.3), (0.3, 0.3), tuple(-s for s in size), size)
    _, kit = of_prior(
        "double_pendulum", control=control, sensor_sigma=(1e-3, 1e-3, 1e-2, 1e-2), safe_input=(0.0, 0.0)
    )
    model = kit.models["prior"]
    t = periods * model.dt
    names = [s.name for s in model.outputs]
    faults = (
        replays.freezes(0.4 * t, 0.43 * t, names[0]),
        Fault(0.6 * t, 0.8 * t, "input_offset", 0.5, model.inputs[0].name),
    )

    def reference(t):
        return np.column_stack(
            [0.5 * np.sin(2 * t), 0.4 * np.cos(3 * t), np.cos(2 * t), -1.2 * np.sin(3 * t)]
        )

    return watched(kit, replays.MachinePlant(model, sigma=1e-3), reference, model.x0, periods, faults, seed)


LOOPS = {
    **{f"golf robot, {loop}": (lambda n, seed, loop=loop: golden("golf_robot", loop, n, seed), 300, 2)
       for loop in ("stroke", "track", "heavy", "frozen")},
    "golf robot, heavier, prior takes over": (lambda n, _: prior_takes_over(n), 300, 1),
    **{f"disk, {loop}": (lambda n, seed, loop=loop: golden("unbalanced_disk", loop, n, seed), 300, 2)
       for loop in ("weak", "swing_up")},
    "arm": (replays.arm_case, 1000, 1),
    "tanks": (replays.tanks_case, 2000, 1),
    "heaters, set-points": (replays.heaters_case, 1000, 1),
    "temperature lab": (temperature_lab, 1500, 1),
    "double pendulum": (double_pendulum, 1500, 1),
}  # fmt: skip
"""Loops by name: what makes one of so many periods with a seed, the periods, how many seeds."""


def main() -> None:
    """Replay and print."""
    parser = arguments(__doc__)
    parser.add_argument("--share", type=float, default=1.0, help="of each loop's periods")
    parser.add_argument("--only", default="", help="loops whose name holds this")
    given = parser.parse_args()
    rows = []
    for name, (make, periods, seeds) in LOOPS.items():
        if given.only not in name:
            continue
        for seed in range(seeds):
            case = make(max(60, round(given.share * periods)), seed)
            with tempfile.TemporaryDirectory() as folder:
                told = replay(Whole(Path(folder), case), case)
            rows.append(
                {
                    "loop": name, "seed": seed, "periods": told.periods, "with alarm": told.alarms,
                    "modes": " ".join(told.modes), "input": told.input, "state": told.estimate, "reading": told.reading,
                }
            )  # fmt: skip
            print(rows[-1], flush=True)
    report(rows, given.out, periods=sum(row["periods"] for row in rows))


if __name__ == "__main__":
    main()
