"""The paper's experiment on the pendulum (Fig. 3): exact states, the prior as it is. No torch in here."""

from __future__ import annotations

from pathlib import Path

from hybrid_mpc import Trajectory
from scenarios.paper.experiment import Effort, Experiment
from scenarios.paper.table import Claim
from scenarios.pendulum.data import ROLES, SIZES, exact_runs

SET = "exact"
FIGURE = "paper, Fig. 3 and its text"
GOAL = "goal of this project"


def runs(data_set: str, seed: int, folder: Path) -> list[Trajectory]:
    """The exact runs of all roles; nothing is written."""
    return [t for role in ROLES for t in exact_runs(role, SIZES["full"][role], seed=seed)]


CLAIMS = (
    *(
        Claim(
            f"{model}_beats_phy",
            f"{name} lies far below the physics, here: at most half of it, with every amount of data",
            FIGURE,
            Claim.below(model, "phy", 0.5, SET),
        )
        for model, name in (("rnn", "RNN"), ("pgrnn", "PGRNN"), ("mopgrnn", "MOPGRNN"))
    ),
    Claim(
        "pgrnn_below_rnn",
        "PGRNN at least 34 % (to 67 %) below RNN with every amount of data",
        FIGURE,
        Claim.below("pgrnn", "rnn", 0.34, SET),
    ),
    Claim(
        "mopgrnn_below_rnn",
        "MOPGRNN at least 19 % (to 67 %) below RNN with every amount of data",
        FIGURE,
        Claim.below("mopgrnn", "rnn", 0.19, SET),
    ),
    Claim(
        "on_a_par",
        "MOPGRNN on a par with PGRNN, here: within 20 % with every amount of data",
        FIGURE,
        Claim.level("mopgrnn", "pgrnn", 0.2, SET),
    ),
    Claim(
        "narrower",
        "the standard deviation of MOPGRNN below that of PGRNN with every amount of data",
        FIGURE,
        Claim.narrower("mopgrnn", ("pgrnn",), SET),
    ),
    Claim("sooner", "MOPGRNN converges faster than PGRNN", FIGURE, Claim.sooner("mopgrnn", "pgrnn", SET)),
    Claim(
        "no_influence",
        "no clear influence of the amount of data, here: MOPGRNN with least data at most 20 % worse than with most",
        FIGURE,
        Claim.steady("mopgrnn", 0.2, SET),
    ),
    Claim(
        "free_run",
        "training on free runs brings MOPGRNN down by a further 20 % with most data",
        GOAL,
        Claim.below("hybrid", "mopgrnn", 0.2, SET, at="most"),
    ),
    Claim(
        "sindy",
        "SINDy with control reaches comparable accuracy, here: at most 25 % above MOPGRNN with most data",
        "paper, text",
        Claim.below("sindy", "mopgrnn", -0.25, SET, at="most"),
    ),
)

EXPERIMENT = Experiment(
    figure="Fig. 3",
    data_sets={SET: "Damped pendulum, exact states (Fig. 3)"},
    most=SIZES["full"]["train"],
    runs=runs,
    measured=False,
    shown="test_01",
    efforts={
        "quick": Effort(4, (3, 6), steps=300, free_run_steps=50, valid=2, test=3, every=50),
        "full": Effort(16, (3, 6, 9, 12, 15), steps=5000, free_run_steps=600, valid=5, test=10),
    },
    claims=CLAIMS,
)
