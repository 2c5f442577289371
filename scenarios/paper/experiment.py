"""What a scenario says of the paper's experiment on its machine. No torch in here."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path

from hybrid_mpc.data.trajectories import Dataset, Trajectory
from hybrid_mpc.scenario import Scenario
from scenarios.paper.table import Claim


@dataclass(frozen=True)
class Effort:
    """Effort of a reproduction; fixed in advance and the same for all kinds of networks.

    Args:
        networks: Networks of each ensemble; they differ in their initial weights.
        sequences: Amounts of training data, in runs.
        steps: Optimiser steps of every training.
        free_run_steps: How many of them are made on free runs, in the free-run-trained hybrid alone.
        valid: Validation runs.
        test: Test runs.
        hidden: Hidden units z. Default 16.
        every: Steps between evaluations on validation free runs. Default 100.
        batch: Windows a step. Default 32.
        decay: Weight decay of AdamW times the number of training samples; 0 is the paper's Adam. Default 0.
    """

    networks: int
    sequences: tuple[int, ...]
    steps: int
    free_run_steps: int
    valid: int
    test: int
    hidden: int = 16
    every: int = 100
    batch: int = 32
    decay: float = 0.0


@dataclass(frozen=True)
class Experiment:
    """The paper's experiment on one machine.

    Args:
        figure: Name of the paper's figure, e.g. ``"Fig. 3"``.
        data_sets: Title of each data set by its name. Validation and test runs are the same in all of them.
        most: Training runs that there are.
        runs: ``(data set, seed, folder) -> trajectories`` of all roles in order, or the data set that recordings were
            read as, whose findings are reported; files go into ``folder``.
        measured: True: the states are not measured. Then the prior is fitted to every amount of training data
            anew, and its equations smooth them. False: states are exact and the prior is taken as it is.
        shown: Name of the test run that is drawn (the paper's Fig. 6).
        efforts: Effort by the name of the budget.
        claims: What the paper, and this project, expect.
    """

    figure: str
    data_sets: Mapping[str, str]
    most: int
    runs: Callable[[str, int, Path], Sequence[Trajectory] | Dataset]
    measured: bool
    shown: str
    efforts: Mapping[str, Effort]
    claims: tuple[Claim, ...] = ()

    @property
    def reference(self) -> str:
        """The last data set; with most training data it gives what all models are evaluated on."""
        return list(self.data_sets)[-1]


@dataclass(frozen=True)
class PaperScenario(Scenario):
    """A scenario with the paper's experiment on its machine, for ``hybrid-mpc reproduce``."""

    experiment: Experiment = field(kw_only=True)
