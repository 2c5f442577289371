"""Build estimator, controller and guard from models, noise and a control problem."""

from __future__ import annotations

import warnings
from collections.abc import Callable, Mapping, Sequence
from functools import partial
from typing import TYPE_CHECKING, Any, Protocol

import numpy as np
from numpy.typing import ArrayLike, NDArray

from hybrid_mpc.control.ocp import OCP
from hybrid_mpc.control.problem import Controller
from hybrid_mpc.control.safeguard import SafeController
from hybrid_mpc.control.sizes import Sizes, disturbance_sizes
from hybrid_mpc.data.scales import evenly
from hybrid_mpc.errors import InputError
from hybrid_mpc.estimate.kalman import Estimator, ExtendedKalmanFilter
from hybrid_mpc.estimate.offset_free import distinguishable, offset_free, steady_matrices
from hybrid_mpc.estimate.parameters import parameter_filter, with_parameter_states
from hybrid_mpc.estimate.switching import OUTLIER, SLIP, SWITCHES, Filter, SwitchingFilter, with_outliers
from hybrid_mpc.estimate.tuning import FOUND, choose_most_likely, remaining_load
from hybrid_mpc.loop.guard import Guard, Mode
from hybrid_mpc.model.equilibrium import hidden_fixed_point
from hybrid_mpc.model.model import HybridModel, kinematics, output_with_jacobian
from hybrid_mpc.records import known
from nn_export.errors import CompileError

if TYPE_CHECKING:  # what takes long to import is imported where it is made
    from hybrid_mpc.control.best_of import BestOf
    from hybrid_mpc.control.sqp import SQPController
    from hybrid_mpc.data.trajectories import Trajectory

Array = NDArray[np.float64]
MODES = ("quiet", "slip", "jump", "outlier")
"""Modes of the observer: those of :data:`~hybrid_mpc.estimate.switching.SWITCHES`, and outlier."""
QUIET_SHARE = 0.0003
"""Standard deviation of the load's random walk per period in the quiet filter, as a share of the load's size (drift,
temperature). It is doubled if the filter is too slow, see :func:`quiet_shares`."""
FOUND_HORIZONS, MOST_DOUBLED = 1.5, 7
"""Horizons of the controller within which quiet and slip filter must estimate two thirds of a constant load, and the
largest number of doublings. Only loads that the jump filter does not detect take that long. The golf robot's quiet
filter takes 1.3 horizons, the disk's less, so neither is doubled: with faster filters a loop limit-cycles around static
friction, and intermittent model errors are taken for loads. With four horizons instead, the cost under a load is 1.3 to
1.5 times as large for machines that only lag, as heaters and arms (docs/results/simulated_machines.md)."""
SEARCHED = 100
"""Horizons after which a load that no filter has estimated counts as never estimated: its offset would last for minutes
with a plan of seconds."""
JUMP = 0.05
"""Standard deviation of a jump of the load per period in the jump filter, as a share of the load's size: a load of 5 %
is ordinary, a larger one takes a few periods. It is larger if slips would explain it, see :func:`jump_shares`."""
FIRST_LOAD = 0.001
"""Initial standard deviation of the load, as a share of the input's range. It is small, because the load of a machine
that sticks at rest is not observable, and its estimate would be wrong when the machine moves."""
TUNED_PERIODS, TUNED_RECORDINGS = 500, 3
"""Number of periods and of training recordings in that likelihood."""
DWELL_S, QUIET_S = 0.5, 1.0
"""A guard's shortest time in a mode, and the time without alarm before it switches back, in time constants of the
machine."""
GAIN = "gain of "


def native(model: HybridModel, ocp: OCP) -> Controller:
    """The real-time iteration as compiled C; without a compiler that of Python, with a ``RuntimeWarning``.

    Raises:
        InputError: If a part of model or problem cannot be exported to C; the message names it.
    """
    from hybrid_mpc.control.rti import CondensedController
    from hybrid_mpc.embedded.native import NativeController

    try:
        return NativeController(model, ocp)
    except CompileError as error:
        warnings.warn(
            f"solver native: {error}. Using rti in Python, which computes the same inputs but takes longer",
            RuntimeWarning,
            stacklevel=2,
        )
        return CondensedController(model, ocp)


def _rti(model: HybridModel, ocp: OCP, **options: Any) -> Controller:
    from hybrid_mpc.control.rti import CondensedController

    return CondensedController(model, ocp, **options)


def _sqp(model: HybridModel, ocp: OCP, **options: Any) -> Controller:
    from hybrid_mpc.control.sqp import SQPController

    return SQPController(model, ocp, **options)


def _ipopt(model: HybridModel, ocp: OCP, **options: Any) -> Controller:
    from hybrid_mpc.control.nlp import IpoptController

    return IpoptController(model, ocp, **options)


# a solver is imported when it is built: a kit for an estimator or monitor alone imports none
SOLVERS: Mapping[str, Callable[..., Controller]] = {
    "rti": _rti,
    "native": native,
    "sqp": _sqp,
    "ipopt": _ipopt,
}
"""Solvers by name: ``rti``, the condensed real-time iteration; ``native``, the same as compiled C; ``sqp``, sequential
quadratic programming to convergence; ``ipopt``, the nonlinear program solved by IPOPT."""


def _unscented(model: HybridModel, **sigmas: Any) -> ExtendedKalmanFilter:
    from hybrid_mpc.estimate.unscented import UnscentedKalmanFilter

    return UnscentedKalmanFilter(model, **sigmas)


def _moving_horizon(model: HybridModel, **sigmas: Any) -> ExtendedKalmanFilter:
    from hybrid_mpc.estimate.moving_horizon import MovingHorizonEstimator

    return MovingHorizonEstimator(model, **sigmas)


OBSERVERS: Mapping[str, Callable[..., ExtendedKalmanFilter]] = {
    "switching": ExtendedKalmanFilter,
    "ekf": ExtendedKalmanFilter,
    "ukf": _unscented,
    "mhe": _moving_horizon,
}
"""Filters by kind of observer: ``switching`` between four extended Kalman filters, one ``ekf``, the unscented Kalman
filter ``ukf``, and the moving horizon estimator ``mhe``."""


class LoopAssumptions(Protocol):
    """Assumptions of estimators and guards about a machine, given by a scenario or a kit."""

    @property
    def name(self) -> str:
        """Name of the machine."""

    @property
    def sensor_sigma(self) -> tuple[float, ...]:
        """Standard deviations of the sensors ``(n_y,)`` [output units]."""

    @property
    def first_sigma(self) -> tuple[float, ...] | None:
        """Initial standard deviations of the states that no output measures directly; None: from sensors and ranges."""

    @property
    def control(self) -> OCP | None:
        """The control problem."""

    @property
    def safe_input(self) -> tuple[float, ...] | None:
        """Input ``(n_u,)`` with which the machine may be left alone; None if not declared."""

    @property
    def causes(self) -> Mapping[str, tuple[str, ...]]:
        """Possible faults by name: the parameters that change together."""


def tuned_noise(
    model: HybridModel,
    scenario: LoopAssumptions,
    base: Array,
    recordings: Sequence[Trajectory],
    *,
    observer: bool,
    known: Mapping[str, float] | None = None,
) -> Array:
    """Process noise ``(n_x,)`` per period by maximum likelihood on undisturbed recordings: ``base`` times a scale.

    The noise of a state is at most its spread in the recordings.

    Args:
        model: The model.
        scenario: Assumptions about the machine.
        base: One-period errors of the model ``(n_x,)``.
        recordings: Training recordings with smoothed states.
        observer: Whether the estimator estimates an unknown load.
        known: Fixed noise of single states by name. Default: none.
    """
    own = np.array([(known or {}).get(s.name, np.nan) for s in model.states])
    spread = np.array(model.state_spread) if model.state_spread else np.zeros(model.n_x)
    most = np.where(spread > 0, spread, np.inf)
    chosen = [recordings[i] for i in evenly(len(recordings), TUNED_RECORDINGS)]
    parts = [r.part(slice(TUNED_PERIODS), r.name, "train") for r in chosen]

    def scaled(scale: float) -> Array:
        return np.where(np.isnan(own), np.minimum(scale * base, most), own)

    def filter_of(scale: float) -> Filter:
        return make_estimator(model, scenario, scaled(scale), observer=observer)

    # factors on the model's one-period errors; the process noise is that of largest likelihood
    return scaled(choose_most_likely(filter_of, parts, (1.0, 3.0)))


def _ask_for_point(model: HybridModel) -> str:
    """Remedy for a failed rank test at a point that the prior does not declare; empty if it does."""
    if model.x0.any() or model.u0.any():
        return ""
    return (
        "All states and inputs are zero at this point: declare the operating point of the machine in the prior, "
        "operating_point = OperatingPoint(x=(...), u=(...)). "
    )


def make_estimator(
    model: HybridModel,
    scenario: LoopAssumptions,
    sigma_x: Array,
    control: OCP | None = None,
    *,
    observer: bool = True,
    kind: str = "switching",
    input_noise: float = 0.0,
) -> Filter:
    """Build the estimator of a model.

    With ``observer``, the kind ``switching`` switches between four filters (:data:`MODES`). A single filter is either
    fast enough for a push, but then passes the encoder's quantization on to the input, or quiet, but then takes a push
    for noise. The unknown loads are those of the model's ``disturbance_model``.

    Args:
        model: The model.
        scenario: A scenario or a kit, with the sensor noise.
        sigma_x: Process noise ``(n_x,)`` per period, see :func:`~hybrid_mpc.estimate.tuning.process_noise`.
        control: The control problem, whose ``input_range`` determines the size of a load. Default: the scenario's.
        observer: Whether it estimates the unmeasured disturbances. Default: True.
        kind: Kind of observer (:data:`OBSERVERS`, docs/observers.md). Kinds other than ``switching`` have the noise of
            its quiet filter. Default: switching; without ``observer`` that is the extended Kalman filter.
        input_noise: Noise at the inputs in the quiet filter, as a share of their ranges; only with ``observer``. With
            0.05 to 0.2, loops of unstable or integrating machines bear larger errors of the model, but inputs move more
            with the sensors' noise, and loads are found later (loop transfer recovery: Doyle and Stein, *Robustness
            with observers*, IEEE TAC 24, 1979). Default: 0.

    Raises:
        InputError: If the kind is unknown, ``input_noise`` is negative, the size of ``sensor_sigma`` or ``first_sigma``
            is wrong, there is no control problem, the disturbances are not observable, or the process noise hides them,
            so that a load is never estimated.

    Example:
        ``make_estimator(model, scenario, process_noise(model, train))``
    """
    control = scenario.control if control is None else control
    make = OBSERVERS[known(kind, OBSERVERS, "kind of observer")]
    if control is None:
        raise InputError(
            f"scenario {scenario.name}: no control problem, so no input range; give control=OCP(...) [HM-KIT-011]"
        )
    first, span = first_deviations(model, scenario), disturbance_sizes(model, control)
    if observer and not (found := distinguishable(model, Sizes(model, control).states)).detectable:
        raise InputError(
            f"observer of model {model.name}: at the operating point {found.why_undetectable}. {_ask_for_point(model)}"
            "Declare other "
            'disturbances, at most as many as outputs: Scenario(disturbance_model=(Disturbance("output", ...), ...)) '
            "[HM-KIT-012]"
        )

    def filter_of(
        sigma: Array, step: Array | None, make: Callable[..., ExtendedKalmanFilter] = ExtendedKalmanFilter,
        sensor: float = 1.0,
    ) -> ExtendedKalmanFilter:  # fmt: skip
        return make(
            model, sigma_y=sensor * np.array(scenario.sensor_sigma), sigma_x=sigma, sigma_x0=first,
            sigma_d=None if step is None else step * span, sigma_d0=None if step is None else FIRST_LOAD * span,
        )  # fmt: skip

    if not observer:
        return filter_of(sigma_x, None, make)
    periods = round(FOUND_HORIZONS * control.horizon)
    if not 0.0 <= input_noise < np.inf:
        raise InputError(
            f"input_noise: must be zero or more, a share of the inputs' ranges, got {input_noise} [HM-KIT-044]"
        )
    robust = np.hypot(sigma_x, input_noise * _moved(model, control.input_range)) if input_noise else sigma_x
    quiet = quiet_shares(partial(filter_of, robust), periods, model.n_d)
    if kind != "switching":
        _check_found((filter_of(robust, quiet),), SEARCHED * control.horizon, Sizes(model, control).states)
        return filter_of(robust, quiet, make)
    slips = np.maximum(SLIP * sigma_x, robust)
    slip = quiet_shares(partial(filter_of, slips), periods, model.n_d)
    # else the slip filter would explain a lasting load by repeated slips, and never estimate it
    modes = (
        filter_of(robust, quiet), filter_of(slips, np.maximum(quiet, slip)),
        filter_of(sigma_x, jump_shares(model, sigma_x, span)), filter_of(sigma_x, quiet, sensor=OUTLIER),
    )  # fmt: skip
    _check_found(modes[:3], SEARCHED * control.horizon, Sizes(model, control).states)
    return SwitchingFilter(modes, with_outliers(SWITCHES))


def _moved(model: HybridModel, sizes: Array) -> Array:
    """Change of each state ``(n_x,)`` in a period by independent changes of the inputs by ``sizes`` ``(n_u,)``, at the
    operating point.
    """
    h = hidden_fixed_point(model, model.x0, model.u0)
    by_u = model.with_jacobian(model.x0, h, model.u0, model.w, model.p)[3].full()[: model.n_x]
    return np.asarray(np.sqrt((by_u**2) @ sizes**2))


def _check_found(modes: Sequence[ExtendedKalmanFilter], periods: int, sizes: Array) -> None:
    """Refuse an observer if none of its filters estimates two thirds of a constant load within ``periods``.

    A covariance that does not converge means too little noise for a constant state, which is harmless, or noise above
    the states' ``sizes`` ``(n_x,)``, where rounding dominates.
    """
    model, sigma = modes[0].model, np.sqrt(modes[0].noise[0])
    left = np.array([remaining_load(one, periods) for one in modes])
    drowned = bool(np.any(sigma[: model.n_x] > sizes))
    unsettled = np.all(np.isnan(left), axis=0)
    lost = np.flatnonzero(~np.any(left <= FOUND, axis=0) & (drowned | ~unsettled))
    if not lost.size:
        return
    d = model.disturbance_model
    where = (
        f"the input {model.inputs[lost[0]].name}" if d is None else f"the {d[lost[0]].at} {d[lost[0]].signal}"
    )
    noise = ", ".join(f"{s.name} {v:.3g} {s.unit}" for s, v in zip(model.states, sigma, strict=False))
    raise InputError(
        f"observer of model {model.name}: a load at {where} is never estimated, because the process noise ({noise} per "
        "period) explains every load. A constant load would cause an offset. Correct the prior, set "
        "Scenario(state_noise={...}), or run the scenario again [HM-KIT-013]"
    )


def quiet_shares(filter_of: Callable[[Array], ExtendedKalmanFilter], periods: int, n_d: int) -> Array:
    """Random walk ``(n_d,)`` of the loads per period in the quiet or slip filter, as shares of their sizes.

    Each is :data:`QUIET_SHARE`, doubled at most :data:`MOST_DOUBLED` times, until the filter estimates two thirds of a
    constant load within ``periods``, at rest or in motion.
    """
    shares = np.full(n_d, QUIET_SHARE)
    for _ in range(MOST_DOUBLED):
        slow = remaining_load(filter_of(shares), periods) > FOUND
        if not slow.any():
            break
        shares = np.where(slow, 2.0 * shares, shares)
    return shares


def jump_shares(model: HybridModel, sigma_x: Array, span: Array) -> Array:
    """Random walk ``(n_d,)`` of the loads per period in the jump filter, as shares of their sizes ``span``.

    Each is at least :data:`JUMP`, and at most one. In between it moves a state in a period by twice the noise of the
    slip filter, where it is most visible. With less, the slip filter would be more probable however large the load is,
    and would explain it by one slip after the other. A disturbance that moves no state within a period has
    :data:`JUMP`, and so has an input whose whole range moves a state less: a jump there is no clearer than a slip.
    """
    h = hidden_fixed_point(model, model.x0, model.u0)
    b_d = steady_matrices(model, model.x0, h, model.u0, model.w)[0][: model.n_x, model.n_x + model.n_h :]
    slips = 2.0 * SLIP * np.maximum(sigma_x, 1e-300)
    seen = np.max(np.abs(b_d) * span / slips[:, None], axis=0)
    shown = (seen >= 1.0) | ((seen > 0) & ~np.any(model.disturbed[0] != 0, axis=0))
    return np.where(shown, np.clip(1.0 / np.maximum(seen, 1e-300), JUMP, 1.0), JUMP)


def first_deviations(model: HybridModel, scenario: LoopAssumptions) -> Array:
    """Initial standard deviations ``(n_x,)`` of the estimator's state.

    A state that an output measures directly has the deviation of its sensor. The others have ``first_sigma``, in their
    order. Without ``first_sigma``, the speed of a measured position has ``sqrt(2) sigma / dt`` (difference of two
    samples), any other state that of a uniform distribution over its range, ``(upper - lower) / sqrt(12)``.

    Raises:
        InputError: If the size of ``sensor_sigma`` or ``first_sigma`` is wrong, or ``first_sigma`` is needed and
            missing.

    Example:
        >>> import casadi as ca
        >>> from types import SimpleNamespace
        >>> from hybrid_mpc.machine.signals import Signal
        >>> x, u, (q, v) = ca.MX.sym("x", 2), ca.MX.sym("u"), (Signal("q", "m"), Signal("v", "m/s"))
        >>> cart = HybridModel.of("cart", 0.02, (q, v), (Signal("F", "N"),), (q,), x=x, u=u, y=x[0],
        ...     x_next=x + 0.02 * ca.vertcat(x[1], u), xdot=ca.vertcat(x[1], u))
        >>> first_deviations(cart, SimpleNamespace(sensor_sigma=(5e-4,), first_sigma=None)).round(4).tolist()
        [0.0005, 0.0354]
    """
    sigma, others = scenario.sensor_sigma, scenario.first_sigma
    if len(sigma) != model.n_y:
        raise InputError(
            f"sensor_sigma: give {model.n_y} standard deviations of the outputs, got {sigma} [HM-KIT-014]"
        )
    found = np.full(model.n_x, np.nan)
    for row, deviation in zip(
        output_with_jacobian(model)(model.x0, model.u0, model.w)[1].full(), sigma, strict=True
    ):
        shown = np.flatnonzero(row)
        if shown.size == 1:
            found[shown[0]] = np.fmin(found[shown[0]], deviation / abs(row[shown[0]]))
    unseen = [int(i) for i in np.flatnonzero(np.isnan(found))]
    if others is not None:
        if len(others) != len(unseen):
            names = ", ".join(model.states[i].name for i in unseen) or "none"
            raise InputError(
                f"first_sigma: give {len(unseen)} standard deviations, of the states that no output measures directly "
                f"({names}), got {others} [HM-KIT-015]"
            )
        found[unseen] = others
        return found
    speeds = {v: q for q, v in kinematics(model).items()}
    for i in unseen:
        low, high = model.states[i].lower, model.states[i].upper
        if i in speeds and np.isfinite(found[speeds[i]]):
            found[i] = np.sqrt(2.0) * found[speeds[i]] / model.dt
        elif np.isfinite(high - low):
            found[i] = (high - low) / np.sqrt(12.0)
    if np.any(np.isnan(found)):
        names = ", ".join(model.states[i].name for i in np.flatnonzero(np.isnan(found)))
        raise InputError(
            f"first_sigma: the initial uncertainty of {names} is unknown. Give first_sigma with {len(unseen)} standard "
            "deviations of the states that no output measures directly, or give these states a range [HM-KIT-016]"
        )
    return found


def make_controller(
    model: HybridModel,
    prior: HybridModel,
    control: OCP,
    *,
    solver: str = "rti",
    iterations: int | None = None,
    safe_input: ArrayLike | None = None,
) -> SafeController:
    """Build a model's controller with its safeguards, which use the prior.

    The first plan of ``rti`` is computed by SQP to convergence before the loop starts, from every start of the control
    problem.

    Args:
        model: The model that plans.
        prior: The fitted prior, for terminal weight and fallback.
        control: The control problem.
        solver: Name in :data:`SOLVERS`. Default: rti.
        iterations: Linearizations a period of ``rti``, or largest number of iterations a solve of ``sqp`` and
            ``ipopt``; ``native`` always has one. Default: that of the solver, one for ``rti``.
        safe_input: Input ``(n_u,)`` with which the machine may be left alone. Default: not declared.

    Raises:
        InputError: If the solver is unknown, ``iterations`` is not possible, or the inputs cannot control the weighted
            outputs.

    Example:
        ``make_controller(models["hybrid"], models["prior"], scenario.control)``
    """
    ocp = make_ocp(prior, control)
    if control.n_y == prior.n_y and 0 < np.count_nonzero(control.q_y) <= prior.n_u:
        found = offset_free(prior, np.flatnonzero(control.q_y).tolist())
        if not found.reachable:
            raise InputError(
                f"control problem: at the operating point {found.why_unreachable}. "
                f"{_ask_for_point(prior)}[HM-KIT-017]"
            )
    if iterations is not None and solver == "native":
        raise InputError(
            "iterations: solver native always linearizes once a period. Omit iterations, or use rti, sqp or ipopt "
            "[HM-KIT-018]"
        )
    options = {} if iterations is None else {"iterations": iterations}
    controller = SOLVERS[known(solver, SOLVERS, "solver")](model, ocp, **options)
    first = None if controller.converges else first_controller(model, ocp, controller)
    return SafeController(controller, prior, first=first, safe_input=safe_input)


def first_controller(
    model: HybridModel, ocp: OCP, controller: Controller | None = None
) -> SQPController | BestOf:
    """The controller of the first plan: SQP, from each start of the problem if there are any.

    It shares the functions of ``controller`` if that is a real-time iteration in Python.
    """
    from hybrid_mpc.control.best_of import BestOf
    from hybrid_mpc.control.rti import CondensedController
    from hybrid_mpc.control.sqp import SQPController

    sqp = SQPController(model, ocp, inner=controller if isinstance(controller, CondensedController) else None)
    return BestOf(sqp, starts=ocp.starts) if ocp.starts else sqp


def make_ocp(prior: HybridModel, control: OCP) -> OCP:
    """The problem with a working point, at which terminal weight and fallback are linearized; by default in motion.

    At rest, the slope of smoothed dry friction would act like strong damping.

    Args:
        prior: The fitted prior.
        control: The control problem.

    Example:
        ``CondensedController(models["hybrid"], make_ocp(models["prior"], scenario.control))``
    """
    return control.changed(working_point=working_point(prior, control))


def working_point(model: HybridModel, control: OCP) -> tuple[Array, Array]:
    """Working point ``(x, u)`` of the problem; without one, the operating point with speeds ``1 / sqrt(q)``.

    A speed without weight is ``1 / sqrt(q) / T``, with the weight ``q`` of its position and the horizon ``T`` [s].
    """
    x, u = control.point(model)
    if control.working_point is not None:
        return x, u
    tolerated = np.where(control.q > 0, 1.0 / np.sqrt(np.where(control.q > 0, control.q, 1.0)), 0.0)
    for position, speed in kinematics(model).items():
        crossing = tolerated[position] / (control.horizon * model.dt)
        x[speed] += tolerated[speed] if tolerated[speed] > 0 else crossing
    return x, u


def sensor_steps(sensor_sigma: Sequence[float]) -> tuple[float, ...]:
    """Resolution ``(n_y,)`` of the sensors, from the deviation of a uniform quantization error: ``sqrt(12) sigma``.

    If the real resolution is finer, a frozen sensor is detected a little later.

    Example:
        >>> [round(step, 6) for step in sensor_steps((0.001,))]
        [0.003464]
    """
    return tuple(float(np.sqrt(12.0) * sigma) for sigma in sensor_sigma)


def make_resting_guard(model: HybridModel) -> Guard:
    """Build a guard that only records alarms of the model, and switches to the safe input when a sensor freezes.

    Args:
        model: The model, whose ``time_unit`` scales the guard's times.

    Example:
        ``simulate(..., monitor=monitor, guard=make_resting_guard(hybrid))``
    """
    unit = model.time_unit
    return Guard(Mode.NORMAL, Mode.REST, dwell=DWELL_S * unit, quiet=QUIET_S * unit)


def make_backup_guard(controller: SafeController, estimator: Estimator) -> Guard:
    """Build a guard that switches to another controller and its estimator after an alarm of the model."""
    unit = controller.controller.model.time_unit
    return Guard(
        Mode.BACKUP, Mode.REST, backup=controller, backup_estimator=estimator, dwell=DWELL_S * unit,
        quiet=QUIET_S * unit,
    )  # fmt: skip


def make_adaptive_guard(
    model: HybridModel,
    prior: HybridModel,
    scenario: LoopAssumptions,
    sigma_x: Array,
    control: OCP | None = None,
    *,
    patience: float | None = None,
) -> Guard:
    """Build a guard with a backup that estimates changes of the prior's parameters, and plans with them.

    The backup's filter always runs, so its estimate has converged when the guard switches. With a frozen sensor the
    safe input is applied.

    Args:
        model: The model of the normal controller; it must have parameters.
        prior: The fitted prior, whose parameters change, for terminal weight and fallback.
        scenario: Sensor noise, and ``causes``: groups of parameters that change together, by name. Gains of inputs are
            left out if there are other causes, because a weaker motor acts like a heavier machine, friction apart.
        sigma_x: Process noise ``(n_x,)`` per period of the model's estimator.
        control: The control problem. Default: the scenario's.
        patience: Time [s] that an alarm must last. Default: 0.8 time constants of the machine.

    Raises:
        InputError: If causes or control problem are missing, the model has no parameters, or a parameter of a cause is
            unknown.

    Example:
        ``make_adaptive_guard(hybrid, prior, scenario, sigma_x)``
    """
    groups = adaptable(model, scenario.causes)
    adaptive = with_parameter_states(model, groups, prior=prior)
    control = scenario.control if control is None else control
    if control is None:
        raise InputError(
            f"adaptive guard: scenario {scenario.name} has no control problem; give control=OCP(...) [HM-KIT-019]"
        )
    span = disturbance_sizes(model, control)
    plain = make_ocp(prior, control)
    ocp = plain.changed(terminal=plain.terminal_weight(model))
    backup = SafeController(
        _rti(adaptive, ocp), prior, first=first_controller(adaptive, ocp),
        safe_input=scenario.safe_input,
    )  # fmt: skip
    first, unit = first_deviations(model, scenario), model.time_unit
    estimator = parameter_filter(
        adaptive, len(groups), sigma_y=scenario.sensor_sigma, sigma_x=sigma_x, sigma_x0=first,
        sigma_d=QUIET_SHARE * span, sigma_d0=FIRST_LOAD * span,
    )  # fmt: skip
    # 0.8 time constants: a push of 0.2 s causes alarms for up to 0.7 s, and a backup that takes the push for a heavier
    # machine costs more than it saves (docs/results/guard.md)
    return Guard(
        Mode.BACKUP, Mode.REST, backup=backup, backup_estimator=estimator, dwell=DWELL_S * unit, quiet=QUIET_S * unit,
        patience=0.8 * unit if patience is None else patience,
    )  # fmt: skip


def adaptable(model: HybridModel, causes: Mapping[str, Sequence[str]]) -> dict[str, tuple[str, ...]]:
    """Causes that a backup adapts to; gains of inputs only if there are no other causes.

    Raises:
        InputError: If there are no causes, or the model has no parameters, or its inputs are delayed.
    """
    groups = {name: tuple(names) for name, names in causes.items()}
    if not groups:
        raise InputError(
            "adaptive guard: no causes. Give groups of parameters that may change together in the scenario, e.g. "
            'causes={"mass": ("m", "J")} [HM-KIT-020]'
        )
    if not model.n_p:
        raise InputError(
            f"adaptive guard: model {model.name} has no parameters. Give its prior parameters, and run the scenario "
            "again [HM-KIT-021]"
        )
    if model.delay_states:
        raise InputError(
            f"adaptive guard: model {model.name} has delayed inputs, which the adaptive guard does not support. Use "
            "guard rest or prior [HM-KIT-022]"
        )
    others = {
        name: names
        for name, names in groups.items()
        if not (names and all(n.startswith(GAIN) for n in names))
    }
    return others or groups
