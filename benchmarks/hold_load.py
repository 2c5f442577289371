"""How still does the golf robot hold a load: ``python benchmarks/hold_load.py --model DIR``.

Options: ``--seeds 3`` (loops a hold, the table shows the worst), ``--seconds 60`` (the second half is judged),
``--names prior``, ``--step 0.005`` (in place of the switching filter one filter, whose disturbance may step by this
share of the input's range a period), ``--out FILE.json``.

The club is held at an angle for 60 s under the task's own control problem; after 1 s a constant load sets in at the
motor. The encoder counts in steps of 1.53 mrad, and friction sticks. Printed for the second half: the angle's largest
error in counts, the swings (turning points with a move of more than two counts on either side: a limit cycle has many,
rest has none), and the range of the torque.
"""

from __future__ import annotations

import os

os.environ.setdefault("OMP_NUM_THREADS", "1")

import argparse
import json
from pathlib import Path

import numpy as np

import hybrid_mpc as hm
from hybrid_mpc import ExtendedKalmanFilter, Fault, make_controller, make_estimator, simulate
from hybrid_mpc.kit.assembly import FIRST_LOAD
from scenarios.golf_robot import scenario
from scenarios.golf_robot.tasks import CONTROL

DT = 0.02
COUNT = 2 * np.pi / 4096
SIGMA_X = (1e-4, 2e-2)
"""Process noise per period [rad, rad/s] where none is given."""
FIGURES = ("largest_error_counts", "swings", "torque_range_nm")
HOLDS = ((0.3, -0.08), (0.3, 0.0), (-0.2, 0.08), (0.6, 0.05))
"""Angle [rad] and load [N m]."""


def swings(error, size: float) -> int:
    """Number of turning points of ``error`` ``(n,)`` with a move of more than ``size`` on either side."""
    low = high = error[0]
    direction, count = 0, 0
    for value in error:
        low, high = min(low, value), max(high, value)
        if direction >= 0 and high - value > size:  # it has turned down
            count, direction, low = count + (direction > 0), -1, value
        elif direction <= 0 and value - low > size:  # it has turned up
            count, direction, high = count + (direction < 0), 1, value
    return count


def one(model, sigma_x, step: float) -> ExtendedKalmanFilter:
    """A filter whose disturbance steps by a share of the input's range a period."""
    span, sigma_y = CONTROL.input_range[0], scenario.sensor_sigma[0]
    return ExtendedKalmanFilter(
        model, sigma_y=[sigma_y], sigma_x=sigma_x, sigma_d=[step * span], sigma_x0=[sigma_y, 0.1],
        sigma_d0=[FIRST_LOAD * span],
    )  # fmt: skip


def held(
    models, name: str, angle: float, load: float, *, seed=0, sigma_x=SIGMA_X, seconds=60.0, step=None
) -> dict:
    """Figures of one loop."""
    model = models[name]
    noise = np.array(sigma_x)
    estimator = make_estimator(model, scenario, noise) if step is None else one(model, noise, step)
    result = simulate(
        scenario.plant(), estimator, make_controller(model, models["prior"], CONTROL),
        lambda t: np.tile([angle, 0.0], (len(t), 1)), dt=DT, duration=seconds, x0=np.array([angle, 0.0]), seed=seed,
        faults=[Fault(1.0, np.inf, "input_offset", load)] if load else [],
    )  # fmt: skip
    late = result.t >= 0.5 * seconds - 1e-9
    error = (result.x[late, 0] - angle) / COUNT
    return {
        "model": name,
        "seed": seed,
        "angle_rad": angle,
        "load_nm": load,
        "largest_error_counts": float(np.abs(error).max()),
        "swings": swings(error, 2.0),
        "torque_range_nm": float(np.ptp(result.u[late])),
        "solved": result.source.count("MPC") / len(result.source),
    }


def main() -> None:
    """Print a table; write JSON where asked."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--model", type=Path, required=True, help="artifact folder")
    parser.add_argument("--seeds", type=int, default=1, help="loops a hold")
    parser.add_argument("--seconds", type=float, default=60.0, help="length of a loop")
    parser.add_argument("--names", nargs="+", default=["hybrid", "prior"], help="models")
    parser.add_argument(
        "--step", type=float, help="one filter, its disturbance's step as a share of the range"
    )
    parser.add_argument("--out", type=Path, help="JSON file to write")
    given = parser.parse_args()
    kit, rows = hm.load(given.model), []
    models, noise = kit.models, kit.loop.process_noise
    print("| model | angle [rad] | load [N m] | largest error [counts] | swings | torque range [N m] |")
    print("| --- | ---: | ---: | ---: | ---: | ---: |")
    for name in given.names:
        for angle, load in HOLDS:
            sigma_x = noise.get(f"{name}_observer", SIGMA_X)
            settings = {"sigma_x": sigma_x, "seconds": given.seconds, "step": given.step}
            of_hold = [held(models, name, angle, load, seed=i, **settings) for i in range(given.seeds)]
            rows += of_hold
            worst = {key: max(row[key] for row in of_hold) for key in FIGURES}
            print(
                f"| {name} | {angle:g} | {load:g} | {worst['largest_error_counts']:.2f} | {worst['swings']} "
                f"| {worst['torque_range_nm']:.3f} |",
                flush=True,
            )
    if given.out is not None:
        given.out.write_text(json.dumps(rows, indent=1) + "\n")


if __name__ == "__main__":
    main()
