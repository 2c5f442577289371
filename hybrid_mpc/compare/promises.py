"""Examine the promises of a kit: no offset with wrong models and loads, margins, limits, step time, observer.

Everything is computed from the kit, the scenario's tasks, and earlier results of the run. No recordings are needed.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property, partial
from time import thread_time

import numpy as np
from numpy.typing import NDArray

from hybrid_mpc.analyze.linearize import linearize
from hybrid_mpc.analyze.margins import LinearLoop, Margins, mpc_loop, solved_gain, steady_filter
from hybrid_mpc.control.ocp import OCP
from hybrid_mpc.control.safeguard import SafeController, Source
from hybrid_mpc.control.sizes import Sizes, disturbance_sizes
from hybrid_mpc.errors import InputError
from hybrid_mpc.estimate.kalman import Estimate, ExtendedKalmanFilter
from hybrid_mpc.estimate.offset_free import OffsetFree, distinguishable, offset_free, steady_matrices
from hybrid_mpc.estimate.switching import Filter, SwitchingFilter
from hybrid_mpc.estimate.tracking import TrackingFilter
from hybrid_mpc.estimate.tuning import periods_to_find
from hybrid_mpc.kit.artifact import Kit
from hybrid_mpc.kit.assembly import SEARCHED, make_ocp
from hybrid_mpc.kit.disturbances import loads_by_parameters, rates_of_outputs
from hybrid_mpc.kit.promises import Promise
from hybrid_mpc.loop.plant import ModelPlant, ModelState
from hybrid_mpc.loop.simulate import ClosedLoopResult, simulate
from hybrid_mpc.machine.signals import Signal
from hybrid_mpc.model.disturbance import Disturbance
from hybrid_mpc.model.equilibrium import equilibrium_input, hidden_fixed_point
from hybrid_mpc.model.model import HybridModel, kinematics, output_with_jacobian
from hybrid_mpc.model.riccati import dare
from hybrid_mpc.rules import counted, time_text
from hybrid_mpc.scenario import Task

Array = NDArray[np.float64]
OFF = 0.2
"""Relative error of each parameter of the wrong models, with random sign: larger than the uncertainty after a fit,
about the effect of another mass or of a worn bearing."""
LOAD = 0.2
"""Load of a trial, as a share of the distance from the set-point's input to its limit, or of the disturbance's size;
the default task ``hold`` has the same load."""
PERIODS, LONGER, FEWEST, MOST = 800, 800, 3, 4
"""Total number of periods of all trials (a few seconds of computing); periods of the longer trial of a slow loop;
fewest and most trials of a set-point."""
LASTS = 6
"""Length of a trial in horizons. The observer's time constant is at most 1.5 horizons; exp(-6 / 1.5) = 2 % is left."""
END = 0.2
"""Last share of a trial or task over which offset and scatter are evaluated; as in the report's step responses."""
NOISE = 1.0
"""Largest offset within the noise, in standard deviations of the sensor."""
RESTS = 5.0
"""Largest scatter of a settled output, in standard deviations of its sensor. The sensor noise alone makes 1. Noise that
the observer passes on to the input adds to it, in an unstable machine several times as much."""
SLOW = "the observer is slow"
"""Beginning of the reason of a loop whose estimate of the load does not settle within the trial."""
AT_ITS_LIMIT = "is at its limit"
UNREACHED = "the set-point cannot be reached within the limits"
UNMOVED = "the estimated disturbance does not change: the observer explains every load by its process noise"
RESTLESS = "the loop does not settle: noise or friction excites it"
PULLED = "the weight r pulls the input towards the operating point; set r = 0 and weight changes by r_delta"
BESIDE = "the machine stands still beside its set-point, as with dry friction"
REMEDIES = (
    (
        (AT_ITS_LIMIT, UNREACHED),
        "Choose set-points farther from the limits of the inputs, or use a stronger actuator.",
    ),
    (
        (SLOW, UNMOVED),
        "Reduce the process noise (Scenario(state_noise=...)), or improve the prior's one-step prediction; see the "
        "rows on the observer.",
    ),
    ((PULLED,), "Set r = 0."),
    (
        (RESTLESS, BESIDE),
        "Model the friction in the prior (docs/disturbances.md#dry-friction), or reduce it in the machine.",
    ),
)
"""Remedies for an offset, by its reasons."""
ELSE = (
    "Declare a disturbance where the error enters (Scenario(disturbance_model=...)). Look at friction, and at the "
    "task's loops in the report."
)
"""Remedy for an offset of unknown reason."""
ROBUST = 0.1
"""Noise at the inputs (:func:`~hybrid_mpc.kit.assembly.make_estimator`) that is tried where loops do not settle: of 15
machines with parameters 20 % off, it lowers the cost of the swinging ones (docs/results/unknown_machines.md)."""
STILL_MOVES = 0.02
"""Change of the estimated load within the end of a trial, over the load, above which the estimate has not settled."""
STANDS = 0.2
"""Standard deviation of a true output, over that of its sensor noise, below which the output stands still."""
CONSTANTS = 3
"""Time constants of the observer after which a load counts as estimated: exp(-3) = 5 % is left."""
DIVERGED = 1e12
"""Mean squared error of a loop that diverges."""
GAINS = 1.5
"""Ratio of squared errors from which on disturbances at rates are recommended for loads elsewhere."""
ROUNDING = 1e-6
"""A state counts if the disturbances leave more than this share of a load at its rate unrepresented."""
AT_LIMIT = 1e-3
"""Distance from a limit, over the input's range, that counts as at the limit."""
LEAVES = 2.0
"""Distance of a state from its set-point, over its range, from which on the loop fails."""
BEFORE = 5
"""Periods before the first failed solve that tell whether an input was at its limit."""
GROWTHS = 3.0
"""Horizon of an unstable machine, in times in which small errors grow tenfold: over longer horizons the linearized plan
amplifies rounding and model errors more than a thousandfold."""
TAIL = (0.05, 0.01)
"""Remaining shares of the cost between which the time constant of its slowest mode is measured."""
LOOKED, LEAST = 20, 2000
"""Number of horizons over which the cost of a deviation is followed, and smallest number of periods."""
CARRIES = 0.95
"""Required share of the cost of a deviation within the horizon; the terminal weight approximates the rest."""
MODULUS = 0.5
"""Least distance of the Nyquist curve from -1: peak sensitivity 2, gain margin 2, phase margin 29 degrees (Astrom and
Hagglund, *Advanced PID Control*, 2006, section 4.6)."""
INWARD = (
    "Move the bound inwards, or raise its penalty (docs/bounds.md#soft-or-hard). No start may violate it."
)
"""Remedy for a bound that the run's loops violate."""
SOFTER = "Increase the weights of changes (r_delta), or reduce the process noise; hybrid-mpc analyze shows details."
SLOWER = (10.0, 100.0, 1000.0)
"""Factors of the change weights with which a loop that does not settle with late inputs is tried again."""
LATE = (
    "Model the delay: by a state with the actuator's lag, by largest_delay of the data, or by DelayCompensation "
    "(docs/clocks.md#known-delays)."
)
"""Remedy for a loop that does not settle with late inputs. Another observer or larger change weights are added if they
suffice."""
LATE_INPUTS = "late inputs"
"""Name of the row on late inputs."""
BY_NETWORK = (
    "The network's slope at the set-point reduces this margin: record small motions about the set-point and run again. "
    "Start on the machine with small steps, and compare with the prior's loop (hybrid-mpc control --controller "
    "prior_observer --controller hybrid_observer)."
)
"""Remedies for small margins: ``SOFTER`` for any loop, ``BY_NETWORK`` if the prior's margins are larger."""
HALF = 0.5
"""Share of the period that 99 % of the steps may take: sensors, actuator and other work need the rest."""
VIOLATES = 4.0
"""Largest violation of a bound within the noise, in standard deviations: about the largest of 10,000 samples."""
NEAR = 0.05
"""Distance of a start from a hard bound, as a share of the distance from the set-point to the bound."""
WHITE = 0.3
"""Largest autocorrelation of the innovations: it explains less than 10 % of their variance."""
SURE = 4.0
"""Largest mean normalised squared innovation, and the inverse of the smallest: innovations of twice or half the assumed
standard deviation."""


@dataclass(frozen=True)
class LoadedPlant(ModelPlant):
    """A model in place of the machine, with constant unmeasured disturbances.

    Args:
        d: The disturbances ``(n_d,)``, in the order of the model's ``disturbance_model``.
    """

    d: tuple[float, ...]

    def step(self, state: ModelState, u: Array, dt: float, w: Array | None = None) -> ModelState:
        """The state after one period."""
        on_u, on_x, _ = self.model.disturbed
        after = super().step(state, u + on_u @ np.array(self.d), dt, w)
        return after._replace(x=after.x + on_x @ np.array(self.d))

    def measure(self, state: ModelState, rng: np.random.Generator) -> Array:
        """Outputs with noise and disturbances."""
        return np.asarray(super().measure(state, rng) + self.model.disturbed[2] @ np.array(self.d))


@dataclass(frozen=True)
class SetPoint:
    """A set-point of a control problem at which loops are examined, with the parts of its loop.

    Args:
        model: The recommended model.
        problem: The control problem.
        tasks: Names of the tasks with this problem; the first task ends at this set-point, if any task does.
        reference: The set-point ``(columns,)``.
        w: Measured disturbances ``(n_w,)`` at the set-point.
        estimator: The kit's observer.
        controller: The kit's controller. If it plans with tracked parameters, the observer tracks them.
    """

    model: HybridModel
    problem: OCP
    tasks: tuple[str, ...]
    reference: Array
    w: Array
    estimator: Filter | TrackingFilter
    controller: SafeController

    @property
    def tracking(self) -> bool:
        """Whether the observer tracks parameters."""
        return isinstance(self.estimator, TrackingFilter)

    @property
    def planned_w(self) -> Array:
        """:attr:`w` with the fitted values of tracked parameters: the measured disturbances of the controller."""
        return np.append(self.w, self.estimator.model.w[self.model.n_w :])

    @cached_property
    def rest(self) -> tuple[Array, Array]:
        """State ``(n_x,)`` and input ``(n_u,)`` of the set-point's steady state.

        If the reference is a state: this state, and the input that holds it best.

        Raises:
            InputError: If the set-point has no steady state.
        """
        m = self.model
        empty = np.full(m.n_y, np.nan)
        n = m.n_x + m.n_h + m.n_d
        at = Estimate(
            0.0, m.x0, hidden_fixed_point(m, m.x0, m.u0, w=self.w), np.zeros(m.n_d), np.zeros((n, n)), empty,
            float("nan"), w=self.planned_w,
        )  # fmt: skip
        target = self.controller.controller.problem.target(self.reference[None], None, at)
        x, u = target.x[0], target.u[0]
        if self.problem.n_y and (target.steady is None or not target.steady.steady):
            raise InputError(
                f"set-point {self.reference.tolist()} of {self.title}: the model has no steady state there. Choose "
                "another set-point [HM-COMPARE-020]"
            )
        if not self.problem.n_y:
            sizes = self.controller.controller.problem.sizes.states
            best = equilibrium_input(m, sizes, self.problem.input_scale)(x, self.w).full().ravel()
            u = np.clip(best, self.problem.u_min, self.problem.u_max)
        return x, u

    @property
    def title(self) -> str:
        """Text that names the tasks."""
        others = f" and {len(self.tasks) - 1} more" if len(self.tasks) > 1 else ""
        return f"task {self.tasks[0]}{others}" if self.tasks else "the operating point"

    @cached_property
    def held(self) -> list[int]:
        """Indices of the controlled outputs."""
        return find_controlled_outputs(self.model, self.problem, *self.rest, self.w)

    def errors(self, y: Array, u: Array) -> Array:
        """Deviations ``(n, n_y)`` of measured outputs ``(n, n_y)`` from the set-point, under inputs ``(n, n_u)``."""
        return compute_errors(self.model, self.problem, self.reference, self.w, y, u)

    @property
    def sigma(self) -> Array:
        """Noise of the sensors ``(n_y,)``, standard deviations."""
        return np.sqrt(quiet(self.estimator).noise[1])


@dataclass(frozen=True)
class Deviation:
    """Deviation of an output from its set-point at the end of a loop [unit of the output].

    Args:
        signal: The output.
        sigma: Standard deviation of its sensor noise.
        offset: Mean deviation over the end of the loop.
        scatter: Standard deviation over the end of the loop.
    """

    signal: Signal
    sigma: float
    offset: float
    scatter: float

    @property
    def kept(self) -> bool:
        """Whether the output has settled within the noise."""
        return abs(self.offset) <= NOISE * self.sigma and self.scatter <= RESTS * self.sigma

    @property
    def size(self) -> float:
        """The larger of offset and scatter over their limits [-]; infinite if the loop diverges."""
        found = max(abs(self.offset) / NOISE, self.scatter / RESTS) / self.sigma
        return found if math.isfinite(found) else math.inf

    def __str__(self) -> str:
        if not math.isfinite(self.size):
            return f"{self.signal.name} diverges"
        what = f"offset {abs(self.offset):.2g} {self.signal.unit}"
        if self.scatter > RESTS * self.sigma:
            what += f", varies by {self.scatter:.2g} {self.signal.unit}"
        return f"{self.signal.name} {what} (noise {self.sigma:.2g} {self.signal.unit})"


@dataclass(frozen=True)
class Trial:
    """A simulated loop at a set-point, on a wrong model with loads.

    Args:
        deviations: Those of the controlled outputs.
        settled_s: Time after which all stay within the noise [s]; None if they do not.
        why: Why they do not settle; empty if they do.
        result: The loop's record.
        fails: Which state leaves its range by far, and when, with the first failed solve. Default: none does.
    """

    deviations: tuple[Deviation, ...]
    settled_s: float | None
    why: str
    result: ClosedLoopResult = field(repr=False)
    fails: str = ""

    @property
    def solved(self) -> NDArray[np.bool_]:
        """Mask of the periods whose solve succeeded ``(n,)``."""
        return np.array([source == Source.MPC.name for source in self.result.source])

    @property
    def worst(self) -> Deviation:
        """The largest deviation."""
        return max(self.deviations, key=lambda one: one.size)

    @property
    def limited(self) -> bool:
        """Whether a limit of the inputs causes the deviations."""
        return AT_ITS_LIMIT in self.why or UNREACHED in self.why


@dataclass(frozen=True)
class TaskEnd:
    """Deviations at the end of a task that ends at a set-point, in a loop of the run.

    Args:
        task: Name of the task.
        deviations: Those of the controlled outputs.
    """

    task: str
    deviations: tuple[Deviation, ...]


@dataclass(frozen=True)
class Tested:
    """Statistics of the innovations of the kit's observer on test recordings.

    Args:
        correlation: Largest magnitude of the autocorrelation [-].
        nis: Mean normalised innovation squared per output [-]; 1 if the assumed covariance is right.
        samples: Number of samples.
    """

    correlation: float
    nis: float
    samples: int


def find_controlled_outputs(model: HybridModel, problem: OCP, x: Array, u: Array, w: Array) -> list[int]:
    """Indices of the controlled outputs: weighted ones, or those that depend on a weighted state at a point."""
    if problem.n_y:
        return [int(i) for i in np.flatnonzero(problem.q_y > 0)]
    by_x = output_with_jacobian(model)(x, u, w)[1].full()
    return [int(i) for i in np.flatnonzero(np.any(by_x[:, problem.q > 0] != 0, axis=1))]


def compute_errors(model: HybridModel, problem: OCP, reference: Array, w: Array, y: Array, u: Array) -> Array:
    """Deviations ``(n, n_y)`` of measured outputs ``(n, n_y)`` from a set-point ``(columns,)``, with the applied inputs
    ``(n, n_u)``.
    """
    if problem.n_y:
        return np.asarray(y - reference[: problem.n_y])
    x = reference[: model.n_x]
    return np.asarray(y - np.array([model.output(x, one, w, model.p).full().ravel() for one in u]))


def task_end(kit: Kit, task: Task, loop: Mapping[str, Array]) -> TaskEnd | None:
    """Deviations at the end of a task in a loop of the run; None if the task ends at no set-point or weights no output.

    Args:
        kit: The kit.
        task: The task.
        loop: Its arrays ``u`` ``(n, n_u)`` and ``y`` ``(n, n_y)``.
    """
    model, problem = kit.models[kit.recommended], task.control or kit.problem()
    end = find_end(task, model)
    if end is None:
        return None
    row, w = end
    x = model.x0 if problem.n_y else row[: model.n_x]
    held = find_controlled_outputs(model, problem, x, model.u0, w)
    before = np.vstack([loop["u"][:1], loop["u"][:-1]])
    errors = compute_errors(model, problem, row, w, loop["y"], before)
    return (
        TaskEnd(task.name, deviations(model.outputs, held, np.array(kit.sensor_sigma), errors))
        if held
        else None
    )


def quiet(estimator: Filter | TrackingFilter) -> ExtendedKalmanFilter:
    """The quiet filter of a switching observer, or the observer itself."""
    own = estimator.inner if isinstance(estimator, TrackingFilter) else estimator
    return own.filters[0] if isinstance(own, SwitchingFilter) else own


def set_points(kit: Kit, tasks: Sequence[Task], *, tracking: bool = False) -> list[SetPoint]:
    """One set-point for each control problem of a kit's tasks: the end of a task, else the operating point.

    With ``tracking``, the parts of the loops track the kit's parameters.

    Raises:
        InputError: If the kit lacks a control problem or noise.

    Example:
        ``[one.title for one in set_points(hm.load("runs/golf"), load_scenario("golf_robot").tasks)]``
    """
    model, found = kit.models[kit.recommended], list[SetPoint]()
    groups: list[tuple[OCP, list[Task]]] = []
    for task in tasks:
        problem = task.control or kit.problem()
        same = next((own for known, own in groups if known == problem), None)
        if same is None:
            groups.append((problem, [task]))
        else:
            same.append(task)
    if not groups:
        groups = [(kit.problem(), [])]
    ends = [
        {task.name: end for task in own if (end := find_end(task, model)) is not None} for _, own in groups
    ]
    if not any(ends):  # only trajectories
        groups, ends = groups[:1], ends[:1]
    for (problem, own), at in zip(groups, ends, strict=True):
        if not at and any(ends):
            continue
        named = sorted((task.name for task in own), key=lambda name: name not in at)
        first = named[0] if named else ""
        asked = first if first in kit.loop.control else ""
        controller = kit.controller(task=asked, tracking=tracking)
        estimator = kit.tracking_observer(task=asked) if tracking else kit.observer(task=asked)
        row = at.get(first, (controller.controller.problem.standing()[0], model.w))
        found.append(SetPoint(model, problem, tuple(named), row[0], row[1], estimator, controller))
    return found


def find_end(task: Task, model: HybridModel) -> tuple[Array, Array] | None:
    """Set-point and measured disturbances at the end of a task; None if they change there, or if weights change."""
    t = task.duration * np.linspace(1.0 - END, 1.0, 50)
    rows = np.asarray(task.reference(t), dtype=np.float64)
    w = np.tile(model.w, (len(t), 1)) if task.w is None else np.asarray(task.w(t), dtype=np.float64)
    still = all(np.all(np.isfinite(v)) and np.array_equal(v, np.tile(v[-1], (len(v), 1))) for v in (rows, w))
    return (rows[-1], w[-1]) if still and task.weight is None else None


# Row "no offset": loops on wrong models with constant loads.


def wrong_model(model: HybridModel, draw: int) -> HybridModel:
    """The model with parameters ``p (1 ± OFF)`` within their bounds.

    Args:
        model: The model.
        draw: Number of the draw, which determines the signs. 0: the model itself.
    """
    if not draw:
        return model
    signs = np.random.default_rng([draw, 0]).choice((-1.0, 1.0), model.n_p)
    return replace(
        model,
        name=f"{model.name}_wrong_{draw}",
        parameters=tuple(
            replace(one, value=float(np.clip(one.value * (1.0 + OFF * sign), one.lower, one.upper)))
            for one, sign in zip(model.parameters, signs, strict=True)
        ),
    )


def loads(point: SetPoint, draw: int) -> Array:
    """A constant value ``(n_d,)`` of each disturbance of the model; the draw determines the signs.

    Its size is ``LOAD`` times the distance from the set-point's input to the limit on that side, or times the
    disturbance's size.
    """
    model, problem, (_, u) = point.model, point.problem, point.rest
    sizes = disturbance_sizes(model, problem)
    signs = np.random.default_rng([draw, 1]).choice((-1.0, 1.0), model.n_d)
    found = LOAD * sizes * signs
    for j, i in zip(*np.nonzero(model.disturbed[0].T), strict=True):
        # the input must move against the load
        room = u[i] - problem.u_min[i] if signs[j] > 0 else problem.u_max[i] - u[i]
        found[j] = signs[j] * LOAD * min(room, sizes[j]) if math.isfinite(room) else found[j]
    return np.asarray(found)


def trial(point: SetPoint, draw: int, periods: int) -> Trial:
    """A loop of the kit's observer and controller at a set-point, on a wrong model with loads.

    Args:
        point: The set-point.
        draw: Number of the draw; 0 has the right parameters.
        periods: Length [periods].

    Raises:
        InputError: If the set-point has no steady state.
    """
    x, _ = point.rest
    plant = LoadedPlant(
        wrong_model(point.model, draw), tuple(point.sigma), tuple(loads(point, draw).tolist())
    )
    return tried(point, plant, x, periods, draw)


def tried(point: SetPoint, plant: ModelPlant, x0: Array, periods: int, seed: int = 0, late: int = 0) -> Trial:
    """A loop of the kit's parts on a plant from the state ``x0`` ``(n_x,)``; inputs act ``late`` periods later.

    Durations are processor time.
    """
    model = point.model
    result = simulate(
        plant, point.estimator, point.controller, point.reference, dt=model.dt, duration=periods * model.dt, x0=x0,
        seed=seed, w=point.w if model.n_w else None, now=thread_time, input_delay=late,
    )  # fmt: skip
    before = np.vstack([result.u[:1], result.u[:-1]])
    errors = point.errors(result.y, before)
    found = deviations(point.model.outputs, point.held, point.sigma, errors)
    settled = _find_settled(errors[:, point.held], point.sigma[point.held], point.problem.horizon)
    kept = all(one.kept for one in found)
    settled_s = None if settled is None or not kept else settled * model.dt
    fails = _explain_failure(point, result)
    why = "" if kept else fails or _explain_offset(point, result, errors)
    return Trial(found, settled_s, why, result, fails)


def deviations(
    signals: Sequence[Signal], held: Sequence[int], sigma: Array, errors: Array
) -> tuple[Deviation, ...]:
    """Deviations over the end of a loop, from errors ``(n, n_y)`` of the outputs, NaN where a sample is lost.

    A deviation is NaN if all samples are lost, as after a failure.
    """
    late = errors[int((1.0 - END) * len(errors)) :]
    found = []
    for i in held:
        known = late[~np.isnan(late[:, i]), i]
        with np.errstate(over="ignore", invalid="ignore"):
            mean, std = (float(known.mean()), float(known.std())) if len(known) else (math.nan, math.nan)
        found.append(Deviation(signals[i], float(sigma[i]), mean, std))
    return tuple(found)


def _find_settled(errors: Array, sigma: Array, horizon: int) -> int | None:
    """Period from which moving means of the errors over half a horizon stay within twice the noise; None: never.

    Twice, because the observer passes noise on to the input, and means of few samples scatter.
    """
    width = max(1, horizon // 2)
    if len(errors) < 2 * width:
        return None
    means = np.apply_along_axis(lambda v: np.convolve(v, np.full(width, 1.0 / width), "valid"), 0, errors)
    outside = np.flatnonzero(~np.all(np.abs(means) <= 2.0 * NOISE * sigma, axis=1))
    last = int(outside[-1]) + 1 if outside.size else 0
    return last if last < len(means) else None


def _explain_failure(point: SetPoint, result: ClosedLoopResult) -> str:
    """Which state leaves its declared range by far, and when, with the first failed solve; empty if none does."""
    model, within = point.model, _is_near(point, result)
    if within.all():
        return ""
    k, i = (int(own[0]) for own in np.nonzero(~within))
    signal = model.states[i]
    text = (
        f"{signal.name} is far outside its range of {signal.lower:g} to {signal.upper:g} {signal.unit} after "
        f"{k * model.dt:.3g} s"
    )
    failed = np.flatnonzero([source != Source.MPC.name for source in result.source])
    if not failed.size:
        return f"{text}; no solve failed"
    share = f"{failed.size} of {len(result.source)} failed"
    return f"{text}; first failed solve after {failed[0] * model.dt:.3g} s ({share})"


def _is_near(point: SetPoint, result: ClosedLoopResult) -> NDArray[np.bool_]:
    """Whether each state is near its declared range ``(n, n_x)``."""
    with np.errstate(invalid="ignore", over="ignore"):
        return np.asarray(np.abs(result.x - point.rest[0]) <= LEAVES * _compute_ranges(point.model))


def failing_loop(points: Sequence[SetPoint], every: Sequence[Sequence[Trial]]) -> Promise | None:
    """Row "closed loop": a loop whose machine leaves its declared ranges by far; None if all stay near them.

    Args:
        points: The set-points.
        every: The trials of each.
    """
    failing = [
        (point, one) for point, trials in zip(points, every, strict=True) for one in trials if one.fails
    ]
    if not failing:
        return None
    (point, worst), total = failing[0], sum(len(trials) for trials in every)
    evidence = (
        f"the loop fails in {len(failing)} of {counted(total, 'trial')} with constant loads and parameter errors of up "
        f"to {100 * OFF:.0f} %: in {point.title}, {worst.fails}"
    )
    return Promise("closed loop", "not promised", evidence, _choose_failure_remedy(point, worst))


def _choose_failure_remedy(point: SetPoint, failing: Trial) -> str:
    """Remedy for a loop that fails, by its solves and the growth of small errors at the set-point."""
    solved, problem = failing.solved, point.problem
    first = len(solved) if solved.all() else int(np.argmin(solved))
    ran_away = not _is_near(point, failing.result)[:first].all()  # although every solve until then succeeded
    before, edge = failing.result.u[max(0, first - BEFORE) : first], AT_LIMIT * problem.input_range
    at = (before >= problem.u_max - edge) | (before <= problem.u_min + edge)
    if ran_away or solved.all() or (at.size and at.mean(axis=0).max() > 0.5):
        return (
            "The inputs cannot compensate these loads and errors. Use set-points farther from the limits of the "
            "inputs, a stronger actuator, a shorter period, or a better prior."
        )
    finite = "write a prior that is finite beyond the ranges of its states (docs/unstable.md)"
    tenfold = _compute_growth(point)
    periods = math.ceil(GROWTHS * tenfold / point.model.dt) if math.isfinite(tenfold) else 0
    if 0 < periods < point.problem.horizon:
        return (
            f"Use a shorter horizon: small errors grow tenfold in {tenfold:.2g} s, and {periods} periods are "
            f"{GROWTHS:g} times that time. Or {finite}."
        )
    return f"{finite[0].upper()}{finite[1:]}."


def _compute_growth(point: SetPoint) -> float:
    """Time [s] in which small errors grow tenfold at the set-point, without control; infinite if they do not."""
    model, (x, u) = point.model, point.rest
    h = hidden_fixed_point(model, x, u, w=point.w)
    assert model.with_jacobian is not None  # every model has it once it is made
    a = model.with_jacobian(x, h, u, point.w, model.p)[2].full()
    largest = float(np.abs(np.linalg.eigvals(a)).max(initial=0.0)) if np.isfinite(a).all() else 0.0
    return model.dt * math.log(10.0) / math.log(largest) if largest > 1.0 + 1e-6 else math.inf


def _explain_offset(point: SetPoint, result: ClosedLoopResult, errors: Array) -> str:
    problem, model = point.problem, point.model
    late = slice(int((1.0 - END) * len(errors)), None)
    edge = AT_LIMIT * problem.input_range
    at = np.mean((result.u[late] >= problem.u_max - edge) | (result.u[late] <= problem.u_min + edge), axis=0)
    if at.max() > 0.5:
        return f"{model.inputs[int(at.argmax())].name} {AT_ITS_LIMIT}"
    if result.reached.size and not np.all(result.reached[late]):
        return UNREACHED
    periods = periods_to_find(quiet(point.estimator), SEARCHED * problem.horizon)
    slowest = float(np.max(np.where(np.isnan(periods), np.inf, periods)))
    if not math.isfinite(slowest):
        return UNMOVED
    found = deviations(model.outputs, point.held, point.sigma, errors)
    if all(abs(one.offset) <= NOISE * one.sigma for one in found):
        return RESTLESS
    half = (len(errors) - late.start) // 2
    d, sizes = result.d[late], LOAD * disturbance_sizes(model, problem)
    moved = np.abs(d[half:].mean(axis=0) - d[:half].mean(axis=0)) / sizes
    if moved.max() > STILL_MOVES or CONSTANTS * slowest > len(errors):
        return f"{SLOW}: after {len(errors) * model.dt:.3g} s its estimate of the load has not settled"
    if not problem.n_y and np.any(problem.r > 0) and np.any(np.abs(point.rest[1] - model.u0) > edge):
        return PULLED
    true = np.array([model.output(x, model.u0, point.w, model.p).full().ravel() for x in result.x[late]])
    if all(float(np.std(true[:, one])) < STANDS * point.sigma[one] for one in point.held):
        return BESIDE
    return "no disturbance of the model explains the error"


def _compute_ranges(model: HybridModel) -> Array:
    """Ranges of the states ``(n_x,)``; infinite without bounds."""
    return np.array([s.upper - s.lower for s in model.states])


def ranks(point: SetPoint) -> OffsetFree:
    """The rank conditions at the set-point; friction at rest may hide a load that is observable in motion."""
    x, u = point.rest
    found = offset_free(point.model, point.held, x=x, u=u, w=point.w)
    if (
        not found.detectable
        and distinguishable(point.model, Sizes(point.model, point.problem).states).detectable
    ):
        return replace(found, rank=found.needed)
    return found


def no_offset(point: SetPoint, trials: Sequence[Trial], several: bool = False) -> Promise:
    """Row "no offset": whether constant loads leave no offset at a set-point.

    Args:
        point: The set-point.
        trials: Its trials.
        several: Whether there are other set-points, so that the row must name its tasks. Default: False.
    """
    name = "no offset" + (f" in {point.title}" if several else "")
    settled = [one for one in trials if not one.why]
    assert trials
    worst = max(trials, key=lambda one: one.worst.size)
    moved = len(trials) - 1 if any(not one.fixed for one in point.model.parameters) else 0
    what = f"{counted(len(trials), 'loop')} with constant loads" + (
        f", {moved} of them on models with parameter errors of {100 * OFF:.0f} %," if moved else ""
    )
    within = f"{len(settled)} of {what} settle within the noise"
    if worst.why:
        within += f"; the worst leaves {worst.worst}: {worst.why}"
    if point.problem.economic is not None:
        return Promise(
            name, "not promised", f"the cost is economic, so its optimum may have an offset; {within}",
            "To hold a set-point, weight the outputs (q_y) and omit the economic cost.",
        )  # fmt: skip
    lacks, remedies = [], []
    if len(point.held) > point.model.n_u:
        remedies.append("Weight at most as many outputs as there are inputs.")
        names = ", ".join(point.model.outputs[i].name for i in point.held)
        lacks.append(
            f"{counted(len(point.held), 'output')} ({names}) are controlled by {counted(point.model.n_u, 'input')}"
        )
    if why := ranks(point).why:
        lacks.append(why)
        remedies.append("Declare as many observable disturbances as outputs (docs/disturbances.md).")
    if lacks:
        return Promise(
            name, "not promised", f"{'; '.join(lacks)}; {within}",
            " ".join(remedies),
        )  # fmt: skip
    if worst.why:
        return Promise(name, "doubted", within, choose_remedy(worst.why))
    times = [one.settled_s for one in trials if one.settled_s is not None]
    return Promise(name, "shown", f"{within}, after {max(times):.3g} s at most" if times else within)


def choose_remedy(why: str) -> str:
    """Remedy for an offset, by its reason."""
    return next((remedy for reasons, remedy in REMEDIES if any(one in why for one in reasons)), ELSE)


# Step time.


def step_time(trials: Sequence[Trial], period_ms: float) -> Promise:
    """Row "step time": whether steps end within the period, in processor time, which other processes hardly change.

    Steps whose solve failed do not count: they may end early or late.
    """
    ms = np.sort(np.concatenate([one.result.timing_ms["total"][one.solved] for one in trials]))
    if ms.size < 2:
        return Promise("step time", "not promised", "every solve failed", "See the row on the closed loop.")
    p99, worst = float(np.quantile(ms, 0.99)), float(ms[-1])
    evidence = (
        f"99 % of {ms.size} steps take less than {time_text(p99)} of processor time, the longest {time_text(worst)}; "
        f"the period is {time_text(period_ms)}"
    )
    remedy = (
        "Use solver native (compiled C), a shorter horizon, move blocks or a longer dt (docs/choosing.md)."
    )
    if p99 > period_ms:
        return Promise("step time", "not promised", evidence, remedy)
    # ignore a single long step: it may be caused by the operating system
    if p99 > HALF * period_ms or ms[-2] > period_ms:
        return Promise("step time", "doubted", evidence, remedy)
    return Promise("step time", "shown", f"{evidence}; on this computer")


# Horizon and margins.


def horizon(points: Sequence[SetPoint]) -> Promise:
    """Row "horizon": which share of the cost of a deviation lies within the horizon, and the slowest mode of the cost.

    With the linear-quadratic regulator at the operating point, ``x' P x`` is the cost over all time, and ``x_N' P x_N``
    the part after the horizon. The share is ``1 - sum x_N' P x_N / sum x_0' P x_0`` over the states that inputs of
    their full range reach within the horizon.
    """
    name = "horizon"
    point, cost = min(
        ((one, _compute_left_costs(one)) for one in points),
        key=lambda pair: -pair[1][pair[0].problem.horizon],
    )
    dt, n = point.model.dt, point.problem.horizon
    share = 1.0 - float(cost[n])
    evidence = f"the {n} periods ({n * dt:.3g} s) contain {100 * share:.3g} % of the cost of a deviation"
    tail = [int(np.argmax(cost < left)) for left in TAIL]
    if all(tail):
        # cost ~ exp(-2 t / tau), since it is quadratic in the state
        slow = 2.0 * dt * max(tail[1] - tail[0], 1) / math.log(TAIL[0] / TAIL[1])
        evidence += f"; the time constant of its slowest mode is {slow:.2g} s"
    if share >= CARRIES:
        return Promise(name, "shown", evidence)
    enough = int(np.argmax(cost <= 1.0 - CARRIES))
    remedy = (
        f"A horizon of {enough} periods contains {100 * CARRIES:.0f} %. A longer dt or move blocks reduce its "
        "computing time."
        if enough
        else "Weight the states that drift, so that the controller brings them back."
    )
    return Promise(name, "doubted", evidence, remedy)


def _compute_left_costs(point: SetPoint) -> Array:
    """Remaining share of the cost of a deviation after each period, ``(m,)``."""
    model, n = point.model, point.problem.horizon
    a, b, q, r = make_ocp(model, point.problem).linear_quadratic(model)
    p, k = dare(a, b, q, r)
    pushed, reached = b * point.problem.input_scale, []
    for _ in range(n):
        reached.append(pushed)
        pushed = a @ pushed
    x, closed, found = np.hstack(reached), a - b @ k, []
    for _ in range(max(LOOKED * n, LEAST) + 1):
        found.append(float(np.sum(x * (p @ x))))
        x = closed @ x
    return np.array(found) / found[0]


def margins(
    points: Sequence[SetPoint], of_prior: Sequence[SetPoint] = (), lacking_delay: float = 0.0
) -> Promise:
    """Row "stability margins": of the linearized loop of observer and controller at the set-points, for each input.

    Args:
        points: Set-points of the recommended model.
        of_prior: Set-points of the fitted prior, if another model is recommended: they show whether the network reduces
            the margin. Default: none.
        lacking_delay: Delay of the inputs [s] that the recordings show and the prior lacks; the loop must bear a period
            more. Default: none.
    """
    name = "stability margins"
    worst: tuple[SetPoint, Signal, Margins] | None = None
    lacks, good, together = [], True, math.inf
    for point in points:
        try:
            found, lacking = _margins_at(point), lacking_delay / point.model.dt
            if len(found) > 1:
                together = min(
                    together, _count_common_delay(point, min(own.delay_periods for _, own in found))
                )
            good &= together >= 1 + math.ceil(lacking)
            for signal, own in found:
                good &= own.modulus >= MODULUS and own.delay_periods >= 1 + lacking
                if worst is None or own.modulus < worst[2].modulus:
                    worst = point, signal, own
        except InputError as error:
            lacks.append(f"{point.title}: {error}")
    if lacks or worst is None:
        return Promise(name, "not promised", "; ".join(lacks), SOFTER)
    point, signal, own = worst
    late = counted(own.delay_periods, "period")
    evidence = (
        f"at {signal.name} in {point.title}: gain {own.gain_down:.2g} to {own.gain_up:.3g} times, phase "
        f"{math.degrees(own.phase):.3g} deg, distance from -1 {own.modulus:.2g}, {late} of delay, for small motions"
    )
    if math.isfinite(together):
        evidence += f"; of all inputs together {counted(int(together), 'period')} of delay"
    if lacking_delay:
        shown = lacking_delay / point.model.dt
        evidence += f", of which the recordings show {lacking_delay:.2g} s ({shown:.1f}) already"
    if good:
        return Promise(name, "shown", evidence)
    evidence += f". Beyond these margins the linearized loop is unstable (recommended distance: {MODULUS:g})"
    other = _find_distance(of_prior, signal)
    if other is None:
        return Promise(name, "doubted", evidence, SOFTER)
    evidence += f"; with the fitted prior as model and controller the distance is {other:.2g}"
    return Promise(name, "doubted", evidence, BY_NETWORK if other > 2 * own.modulus else SOFTER)


def _margins_at(point: SetPoint) -> list[tuple[Signal, Margins]]:
    loop = _linear_loops(point)()
    return [(signal, loop.margins(j)) for j, signal in enumerate(point.model.inputs)]


def _count_common_delay(point: SetPoint, most: float) -> int:
    """Largest whole delay [periods] of all inputs together, up to ``most``, at which the linearized loop is stable."""
    loop_with, every = _linear_loops(point), range(1, math.floor(min(most, point.problem.horizon)) + 1)
    return next((late - 1 for late in every if not loop_with(delay=late).stable), len(every))


def _linear_loops(point: SetPoint) -> Callable[..., LinearLoop]:
    """The linearized loop of controller and quiet filter, as a function of the delay of all inputs [periods]."""
    model, (x, u) = point.model, point.rest
    h = hidden_fixed_point(model, x, u, w=point.w)
    gain = solved_gain(point.controller.controller, x, u, point.reference, h, w=point.planned_w)
    plant, ekf = linearize(model, x, u, h), quiet(point.estimator)
    if not isinstance(point.estimator, TrackingFilter):
        return partial(mpc_loop, gain, steady_filter(ekf, x, u, h, system=plant), plant)
    # the filter's deviations theta move the planned values: du = by_measured (dw / dtheta) dtheta, at theta = 0
    fitted = point.planned_w[model.n_w :]
    relative = [one.relative for one in point.estimator.tracked]
    assert gain.by_measured is not None
    by_theta = gain.by_measured[:, model.n_w :] * np.where(relative, fitted, 1.0)
    gain = replace(gain, by_state=np.hstack([gain.by_state, by_theta]))
    return partial(mpc_loop, gain, steady_filter(ekf, x, u, np.append(h, 0.0 * fitted)), plant)


def _find_distance(points: Sequence[SetPoint], signal: Signal) -> float | None:
    """Least distance from -1 at an input over set-points; None without a linearized loop."""
    try:
        found = [own.modulus for point in points for s, own in _margins_at(point) if s == signal]
    except InputError:  # the prior's loop cannot be linearized there
        return None
    return min(found, default=None)


def late_inputs(kit: Kit, point: SetPoint, lacking_s: float = 0.0) -> Promise | None:
    """Row "late inputs": a loop on the model itself, with inputs that act later than in the model.

    At the start each controlled output is off its set-point by its spread in the recordings. Margins of the linearized
    loop hold for small motions only: with inputs at their limits, a large motion can start swings that never end. Then
    the extended Kalman filter and larger change weights are tried.

    Args:
        kit: The kit.
        point: The set-point.
        lacking_s: Delay [s] that the recordings show and the model lacks. Default: none; then one period.

    Returns:
        None if a spread is unknown.
    """
    model, (x, u) = point.model, point.rest
    slopes = output_with_jacobian(model)(x, u, point.w)[1].full()[point.held]
    sizes = point.controller.controller.problem.sizes
    spreads = sizes.natural_outputs
    # the smallest deviation of the states, over their sizes, that moves the outputs by their spreads
    start = x - sizes.natural * (np.linalg.pinv(slopes * sizes.natural) @ spreads[point.held])
    start = np.clip(start, *np.array([(s.lower, s.upper) for s in model.states]).T)
    late, periods = max(1, math.ceil(lacking_s / model.dt - ROUNDING)), LASTS * point.problem.horizon
    plant = ModelPlant(model, tuple(point.sigma))
    if not np.isfinite(start).all():
        return None
    moved = ", ".join(
        f"{model.outputs[i].name} by {size:.2g} {model.outputs[i].unit}"
        for i, size in zip(point.held, np.abs(slopes @ (start - x)), strict=True)
    )
    recorded = (
        f"; in the recordings inputs act {lacking_s:.2g} s later than in the prior" if lacking_s else ""
    )
    in_time = tried(point, plant, start, periods)
    if in_time.why:
        evidence = (
            f"not examined: the loop on the model itself does not settle after a deviation ({moved}), even without a "
            f"delay: {in_time.why}"
        )
        return Promise(LATE_INPUTS, "not promised", evidence, choose_remedy(in_time.why))
    found = tried(point, plant, start, periods, late=late)
    when = f"after a deviation ({moved}) with inputs {counted(late, 'period')} late"
    if not found.why:
        return Promise(LATE_INPUTS, "shown", f"the loop on the model itself settles {when}{recorded}")
    evidence = f"the loop on the model itself does not settle {when}: {found.worst}{recorded}"

    def settles(other: SetPoint) -> bool:
        return not tried(other, plant, start, periods, late=late).why

    remedy = LATE
    make = kit.tracking_observer if point.tracking else kit.observer
    if settles(replace(point, estimator=make(task=_find_own_problem(kit, point), kind="ekf"))):
        remedy += f' Or use kit.{make.__name__}(kind="ekf"): with it, the loop settles.'
    slower = (_with_change_weights(kit, point, factor) for factor in SLOWER)
    if (gentle := next(filter(settles, slower), None)) is not None:
        weights = ", ".join(f"{v:g}" for v in gentle.problem.r_delta)
        remedy += f" Or set r_delta=({weights},): then the loop settles."
    return Promise(LATE_INPUTS, "doubted", evidence, remedy)


def _with_change_weights(kit: Kit, point: SetPoint, factor: float) -> SetPoint:
    """The same set-point with ``factor`` times the weights of input changes; times ``r`` for an input without one."""
    problem = point.problem.changed(
        r_delta=factor * np.where(point.problem.r_delta > 0, point.problem.r_delta, point.problem.r)
    )
    task = _find_own_problem(kit, point)
    own = replace(kit, loop=replace(kit.loop, control={**kit.loop.control, task: problem}))
    return replace(point, problem=problem, controller=own.controller(task=task, tracking=point.tracking))


# Limits.


def limits(
    points: Sequence[SetPoint],
    trials: Sequence[Trial],
    given_way: Mapping[str, Mapping[str, float]],
    violation: tuple[float, str] = (0.0, ""),
) -> Promise:
    """Row "limits": whether the controller finds a plan within the hard bounds in every period, and whether the run's
    loops violate bounds of states and outputs by more than the noise.

    Args:
        points: The set-points.
        trials: All trials.
        given_way: Share of the periods with a relaxed hard bound, by task of the run's loops and bound.
        violation: The largest violation of a bound in the run's loops over the noise [-], and a text
            (:func:`largest_violation`). Default: no loop was run.
    """
    name, model = "limits", points[0].model
    results = [one.result for one in trials]
    hard = [point for point in points if point.problem.hard]
    starts = [(point, *start) for point in hard for start in starts_near(point)]
    found: list[str] = []
    for point, label, x0 in starts:
        plant = ModelPlant(model, tuple(point.sigma))
        own = tried(point, plant, x0, point.problem.horizon).result
        results.append(own)
        if gave := sorted({way for period in own.given_way for way in period}):
            found.append(f"from {label} the bound of {', '.join(gave)} is relaxed")
    found += [
        f"in task {task} the bound of {bound} was relaxed in {100 * share:.2g} % of the periods"
        for task, own in given_way.items()
        for bound, share in own.items()
    ]
    sources = [source for one in results for source in one.source]
    failed = sum(source != Source.MPC.name for source in sources)
    if failed:
        found.append(f"{failed} of {len(sources)} solves failed, so the safeguard computed the input")
    beyond, largest = violation
    remedy = "Widen the bounds, use a longer horizon, or a terminal set (HardBound(..., at_end=True))."
    if beyond > VIOLATES:
        remedy = remedy if found else INWARD
        found.append(largest)
    if found:
        return Promise(name, "doubted", "; ".join(found), remedy)
    ends = [bound for point in hard for bound in point.problem.hard if bound.at_end]
    if not hard:
        evidence = f"every period has a plan within the inputs' limits ({len(sources)} periods tested)"
        soft = any(_is_soft(point.problem) for point in points)
        bounds = f"bounds of states and outputs are soft; {largest}" if soft else "only inputs are bounded"
        return Promise(name, "shown", f"{evidence}; {bounds}")
    evidence = (
        f"no hard bound is relaxed from {counted(len(starts), 'start')} within {100 * NEAR:.0f} % of a bound"
    )
    return Promise(
        name,
        "shown",
        evidence + (", and the plan has a terminal set" if ends else " (simulation, not a proof)"),
    )


def largest_violation(
    point: SetPoint, excess: Mapping[str, Mapping[str, float]], where: str = ""
) -> tuple[float, str]:
    """The largest violation of a bound of a state or output over the noise [-], and a text.

    The noise of a state is the larger one of its process noise per period and its sensor's noise.

    Args:
        point: A set-point of the kit.
        excess: Largest violation by task and signal (:attr:`~hybrid_mpc.compare.loops.LoopRow.excess`).
        where: Text that names the plant of the loops. Default: empty.
    """
    model, sigma = point.model, dict(zip([s.name for s in point.model.outputs], point.sigma, strict=True))
    process = np.maximum(
        np.sqrt(quiet(point.estimator).noise[0][: model.n_x]), ROUNDING * Sizes(model, point.problem).states
    )
    noise = {f"output {s.label}": sigma[s.name] for s in model.outputs}
    noise |= {s.label: max(q, sigma.get(s.name, q)) for s, q in zip(model.states, process, strict=True)}
    found = [(-1.0, "no loop of the run tested them")]
    for task, by_signal in excess.items():
        for label in by_signal.keys() & noise:
            name, _, unit = label.rstrip("]").rpartition(" [")
            text = f"largest violation in the run's loops: {by_signal[label]:.2g} {unit} of {name} in task {task}"
            text += f" {where} (noise {noise[label]:.2g} {unit})"
            if not by_signal[label] > 0:
                text = f"no bound of a state or output is violated in the run's loops {where}".rstrip()
            found.append((float(by_signal[label] / noise[label]), text))
    return max(found)


def _is_soft(problem: OCP) -> bool:
    ranges = (problem.x_min, problem.x_max, problem.y_min, problem.y_max)
    return bool(problem.soft) or any(np.any(np.isfinite(v)) for v in ranges)


def starts_near(point: SetPoint) -> Sequence[tuple[str, Array]]:
    """Starts close to each hard bound of a state, or of an output that depends on one state, with a text; all other
    states are at the set-point.
    """
    model, (x, u) = point.model, point.rest
    rows = output_with_jacobian(model)(x, u, point.w)[1].full()
    found: list[tuple[str, Array]] = []

    def add(i: int, value: float) -> None:
        if math.isfinite(value):
            start = x.copy()
            start[i] = x[i] + (1.0 - NEAR) * (value - x[i])
            found.append((f"{model.states[i].name} = {start[i]:.3g} {model.states[i].unit}", start))

    for bound in point.problem.hard:
        if bound.at_end or not isinstance(bound.what, str):
            continue
        for j, ends in enumerate(zip(bound.lower, bound.upper, strict=True)):
            if bound.what == "x":
                for value in ends:
                    add(j, float(value))
            elif np.flatnonzero(rows[j]).size == 1:
                i = int(np.flatnonzero(rows[j])[0])
                y = float(model.output(x, u, point.w, model.p).full()[j, 0])
                for value in ends:
                    add(i, float(x[i] + (value - y) / rows[j, i]))
    return found


# The observer, and the run's own loops.


def process_noise(kit: Kit) -> Promise:
    """Row "process noise": whether it is at most the spread of the states in the recordings."""
    name, model = "process noise", kit.models[kit.recommended]
    sigma = kit.noise(f"{kit.recommended}_observer")
    if not model.state_spread:
        return Promise(
            name, "not promised", "this kit has no spread of the states", "Run the scenario again."
        )
    spread = np.array(model.state_spread)
    shares = np.where(spread > 0, sigma / np.where(spread > 0, spread, 1.0), 0.0)
    i = int(shares.argmax())
    signal = model.states[i]
    evidence = (
        f"the largest is that of {signal.name}: {sigma[i]:.2g} {signal.unit} a period, {100 * shares[i]:.2g} % of its "
        f"spread ({spread[i]:.2g} {signal.unit})"
    )
    if shares[i] <= 1.0:
        return Promise(name, "shown", evidence)
    return Promise(
        name, "doubted", evidence,
        "The prior does not describe this state. Correct the prior, or set Scenario(state_noise=...).",
    )  # fmt: skip


def innovations(found: Tested | str) -> Promise:
    """Row "innovations": whether they are nearly white, and as large as assumed, on test recordings.

    ``found`` holds their statistics, or the reason why there are none.
    """
    name = "innovations"
    if isinstance(found, str):
        return Promise(name, "not promised", found, "Give longer test recordings.")
    evidence = (
        f"largest autocorrelation {found.correlation:.2g} (at most {WHITE:g}), variance {found.nis:.3g} times the "
        f"assumed one (from {1 / SURE:g} to {SURE:g}), on {found.samples} samples"
    )
    if found.correlation <= WHITE and 1.0 / SURE <= found.nis <= SURE:
        return Promise(name, "shown", evidence)
    return Promise(
        name, "doubted", evidence,
        "The observer's model lacks a state, friction or a delay, or the sensor noise (sensor_sigma) is wrong; see "
        "section Estimation of the report.",
    )  # fmt: skip


def disturbance_model(points: Sequence[SetPoint], trials: Sequence[Trial]) -> Promise:
    """Row "disturbance model": how fast the observer estimates a constant load, in a loop on the model itself.

    Args:
        points: The set-points.
        trials: The first trial of each set-point, with the right parameters.
    """
    name, model = "disturbance model", points[0].model
    remedy = (
        "Reduce the process noise (Scenario(state_noise=...)), or declare other disturbances "
        "(Scenario(disturbance_model=...))."
    )
    worst = (0.0, "")
    for point, one in zip(points, trials, strict=True):
        n, dt = point.problem.horizon, model.dt
        periods = periods_to_find(quiet(point.estimator), SEARCHED * n)
        dead = [_name_disturbance(model, j) for j, v in enumerate(periods) if not math.isfinite(v)]
        if dead:
            evidence = f"the load at {dead[0]} is not estimated: the observer's gain on it is zero"
            return Promise(name, "not promised", evidence, remedy)
        goal, d = loads(point, 0), one.result.d
        # a load may be as small as the noise of its estimate: then allow a tenth of an ordinary load
        near = np.maximum(np.abs(goal) / 3.0, 0.1 * LOAD * disturbance_sizes(model, point.problem))
        late = int(np.flatnonzero(np.append(True, np.any(np.abs(d - goal) > near, axis=1)))[-1])
        found = (
            "two thirds of a load are estimated after" if late < len(d) else "a load is not estimated within"
        )
        evidence = (
            f"{found} {late * dt:.3g} s ({late / n:.2g} horizons) in a loop on the model itself, {point.title}; the "
            f"quiet filter alone takes {float(periods.max()) * dt:.3g} s"
        )
        worst = max(worst, (late / n, evidence))
    if worst[0] <= LASTS / CONSTANTS:  # then exp(-CONSTANTS) = 5 % is left at the end of a trial
        return Promise(name, "shown", worst[1])
    return Promise(name, "doubted", worst[1], remedy)


def loads_elsewhere(kit: Kit, point: SetPoint) -> Promise | None:
    """Row "loads elsewhere": loops on the model itself, with a constant load at the rate of a state.

    A state counts if the disturbances do not represent its load within a period. A load has the effect of an error of
    20 % in one parameter. If each output measures another state, the loops are compared with loops whose disturbances
    act at the rates of these states. None if no state counts, or if no output has a weight.

    Args:
        kit: The kit.
        point: The set-point.
    """
    places = _find_unrepresented(point)
    if not point.problem.n_y or not places:
        return None
    name, states, n = "loads elsewhere", point.model.states, LASTS * point.problem.horizon
    trials = {i: _load_rate(point, i, load) for i, load in places.items()}
    off = {i: one for i, one in trials.items() if one.why and not one.limited}
    rates = rates_of_outputs(point.model, point.problem)
    other = None if rates is None else _with_disturbances(kit, point, rates)
    gains = [1.0]
    if other is not None:
        gains = [
            _mean_square(point, trials[i]) / _mean_square(other, _load_rate(other, i, load))
            for i, load in places.items()
        ]
    gain, names = float(np.exp(np.mean(np.log(gains)))), ", ".join(states[i].name for i in places)
    many = len(places) > 1
    what = f"{'constant loads at the rates' if many else 'a constant load at the rate'} of {names}"
    what += f" with the effect of a parameter {100 * OFF:.0f} % off"
    where = f"in loops of {n * point.model.dt:.3g} s on the model itself, {point.title}"
    if not off and gain < GAINS:
        return Promise(name, "shown", f"{what} leave{'' if many else 's'} no offset {where}")
    if rates is not None and gain >= GAINS:
        declared = ", ".join(f'Disturbance("rate", "{d.signal}", {d.size:.2g})' for d in rates)
        evidence = (
            f"{what}: with a disturbance at each rate, the squared error is {1 / gain:.2g} times as large"
        )
        remedy = f"If such loads act, declare disturbance_model=({declared})."
    else:
        i, worst = max(off.items(), key=lambda one: one[1].worst.size)
        evidence = (
            f"a constant load of {places[i]:.2g} {states[i].unit}/s at the rate of {states[i].name} leaves "
        )
        evidence += str(worst.worst)
        remedy = "If such loads act, declare a disturbance there (docs/disturbances.md)."
    return Promise(name, "doubted", f"{evidence}, {where}", remedy)


def _find_own_problem(kit: Kit, point: SetPoint) -> str:
    """The set-point's task if it has a control problem of its own; empty otherwise."""
    return next((name for name in point.tasks[:1] if name in kit.loop.control), "")


def _with_disturbances(kit: Kit, point: SetPoint, chosen: tuple[Disturbance, ...]) -> SetPoint | None:
    """The same set-point with another disturbance model; None if no observer can be made with the kit's noise."""
    of, task = kit.with_disturbances(chosen), _find_own_problem(kit, point)
    try:
        controller, estimator = of.controller(task=task), of.observer(task=task)
    except InputError:  # e.g. the process noise hides a disturbance
        return None
    return replace(point, model=of.models[of.recommended], controller=controller, estimator=estimator)


def _find_unrepresented(point: SetPoint) -> dict[int, float]:
    """Loads at the rates of states [unit/s] that the disturbances do not represent within a period, by state."""
    model, (x, u) = point.model, point.rest
    sizes, positions = loads_by_parameters(model, point.problem), kinematics(model)
    h = hidden_fixed_point(model, x, u, w=point.w)
    b_d = steady_matrices(model, x, h, u, point.w)[0][: model.n_x, model.n_x + model.n_h :]
    left = np.linalg.norm(np.eye(model.n_x) - b_d @ np.linalg.pinv(b_d), axis=0)
    return {
        i: float(sizes[i])
        for i in np.flatnonzero((left > ROUNDING) & (sizes > 0)).tolist()
        if i not in positions
    }


def _load_rate(point: SetPoint, i: int, load: float) -> Trial:
    """A loop on the model itself with a constant load [unit/s] at the rate of a state."""
    model = replace(point.model, disturbance_model=(Disturbance("rate", point.model.states[i].name, load),))
    plant = LoadedPlant(model, tuple(point.sigma), (load,))
    return tried(point, plant, point.rest[0], LASTS * point.problem.horizon)


def _mean_square(point: SetPoint, one: Trial) -> float:
    """Mean squared error of the controlled outputs, over their noise; at most 1e12, also of a loop that diverges."""
    before = np.vstack([one.result.u[:1], one.result.u[:-1]])
    errors = point.errors(one.result.y, before)[:, point.held] / point.sigma[point.held]
    known = np.abs(errors[~np.isnan(errors)])
    if one.fails or not known.size:
        return DIVERGED
    return float(np.clip(np.mean(np.minimum(known, DIVERGED) ** 2), 1.0 / DIVERGED, DIVERGED))


def _name_disturbance(model: HybridModel, j: int) -> str:
    chosen = model.disturbance_model
    if chosen is None:
        return f"the input {model.inputs[j].name}"
    return f"the {chosen[j].at} {chosen[j].signal}"


def tasks_end(ends: Sequence[TaskEnd], where: str) -> Promise:
    """Row "set-points of the tasks": whether the run's loops reach the set-points at the end of their tasks.

    Args:
        ends: Deviations at the ends of the tasks.
        where: Text that names the plant of the loops.
    """
    name = "set-points of the tasks"
    if not ends:
        return Promise(
            name, "not promised", "no task of the run's loops ends at a set-point", "Add a task, e.g. a step."
        )
    missed = [
        f"{one.task}: {deviation}" for one in ends for deviation in one.deviations if not deviation.kept
    ]
    if not missed:
        return Promise(name, "shown", f"{', '.join(one.task for one in ends)} end within the noise, {where}")
    return Promise(
        name, "doubted", f"{'; '.join(missed)}; {where}",
        "Look at these loops in the report. Possible causes: friction, a limit, a slow observer, a load without a "
        "disturbance.",
    )  # fmt: skip


def examine(
    kit: Kit,
    tasks: Sequence[Task],
    *,
    ends: Sequence[TaskEnd] = (),
    where: str = "",
    given_way: Mapping[str, Mapping[str, float]] | None = None,
    excess: Mapping[str, Mapping[str, float]] | None = None,
    tested: Tested | str = "no test recording was examined",
    lacking_delay: float = 0.0,
    report: Callable[[int, int, str], None] = lambda done, total, text: None,
) -> tuple[Promise, ...]:
    """Examine all promises of a kit.

    Args:
        kit: The kit.
        tasks: The scenario's tasks.
        ends: Deviations at the ends of tasks in the run's loops. Default: none.
        where: Text that names the plant of these loops.
        given_way: Share of their periods with a relaxed hard bound, by task and bound. Default: none.
        excess: Their largest violation of bounds, by task and signal. Default: none.
        tested: Statistics of the innovations on recordings, or why there are none.
        lacking_delay: Delay of the inputs [s] that the recordings show and the prior lacks. Default: none.
        report: Called with ``(done, total, text)``. Default: no report.

    Raises:
        InputError: If the kit lacks a control problem or noise.

    Example:
        ``for promise in examine(kit, scenario.tasks): print(promise)``
    """
    points = set_points(kit, tasks)
    every = _find_trials(points, report)
    own = [one for trials in every for one in trials]
    report(len(points), len(points), "margins, limits, observer")
    fails = failing_loop(points, every)
    time = step_time([one for one in own if not one.fails] or own, 1e3 * points[0].model.dt)
    of_model = horizon(points), margins(points, _find_prior_points(kit, tasks), lacking_delay)
    of_observer = process_noise(kit), innovations(tested)
    of_tracking = examine_tracking(kit, tasks, lacking_delay, report)
    if fails is not None:  # with a failing loop, rows about settled loops have no meaning
        return (advised(fails, kit, points, every), time, *of_model, *of_observer, *of_tracking)
    elsewhere = loads_elsewhere(kit, points[0])
    late = late_inputs(kit, points[0], lacking_delay)
    return (
        *_offset_rows(kit, points, every),
        *([] if elsewhere is None else [elsewhere]),
        tasks_end(ends, where),
        time,
        *of_model,
        *([] if late is None else [late]),
        limits(points, own, given_way or {}, largest_violation(points[0], excess or {}, where)),
        *of_observer,
        disturbance_model(points, [trials[0] for trials in every]),
        *of_tracking,
    )


def advised(row: Promise, kit: Kit, points: Sequence[SetPoint], every: Sequence[Sequence[Trial]]) -> Promise:
    """A row, with :data:`ROBUST` as another remedy if all loops that fail or do not settle settle with it.

    Args:
        row: The row about the loops.
        kit: The kit.
        points: The set-points.
        every: The trials of each.
    """
    lost = [
        (point, draw, len(one.result.t))
        for point, trials in zip(points, every, strict=True)
        for draw, one in enumerate(trials)
        if one.why or one.fails
    ]
    if row.verdict == "shown" or not lost or any(ranks(point).why for point, *_ in lost):
        return row
    make = kit.tracking_observer if points[0].tracking else kit.observer
    for point, draw, periods in lost:
        estimator = make(task=_find_own_problem(kit, point), input_noise=ROBUST)
        one = trial(replace(point, estimator=estimator), draw, periods)
        if one.why or one.fails:
            return row
    again = "it settles" if len(lost) == 1 else "they settle"
    return replace(
        row, remedy=f"{row.remedy} Or use kit.{make.__name__}(input_noise={ROBUST:g}): with it {again}."
    )


def _offset_rows(kit: Kit, points: Sequence[SetPoint], every: Sequence[Sequence[Trial]]) -> list[Promise]:
    return [
        advised(no_offset(point, trials, len(points) > 1), kit, [point], [trials])
        for point, trials in zip(points, every, strict=True)
    ]


def _find_trials(points: Sequence[SetPoint], report: Callable[[int, int, str], None]) -> list[list[Trial]]:
    """Loops on wrong models with loads, for each set-point."""
    lengths = [LASTS * point.problem.horizon for point in points]
    draws = min(max(round(PERIODS / sum(lengths)), FEWEST), MOST)
    every: list[list[Trial]] = []
    for i, (point, length) in enumerate(zip(points, lengths, strict=True)):
        report(i, len(points), f"loops on wrong models, {point.title}")
        # without full rank "no offset" is not promised: one loop suffices to measure the step time
        number = 1 if len(point.held) > point.model.n_u or ranks(point).why else draws
        trials = [trial(point, draw, length) for draw in range(number)]
        worst = max(range(number), key=lambda draw: trials[draw].worst.size)
        if trials[worst].why.startswith(SLOW):
            longer = trial(point, worst, max(2 * length, LONGER))
            trials[worst] = replace(
                trials[worst], why=f"{trials[worst].why}; {_explain_longer_trial(longer)}"
            )
        every.append(trials)
    return every


def examine_tracking(
    kit: Kit,
    tasks: Sequence[Task],
    lacking_delay: float = 0.0,
    report: Callable[[int, int, str], None] = lambda done, total, text: None,
) -> tuple[Promise, ...]:
    """The rows on offset, late inputs, step time and margins, of the loops with tracked parameters; empty without.

    Args:
        kit: The kit.
        tasks: The scenario's tasks.
        lacking_delay: As for :func:`examine`. Default: none.
        report: As for :func:`examine`. Default: no report.
    """
    if not kit.loop.tracked:
        return ()
    try:
        points = set_points(kit, tasks, tracking=True)
    except InputError as error:  # e.g. undetectable disturbances at other values of the parameters
        remedy = "Track other parameters (docs/tracking.md#decide-yourself)."
        return (Promise("closed loop, tracking", "not promised", str(error), remedy),)
    every = _find_trials(points, report)
    fails = failing_loop(points, every)
    own = [one for trials in every for one in trials if not one.fails]
    rows = [
        *_offset_rows(kit, points, every),
        late_inputs(kit, points[0], lacking_delay),
    ]
    time = step_time(own or every[0], 1e3 * points[0].model.dt)
    rows = [
        *(rows if fails is None else [advised(fails, kit, points, every)]),
        time,
        margins(points, lacking_delay=lacking_delay),
    ]
    return tuple(replace(row, name=f"{row.name}, tracking") for row in rows if row is not None)


def _find_prior_points(kit: Kit, tasks: Sequence[Task]) -> list[SetPoint]:
    """Set-points of the fitted prior; empty if the kit recommends the prior."""
    return [] if kit.recommended == "prior" else set_points(replace(kit, recommended="prior"), tasks)


def _explain_longer_trial(longer: Trial) -> str:
    seconds = len(longer.result.t) * longer.result.dt
    return f"a loop of {seconds:.3g} s {'does not settle either' if longer.why else 'settles'}"
