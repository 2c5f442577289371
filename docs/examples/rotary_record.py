"""Recordings of a simulated rotary pendulum that a controller holds upright: ``python rotary_record.py FOLDER``.

A motor's voltage turns an arm, a pendulum stands at the arm's end. Encoders of 2048 steps a turn, 500 samples a second,
16 s. A binary signal of the experimenter is added to the voltage. The machine has dry friction, the prior has none.
"""

import sys
from pathlib import Path

import numpy as np

JR, MP, LR, LP, KM, RM, DR, DP, STATIC = 7.0e-5, 0.024, 0.085, 0.129, 0.042, 8.4, 2.0e-4, 3.0e-5, 1.0e-3
"""Arm [kg m^2], pendulum [kg], lengths [m], motor [V s/rad, ohm], friction [N m s/rad, N m]."""
STEP, DT, SAMPLES = 2 * np.pi / 2048, 0.002, 8000


def rates(z: np.ndarray, voltage: float) -> np.ndarray:
    """Rates of the angles and speeds of arm and pendulum; the pendulum's angle counts from upright."""
    _, a, arm, pendulum = z
    s, c, mass = np.sin(a), np.cos(a), MP * LP**2 / 4
    m11, m12, m22 = JR + MP * LR**2 + mass * s**2, MP * LP * LR * c / 2, MP * LP**2 / 12 + mass
    f1 = KM * (voltage - KM * arm) / RM - DR * arm - STATIC * np.tanh(arm / 0.05)
    f1 += -2 * mass * s * c * arm * pendulum + MP * LP * LR * s * pendulum**2 / 2
    f2 = mass * s * c * arm**2 + MP * 9.81 * LP * s / 2 - DP * pendulum
    det = m11 * m22 - m12**2
    return np.array([arm, pendulum, (m22 * f1 - m12 * f2) / det, (m11 * f2 - m12 * f1) / det])


def record(seed: int) -> np.ndarray:
    """Rows ``(t, theta, alpha, voltage)``."""
    rng = np.random.default_rng(seed)
    z, speed, last, added, goal, rows = np.array([0.0, 0.02, 0.0, 0.0]), np.zeros(2), None, 0.0, 0.0, []
    for k in range(SAMPLES):
        y = np.round(z[:2] / STEP) * STEP
        speed += 0.2 * ((y - (y if last is None else last)) / DT - speed)
        last = y
        if k > 500 and k % 50 == 0:
            added = rng.choice([-0.7, 0.7])
        if k % 1500 == 0:
            goal = rng.uniform(-0.5, 0.5)
        u = 4.5 * (y[0] - goal) + 42.0 * y[1] + 2.3 * speed[0] + 3.5 * speed[1] + added
        u = float(np.clip(u, -10.0, 10.0))
        rows.append((k * DT, *y, u))
        for _ in range(4):
            h = DT / 4
            z = z + h * rates(z + h / 2 * rates(z, u), u)
    return np.array(rows)


if __name__ == "__main__":
    out = Path(sys.argv[1])
    out.mkdir(parents=True, exist_ok=True)
    for run in (1, 2, 3):
        names = "t,theta,alpha,voltage"
        np.savetxt(out / f"run_{run}.csv", record(run), delimiter=",", comments="", fmt="%.6g", header=names)
