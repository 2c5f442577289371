"""Settings of a training."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Literal, get_args

from hybrid_mpc.machine.prior import Prior
from hybrid_mpc.machine.specification import Count, CountOrNone
from hybrid_mpc.records import Fields
from hybrid_mpc.rules import Name, NotNegative, Positive

Kind = Literal["rnn", "pgrnn", "mopgrnn"]
PriorParameters = Literal["fixed", "trained"]
KINDS: tuple[Kind, ...] = get_args(Kind)
NO_BALANCE = "the prior has no balance, so a MOPGRNN would equal the PGRNN"
"""Why there is no MOPGRNN of a prior without balances."""


def kinds_of(prior: Prior) -> tuple[Kind, ...]:
    """Kinds of networks for a prior; a prior without balances has no second objective, so no MOPGRNN.

    Example:
        >>> from scenarios.pendulum.prior import PendulumPrior
        >>> kinds_of(PendulumPrior())
        ('rnn', 'pgrnn', 'mopgrnn')
    """
    return tuple(kind for kind in KINDS if kind != "mopgrnn" or prior.equations.balances)


@dataclass(frozen=True)
class TrainingSettings:
    """Settings of a training; trainings with equal settings and data have equal results.

    Args:
        kind: ``"rnn"`` (no prior), ``"pgrnn"`` (prior, first objective), ``"mopgrnn"`` (prior, all objectives).
        hidden: Hidden units z.
        networks: Number of networks trained at once; they differ in their initial weights.
        teacher_steps: Optimizer steps with teacher forcing.
        free_run_steps: Optimizer steps on free runs.
        seed: Seed of weights and batches.
        warm: Warm-up samples of a window.
        horizon: Maximum evaluated periods of a free-run window; fewer if trajectories are short
            (:func:`~hybrid_mpc.identify.dataset.fitting_horizon`).
        batch: Number of windows in a step.
        decay: Weight decay of AdamW times the number of training samples; more data reduce the weight decay.
        learning_rates: Start and end of the cosine schedule for teacher forcing, then for free runs. The default suits
            networks of 8 units; use half of it for larger networks.
        every: Steps between evaluations (bounds, validation, checkpoint).
        validation_horizon: Maximum evaluated periods of a validation window. Default: two thirds of a typical
            validation recording, at most 1000 (:func:`~hybrid_mpc.identify.dataset.validation_horizon`). Validation
            errors of two trainings are comparable only with equal validation horizons.
        objectives: Names in :data:`~hybrid_mpc.identify.objectives.OBJECTIVES`, names of balances of the prior, or
            ``"balances"`` for all balances. The curve holds all; the first one is used for free runs and validation.
            Default: the outputs, which also evaluate models, and all balances.
        prior_parameters: ``"fixed"`` at their fitted values, or ``"trained"`` within their bounds, separately for each
            network. Balances in the objectives keep the fitted values. Default: ``"fixed"``.
        prior_replay: Weight of the mean squared (scaled) correction in states far from all recordings
            (:mod:`~hybrid_mpc.identify.prior_replay`), added to the objectives in units of their bounds. An rnn ignores
            it. Default: 0, no prior replay.
        parts: Number of parts of the training data; network ``i`` leaves out part ``i``. The choice of the model then
            uses data that neither trained a network nor selected its weights. Default 0: all networks use all data.

    Raises:
        InputError: If a name is unknown, there is no objective, an rnn has trained prior parameters, prior_replay is
            negative, or parts is 1.

    Example:
        >>> TrainingSettings("mopgrnn", 16, 4, 100, 100, seed=0, warm=10).objectives
        ('output', 'balances')
    """

    kind: Kind
    hidden: Count
    networks: Count
    teacher_steps: CountOrNone
    free_run_steps: CountOrNone
    seed: int
    warm: CountOrNone
    horizon: Count = 50
    batch: Count = 32
    decay: NotNegative = 300.0
    learning_rates: tuple[Positive, Positive, Positive, Positive] = (2e-2, 2e-3, 1e-2, 5e-4)
    every: Count = 25
    validation_horizon: Count | None = None
    objectives: tuple[Name, ...] = ("output", "balances")
    prior_parameters: PriorParameters = "fixed"
    prior_replay: NotNegative = 0.0
    parts: CountOrNone = 0

    def __post_init__(self) -> None:
        own = Fields(self, "training settings")
        own.need(
            "objectives", lambda: self.objectives,
            "objectives: empty; give at least one, e.g. ('error',) [HM-IDENTIFY-046]",
        )  # fmt: skip
        own.need(
            "kind prior_parameters", lambda: self.use_prior or self.prior_parameters == "fixed",
            "prior_parameters: an rnn has no prior to train; set 'fixed' [HM-IDENTIFY-047]",
        )  # fmt: skip
        own.need("parts", lambda: self.parts != 1, "parts: give 0, or at least 2; got 1 [HM-IDENTIFY-048]")
        own.refuse()

    @property
    def shortest(self) -> int:
        """Minimum samples of a training trajectory for windows of the horizon with several start samples."""
        return self.warm + 1 + math.ceil(1.5 * self.horizon)

    @property
    def use_prior(self) -> bool:
        """Whether the model contains the prior."""
        return self.kind != "rnn"
