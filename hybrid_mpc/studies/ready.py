"""Studies that are ready: they need models only."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path

from hybrid_mpc.records import known
from hybrid_mpc.studies.configuration import Study
from hybrid_mpc.studies.draws import FaultKind, RandomFaults

Models = str | Path | Mapping[str, str | Path]
DEPLOYABLE = ("prior", "prior_observer", "hybrid", "hybrid_observer")
"""The contenders without oracles, which know the machine as it is built, not as it is drawn."""
SPAN = 0.2


@dataclass(frozen=True)
class Ready:
    """A ready study.

    Args:
        title: One line.
        make: From models by label to the study.
    """

    title: str
    make: Callable[[Models], Study]


def ready_study(name: str, models: Models) -> Study:
    """The ready study of that name with these models.

    Args:
        name: Name in :data:`READY`.
        models: Artifact folders by label, or one.

    Raises:
        InputError: If there is none of that name.

    Example:
        >>> ready_study("faults_1000", "runs/golf").size
        1000
    """
    return READY[known(name, READY, "ready study")].make(models)


def _plant_variation(models: Models) -> Study:
    """The parts of the rig that a copy of it would differ in: masses, drive, friction, belt."""
    varied = (
        "m",
        "a",
        "J",
        "d",
        "mu_c",
        "mu_s",
        "motor_gain",
        "drag",
        "belt_stiffness",
        "gap",
        "motor_friction",
    )
    return Study(
        "golf_robot", models, controllers=DEPLOYABLE, vary=dict.fromkeys(varied, SPAN), draws=20, seeds=1,
        name="plant_variation",
    )  # fmt: skip


def _horizon_size(models: Models) -> Study:
    """Tasks that can be done with any horizon: a stroke needs one that reaches the impact."""
    return Study(
        "golf_robot", models, tasks=("track_sine", "track_step", "reject_load"), controllers=("hybrid_observer",),
        horizons=(10, 20, 35, 50, 80), solvers=("rti", "sqp"), seeds=5, name="horizon_size",
    )  # fmt: skip


def _data_amount(models: Models) -> Study:
    return Study(
        "golf_robot", models, tasks=("track_sine", "stroke_1.4", "stroke_3", "reject_push"), seeds=10,
        controllers=("prior_observer", "hybrid_observer"), name="data_amount",
    )  # fmt: skip


def _faults_1000(models: Models) -> Study:
    """The golf robot's catalogue of faults at 70 to 130 % of its sizes, one to three at once, and late solves."""
    kinds = (
        FaultKind("plant_friction", 1.35, 4.9),
        FaultKind("plant_mass", 1.07, 1.65),
        FaultKind("input_gain", 0.74, 0.86),
        FaultKind("measurement_offset", 0.014, 0.026, signed=True),
        FaultKind("measurement_scale", 1.035, 1.065),
        FaultKind("measurement_freeze"),
        FaultKind("measurement_dropout", length=(0.02, 0.1)),
        FaultKind("plant_push", 0.7, 1.3, signed=True, length=(0.1, 0.3)),
        FaultKind("plant_belt", 0.56, 1.04),
        FaultKind("plant_delay", 0.042, 0.078, ramp=5.0),
        FaultKind("late", length=(0.02, 0.24)),
    )
    return Study(
        "golf_robot", models, tasks=("track_sine", "track_step", "stroke_1.4", "stroke_3", "reject_heavy"),
        controllers=("prior_observer", "hybrid_observer"), random_faults=RandomFaults(kinds), draws=100, seeds=1,
        duration=4.0, name="faults_1000",
    )  # fmt: skip


READY: Mapping[str, Ready] = {
    "plant_variation": Ready(
        "every controller on every task of the golf robot, 20 copies of the rig that differ by up to 20 %",
        _plant_variation,
    ),
    "horizon_size": Ready(
        "horizon x hidden units (one --model each) x solver: what a longer look or a larger network pays",
        _horizon_size,
    ),
    "data_amount": Ready(
        "models of runs with more and less data (one --model each): what data pay", _data_amount
    ),
    "faults_1000": Ready("1,000 loops of the golf robot with one to three random faults each", _faults_1000),
}
