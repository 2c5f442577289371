"""Everything that decides a training."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Literal, get_args

from hybrid_mpc.errors import InputError
from hybrid_mpc.identify.networks import Cell
from hybrid_mpc.identify.objectives import OBJECTIVES, CombinationName
from hybrid_mpc.machine.specification import check_prior_replay

Kind = Literal["rnn", "pgrnn", "mopgrnn"]
Form = Literal["hybrid", "literal"]
Reading = Literal["stage", "one_step", "free_run"]
PriorParameters = Literal["fixed", "trained"]
KINDS: tuple[Kind, ...] = ("rnn", "pgrnn", "mopgrnn")


@dataclass(frozen=True)
class TrainingSettings:
    """Everything that decides a training; two trainings with equal settings and data are equal.

    Args:
        kind: ``"rnn"`` (no prior), ``"pgrnn"`` (prior, error objective), ``"mopgrnn"`` (error and energy).
        hidden: Hidden units z.
        networks: Networks trained at once; they differ in their initial weights.
        teacher_steps: Optimiser steps with teacher forcing.
        free_run_steps: Optimiser steps on free runs.
        seed: Seed of weights and batches.
        warm: Warm-up samples of a window.
        horizon: Most scored periods of a free-run window; fewer where a trajectory is short
            (:func:`~hybrid_mpc.identify.dataset.fitting_horizon`).
        batch: Windows a step.
        decay: Weight decay of AdamW times the number of training samples: the weights' prior counts the
            less, the more data there are. Small recordings need it, large ones do not notice.
        learning_rates: Start and end of the cosine schedule, teacher forcing then free runs.
        every: Steps between evaluations (bounds, validation, checkpoint).
        validation_horizon: Most scored periods of a validation window. Default: five times ``horizon``. Trainings
            with other horizons can be compared by their validation only if this is the same.
        cell: ``"gru"`` (torch's form), ``"gru_paper"`` (one bias a gate), ``"lstm"``, ``"feed_forward"``.
        form: ``"hybrid"`` (exact kinematics, correction of the prior's acceleration, Runge-Kutta) or
            ``"literal"`` (the paper's: the network gives xdot, explicit Euler).
        objectives: Names in ``OBJECTIVES``. A mopgrnn is trained on all of them, the other kinds on the
            first; the curve has them all.
        combination: How a mopgrnn's objectives become one number: the vector performance index with a
            ``"smooth_maximum"`` or a ``"hard_maximum"``, or as ablations ``"weighted_sum"`` and
            ``"augmented_lagrangian"`` (:mod:`~hybrid_mpc.identify.objectives`).
        weights: Weights of the weighted sum, one for each objective; default: equal.
        energy: Where the energy objective is taken: ``"stage"`` (what the stage predicts), ``"one_step"``
            (always at the measured state), ``"free_run"`` (always at the model's own state). The last two
            cost a second prediction in the other stage
            (:func:`~hybrid_mpc.identify.objectives.energy_objective`).
        fused: Sequences of the GRUs with few operations a step: faster, but not the same bits.
        prior_parameters: ``"fixed"`` at their fitted values, or ``"trained"`` along within their bounds, each
            network its own (:mod:`~hybrid_mpc.identify.step`). The energy balance that trains and
            judges keeps the fitted values.
        prior_replay: Weight of the mean square of the correction (in its own scale) in states that no recording comes
            near
            (:mod:`~hybrid_mpc.identify.prior_replay`), so that the prior stands alone there, with its parameters as
            they are trained along if they are. It stands beside the objectives in units of their bounds; these fall
            as the training goes on. Validation, which keeps the best weights, does not know it. An rnn has no prior
            to fall back on and ignores it. Default: zero, none.

    Raises:
        InputError: If a name is not known, there is no objective, weights do not fit the objectives, an rnn is to
            train the prior that it does not have, or prior_replay are negative or asked of the literal form, whose
            network gives the whole derivative and corrects nothing.

    Example:
        >>> TrainingSettings("mopgrnn", 16, 4, 100, 100, seed=0, warm=10).objectives
        ('error', 'energy')
    """

    kind: Kind
    hidden: int
    networks: int
    teacher_steps: int
    free_run_steps: int
    seed: int
    warm: int
    horizon: int = 50
    batch: int = 32
    decay: float = 300.0
    learning_rates: tuple[float, float, float, float] = (1e-2, 1e-3, 5e-3, 1e-4)
    every: int = 25
    validation_horizon: int | None = None
    cell: Cell = "gru"
    form: Form = "hybrid"
    objectives: tuple[str, ...] = ("error", "energy")
    combination: CombinationName = "smooth_maximum"
    weights: tuple[float, ...] = ()
    energy: Reading = "stage"
    fused: bool = False
    prior_parameters: PriorParameters = "fixed"
    prior_replay: float = 0.0

    def __post_init__(self) -> None:
        for name in ("objectives", "weights"):  # lists, where they come from a file
            object.__setattr__(self, name, tuple(getattr(self, name)))
        names = {"kind": Kind, "cell": Cell, "form": Form, "combination": CombinationName, "energy": Reading}
        names |= {"prior_parameters": PriorParameters}
        for name, choices in names.items():
            _check_choice(name, getattr(self, name), get_args(choices))
        for objective in self.objectives:
            _check_choice("objectives", objective, tuple(OBJECTIVES))
        if not self.objectives:
            raise InputError("objectives is empty; a training needs at least one, e.g. ('error',)")
        if self.weights and len(self.weights) != len(self.objectives):
            raise InputError(
                f"weights has {len(self.weights)} numbers for the objectives {', '.join(self.objectives)}; "
                "give one for each, or none for equal ones"
            )
        if self.kind == "rnn" and self.prior_parameters == "trained":
            raise InputError("an rnn has no prior to train along; leave prior_parameters 'fixed'")
        check_prior_replay(self.prior_replay)
        if self.prior_replay and self.form == "literal":
            raise InputError(
                "the literal form corrects no prior, so it cannot be anchored to it; leave prior_replay 0"
            )

    @property
    def use_prior(self) -> bool:
        """Whether the network sees the prior."""
        return self.kind != "rnn"


def _check_choice(name: str, value: Any, choices: tuple[Any, ...]) -> None:
    if value not in choices:
        raise InputError(f"{name} has no {value!r}; there are: {', '.join(map(str, choices))}")
