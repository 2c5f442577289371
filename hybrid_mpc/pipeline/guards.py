"""What a watched loop does on an alarm: record it, or go over to a backup that adapts."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np
from numpy.typing import NDArray

from hybrid_mpc.closed_loop.guard import Guard, Mode
from hybrid_mpc.errors import InputError
from hybrid_mpc.estimation.parameters import parameter_filter, with_parameter_states
from hybrid_mpc.model import HybridModel
from hybrid_mpc.mpc.condensed import CondensedController
from hybrid_mpc.mpc.ocp import OCP
from hybrid_mpc.mpc.safeguard import SafeController
from hybrid_mpc.pipeline.loops import (
    FIRST_LOAD,
    QUIET_SHARE,
    Machine,
    first_controller,
    first_deviations,
    make_ocp,
)

Array = NDArray[np.float64]
REACTIONS = ("rest", "adapt")
"""What ``hybrid-mpc control --guard`` and ``--adapt`` do."""
DWELL_S, QUIET_S = 0.5, 1.0
"""A guard's shortest time in a mode, and the time without alarm before it goes back [the machine's seconds]."""
PATIENCE_S = 0.8
"""[The machine's seconds.] A push of 0.2 s raised alarms for up to 0.7 s, through the monitor's windows and what the
observer makes of it; a backup that takes it for a heavier machine costs more than it saves (docs/energy-guard.md)."""
GAIN = "gain of "


def make_resting_guard(model: HybridModel) -> Guard:
    """A guard that records where the model does not describe the machine, and rests where the sensor is frozen.

    Args:
        model: The model, whose unit of time its times are in.

    Example:
        ``simulate(..., monitor=monitor, guard=make_resting_guard(hybrid))``
    """
    unit = model.time_unit
    return Guard(Mode.NORMAL, Mode.REST, dwell=DWELL_S * unit, quiet=QUIET_S * unit)


def make_adaptive_guard(
    model: HybridModel,
    prior: HybridModel,
    scenario: Machine,
    sigma_x: Array,
    control: OCP | None = None,
    *,
    patience: float | None = None,
) -> Guard:
    """A guard whose backup estimates what has become of the prior's parameters, and plans with it.

    The backup's filter runs all the time, so it has found the change when the guard switches. A frozen sensor takes
    the input away.

    Args:
        model: The model that the normal controller plans with; it must know its parameters.
        prior: The fitted prior, whose parameters change, for terminal weight and fallback.
        scenario: The machine: its sensors' noise, and as ``causes`` the parameters that change together, by name. Gains
            of inputs are left out where there are other causes: a weaker motor is a heavier machine, but for its
            friction.
        sigma_x: Process noise ``(n_x,)`` per period of the model's estimator.
        control: The control problem. Default: the scenario's.
        patience: Time [s] for which the model must have been in doubt. Default: 0.8 of the machine's seconds.

    Raises:
        InputError: If there are no causes or no control problem, the model does not know its parameters, or one of
            them is unknown.

    Example:
        ``make_adaptive_guard(hybrid, prior, scenario, sigma_x)``
    """
    groups = adaptable(model, scenario.causes)
    adaptive = with_parameter_states(model, groups, prior=prior)
    control = scenario.control if control is None else control
    if control is None:
        raise InputError(f"a guard that adapts needs a control problem; scenario {scenario.name} has none")
    span = control.input_range
    plain = make_ocp(prior, control)
    ocp = plain.changed(terminal=plain.terminal_weight(model))
    backup = SafeController(CondensedController(adaptive, ocp), prior, first=first_controller(adaptive, ocp))
    first, unit = first_deviations(model, scenario), model.time_unit
    estimator = parameter_filter(
        adaptive, len(groups), sigma_y=scenario.sensor_sigma, sigma_x=sigma_x, sigma_x0=first,
        sigma_d=QUIET_SHARE * span, sigma_d0=FIRST_LOAD * span,
    )  # fmt: skip
    return Guard(
        Mode.BACKUP, Mode.REST, backup=backup, backup_estimator=estimator, dwell=DWELL_S * unit, quiet=QUIET_S * unit,
        patience=PATIENCE_S * unit if patience is None else patience,
    )  # fmt: skip


def adaptable(model: HybridModel, causes: Mapping[str, Sequence[str]]) -> dict[str, tuple[str, ...]]:
    """Those of the causes that a backup adapts to.

    Raises:
        InputError: If there are none, the model does not know its parameters, or its inputs act later.

    Example:
        ``adaptable(hybrid, {"mass": ("m", "J"), "motor": ("gain of u",)})`` is ``{"mass": ("m", "J")}``.
    """
    groups = {name: tuple(names) for name, names in causes.items()}
    if not groups:
        raise InputError(
            'a guard that adapts needs causes: groups of parameters that may change, e.g. {"mass": ("m", "J")}; '
            "a scenario names them in its field causes"
        )
    if not model.n_p:
        raise InputError(
            f"a guard that adapts needs a model that knows its parameters; model {model.name} has none: give its prior "
            "a parameters_spec and train it anew"
        )
    if model.waiting:
        raise InputError(
            f"a guard that adapts needs a model whose inputs act at once; those of model {model.name} act later"
        )
    return {name: names for name, names in groups.items() if not _is_gain(names)} or groups


def _is_gain(names: Sequence[str]) -> bool:
    return bool(names) and all(name.startswith(GAIN) for name in names)
