"""Everything of this package, for the models of one artifact: what ``hybrid-mpc analyze`` computes."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from hybrid_mpc.analysis.along import linearize_along
from hybrid_mpc.analysis.contraction import contraction, feature_box, gru_weights
from hybrid_mpc.analysis.equilibria import equilibria
from hybrid_mpc.analysis.friction import friction_slopes, linearize_secant
from hybrid_mpc.analysis.gains import mpc_gain, steady_filter
from hybrid_mpc.analysis.linearize import hidden_fixed_point, linearize, linearize_at_speed
from hybrid_mpc.analysis.loop import Loop, mpc_loop
from hybrid_mpc.analysis.lyapunov import lyapunov_exponent
from hybrid_mpc.analysis.measured import (
    MeasuredResponse,
    multisine_response,
    run_model,
    run_plant,
    welch_response,
)
from hybrid_mpc.analysis.properties import frequency_response
from hybrid_mpc.analysis.reduction import physical_states
from hybrid_mpc.analysis.schedule import gain_schedule, holding_input
from hybrid_mpc.analysis.sensitivity import parameter_sensitivities
from hybrid_mpc.analysis.structure import structure
from hybrid_mpc.analysis.toolbox import control_toolbox
from hybrid_mpc.data.excitation import multisine
from hybrid_mpc.errors import InputError
from hybrid_mpc.estimation.kalman import ExtendedKalmanFilter
from hybrid_mpc.model import HybridModel
from hybrid_mpc.mpc import OCP, CondensedController
from hybrid_mpc.scenario import Plant
from nn_export import Program

Array = NDArray[np.float64]
Say = Callable[[str, int, int, str], None]
Part = tuple[dict[str, Any], dict[str, Any]]
POINTS = ("rest", "working", "moving", "driven")
"""Linearisations: the tangent at rest, the describing function of motions of working size around it, the tangent in
motion at working speed, and the mean along a driven run."""
PERIOD, PERIODS, BAND = 20.0, 4, (0.1, 3.0)
"""The multisine: its period [s], periods that count, and band [Hz]."""
GRID = 21
"""Positions of the gain schedule."""
LEVEL = 0.5
"""Its size over the input's range."""


@dataclass(frozen=True)
class Subject:
    """What is analysed.

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
class Findings:
    """Numbers of an analysis.

    Args:
        result: Plain numbers, for JSON; a part that could not be had holds its ``reason``.
        arrays: Curves by name, ``"bode/hybrid/rest/magnitude"``.
    """

    result: Mapping[str, Any]
    arrays: Mapping[str, Any]


def study(subject: Subject, say: Say | None = None) -> Findings:
    """Analyse the models of a subject, part after part; a part that cannot be had says why.

    Args:
        subject: What is analysed.
        say: Called with ``(part, done, total, text)``. Default: nothing is said.
    """
    result: dict[str, Any] = {}
    arrays: dict[str, Any] = {}
    points = {name: _rest(subject, model) for name, model in subject.models.items()}
    parts: dict[str, Callable[[], Part]] = {
        "equilibria": lambda: _equilibria(subject),
        "friction": lambda: _friction(subject, points),
        "linear": lambda: _linear(subject, points),
        "measured": lambda: _measured(subject),
        "schedule": lambda: _schedule(subject),
        "loops": lambda: _loops(subject, points),
        "memory": lambda: _memory(subject),
        "sensitivity": lambda: _sensitivity(subject),
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


def _rest(subject: Subject, model: HybridModel) -> tuple[Array, Array]:
    """The point of rest without input that is nearest to zero, else zero; with the hidden state there."""
    u = np.zeros(model.n_u)
    found = equilibria(model, u, _pairs(subject.x_range), starts=16).points
    calm = [p for p in found if p.stability == "stable"] or list(found)
    if calm:
        best = min(calm, key=lambda p: float(np.linalg.norm(p.x)))
        return best.x, best.h
    x = np.zeros(model.n_x)
    return x, hidden_fixed_point(model, x, u)


def _pairs(box: Array) -> list[tuple[float, float]]:
    return [(float(a), float(b)) for a, b in box]


def _equilibria(subject: Subject) -> Part:
    outer = subject.x_range if subject.outer is None else subject.outer
    result: dict[str, Any] = {"region": outer}
    for name, model in subject.models.items():
        found = equilibria(model, np.zeros(model.n_u), _pairs(outer))
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


def _friction(subject: Subject, points: Mapping[str, tuple[Array, Array]]) -> Part:
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


def _systems(subject: Subject, name: str, point: tuple[Array, Array]) -> dict[str, Any]:
    model, (x, h), u = subject.models[name], point, np.zeros(subject.models[name].n_u)
    return {
        "rest": linearize(model, x, u, h), "working": linearize_secant(model, x, u, subject.speed, h),
        "moving": linearize_at_speed(model, x[: model.n_x // 2], subject.speed, u),
        "driven": linearize_along(model, x, _drive(subject, model, 30.0), h).mean(round(5.0 / model.dt)),
    }  # fmt: skip


def _linear(subject: Subject, points: Mapping[str, tuple[Array, Array]]) -> Part:
    control = control_toolbox()
    result: dict[str, Any] = {}
    arrays: dict[str, Any] = {}
    half_x, half_u = (0.5 * (box[:, 1] - box[:, 0]) for box in (subject.x_range, subject.u_range))
    for name, model in subject.models.items():
        x, h = points[name]
        result[name] = {"x": x}
        for point, system in _systems(subject, name, points[name]).items():
            found = structure(system)
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
            result[name][point] = row
    return result, arrays


def _measured(subject: Subject) -> Part:
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
        amplitude = LEVEL * float(subject.u_range[0, 1])
        drive: dict[str, Any] = {"amplitude": amplitude, "band": BAND, "period": PERIOD, "periods": PERIODS}
        zero = np.zeros(some.n_x)
        found = {"measured": multisine_response(run_plant(subject.plant, zero, some.dt), some.dt, **drive)}
        found |= {name: multisine_response(run_model(m, zero), m.dt, **drive) for name, m in models.items()}
        source = f"odd multisine of {amplitude:g} {some.inputs[0].unit}, {BAND[0]:g} to {BAND[1]:g} Hz, {PERIODS} periods"
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


def _schedule(subject: Subject) -> Part:
    ocp, result, arrays = subject.ocp, {}, {}
    if ocp is None:
        raise InputError("a gain schedule needs the weights of the scenario's control problem")
    for name, model in sorted(subject.models.items(), key=lambda m: m[1].n_h):
        if model.n_x != 2 or model.n_u != 1:
            raise InputError("the schedule is made over one position with one input")
        points, lost = _held(model, np.linspace(*subject.x_range[0], GRID))
        weights = ocp.q * model.dt, (ocp.r + ocp.r_delta) * model.dt
        result[name] = {"positions_lost": lost}
        for point, speed in (("rest", None), ("working", subject.speed)):
            found = gain_schedule(model, points, *weights, speed=speed)
            key = f"{name}/{point}"
            arrays |= {
                f"{key}/x": found.x,
                f"{key}/u": found.u,
                f"{key}/gain": found.gain,
                f"{key}/radius": found.radius,
            }
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


def _loops(subject: Subject, points: Mapping[str, tuple[Array, Array]]) -> Part:
    """Each model's controller and filter around itself, and the prior's around the hybrid."""
    if subject.ocp is None or not subject.filters:
        raise InputError("loops need the scenario's control problem and the filters' noise")
    pairs = [(n, n) for n in subject.models]
    if {"prior", "hybrid"} <= set(subject.models):
        pairs.append(("prior", "hybrid"))
    result: dict[str, Any] = {}
    arrays: dict[str, Any] = {}
    controllers = {n: CondensedController(m, subject.ocp) for n, m in subject.models.items()}
    systems = {n: _systems(subject, n, points[n]) for n in subject.models}
    for (name, mode), ekf in subject.filters.items():
        model, (x, h), zero = subject.models[name], points[name], np.zeros(subject.models[name].n_u)
        for point in POINTS:
            gain = mpc_gain(controllers[name], x, zero, h, system=systems[name][point])
            steady = steady_filter(ekf, x, zero, h, system=systems[name][point])
            for around in (plant for own, plant in pairs if own == name):
                loop = mpc_loop(gain, steady, systems[around][point])
                key = f"{name} on {around}"
                row, curves = _judged(loop, model.dt)
                row["gain"] = gain.by_state[:, : model.n_x]
                result.setdefault(key, {}).setdefault(point, {})[mode] = row
                arrays |= {f"{key}/{point}/{mode}/{k}": v for k, v in curves.items()}
    return result, arrays


def _judged(loop: Loop, dt: float) -> Part:
    row: dict[str, Any] = {"stable": loop.stable, "radius": abs(loop.poles[0])}
    omega = np.geomspace(0.05, np.pi / dt, 500)
    response = frequency_response(loop.broken(), omega)
    curves: dict[str, Any] = {
        "omega": omega, "L": response.magnitude[0, 0] * np.exp(1j * response.phase[0, 0])
    }  # fmt: skip
    if loop.stable:
        row["margins"] = {k: v for k, v in vars(loop.margins()).items()}
        functions = loop.sensitivity(omega)
        curves |= {k: functions[k][0, 0] for k in ("S", "T", "KS", "GS")}
        row["peak_S"], row["peak_T"] = (float(np.abs(functions[k][0, 0]).max()) for k in ("S", "T"))
    return row, curves


def _drive(subject: Subject, model: HybridModel, seconds: float) -> Array:
    t = model.dt * np.arange(round(seconds / model.dt))
    u = multisine(t, LEVEL * float(subject.u_range[0, 1]), 0.1, 1.5)
    return np.tile(u[:, None], (1, model.n_u))


def _memory(subject: Subject) -> Part:
    """Does the recurrent part forget? The certificate over the working range, and exponents of driven runs."""
    result: dict[str, Any] = {}
    arrays: dict[str, Any] = {}
    for name, model in subject.models.items():
        u, zero = _drive(subject, model, 30.0), np.zeros(model.n_x)
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


def _sensitivity(subject: Subject) -> Part:
    result: dict[str, Any] = {}
    arrays: dict[str, Any] = {}
    for name, model in subject.models.items():
        u = _drive(subject, model, 10.0)
        found = parameter_sensitivities(subject.programs[f"{name}/step"], np.zeros(model.n_x), u)
        sigma = np.full(model.n_x, np.inf)
        sigma[: model.n_y] = 1.0  # positions are what is measured
        apart = found.apart(sigma)
        rms = np.sqrt(np.mean(found.relative**2, axis=0))
        result[name] = {
            "parameters": [n.removeprefix("prior.") for n in found.names], "rms_per_100_percent": rms,
            "told_apart": [n.removeprefix("prior.") for n in apart.names], "correlation": apart.correlation(sigma),
        }  # fmt: skip
        arrays |= {f"{name}/t": model.dt * np.arange(len(found.x)), f"{name}/relative": found.relative}
    return result, arrays
