"""A cart that is simulated here, as a scenario file and as recordings: what benchmarks are tested on."""

import numpy as np

from hybrid_mpc import write_csv

MACHINE = """
from hybrid_mpc import BenchmarkBudget, BenchmarkSpec
from hybrid_mpc import MechanicalPrior
from hybrid_mpc import DataSpec, Scenario
from hybrid_mpc import Parameter, Signal


class Cart(MechanicalPrior):
    states = (Signal("s", "m"), Signal("v", "m/s"))
    inputs = (Signal("F", "N"),)
    outputs = (states[0],)
    parameters = (Parameter("k", 1.0, "N/kg/m", 0.2, 9.0), Parameter("d", 0.5, "1/s", 0.0, 2.0))

    def mass_matrix(self, q, p):
        return 1.0

    def potential(self, q, p):
        return p.k * q.s ** 2 / 2

    def friction(self, q, v, p):
        return p.d * v.v


scenario = Scenario(
    "cart", "A cart", "", prior=Cart,
    data=DataSpec("t", ("u",), ("s",), dt=0.1, max_gap=0.25, smoothing=0.7, warm_up=1.0, fractions=(0.6, 0.2, 0.2),
                  largest_delay=0.3),
    benchmark=BenchmarkSpec(
        {"quick": BenchmarkBudget(4, 2, teacher_steps=5, free_run_steps=5, horizon=10, batch=8)},
        units={"s": ("mm", 1e3)}, piece=20.0,
    ),
)
"""
TRUE = {"k": 4.0, "d": 0.6, "cubic": 0.5}
DELAY = 0.13


def recording(path, *, seed, seconds=100.0, k=TRUE["k"]):
    """The cart with a stiffening spring that no prior knows, its input 0.13 s late, an encoder of 0.1 mm."""
    rng, n, sub = np.random.default_rng(seed), round(seconds / 0.1), 20
    u = np.repeat(rng.uniform(-2, 2, n // 5), 5)
    x, s = np.zeros(2), []
    for i in range(n * sub):
        if i % sub == 0:
            s.append(x[0])
        late = i - round(DELAY / 0.1 * sub)
        held = u[late // sub] if late >= 0 else 0.0
        a = held - k * x[0] - TRUE["cubic"] * x[0] ** 3 - TRUE["d"] * x[1]
        x = x + 0.1 / sub * np.array([x[1] + 0.5 * 0.1 / sub * a, a])
    return write_csv(path, {"t": 0.1 * np.arange(n), "u": u, "s": np.round(np.array(s), 4)})


def written(folder):
    """Scenario file, training recording (100 s), test recording (40 s)."""
    (folder / "cart.py").write_text(MACHINE)
    train = recording(folder / "train.csv", seed=0)
    test = recording(folder / "test.csv", seed=1, seconds=40.0)
    return folder / "cart.py", train, test
