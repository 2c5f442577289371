"""The paper's experiment on the golf robot (Fig. 5 and 6), on the simulated rig. No torch in here."""

from __future__ import annotations

from pathlib import Path

from hybrid_mpc import Dataset, DataSpec, load_trajectories
from scenarios.golf_robot.data import SIZES, make_data, windows
from scenarios.golf_robot.prior import GolfRobotPrior
from scenarios.paper.experiment import Effort, Experiment
from scenarios.paper.table import Claim

FIGURE = "paper, Fig. 5 ({}) and its text"
GOAL = "goal of this project, ({})"
DATA = DataSpec(
    time="time_s",
    inputs=("u_nm",),
    outputs=("phi_rad",),
    dt=0.02,
    max_gap=0.05,
    smoothing=0.25,  # noise in the acceleration goes with length^-2.5, bias grows: docs/results/golf_robot.md
    warm_up=0.5,
    windows=windows(),
)
"""How the recordings are read, here and by the main job."""


def runs(data_set: str, seed: int, folder: Path) -> Dataset:
    """All recordings of a data set; their files go into ``folder``."""
    files = make_data(folder, seed, "full", data_set=data_set)
    return load_trajectories(files, GolfRobotPrior, DATA)


def claims(data_set: str, rnn: float, pgrnn: float, mopgrnn: float) -> tuple[Claim, ...]:
    """The claims on one data set, as shares of the physics' error.

    The RNN is ``rnn`` above it, the PGRNN at best ``pgrnn`` and the MOPGRNN ``mopgrnn`` below it.
    """
    paper, goal, s = FIGURE.format(data_set), GOAL.format(data_set), data_set
    return (
        Claim(
            f"{s}_rnn_worse",
            f"RNN at least {100 * rnn:.0f} % above the physics with every amount of data",
            paper,
            Claim.above("rnn", "phy", rnn, s),
        ),
        Claim(
            f"{s}_pgrnn_level",
            "PGRNN about level with the physics with least data, here: within 20 %",
            paper,
            Claim.level("pgrnn", "phy", 0.2, s, at="least"),
        ),
        Claim(
            f"{s}_pgrnn_best",
            f"PGRNN up to {100 * pgrnn:.0f} % below the physics, here: at least that at best",
            paper,
            Claim.below("pgrnn", "phy", pgrnn, s, at="some"),
        ),
        Claim(
            f"{s}_mopgrnn",
            f"MOPGRNN {100 * mopgrnn:.0f} % below the physics with most data",
            paper,
            Claim.below("mopgrnn", "phy", mopgrnn, s, at="most"),
        ),
        Claim(
            f"{s}_rnn_above_pgrnn",
            "RNN above PGRNN with every amount of data",
            paper,
            Claim.above("rnn", "pgrnn", 0.0, s),
        ),
        Claim(
            f"{s}_little_data",
            "MOPGRNN hardly worse with little data, here: with least at most 10 % worse than with most",
            paper,
            Claim.steady("mopgrnn", 0.1, s),
        ),
        Claim(
            f"{s}_narrower",
            "the standard deviation of MOPGRNN below those of PGRNN and RNN with every amount of data",
            paper,
            Claim.narrower("mopgrnn", ("pgrnn", "rnn"), s),
        ),
        Claim(
            f"{s}_more_physics",
            "the more physics, the more accurate and consistent: RNN, PGRNN, MOPGRNN in this order with most data",
            paper,
            Claim.ordered(("rnn", "pgrnn", "mopgrnn"), s),
        ),
        Claim(
            f"{s}_violation",
            "the energy violation of MOPGRNN below that of PGRNN with every amount of data",
            goal,
            Claim.below("mopgrnn", "pgrnn", 0.0, s, metric="energy_violation_w"),
        ),
        Claim(
            f"{s}_free_run",
            "training on free runs brings MOPGRNN down by a further 20 % with most data",
            goal,
            Claim.below("hybrid", "mopgrnn", 0.2, s, at="most"),
        ),
        Claim(
            f"{s}_sindy",
            "SINDy with control reaches comparable accuracy, here: at most 25 % above MOPGRNN with most data",
            "paper, text",
            Claim.below("sindy", "mopgrnn", -0.25, s, at="most"),
        ),
    )


EXPERIMENT = Experiment(
    figure="Fig. 5",
    data_sets={
        "a": "Golf robot, (a) without sinusoidal training data",
        "b": "Golf robot, (b) with sinusoidal training data",
    },
    most=SIZES["full"]["train"],
    runs=runs,
    measured=True,
    shown="test_01_sine",
    efforts={
        "quick": Effort(4, (3, 6), steps=120, free_run_steps=20, valid=2, test=3, every=40, decay=300.0),
        "full": Effort(16, (3, 6, 9, 12, 15), steps=1500, free_run_steps=200, valid=6, test=15, decay=300.0),
    },
    claims=(*claims("a", 0.23, 0.38, 0.46), *claims("b", 0.59, 0.29, 0.42)),
)
