"""The linear analysis of an artifact's models, which ``hybrid-mpc analyze`` computes.

:func:`analyze_models` computes one part after the other. A part that cannot be computed is a :class:`Missing` with its
reason.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from typing import Any, TypeVar

import casadi as ca
import numpy as np
from numpy.typing import NDArray

from hybrid_mpc.analyze.equilibria import Equilibria, equilibria
from hybrid_mpc.analyze.linearize import (
    FrictionSlopes,
    control_toolbox,
    friction_slopes,
    linearize,
    linearize_along,
    linearize_at_speed,
    linearize_secant,
)
from hybrid_mpc.analyze.margins import (
    GainSchedule,
    LinearLoop,
    Margins,
    MpcGain,
    gain_schedule,
    mpc_gain,
    mpc_loop,
    solved_gain,
    steady_filter,
)
from hybrid_mpc.analyze.measured import (
    MeasuredResponse,
    multisine_response,
    run_model,
    run_plant,
    welch_response,
)
from hybrid_mpc.analyze.memory import (
    Contraction,
    LyapunovExponent,
    contraction,
    feature_box,
    gru_weights,
    lyapunov_exponent,
)
from hybrid_mpc.analyze.properties import (
    FrequencyResponse,
    SteadyGain,
    Structure,
    frequency_response,
    hankel_singular_values,
    physical_states,
    steady_gain,
    system_structure,
)
from hybrid_mpc.analyze.sensitivity import parameter_sensitivities
from hybrid_mpc.control.ocp import OCP
from hybrid_mpc.control.rti import CondensedController
from hybrid_mpc.data.excitation import multisine
from hybrid_mpc.errors import InputError
from hybrid_mpc.estimate.kalman import ExtendedKalmanFilter
from hybrid_mpc.loop.plant import Plant
from hybrid_mpc.machine.signals import Signal
from hybrid_mpc.model.equilibrium import hidden_equilibrium, holding_input
from hybrid_mpc.model.model import HybridModel, positions_of
from hybrid_mpc.watch.lengths import machine_second
from nn_export import Program

Array = NDArray[np.float64]
Complex = NDArray[np.complex128]
R = TypeVar("R")
Point = tuple[Array, Array]
"""A state ``(n_x,)`` and a hidden state ``(n_h,)``."""

POINTS = ("rest", "working", "moving", "driven")
"""Linearizations: tangent at rest; describing function of motions of working size; tangent in motion at working speed;
mean along a driven run. Only mechanical models have ``"working"`` and ``"moving"``."""
LEVEL = 0.5
"""Amplitude of the multisine over half the input's range."""
PERIOD, PERIODS, BAND = 20.0, 4, (0.1, 3.0)
"""Multisine for frequency responses: its period [time units], number of counted periods, and band [1 / time unit]."""
DRIVEN, DRIVEN_BAND = 30.0, (0.1, 1.5)
"""Driven run: its length [time units], and the band of its multisine [1 / time unit]."""


@dataclass(frozen=True)
class AnalysisInput:
    """Models to analyze, and data about their machine.

    Args:
        models: Models by name; ``"prior"`` and ``"hybrid"`` are compared.
        programs: Exported programs by ``"MODEL/step"``.
        x_range: Working range of the states ``(n_x, 2)``.
        u_range: Working range of the inputs ``(n_u, 2)``.
        speed: Working speeds ``(n_x / 2,)``; empty for a machine without speeds.
        ocp: Control problem. Default: none.
        filters: Observers by model and mode, ``("hybrid", "quiet")``. Default: none.
        plant: Simulated machine. Default: none.
        recordings: Inputs ``(n,)``, outputs ``(n,)`` and initial state of each recording. Default: none.
        region: Region in which equilibria are searched ``(n_x, 2)``. Default: ``x_range``.
    """

    models: Mapping[str, HybridModel]
    programs: Mapping[str, Program]
    x_range: Array
    u_range: Array
    speed: Array
    ocp: OCP | None = None
    filters: Mapping[tuple[str, str], ExtendedKalmanFilter] = field(default_factory=dict)
    plant: Plant | None = None
    recordings: Sequence[tuple[Array, Array, Array]] = ()
    region: Array | None = None


@dataclass(frozen=True)
class Missing:
    """Reason why a part could not be computed."""

    reason: str


@dataclass(frozen=True)
class FrictionAnalysis:
    """Damping of a model's first axis: over the amplitude of the speed, and at the working speed ``(1,)``."""

    slopes: FrictionSlopes
    working: FrictionSlopes


@dataclass(frozen=True)
class Reduction:
    """A linearization reduced to its physical states; ``bound`` is an upper bound of the error of its response."""

    a: Array
    b: Array
    bound: float
    hankel: Array
    response: FrequencyResponse


@dataclass(frozen=True)
class Linearization:
    """One linearization of a model.

    Args:
        structure: Modes with their controllability and observability.
        zeros: Zeros of a system with as many inputs as outputs, else empty.
        response: Frequency response.
        t: Times of the step responses ``(k,)`` [s].
        step: Unit step responses ``(n_y, n_u, k)``.
        reduced: Reduction to the physical states; None for a model without hidden states.
        gain: Steady-state gain.
    """

    structure: Structure
    zeros: Complex
    response: FrequencyResponse
    t: Array
    step: Array
    reduced: Reduction | Missing | None
    gain: SteadyGain | Missing


@dataclass(frozen=True)
class ResponseError:
    """Relative difference of two frequency responses: median and maximum over the frequencies."""

    median: float
    largest: float


@dataclass(frozen=True)
class ResponseAnalysis:
    """Responses of machine and models to the same inputs, and the error of each model's response.

    ``left_out`` holds the reason for each model without a response, for example a diverging free run.
    """

    source: str
    machine: MeasuredResponse
    models: Mapping[str, MeasuredResponse]
    errors: Mapping[str, ResponseError]
    left_out: Mapping[str, str] = field(default_factory=dict)


@dataclass(frozen=True)
class ScheduleAnalysis:
    """LQR gains over the working range: tangent at rest, friction of working size, and positions no input holds."""

    rest: GainSchedule
    working: GainSchedule
    not_held: tuple[float, ...]


@dataclass(frozen=True)
class LoopAnalysis:
    """A loop of controller, filter and linearized machine, broken at one input with the others closed.

    Args:
        stable: Whether all closed-loop poles are inside the unit circle.
        radius: Spectral radius of the closed loop.
        gain: Gain of the controller from the physical states ``(n_u, n_x)``.
        omega: Frequencies ``(n,)`` [rad/s].
        open_loop: Loop gain ``(n,)``, for negative feedback.
        margins: Stability margins; None for an unstable loop.
        sensitivity: ``"S"`` and ``"T"`` ``(n,)``, ``"KS"`` and ``"GS"`` ``(n_y, n)``; empty for an unstable loop.
        peaks: Largest magnitudes of ``"S"`` and ``"T"``; empty for an unstable loop.
    """

    stable: bool
    radius: float
    gain: Array
    omega: Array
    open_loop: Complex
    margins: Margins | None
    sensitivity: Mapping[str, Complex]
    peaks: Mapping[str, float]


@dataclass(frozen=True)
class MemoryAnalysis:
    """Whether a model forgets its initial state: exponents of the whole and of the hidden state, and a certificate."""

    whole: LyapunovExponent
    hidden: LyapunovExponent | None
    certificate: Contraction | Missing | None


@dataclass(frozen=True)
class SensitivityAnalysis:
    """Derivatives of a driven run with respect to the prior's parameters.

    Args:
        parameters: Names of the parameters ``(n_p,)``.
        t: Times ``(n,)`` [s].
        relative: Change of the states per 100 % change of each parameter ``(n, n_x, n_p)``.
        rms: Root mean square of ``relative`` over the run ``(n_x, n_p)``.
        identifiable: Parameters that are identifiable together from this run.
        correlation: Correlation of the errors of the identifiable parameters.
    """

    parameters: tuple[str, ...]
    t: Array
    relative: Array
    rms: Array
    identifiable: tuple[str, ...]
    correlation: Array


@dataclass(frozen=True)
class AnalysisResult:
    """The parts of an analysis, by model; linearizations also by point of :data:`POINTS`.

    Keys of ``loops``: controller and machine (``"prior on hybrid"``), point, and mode of the filter. With several
    inputs, the mode also names the input at which the loop is broken: ``"quiet at heater_1"``.
    """

    equilibria: Mapping[str, Equilibria] | Missing
    friction: Mapping[str, FrictionAnalysis] | Missing
    linear: Mapping[str, Mapping[str, Linearization]] | Missing
    measured: ResponseAnalysis | Missing
    schedule: Mapping[str, ScheduleAnalysis] | Missing
    loops: Mapping[str, Mapping[str, Mapping[str, LoopAnalysis]]] | Missing
    memory: Mapping[str, MemoryAnalysis] | Missing
    sensitivity: Mapping[str, SensitivityAnalysis] | Missing


def state_range(model: HybridModel, control: OCP | None = None) -> Array:
    """Range of the states ``(n_x, 2)``: limits of the control problem, else the signals' limits.

    An open side lies one unit (half a turn for a periodic state) from the operating point.
    """
    none = np.full(model.n_x, np.inf)
    lower, upper = (-none, none) if control is None else control.state_range
    sides = zip(model.states, lower.tolist(), upper.tolist(), model.x0.tolist(), strict=True)
    return np.array(
        [_within(s, s.period / 2 if s.periodic else 1.0, low, high, at) for s, low, high, at in sides]
    )


def input_range(model: HybridModel, control: OCP | None) -> Array:
    """Range of the inputs ``(n_u, 2)``: limits of the control problem, else the signals' limits.

    An open side lies one input scale (without a control problem one unit) from the operating point.
    """
    if control is None:
        return np.array(
            [_within(s, 1.0, at=at) for s, at in zip(model.inputs, model.u0.tolist(), strict=True)]
        )
    sides = zip(
        model.inputs, control.input_scale, control.u_min, control.u_max, model.u0.tolist(), strict=True
    )
    return np.array([_within(s, size, low, high, at) for s, size, low, high, at in sides])


def _within(
    signal: Signal, size: float, lower: float = -np.inf, upper: float = np.inf, at: float = 0.0
) -> tuple[float, float]:
    """Finite limits of a signal: those given, else its own; an open side lies ``size`` from ``at``.

    The distance of an open side from the other side is at least ``size``.
    """
    low = lower if np.isfinite(lower) else signal.lower
    high = upper if np.isfinite(upper) else signal.upper
    if not np.isfinite(low):
        low = min(at - size, high - size) if np.isfinite(high) else at - size
    return low, high if np.isfinite(high) else max(at + size, low + size)


# The parts.


Report = Callable[[str, int, int, str], None]


def analyze_models(given: AnalysisInput, report: Report = lambda *text: None) -> AnalysisResult:
    """Analyze the models, one part after the other; a part that cannot be computed is its reason.

    ``report`` is called with ``("parts", done, total, part)``.
    """
    points = {name: resting_point(given, model) for name, model in given.models.items()}
    parts: dict[str, Callable[[], Any]] = {
        "equilibria": lambda: equilibria_of(given),
        "friction": lambda: friction_of(given, points),
        "linear": lambda: linearizations_of(given, points),
        "measured": lambda: responses_of(given),
        "schedule": lambda: schedules_of(given),
        "loops": lambda: loops_of(given, points),
        "memory": lambda: memory_of(given),
        "sensitivity": lambda: sensitivities_of(given),
    }
    found: dict[str, Any] = {}
    for number, (name, compute) in enumerate(parts.items()):
        report("parts", number, len(parts), name)
        found[name] = _try(compute)
    return AnalysisResult(**found)


def _try(compute: Callable[[], R]) -> R | Missing:
    """Compute a part; :class:`Missing` with the reason if an InputError prevents it."""
    try:
        return compute()
    except InputError as error:
        return Missing(str(error))


def resting_point(given: AnalysisInput, model: HybridModel) -> Point:
    """Nearest equilibrium to the operating point under its input, a stable one if there is one.

    The operating point itself if there is no equilibrium.
    """
    size = given.x_range[:, 1] - given.x_range[:, 0]
    found = equilibria(model, model.u0, pairs(given.x_range), starts=16).points
    stable = [p for p in found if p.stability == "stable"] or list(found)
    if stable:
        best = min(stable, key=lambda p: float(np.linalg.norm((p.x - model.x0) / size)))
        return best.x, best.h
    return model.x0, hidden_equilibrium(model, model.x0, model.u0)


def pairs(box: Array) -> list[tuple[float, float]]:
    """Convert the rows of a box ``(n, 2)`` to pairs."""
    return [(float(a), float(b)) for a, b in box]


def driving_input(given: AnalysisInput, model: HybridModel, seconds: float) -> Array:
    """Multisine ``(n, n_u)`` of working size around the middle of each input's range.

    ``seconds`` is its length in the machine's time units. Each input has its own frequencies.
    """
    unit = machine_second(model.dt, model.time_unit)
    t = np.asarray(model.dt * np.arange(round(seconds * unit / model.dt)), dtype=np.float64)
    sizes = [(LEVEL * 0.5 * (high - low), 0.5 * (low + high)) for low, high in pairs(given.u_range)]
    low, high = (edge / unit for edge in DRIVEN_BAND)
    return np.column_stack([multisine(t, size, low, high, offset=middle) for size, middle in sizes])


def equilibria_of(given: AnalysisInput) -> dict[str, Equilibria]:
    """Equilibria of each model in the whole range of the states."""
    region = given.x_range if given.region is None else given.region
    return {name: equilibria(model, model.u0, pairs(region)) for name, model in given.models.items()}


def friction_of(given: AnalysisInput, points: Mapping[str, Point]) -> dict[str, FrictionAnalysis]:
    """Damping at rest, for motions of several amplitudes, and in motion, by model."""
    found = {}
    for name, model in given.models.items():
        q, work = points[name][0][: positions_of(model)], float(given.speed[0])
        slopes = friction_slopes(model, q, work * np.geomspace(0.01, 10.0, 61))
        found[name] = FrictionAnalysis(slopes, friction_slopes(model, q, [work]))
    return found


def systems(given: AnalysisInput, name: str, point: Point) -> dict[str, Any]:
    """The linearizations of a model as ``control.StateSpace``, by the names in :data:`POINTS`."""
    model, (x, h) = given.models[name], point
    u, settled = model.u0, round(5.0 * machine_second(model.dt, model.time_unit) / model.dt)
    found = {"rest": linearize(model, x, u, h)}
    if given.speed.size:
        found["working"] = linearize_secant(model, x, u, given.speed, h)
        found["moving"] = linearize_at_speed(model, x[: positions_of(model)], given.speed, u)
    found["driven"] = linearize_along(model, x, driving_input(given, model, DRIVEN), h).mean(settled)
    return found


def linearizations_of(
    given: AnalysisInput, points: Mapping[str, Point]
) -> dict[str, dict[str, Linearization]]:
    """Modes, reduced systems, frequency and step responses of the linearizations."""
    return {
        name: {
            at: _linearization(given, model, points[name], system)
            for at, system in systems(given, name, points[name]).items()
        }
        for name, model in given.models.items()
    }


def _linearization(given: AnalysisInput, model: HybridModel, point: Point, system: Any) -> Linearization:
    unit = machine_second(model.dt, model.time_unit)
    structure, omega = system_structure(system), np.geomspace(0.02 / unit, np.pi / model.dt, 400)
    structure = replace(structure, hankel=hankel_singular_values(_scaled(given, model, system)))
    t = np.asarray(model.dt * np.arange(round(4.0 * unit / model.dt) + 1), dtype=np.float64)
    step = control_toolbox().step_response(system, t).outputs
    return Linearization(
        structure,
        _zeros(system) if model.n_u == model.n_y else np.zeros(0, dtype=complex),
        frequency_response(system, omega),
        t,
        np.reshape(step, (model.n_y, model.n_u, -1)),
        _try(lambda: _reduced(given, model, point, system, omega)) if model.n_h else None,
        _try(lambda: steady_gain(system)),
    )


def _scaled(given: AnalysisInput, model: HybridModel, system: Any) -> Any:
    """Scale a system's inputs and outputs by their working ranges, so that signals of different units are comparable.

    The range of an output is ``|C| (range of x) + |D| (range of u)``.
    """
    half_x, half_u = (0.5 * (box[:, 1] - box[:, 0]) for box in (given.x_range, given.u_range))
    a, b, c, d = (np.asarray(m) for m in (system.A, system.B, system.C, system.D))
    sizes = np.abs(c[:, : model.n_x]) @ half_x + np.abs(d) @ half_u
    over = np.where(sizes > 0, sizes, 1.0)[:, None]
    return control_toolbox().ss(
        a, b * half_u, c / over, d * half_u / over, system.dt, remove_useless_states=False
    )


def _zeros(system: Any) -> Complex:
    found = np.asarray(system.zeros(), dtype=np.complex128)
    # zeros larger than this are rounding errors: zeros at infinity (of a delay) that are computed as finite
    return found[np.abs(found) < 1e6]


def _reduced(given: AnalysisInput, model: HybridModel, point: Point, system: Any, omega: Array) -> Reduction:
    half_x, half_u = (0.5 * (box[:, 1] - box[:, 0]) for box in (given.x_range, given.u_range))
    (x, h), u = point, model.u0
    small = physical_states(model, x, u, h, x_scale=half_x, u_scale=half_u, system=system)
    response = frequency_response(small.system, omega)
    return Reduction(
        np.asarray(small.system.A), np.asarray(small.system.B), small.bound, small.hankel, response
    )


def responses_of(given: AnalysisInput) -> ResponseAnalysis:
    """Responses of machine and models to the same inputs, from recordings, else from the simulated plant."""
    models = given.models
    some = next(iter(models.values()))
    unit = machine_second(some.dt, some.time_unit)
    if some.n_u != 1:
        raise InputError(
            f"responses: only estimated for machines with one input; this machine has {some.n_u} [HM-ANALYZE-001]"
        )
    if given.recordings:
        length = min(10.0 * unit, 0.25 * max(u.size for u, _, _ in given.recordings) * some.dt)
        machine = welch_response([(u, y) for u, y, _ in given.recordings], some.dt, length=length)

        def response(model: HybridModel) -> MeasuredResponse:
            driven = [(u, run_model(model, x0)(u)) for u, _, x0 in given.recordings]
            return welch_response(driven, some.dt, length=length)

        source = f"H1 estimate of {len(given.recordings)} recordings, Hann windows of {length:g} s"
    elif given.plant is not None:
        low_u, high_u = given.u_range[0].tolist()
        amplitude, bias = LEVEL * 0.5 * (high_u - low_u), 0.5 * (low_u + high_u)
        low, high = (edge / unit for edge in BAND)
        driven: dict[str, Any] = {
            "amplitude": amplitude, "bias": bias, "band": (low, high), "period": PERIOD * unit,
            "periods": PERIODS,
        }  # fmt: skip
        machine = multisine_response(run_plant(given.plant, some.x0, some.dt), some.dt, **driven)

        def response(model: HybridModel) -> MeasuredResponse:
            return multisine_response(run_model(model, some.x0), model.dt, **driven)

        size = f"{amplitude:g} {some.inputs[0].unit}"
        around = f" around {bias:g} {some.inputs[0].unit}" if bias else ""
        source = f"odd multisine of {size}{around}, {low:g} to {high:g} Hz, {PERIODS} periods"
    else:
        raise InputError(
            "responses: neither a recording nor a simulated machine is available; give --data FILE"
            " [HM-ANALYZE-002]"
        )
    tried = {name: _try(partial(response, model)) for name, model in models.items()}
    responses = {name: one for name, one in tried.items() if not isinstance(one, Missing)}
    errors = {name: _response_error(one, machine) for name, one in responses.items()}
    left_out = {name: one.reason for name, one in tried.items() if isinstance(one, Missing)}
    return ResponseAnalysis(source, machine, responses, errors, left_out)


def _response_error(model: MeasuredResponse, machine: MeasuredResponse) -> ResponseError:
    """Error of a model's response at frequencies where the machine's coherence is above 0.8."""
    clean = (machine.coherence > 0.8) & np.isfinite(machine.response) & np.isfinite(model.response)
    if not clean.any():
        raise InputError(
            "responses: the coherence is below 0.8 at all frequencies. Excite the machine more strongly"
            " [HM-ANALYZE-003]"
        )
    error = np.abs(model.response - machine.response)[clean] / np.abs(machine.response[clean])
    return ResponseError(float(np.median(error)), float(error.max()))


def schedules_of(given: AnalysisInput) -> dict[str, ScheduleAnalysis]:
    """LQR gains over the positions of the working range."""
    ocp = given.ocp
    if ocp is None:
        raise InputError(
            "gain schedule: it needs the weights of a control problem; give the scenario control=OCP(...) "
            "[HM-ANALYZE-004]"
        )
    found = {}
    for name, model in sorted(given.models.items(), key=lambda m: m[1].n_h):
        if model.n_x != 2 or model.n_u != 1:
            raise InputError("gain schedule: only computed for one position and one input [HM-ANALYZE-005]")
        # positions of the gain schedule
        points, not_held = _held(model, np.linspace(given.x_range[0, 0], given.x_range[0, 1], 21))
        weights = ocp.q * model.dt, (ocp.r + ocp.r_delta) * model.dt
        found[name] = ScheduleAnalysis(
            gain_schedule(model, points, *weights),
            gain_schedule(model, points, *weights, speed=given.speed),
            tuple(not_held),
        )
    return found


def _held(model: HybridModel, positions: Array) -> tuple[list[tuple[Array, Array]], list[float]]:
    """Equilibria at the positions, and the positions without one.

    The search goes outwards from zero; each position starts with the input of its nearest solved neighbour.
    """
    found: dict[float, Array] = {}
    lost: list[float] = []
    for q in sorted(positions.tolist(), key=abs):
        near = min(found, key=lambda known: abs(known - q), default=None)
        try:
            found[q] = holding_input(model, [q], u_guess=None if near is None else found[near])
        except InputError:
            lost.append(q)
    if not found:
        raise InputError(
            f"model {model.name}: no input holds a position of the range; check the input limits [HM-ANALYZE-006]"
        )
    return [(np.array([q, 0.0]), found[q]) for q in sorted(found)], sorted(lost)


def loops_of(
    given: AnalysisInput, points: Mapping[str, Point]
) -> dict[str, dict[str, dict[str, LoopAnalysis]]]:
    """Loops of each model's controller and filter with the model itself, and of the prior's with the hybrid."""
    if given.ocp is None or not given.filters:
        raise InputError(
            "loops: the scenario's control problem or the observers' noise is missing; run the scenario with "
            "control=OCP(...) [HM-ANALYZE-007]"
        )
    around = [(n, n) for n in given.models]
    if {"prior", "hybrid"} <= set(given.models):
        around.append(("prior", "hybrid"))
    found: dict[str, dict[str, dict[str, LoopAnalysis]]] = {}
    controllers = {n: CondensedController(m, given.ocp) for n, m in given.models.items()}
    made = {n: systems(given, n, points[n]) for n in given.models}
    for (name, mode), ekf in given.filters.items():
        model, (x, h), u = given.models[name], points[name], given.models[name].u0
        for point in made[name]:
            gain = _gain(controllers[name], x, u, h, made[name][point])
            steady = steady_filter(ekf, x, u, h, system=made[name][point])
            for machine in (plant for own, plant in around if own == name):
                loop = mpc_loop(gain, steady, made[machine][point])
                rows = found.setdefault(f"{name} on {machine}", {}).setdefault(point, {})
                for j, signal in enumerate(model.inputs):
                    own = gain.by_state[:, : model.n_x], model.dt, machine_second(model.dt, model.time_unit)
                    rows[f"{mode}{at_input(model, signal)}"] = _loop(loop, j, *own)
    return found


def _gain(controller: CondensedController, x: Array, u: Array, h: Array, system: Any) -> MpcGain:
    """Gain of the MPC at a point: of its QP; of its solves if outputs have weights, or the cost is economic."""
    ocp = controller.ocp
    if ocp.economic is None and not ocp.n_y:
        return mpc_gain(controller, x, u, h, system=system)
    return solved_gain(controller, x, u, controller.problem.standing()[0], h)


def at_input(model: HybridModel, signal: Signal) -> str:
    """Text that names the input at which a loop is broken; empty for a single input."""
    return f" at {signal.name}" if model.n_u > 1 else ""


def _loop(loop: LinearLoop, j: int, gain: Array, dt: float, unit: float) -> LoopAnalysis:
    omega = np.geomspace(0.05 / unit, np.pi / dt, 500)
    response = frequency_response(loop.broken(j), omega)
    open_loop = response.magnitude[0, 0] * np.exp(1j * response.phase[0, 0])
    functions: dict[str, Complex] = {}
    if loop.stable:
        every = loop.sensitivity(omega)
        functions = {k: every[k][j, j] for k in ("S", "T")} | {"KS": every["KS"][j], "GS": every["GS"][:, j]}
    return LoopAnalysis(
        loop.stable,
        float(abs(loop.poles[0])),
        gain,
        omega,
        open_loop,
        loop.margins(j) if loop.stable else None,
        functions,
        {k: float(np.abs(functions[k]).max()) for k in ("S", "T") if k in functions},
    )


def _seen(model: HybridModel) -> NDArray[np.bool_]:
    """Mask ``(n_x,)`` of the states that an output depends on at the operating point."""
    x = ca.MX.sym("x", model.n_x)
    slope = ca.Function("C", [x], [ca.jacobian(model.output(x, model.u0, model.w, model.p), x)])
    return np.asarray(np.any(slope(model.x0).full() != 0, axis=0))


def memory_of(given: AnalysisInput) -> dict[str, MemoryAnalysis]:
    """Lyapunov exponents of driven runs, and the certificate over the working range."""
    found = {}
    for name, model in given.models.items():
        u = driving_input(given, model, DRIVEN)
        whole = lyapunov_exponent(model, model.x0, u, part="all")
        if not model.n_h:
            found[name] = MemoryAnalysis(whole, None, None)
            continue
        hidden = lyapunov_exponent(model, model.x0, u, part="hidden")
        certificate = _try(partial(_certificate, given, given.programs[f"{name}/step"]))
        found[name] = MemoryAnalysis(whole, hidden, certificate)
    return found


def _certificate(given: AnalysisInput, program: Program) -> Contraction:
    return contraction(gru_weights(program), *feature_box(program, given.x_range, given.u_range))


def sensitivities_of(given: AnalysisInput) -> dict[str, SensitivityAnalysis]:
    """Derivatives of a driven run with respect to the prior's parameters, by model."""
    made = {}
    for name, model in given.models.items():
        found = parameter_sensitivities(model, model.x0, driving_input(given, model, 10.0))
        sigma = np.where(_seen(model), given.x_range[:, 1] - given.x_range[:, 0], np.inf)
        apart = found.apart(sigma)
        made[name] = SensitivityAnalysis(
            found.names,
            np.asarray(model.dt * np.arange(len(found.x)), dtype=np.float64),
            found.relative,
            np.sqrt(np.mean(found.relative**2, axis=0)),
            apart.names,
            apart.correlation(sigma),
        )
    return made
