"""Everything that decides a training."""

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
NO_BALANCE = "the prior has no balance, so a MOPGRNN would be the PGRNN once more"
"""Why there is no MOPGRNN of a prior without balances."""


def kinds_of(prior: Prior) -> tuple[Kind, ...]:
    """Kinds of networks that differ for a prior: one without balances has no second objective, so no MOPGRNN.

    Example:
        >>> from scenarios.pendulum.prior import PendulumPrior
        >>> kinds_of(PendulumPrior())
        ('rnn', 'pgrnn', 'mopgrnn')
    """
    return tuple(kind for kind in KINDS if kind != "mopgrnn" or prior.equations.balances)


@dataclass(frozen=True)
class TrainingSettings:
    """Everything that decides a training; two trainings with equal settings and data are equal.

    Args:
        kind: ``"rnn"`` (no prior), ``"pgrnn"`` (prior, first objective), ``"mopgrnn"`` (prior, all objectives).
        hidden: Hidden units z.
        networks: Networks trained at once; they differ in their initial weights.
        teacher_steps: Optimiser steps with teacher forcing.
        free_run_steps: Optimiser steps on free runs.
        seed: Seed of weights and batches.
        warm: Warm-up samples of a window.
        horizon: Most scored periods of a free-run window; fewer where a trajectory is short
            (:func:`~hybrid_mpc.identify.dataset.fitting_horizon`).
        batch: Windows a step.
        decay: Weight decay of AdamW times the number of training samples: the more data there are, the less it counts.
        learning_rates: Start and end of the cosine schedule, teacher forcing then free runs. The default suits networks
            of 8 units; larger ones want half of it.
        every: Steps between evaluations (bounds, validation, checkpoint).
        validation_horizon: Most scored periods of a validation window. Default: two thirds of a usual validation
            recording, at most 1000 (:func:`~hybrid_mpc.identify.dataset.validation_horizon`). Trainings can be compared
            by their validation only if this is the same.
        objectives: Names in :data:`~hybrid_mpc.identify.objectives.OBJECTIVES`, of balances of the prior, or
            ``"balances"`` for all of these; the curve has them all, the first one is that of free runs and validation.
            Default: the outputs, which models are evaluated by, and all balances.
        prior_parameters: ``"fixed"`` at their fitted values, or ``"trained"`` along within their bounds, each network
            its own. The energy balance of the objective keeps the fitted values.
        prior_replay: Weight of the mean square of the correction (in its own scale) in states that no recording comes
            near (:mod:`~hybrid_mpc.identify.prior_replay`); it is added to the objectives, which are in units of
            their bounds. An rnn ignores it. Default: zero, none.
        parts: Parts of the training data, of which network ``i`` leaves out part ``i``: the model is chosen by what
            networks say of data that neither trained them nor chose their weights. Default 0: all are trained on all.

    Raises:
        InputError: If a name is not known, there is no objective, an rnn is to train the prior that it does not have,
            prior_replay is negative, or there is one part, which would leave nothing to train on.

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
        """Samples of a training trajectory that give windows of the horizon at several starts."""
        return self.warm + 1 + math.ceil(1.5 * self.horizon)

    @property
    def use_prior(self) -> bool:
        """Whether the network sees the prior."""
        return self.kind != "rnn"
