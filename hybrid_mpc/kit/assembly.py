"""Assembly: estimator, controller, monitor and guard from models, noise and a control problem."""

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
from hybrid_mpc.estimate.offset_free import distinguishable, offset_free
from hybrid_mpc.estimate.parameters import parameter_filter, with_parameter_states
from hybrid_mpc.estimate.switching import SLIP, SWITCHES, Filter, SwitchingFilter
from hybrid_mpc.estimate.tuning import FOUND, load_left, most_likely
from hybrid_mpc.loop.guard import Guard, Mode
from hybrid_mpc.model.model import HybridModel, kinematics, output_with_jacobian
from hybrid_mpc.records import known
from nn_export.errors import CompileError

if TYPE_CHECKING:  # what takes long to import is imported where it is made
    from hybrid_mpc.control.best_of import BestOf
    from hybrid_mpc.control.sqp import SQPController
    from hybrid_mpc.data.trajectories import Trajectory

Array = NDArray[np.float64]
MODES = ("quiet", "slip", "jump")
"""Modes of the observer, in the order of :data:`~hybrid_mpc.estimate.switching.SWITCHES`."""
QUIET_SHARE = 0.0003
"""Step of the estimated load per period while nothing happens (drift, temperature), as a share of its size. Where
a filter finds a constant load too slowly it is doubled, see :func:`quiet_shares`."""
FOUND_HORIZONS, MOST_DOUBLED = 1.5, 7
"""Horizons of the controller within which the quiet filter, and the slip filter, have found two thirds of a constant
load, and how often their steps are doubled at most. A load that a jump does not show takes as long to be compensated.
The quiet filter of the golf robot takes 1.3 horizons, the disk's less, so neither is doubled: quick steps make a loop
hunt around sticking friction, and where a model's errors come and go they are taken for loads. Four horizons cost
machines that only lag, as heaters and arms, 1.3 to 1.5 times as much under a load
(docs/results/simulated_machines.md)."""
SEARCHED = 100
"""Horizons after which a load that no filter has found counts as never found: its offset would last for minutes where a
plan lasts seconds."""
JUMP_SHARE = 0.05
"""The same when a load comes or goes. A load of a twentieth of what the drive can do is ordinary; for a larger one
the filter needs a few periods."""
FIRST_LOAD = 0.001
"""Deviation of the first load, as a share of the input's range. Small: a machine that sticks at rest shows nothing of
its load, and what an observer makes of it there is wrong when it moves."""
SCALES = (1.0, 3.0)
"""Candidate factors on the model's one-period errors; the likeliest gives the process noise."""
TUNED_PERIODS, TUNED_RECORDINGS = 500, 3
"""So many periods of so many training recordings decide."""
DWELL_S, QUIET_S = 0.5, 1.0
"""A guard's shortest time in a mode, and the time without alarm before it goes back [the machine's seconds]."""
PATIENCE_S = 0.8
"""[The machine's seconds.] A push of 0.2 s raised alarms for up to 0.7 s, through the monitor's windows and what the
observer makes of it; a backup that takes it for a heavier machine costs more than it saves (docs/results/guard.md)."""
GAIN = "gain of "


def native(model: HybridModel, ocp: OCP) -> Controller:
    """The real-time iteration as compiled C; without a compiler, with a ``RuntimeWarning``, that of Python.

    Raises:
        InputError: If something of model or problem has no C, by name.
    """
    from hybrid_mpc.control.rti import CondensedController
    from hybrid_mpc.embedded.native import NativeController

    try:
        return NativeController(model, ocp)
    except CompileError as error:
        warnings.warn(
            f"solver native: {error}; rti, which gives the same inputs, runs in Python instead",
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


# solvers are imported when one is made: a kit that only estimates or watches loads none
SOLVERS: Mapping[str, Callable[..., Controller]] = {
    "rti": _rti,
    "native": native,
    "sqp": _sqp,
    "ipopt": _ipopt,
}
"""By the name that commands and settings take: the condensed real-time iteration; the same as compiled C; sequential
quadratic programs to convergence; the same by IPOPT."""


class LoopAssumptions(Protocol):
    """What estimators and guards assume of a machine: a scenario states it, a kit has it from its folder."""

    @property
    def name(self) -> str:
        """Name of the machine."""

    @property
    def sensor_sigma(self) -> tuple[float, ...]:
        """Standard deviations of the sensors ``(n_y,)`` [output units]."""

    @property
    def first_sigma(self) -> tuple[float, ...] | None:
        """Standard deviations of states that no sensor shows at an estimator's start; None: by sensors and ranges."""

    @property
    def control(self) -> OCP | None:
        """The control problem."""

    @property
    def safe_input(self) -> tuple[float, ...] | None:
        """Input ``(n_u,)`` that the machine may be left with; None: none is declared."""

    @property
    def causes(self) -> Mapping[str, tuple[str, ...]]:
        """What may break, by name: the parameters that change together then."""


def tuned_noise(
    model: HybridModel,
    scenario: LoopAssumptions,
    base: Array,
    recordings: Sequence[Trajectory],
    *,
    observer: bool,
    known: Mapping[str, float] | None = None,
) -> Array:
    """Process noise ``(n_x,)`` per period: ``base`` times the scale that makes undisturbed recordings most likely.

    No state strays further in a period than its spread in the recordings. ``base`` are the model's one-period errors
    ``(n_x,)``; an ``observer`` follows an unknown load. ``known`` is that of single states by name, which no scale
    changes.
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

    return scaled(most_likely(filter_of, parts, SCALES))


def make_estimator(
    model: HybridModel,
    scenario: LoopAssumptions,
    sigma_x: Array,
    control: OCP | None = None,
    *,
    observer: bool = True,
) -> Filter:
    """The estimator that all controllers share.

    With observer it switches between three filters (:data:`MODES`): one filter that is quick enough for a push lets
    the encoder's steps through at all times, and one that is quiet takes a push for noise. The unknown loads are those
    of the model's ``disturbance_model``.

    Args:
        model: The model to estimate with.
        scenario: The machine, a scenario or a kit: its sensors' noise.
        sigma_x: Process noise ``(n_x,)`` per period, see :func:`~hybrid_mpc.estimate.tuning.process_noise`.
        control: The control problem; its ``input_range`` says what a large load is. Default: the scenario's.
        observer: Whether it estimates the unmeasured disturbances. Default: yes.

    Raises:
        InputError: If ``sensor_sigma`` or ``first_sigma`` does not fit the model, there is no control problem, the
            outputs cannot tell the disturbances from the states, or the noise of the states hides them: an observer
            that never finds a load is no observer of loads.

    Example:
        ``make_estimator(model, scenario, process_noise(model, train))``
    """
    control = scenario.control if control is None else control
    if control is None:
        raise InputError(
            f"scenario {scenario.name} has no control problem, so no input range; give control=OCP(...) [HM-KIT-011]"
        )
    first, span = first_deviations(model, scenario), disturbance_sizes(model, control)
    if observer and not (found := distinguishable(model, Sizes(model, control).states)).detectable:
        raise InputError(
            f"an observer of model {model.name}: at its operating point {found.why_undetectable}; declare others: "
            'Scenario(disturbance_model=(Disturbance("output", ...), ...)), no more than there are outputs [HM-KIT-012]'
        )

    def filter_of(scale: float, step: Array | None) -> ExtendedKalmanFilter:
        return ExtendedKalmanFilter(
            model, sigma_y=np.array(scenario.sensor_sigma), sigma_x=scale * sigma_x, sigma_x0=first,
            sigma_d=None if step is None else step * span, sigma_d0=None if step is None else FIRST_LOAD * span,
        )  # fmt: skip

    if not observer:
        return filter_of(1.0, None)
    periods = round(FOUND_HORIZONS * control.horizon)
    quiet, slip = (quiet_shares(partial(filter_of, scale), periods, model.n_d) for scale in (1.0, SLIP))
    # where a load lasts, the slip filter would explain it by slip after slip, and the load would never be found
    modes = (
        filter_of(1.0, quiet), filter_of(SLIP, np.maximum(quiet, slip)), filter_of(1.0, np.full(model.n_d, JUMP_SHARE)),
    )  # fmt: skip
    _check_found(modes, SEARCHED * control.horizon, Sizes(model, control).states)
    return SwitchingFilter(modes, SWITCHES)


def _check_found(modes: Sequence[ExtendedKalmanFilter], periods: int, sizes: Array) -> None:
    """Refuse filters none of which finds two thirds of a constant load within so many periods.

    Where no covariance settles there is too little noise for a state that stays, which does no harm, or so much that
    rounding is all: more than the states' ``sizes`` ``(n_x,)``.
    """
    model, sigma = modes[0].model, np.sqrt(modes[0].noise[0])
    left = np.array([load_left(one, periods) for one in modes])
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
        f"an observer of model {model.name} never finds a load at {where}: with the process noise of the states "
        f"({noise} a period) it takes every load for noise, and a constant one would leave an offset. Correct the "
        "prior, give Scenario(state_noise={...}), or run the scenario again [HM-KIT-013]"
    )


def quiet_shares(filter_of: Callable[[Array], ExtendedKalmanFilter], periods: int, n_d: int) -> Array:
    """Steps ``(n_d,)`` of the loads in a filter that no jump drives, a period, as shares of their sizes.

    Each is :data:`QUIET_SHARE`, doubled until the filter has found two thirds of a constant load of that kind after
    ``periods``, at rest or in motion; at most :data:`MOST_DOUBLED` times.
    """
    shares = np.full(n_d, QUIET_SHARE)
    for _ in range(MOST_DOUBLED):
        slow = load_left(filter_of(shares), periods) > FOUND
        if not slow.any():
            break
        shares = np.where(slow, 2.0 * shares, shares)
    return shares


def first_deviations(model: HybridModel, scenario: LoopAssumptions) -> Array:
    """Standard deviations ``(n_x,)`` of the state at the estimator's start.

    A state that an output shows alone has that of the sensor. The others have ``first_sigma``, in their order, or
    without it: the speed of such a state what two samples tell of it, ``sqrt(2) sigma / dt``; any other that of an even
    spread over its signal's range.

    Raises:
        InputError: If ``sensor_sigma`` or ``first_sigma`` does not fit the model, or is needed and missing.

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
            f"sensor_sigma needs {model.n_y} standard deviations of the outputs, got {sigma} [HM-KIT-014]"
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
                f"first_sigma needs {len(unseen)} standard deviations, of the states that no output shows alone "
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
            f"first_sigma: how uncertain {names} may be at the start nobody can tell; give it, {len(unseen)} standard "
            "deviations of the states that no output shows alone, or give the states' signals a range [HM-KIT-016]"
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
    """A model's controller with its safeguards, which use the prior.

    The first plan of ``rti`` is made before the loop starts: it is converged, from every start of the control problem.

    Args:
        model: The model to plan with.
        prior: The fitted prior, for terminal weight and fallback.
        control: The control problem.
        solver: Name in :data:`SOLVERS`.
        iterations: Linearizations a period of ``rti``, most iterations a solve of ``sqp`` and ``ipopt``; ``native``
            has one. Default: the solver's own, one of ``rti``.
        safe_input: Input ``(n_u,)`` that the machine may be left with. Default: none is declared.

    Raises:
        InputError: If there is no such solver, or none of so many iterations, or the inputs cannot hold the outputs
            that the problem weighs.

    Example:
        ``make_controller(models["hybrid"], models["prior"], scenario.control)``
    """
    ocp = make_ocp(prior, control)
    if control.n_y == prior.n_y and 0 < np.count_nonzero(control.q_y) <= prior.n_u:
        found = offset_free(prior, np.flatnonzero(control.q_y).tolist())
        if not found.reachable:
            raise InputError(f"control problem: at the operating point {found.why_unreachable} [HM-KIT-017]")
    if iterations is not None and solver == "native":
        raise InputError(
            "solver native linearizes once a period: leave iterations out, or take rti, sqp or ipopt [HM-KIT-018]"
        )
    options = {} if iterations is None else {"iterations": iterations}
    controller = SOLVERS[known(solver, SOLVERS, "solver")](model, ocp, **options)
    first = None if controller.converges else first_controller(model, ocp, controller)
    return SafeController(controller, prior, first=first, safe_input=safe_input)


def first_controller(
    model: HybridModel, ocp: OCP, controller: Controller | None = None
) -> SQPController | BestOf:
    """What makes the first plan: SQP, from each of the problem's starts if there are any. It shares the functions of
    the ``controller`` that goes on from there, if that is a real-time iteration in Python.
    """
    from hybrid_mpc.control.best_of import BestOf
    from hybrid_mpc.control.rti import CondensedController
    from hybrid_mpc.control.sqp import SQPController

    sqp = SQPController(model, ocp, inner=controller if isinstance(controller, CondensedController) else None)
    return BestOf(sqp, starts=ocp.starts) if ocp.starts else sqp


def make_ocp(prior: HybridModel, control: OCP) -> OCP:
    """The problem with a working point, at which terminal weight and fallback are linearized: in motion if it has none.

    At rest the slope of dry friction would pass for strong damping.

    Args:
        prior: The fitted prior.
        control: The control problem.

    Example:
        ``CondensedController(models["hybrid"], make_ocp(models["prior"], scenario.control))``
    """
    return control.changed(working_point=working_point(prior, control))


def working_point(model: HybridModel, control: OCP) -> tuple[Array, Array]:
    """Working point of the problem, ``(x, u)``, else the operating point, with positions in motion: at speeds ``1 /
    sqrt(q)``.

    A speed without weight is the one that crosses the position's acceptable deviation ``1 / sqrt(q)`` within the
    horizon.
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
    """Largest steps ``(n_y,)`` of the sensors: an error spread evenly over such a step has the deviation given.

    A real step may be finer; then a frozen sensor is found a little later.

    Example:
        >>> [round(step, 6) for step in sensor_steps((0.001,))]
        [0.003464]
    """
    return tuple(float(np.sqrt(12.0) * sigma) for sigma in sensor_sigma)


def make_resting_guard(model: HybridModel) -> Guard:
    """A guard that records where the model does not describe the machine, and rests where the sensor is frozen.

    Args:
        model: The model; the guard's times count in its ``time_unit``.

    Example:
        ``simulate(..., monitor=monitor, guard=make_resting_guard(hybrid))``
    """
    unit = model.time_unit
    return Guard(Mode.NORMAL, Mode.REST, dwell=DWELL_S * unit, quiet=QUIET_S * unit)


def make_backup_guard(controller: SafeController, estimator: Estimator) -> Guard:
    """A guard that hands over to another controller and its estimator where the model does not describe the machine."""
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
    """A guard whose backup estimates how the prior's parameters have changed, and plans with that.

    The backup's filter runs all the time, so it has found the change when the guard switches. On a frozen sensor the
    input is the safe one.

    Args:
        model: The model that the normal controller plans with; it must know its parameters.
        prior: The fitted prior, whose parameters change; terminal weight and fallback are made of it.
        scenario: The machine: its sensors' noise, and as ``causes`` the parameters that change together, by name. Gains
            of inputs are left out where there are other causes: but for friction, a weaker motor is a heavier machine.
        sigma_x: Process noise ``(n_x,)`` per period of the model's estimator.
        control: The control problem. Default: the scenario's.
        patience: Time [s] that an alarm must have lasted. Default: 0.8 of the machine's seconds.

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
        raise InputError(
            f"a guard that adapts needs a control problem; scenario {scenario.name} has none [HM-KIT-019]"
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
    return Guard(
        Mode.BACKUP, Mode.REST, backup=backup, backup_estimator=estimator, dwell=DWELL_S * unit, quiet=QUIET_S * unit,
        patience=PATIENCE_S * unit if patience is None else patience,
    )  # fmt: skip


def adaptable(model: HybridModel, causes: Mapping[str, Sequence[str]]) -> dict[str, tuple[str, ...]]:
    """Those of the causes that a backup adapts to: gains of inputs only where there is nothing else.

    Raises:
        InputError: If there are no causes, the model does not know its parameters, or its inputs act later.
    """
    groups = {name: tuple(names) for name, names in causes.items()}
    if not groups:
        raise InputError(
            'a guard that adapts needs causes: groups of parameters that may change, e.g. {"mass": ("m", "J")}; '
            "a scenario names them in its field causes [HM-KIT-020]"
        )
    if not model.n_p:
        raise InputError(
            f"a guard that adapts needs a model that knows its parameters; model {model.name} has none: give its prior "
            "a parameters and train it anew [HM-KIT-021]"
        )
    if model.delay_states:
        raise InputError(
            f"a guard that adapts needs a model whose inputs act at once; those of model {model.name} act later"
            " [HM-KIT-022]"
        )
    others = {name: names for name, names in groups.items() if not _is_gain(names)}
    return others or groups


def _is_gain(names: Sequence[str]) -> bool:
    return bool(names) and all(name.startswith(GAIN) for name in names)
