"""Parts of a study: responses to signals, memory, parameters."""

from __future__ import annotations

from typing import Any

import numpy as np

from hybrid_mpc.analysis.contraction import contraction, feature_box, gru_weights
from hybrid_mpc.analysis.lyapunov import lyapunov_exponent
from hybrid_mpc.analysis.measured import (
    MeasuredResponse,
    multisine_response,
    run_model,
    run_plant,
    welch_response,
)
from hybrid_mpc.analysis.sensitivity import parameter_sensitivities
from hybrid_mpc.analysis.study_models import LEVEL, Part, drive
from hybrid_mpc.analysis.subject import Subject
from hybrid_mpc.errors import InputError

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
