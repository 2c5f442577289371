"""Everything of this package, for the models of one artifact: what ``hybrid-mpc analyze`` computes."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, TypeAlias

import numpy as np
from numpy.typing import NDArray

from hybrid_mpc.analyze.equilibria import equilibria, hidden_equilibrium, holding_input
from hybrid_mpc.analyze.linearize import (
    control_toolbox,
    friction_slopes,
    linearize,
    linearize_along,
    linearize_at_speed,
    linearize_secant,
)
from hybrid_mpc.analyze.margins import LinearLoop, gain_schedule, mpc_gain, mpc_loop, steady_filter
from hybrid_mpc.analyze.measured import (
    MeasuredResponse,
    multisine_response,
    run_model,
    run_plant,
    welch_response,
)
from hybrid_mpc.analyze.memory import contraction, feature_box, gru_weights, lyapunov_exponent
from hybrid_mpc.analyze.properties import frequency_response, physical_states, system_structure
from hybrid_mpc.analyze.sensitivity import parameter_sensitivities
from hybrid_mpc.control.ocp import OCP
from hybrid_mpc.control.rti import CondensedController
from hybrid_mpc.data.excitation import multisine
from hybrid_mpc.errors import InputError
from hybrid_mpc.estimate.kalman import ExtendedKalmanFilter
from hybrid_mpc.estimate.switching import SwitchingFilter
from hybrid_mpc.kit.artifact import FILE, Kit, artifact_folder, load
from hybrid_mpc.loop.plant import Plant
from hybrid_mpc.machine.signals import Signal
from hybrid_mpc.model.model import HybridModel
from hybrid_mpc.scenario import Scenario, scenario_of
from nn_export import Program, load_programs

# From an artifact folder and a scenario to what is analyzed.

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Subject:
    """What is analyzed.

    Args:
        models: By name; ``"prior"`` and ``"hybrid"`` are compared.
        programs: Exported programs of the artifact, ``"prior/step"`` and so on.
        x_range: Working range of the states ``(n_x, 2)``.
        u_range: That of the inputs ``(n_u, 2)``.
        speed: Working speeds ``(n_x / 2,)``.
        ocp: The control problem; default: none, then there are no loops.
        filters: Estimators by model and mode, ``("hybrid", "quiet")``; default: none.
        plant: The simulated machine; default: none.
        recordings: Inputs ``(n,)``, outputs ``(n,)`` and first states of recordings; default: none.
        outer: Range in which points of rest are looked for ``(n_x, 2)``. Default: ``x_range``.
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
    outer: Array | None = None


@dataclass(frozen=True)
class Request:
    """What is to be analyzed, as it is asked for.

    Args:
        folder: Artifact folder, or the folder of the run that holds it as ``model``.
        scenario: Name or file. Default: the one that the artifact names; without any the artifact's own control problem
            and noise make the loops, where it holds them.
        data: Recordings.
        speed: Working speed. Default: that of the scenario's weights, else 1.
        seed: Of the recordings that the scenario makes to estimate the filters' noise on, if the artifact holds none.
    """

    folder: Path
    scenario: str = ""
    data: tuple[Path, ...] = ()
    speed: float | None = None
    seed: int = 0


def subject_of(request: Request) -> tuple[Subject, tuple[str, ...]]:
    """What is analyzed, and in words where it came from.

    Args:
        request: What is asked for.

    Raises:
        InputError: If there is no artifact, the scenario does not fit it, or a recording is bad.
    """
    folder = artifact_folder(request.folder)
    artifact = load(folder)
    scenario = scenario_of(artifact.provenance.scenario, folder / FILE, request.scenario)
    name = "" if scenario is None else scenario.name
    if scenario is None and request.data:
        raise InputError("--data needs --scenario: only it says which columns are which")
    model = next(iter(artifact.models.values()))
    if scenario is not None:
        artifact = artifact.on(scenario)
    control = artifact.control
    speed = _speed(model, control, request.speed)
    notes = [f"scenario {name}" if name else "no scenario: no response of a machine"]
    ocp: OCP | None = None
    filters: dict[tuple[str, str], ExtendedKalmanFilter] = {}
    told = scenario is not None or {"prior_observer", "hybrid_observer"} <= set(artifact.loop.process_noise)
    if control is not None and not told:
        notes.append("no loops: the model holds no process noise for its filters; run the scenario again")
    if control is not None and told and {"prior", "hybrid"} <= set(artifact.models):
        from hybrid_mpc.kit.assembly import make_ocp

        ocp = make_ocp(artifact.models["prior"], control)
        filters, source = _filters(request, scenario, artifact)
        notes.append(f"filters' noise: {source}")
    subject = Subject(
        artifact.models, load_programs(folder), _range(model, control), _inputs(model, control), speed, ocp, filters,
        scenario.plant() if scenario is not None and scenario.plant is not None else None,
        _recordings(request, scenario, model), _outer(model),
    )  # fmt: skip
    return subject, tuple(notes)


def _speed(model: HybridModel, control: OCP | None, given: float | None) -> Array:
    n_v = model.n_x - model.n_x // 2
    if given is not None:
        if not (np.isfinite(given) and given > 0):
            raise InputError(f"--speed must be positive, got {given}")
        return np.full(n_v, given)
    if control is None:
        return np.ones(n_v)
    weights = control.q[model.n_x // 2 :]
    return 1.0 / np.sqrt(np.where(weights > 0, weights, 1.0))


def _range(model: HybridModel, control: OCP | None) -> Array:
    """Working range of the states: the limits of the control problem, else the signals', else a unit."""
    none = np.full(model.n_x, np.inf)
    lower, upper = (-none, none) if control is None else (control.x_min, control.x_max)
    sides = zip(model.states, lower.tolist(), upper.tolist(), strict=True)
    return np.array([_within(s, _unit(s), low, high) for s, low, high in sides])


def _outer(model: HybridModel) -> Array:
    """Whole range of the states: the signals', a turn for an angle that turns, else a unit either way."""
    return np.array([_within(s, _unit(s)) for s in model.states])


def _inputs(model: HybridModel, control: OCP | None) -> Array:
    if control is None:
        return np.array([_within(s, 1.0) for s in model.inputs])
    sides = zip(model.inputs, control.input_scale, control.u_min, control.u_max, strict=True)
    return np.array([_within(s, size, low, high) for s, size, low, high in sides])


def _unit(signal: Signal) -> float:
    return np.pi if signal.periodic else 1.0


def _within(
    signal: Signal, size: float, lower: float = -np.inf, upper: float = np.inf
) -> tuple[float, float]:
    """The limits of a signal where they are finite, else its own; a side without either ends at ``size``, and at least
    so far from the other side.
    """
    low = lower if np.isfinite(lower) else signal.lower
    high = upper if np.isfinite(upper) else signal.upper
    if not np.isfinite(low):
        low = min(-size, high - size) if np.isfinite(high) else -size
    return low, high if np.isfinite(high) else max(size, low + size)


def _filters(
    request: Request, scenario: Scenario | None, kit: Kit
) -> tuple[dict[tuple[str, str], ExtendedKalmanFilter], str]:
    """The observers of the closed loops: while nothing happens, and in the periods after a load came or went."""
    from hybrid_mpc.kit.assembly import MODES

    source = "the model's own"
    if scenario is not None:
        from hybrid_mpc.job.controllers import find_noise

        noise, source = find_noise(scenario, kit, ("prior_observer", "hybrid_observer"), request.seed)
        kit = kit.with_noise(noise)
    filters = {}
    for mode in ("quiet", "jump"):
        for name in ("prior", "hybrid"):
            switching = kit.observer(name)
            assert isinstance(switching, SwitchingFilter)
            filters[name, mode] = switching.filters[MODES.index(mode)]
    return filters, source


def _recordings(
    request: Request, scenario: Scenario | None, model: HybridModel
) -> tuple[tuple[Array, Array, Array], ...]:
    if not request.data or scenario is None:
        return ()
    from hybrid_mpc.data.trajectories import load_trajectories

    found = load_trajectories(
        request.data, scenario.data, outputs=model.outputs, inputs=model.inputs, states=model.states
    )
    return tuple((piece.u[:, 0], piece.y[:, 0], piece.x[0]) for piece in found.whole)


# Parts of a study: the models by themselves.

Part: TypeAlias = tuple[dict[str, Any], dict[str, Any]]
"""Plain numbers, and curves by name."""
POINTS = ("rest", "working", "moving", "driven")
"""Linearizations: the tangent at rest, the describing function of motions of working size around it, the tangent in
motion at working speed, and the mean along a driven run."""
FARTHEST = 1e6
"""Zeros farther out belong to a way through the system that begins later: rounding, over the fall of its gain."""
LEVEL = 0.5
"""Size of the multisine over half the input's range."""


def rest(subject: Subject, model: HybridModel) -> tuple[Array, Array]:
    """The point of rest without input that is nearest to zero, else zero; with the hidden state there."""
    u = np.zeros(model.n_u)
    found = equilibria(model, u, pairs(subject.x_range), starts=16).points
    calm = [p for p in found if p.stability == "stable"] or list(found)
    if calm:
        best = min(calm, key=lambda p: float(np.linalg.norm(p.x)))
        return best.x, best.h
    x = np.zeros(model.n_x)
    return x, hidden_equilibrium(model, x, u)


def pairs(box: Array) -> list[tuple[float, float]]:
    """Rows of a box as pairs."""
    return [(float(a), float(b)) for a, b in box]


def equilibria_part(subject: Subject) -> Part:
    """Points of rest of each model in the whole range of the states."""
    outer = subject.x_range if subject.outer is None else subject.outer
    result: dict[str, Any] = {"region": outer}
    for name, model in subject.models.items():
        found = equilibria(model, np.zeros(model.n_u), pairs(outer))
        rows = [
            {
                "x": p.x,
                "residual": p.residual,
                "radius": abs(p.poles[0]),
                "stability": p.stability,
                "hits": p.hits,
            }
            for p in found.points
        ]
        counts = {"starts": found.starts, "converged": found.converged, "unseen": found.unseen}
        result[name] = {"points": rows, **counts}
    return result, {}


def friction_part(subject: Subject, points: Mapping[str, tuple[Array, Array]]) -> Part:
    """Damping at rest, as chords and in motion."""
    result: dict[str, Any] = {"working_speed": subject.speed}
    arrays: dict[str, Any] = {}
    for name, model in subject.models.items():
        q = points[name][0][: model.n_x // 2]
        work = float(subject.speed[0])
        found = friction_slopes(model, q, work * np.geomspace(0.01, 10.0, 61))
        at_work = friction_slopes(model, q, [work])
        result[name] = {
            "tangent_1_s": found.tangent, "secant_1_s": at_work.secant[0], "harmonic_1_s": at_work.harmonic[0],
            "moving_1_s": at_work.moving[0], "per_input": found.per_input,
        }  # fmt: skip
        arrays |= {f"{name}/{key}": getattr(found, key) for key in ("speed", "secant", "harmonic", "moving")}
    return result, arrays


def systems(subject: Subject, name: str, point: tuple[Array, Array]) -> dict[str, Any]:
    """The linearizations of a model, by the names in :data:`POINTS`."""
    model, (x, h), u = subject.models[name], point, np.zeros(subject.models[name].n_u)
    return {
        "rest": linearize(model, x, u, h), "working": linearize_secant(model, x, u, subject.speed, h),
        "moving": linearize_at_speed(model, x[: model.n_x // 2], subject.speed, u),
        "driven": linearize_along(model, x, drive(subject, model, 30.0), h).mean(round(5.0 / model.dt)),
    }  # fmt: skip


def linear_part(subject: Subject, points: Mapping[str, tuple[Array, Array]]) -> Part:
    """Modes, reduced systems, frequency and step responses of the linearizations."""
    control = control_toolbox()
    result: dict[str, Any] = {}
    arrays: dict[str, Any] = {}
    half_x, half_u = (0.5 * (box[:, 1] - box[:, 0]) for box in (subject.x_range, subject.u_range))
    for name, model in subject.models.items():
        x, h = points[name]
        result[name] = {"x": x}
        for point, system in systems(subject, name, points[name]).items():
            found = system_structure(system)
            row: dict[str, Any] = found.to_dict()
            omega = np.geomspace(0.02, np.pi / model.dt, 400)
            curves = {"": system}
            if model.n_h:
                try:
                    small = physical_states(
                        model, x, np.zeros(model.n_u), h, x_scale=half_x, u_scale=half_u, system=system
                    )
                    row["reduced"] = {
                        "A": small.system.A, "B": small.system.B, "bound": small.bound, "hankel": small.hankel,
                    }  # fmt: skip
                    curves["_reduced"] = small.system
                except InputError as none:
                    row["reduced"] = {"reason": str(none)}
            for suffix, one in curves.items():
                response = frequency_response(one, omega)
                key = f"{name}/{point}{suffix}"
                arrays |= {
                    f"{key}/omega": omega, f"{key}/magnitude": response.magnitude, f"{key}/phase": response.phase
                }  # fmt: skip
            t = model.dt * np.arange(round(4.0 / model.dt) + 1)
            step = control.step_response(system, t)
            arrays |= {f"{name}/{point}/t": t, f"{name}/{point}/step": step.outputs}
            arrays[f"{name}/{point}/poles"] = np.array([m.pole for m in found.modes])
            if model.n_u == model.n_y:
                arrays[f"{name}/{point}/zeros"] = _zeros(system)
            result[name][point] = row
    return result, arrays


def _zeros(system: Any) -> NDArray[np.complex128]:
    """Zeros of a square system; those that rounding alone keeps from infinity are left out."""
    found = np.asarray(system.zeros(), dtype=np.complex128)
    return found[np.abs(found) < FARTHEST]


def drive(subject: Subject, model: HybridModel, seconds: float) -> Array:
    """A multisine ``(n, n_u)`` of working size around the middle of each input's range."""
    t = np.asarray(model.dt * np.arange(round(seconds / model.dt)), dtype=np.float64)
    sizes = [(LEVEL * 0.5 * (high - low), 0.5 * (low + high)) for low, high in pairs(subject.u_range)]
    return np.column_stack([multisine(t, size, 0.1, 1.5, offset=middle) for size, middle in sizes])


# Parts of a study: responses to signals, memory, parameters.

PERIOD, PERIODS, BAND = 20.0, 4, (0.1, 3.0)
"""The multisine: its period [s], periods that count, and band [Hz]."""


def measured_part(subject: Subject) -> Part:
    """Response of machine and models to the same inputs; recordings where there are some, else the simulated plant."""
    models = subject.models
    some = next(iter(models.values()))
    if some.n_u != 1:
        raise InputError(f"responses are estimated for one input; this machine has {some.n_u}")
    if subject.recordings:
        length = min(10.0, 0.25 * max(u.size for u, _, _ in subject.recordings) * some.dt)
        found = {
            "measured": welch_response([(u, y) for u, y, _ in subject.recordings], some.dt, length=length)
        }
        for name, model in models.items():
            pieces = [(u, run_model(model, x0)(u)) for u, _, x0 in subject.recordings]
            found[name] = welch_response(pieces, some.dt, length=length)
        source = f"H1 estimate of {len(subject.recordings)} recordings, Hann windows of {length:g} s"
    elif subject.plant is not None:
        low_u, high_u = subject.u_range[0].tolist()
        amplitude, bias = LEVEL * 0.5 * (high_u - low_u), 0.5 * (low_u + high_u)
        driven: dict[str, Any] = {
            "amplitude": amplitude, "bias": bias, "band": BAND, "period": PERIOD, "periods": PERIODS
        }  # fmt: skip
        zero = np.zeros(some.n_x)
        found = {"measured": multisine_response(run_plant(subject.plant, zero, some.dt), some.dt, **driven)}
        found |= {name: multisine_response(run_model(m, zero), m.dt, **driven) for name, m in models.items()}
        size, (low, high) = f"{amplitude:g} {some.inputs[0].unit}", BAND
        around = f" around {bias:g}" if bias else ""
        source = f"odd multisine of {size}{around}, {low:g} to {high:g} Hz, {PERIODS} periods"
    else:
        raise InputError(
            "there is neither a recording (--data) nor a simulated machine to take a response from"
        )
    result: dict[str, Any] = {"source": source}
    arrays: dict[str, Any] = {}
    for name, one in found.items():
        keys = ("omega", "response", "coherence", "deviation")
        arrays |= {f"{name}/{key}": getattr(one, key) for key in keys}
        if name != "measured":
            result[name] = _distance(one, found["measured"])
    return result, arrays


def _distance(model: MeasuredResponse, machine: MeasuredResponse) -> dict[str, float]:
    """Relative distance of two responses where the machine's own is clean: median and largest over frequencies."""
    clean = (machine.coherence > 0.8) & np.isfinite(machine.response) & np.isfinite(model.response)
    if not clean.any():
        raise InputError("responses: at no frequency is the coherence above 0.8; excite the machine harder")
    off = np.abs(model.response - machine.response)[clean] / np.abs(machine.response[clean])
    return {"median_relative_error": float(np.median(off)), "largest_relative_error": float(off.max())}


def memory_part(subject: Subject) -> Part:
    """Does the recurrent part forget? The certificate over the working range, and exponents of driven runs."""
    result: dict[str, Any] = {}
    arrays: dict[str, Any] = {}
    for name, model in subject.models.items():
        u, zero = drive(subject, model, 30.0), np.zeros(model.n_x)
        parts = ("all", "hidden") if model.n_h else ("all",)
        row: dict[str, Any] = {}
        for part in parts:
            found = lyapunov_exponent(model, zero, u, part=part)  # type: ignore[arg-type]
            row[f"lyapunov_{part}_1_s"], row[f"lyapunov_{part}_deviation"] = found.value, found.deviation
            arrays[f"{name}/{part}/growth"] = found.growth
        if model.n_h:
            program = subject.programs[f"{name}/step"]
            try:
                box = feature_box(program, subject.x_range, subject.u_range)
                row["certificate"] = {
                    k: v for k, v in vars(contraction(gru_weights(program), *box)).items()
                    if k in ("certified", "index", "margin", "rate")
                }  # fmt: skip
            except InputError as none:
                row["certificate"] = {"reason": str(none)}
        result[name] = row
    return result, arrays


def sensitivity_part(subject: Subject) -> Part:
    """A driven run's derivatives by the prior's parameters."""
    result: dict[str, Any] = {}
    arrays: dict[str, Any] = {}
    for name, model in subject.models.items():
        u = drive(subject, model, 10.0)
        found = parameter_sensitivities(model, np.zeros(model.n_x), u)
        sigma = np.full(model.n_x, np.inf)
        sigma[: model.n_y] = 1.0  # positions are what is measured
        apart = found.apart(sigma)
        rms = np.sqrt(np.mean(found.relative**2, axis=0))
        result[name] = {
            "parameters": found.names, "rms_per_100_percent": rms,
            "told_apart": apart.names, "correlation": apart.correlation(sigma),
        }  # fmt: skip
        arrays |= {f"{name}/t": model.dt * np.arange(len(found.x)), f"{name}/relative": found.relative}
    return result, arrays


# Parts of a study: gain schedules and control loops.

GRID = 21
"""Positions of the gain schedule."""


def schedule_part(subject: Subject) -> Part:
    """LQR gains over the positions of the working range."""
    ocp = subject.ocp
    result: dict[str, Any] = {}
    arrays: dict[str, Any] = {}
    if ocp is None:
        raise InputError("a gain schedule needs the weights of the scenario's control problem")
    for name, model in sorted(subject.models.items(), key=lambda m: m[1].n_h):
        if model.n_x != 2 or model.n_u != 1:
            raise InputError("the schedule is made over one position with one input")
        points, lost = _held(model, np.linspace(subject.x_range[0, 0], subject.x_range[0, 1], GRID))
        weights = ocp.q * model.dt, (ocp.r + ocp.r_delta) * model.dt
        result[name] = {"positions_lost": lost}
        for point, speed in (("rest", None), ("working", subject.speed)):
            found = gain_schedule(model, points, *weights, speed=speed)
            key = f"{name}/{point}"
            arrays |= {f"{key}/{k}": getattr(found, k) for k in ("x", "u", "gain", "radius")}
            result[name][point] = {
                "gain_lowest": found.gain[:, 0, :2].min(axis=0), "gain_highest": found.gain[:, 0, :2].max(axis=0),
                "radius": found.radius.max(), "holding_input": [float(found.u.min()), float(found.u.max())],
            }  # fmt: skip
    return result, arrays


def _held(model: HybridModel, positions: Array) -> tuple[list[tuple[Array, Array]], list[float]]:
    """Points of rest at positions, outwards from zero, each begun at its neighbour's input; and those without one."""
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
            f"model {model.name}: no position of the range can be held by an input that was found"
        )
    return [(np.array([q, 0.0]), found[q]) for q in sorted(found)], sorted(lost)


def loops_part(subject: Subject, points: Mapping[str, tuple[Array, Array]]) -> Part:
    """Each model's controller and filter around itself, and the prior's around the hybrid."""
    if subject.ocp is None or not subject.filters:
        raise InputError("loops need the scenario's control problem and the filters' noise")
    pairs = [(n, n) for n in subject.models]
    if {"prior", "hybrid"} <= set(subject.models):
        pairs.append(("prior", "hybrid"))
    result: dict[str, Any] = {}
    arrays: dict[str, Any] = {}
    controllers = {n: CondensedController(m, subject.ocp) for n, m in subject.models.items()}
    made = {n: systems(subject, n, points[n]) for n in subject.models}
    for (name, mode), ekf in subject.filters.items():
        model, (x, h), zero = subject.models[name], points[name], np.zeros(subject.models[name].n_u)
        for point in POINTS:
            gain = mpc_gain(controllers[name], x, zero, h, system=made[name][point])
            steady = steady_filter(ekf, x, zero, h, system=made[name][point])
            for around in (plant for own, plant in pairs if own == name):
                loop = mpc_loop(gain, steady, made[around][point])
                key = f"{name} on {around}"
                row, curves = _judged(loop, model.dt)
                row["gain"] = gain.by_state[:, : model.n_x]
                result.setdefault(key, {}).setdefault(point, {})[mode] = row
                arrays |= {f"{key}/{point}/{mode}/{k}": v for k, v in curves.items()}
    return result, arrays


def _judged(loop: LinearLoop, dt: float) -> Part:
    row: dict[str, Any] = {"stable": loop.stable, "radius": abs(loop.poles[0])}
    omega = np.geomspace(0.05, np.pi / dt, 500)
    response = frequency_response(loop.broken(), omega)
    curves: dict[str, Any] = {
        "omega": omega, "L": response.magnitude[0, 0] * np.exp(1j * response.phase[0, 0])
    }  # fmt: skip
    if loop.stable:
        row["margins"] = dict(vars(loop.margins()))
        functions = loop.sensitivity(omega)
        curves |= {k: functions[k][0, 0] for k in ("S", "T", "KS", "GS")}
        row["peak_S"], row["peak_T"] = (float(np.abs(functions[k][0, 0]).max()) for k in ("S", "T"))
    return row, curves


Say = Callable[[str, int, int, str], None]


@dataclass(frozen=True)
class Findings:
    """Numbers of an analysis.

    Args:
        result: Plain numbers, for JSON; a part that could not be had holds its ``reason``.
        arrays: Curves by name, ``"bode/hybrid/rest/magnitude"``.
    """

    result: Mapping[str, Any]
    arrays: Mapping[str, Any]


def study(subject: Subject, say: Say | None = None) -> Findings:
    """Analyze the models of a subject, part after part; a part that cannot be had says why.

    Args:
        subject: What is analyzed.
        say: Called with ``(part, done, total, text)``. Default: nothing is said.
    """
    result: dict[str, Any] = {}
    arrays: dict[str, Any] = {}
    points = {name: rest(subject, model) for name, model in subject.models.items()}
    parts: dict[str, Callable[[], Part]] = {
        "equilibria": lambda: equilibria_part(subject),
        "friction": lambda: friction_part(subject, points),
        "linear": lambda: linear_part(subject, points),
        "measured": lambda: measured_part(subject),
        "schedule": lambda: schedule_part(subject),
        "loops": lambda: loops_part(subject, points),
        "memory": lambda: memory_part(subject),
        "sensitivity": lambda: sensitivity_part(subject),
    }
    for i, (name, part) in enumerate(parts.items()):
        if say is not None:
            say("parts", i, len(parts), name)
        try:
            result[name], found = part()
            arrays |= {f"{name}/{key}": value for key, value in found.items()}
        except InputError as error:
            result[name] = {"reason": str(error)}
    return Findings(result, arrays)


__all__ = ["POINTS", "Findings", "Subject", "study"]
