"""The figures of an analysis."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.figure import Figure

from hybrid_mpc.analysis.study import POINTS, Findings, Subject
from hybrid_mpc.plots import analysis, analysis_loops, analysis_models, save

Named = Iterator[tuple[str, Figure, str]]
_TITLES = {
    "rest": "at rest, where the slope of dry friction dominates", "working": "with friction of working size",
    "moving": "in motion at working speed", "driven": "along a driven run, on average",
}  # fmt: skip

_NOTES = {"moving": " A phase that rises at the resonance tells of negative damping."}


def figures(folder: Path, subject: Subject, findings: Findings) -> dict[str, tuple[Path, str]]:
    """Draw what was found; parts that could not be had have no figure.

    Args:
        folder: Where the PNG files go; made if missing.
        subject: What was analysed.
        findings: What was found.

    Returns:
        Path and caption by name.
    """
    parts: Mapping[str, Callable[[Subject, Findings], Named]] = {
        "friction": _friction, "linear": _linear, "measured": _measured, "loops": _loops, "schedule": _schedule,
        "sensitivity": _sensitivity,
    }  # fmt: skip
    drawn = {}
    for part, draw in parts.items():
        if "reason" in findings.result[part]:
            continue
        for name, figure, caption in draw(subject, findings):
            drawn[name] = save(figure, folder / f"{name}.png"), caption
    return drawn


def _friction(subject: Subject, f: Findings) -> Named:
    some = _some(subject)
    curves = {
        name: {k: f.arrays[f"friction/{name}/{k}"] for k in ("speed", "secant", "harmonic", "moving")}
        | {"tangent": np.asarray(f.result["friction"][name]["tangent_1_s"])}
        for name in _names(subject)
    }
    unit = some.states[some.n_x // 2].unit
    figure = analysis_models.friction_damping(curves, working_speed=float(subject.speed[0]), unit=unit)
    yield (
        "friction",
        figure,
        "Damping as seen at rest and by motions of a size; negative slopes are left out.",
    )


def _linear(subject: Subject, f: Findings) -> Named:
    some = _some(subject)
    for point, figure in (("rest", "poles"), ("driven", "poles_driven")):
        poles, zeros = (
            {n: f.arrays.get(f"linear/{n}/{point}/{kind}", ()) for n in _names(subject)}
            for kind in ("poles", "zeros")
        )
        caption = f"Poles and zeros of the linearisations {_TITLES[point]}."
        yield figure, analysis.pole_map(poles, some.dt, zeros=zeros), caption
    signals: dict[str, Any] = {"input_signal": some.inputs[0], "output_signal": some.outputs[0]}
    for point in POINTS:
        curves = {}
        for key in (f"{name}{suffix}" for name in _names(subject) for suffix in ("", "_reduced")):
            name = key.removesuffix("_reduced")
            at = f"linear/{name}/{point}{key[len(name) :]}"
            if f"{at}/omega" in f.arrays:
                label = name if key == name else f"{name}, reduced to {some.n_x} states"
                curves[label] = (
                    f.arrays[f"{at}/omega"], f.arrays[f"{at}/magnitude"][0, 0], f.arrays[f"{at}/phase"][0, 0]
                )  # fmt: skip
        drawn = analysis.bode(curves, **signals, nyquist=np.pi / some.dt)
        yield (
            f"bode_{point}",
            drawn,
            f"Bode plot of the linearisations {_TITLES[point]}.{_NOTES.get(point, '')}",
        )
    steps = {
        point: {
            name: (f.arrays[f"linear/{name}/{point}/t"], np.reshape(
                f.arrays[f"linear/{name}/{point}/step"], (some.n_y, some.n_u, -1))[0, 0])
            for name in _names(subject)
        }
        for point in POINTS
    }  # fmt: skip
    yield (
        "steps",
        analysis_models.step_responses(steps, **signals),
        "Unit step responses of the linearisations.",
    )


def _measured(subject: Subject, f: Findings) -> Named:
    some = _some(subject)
    keys = ("omega", "response", "coherence", "deviation")
    curves = {n: {k: f.arrays[f"measured/{n}/{k}"] for k in keys} for n in ("measured", *_names(subject))}
    figure = analysis_models.measured_bode(
        curves,
        input_signal=some.inputs[0],
        output_signal=some.outputs[0],
        source=f.result["measured"]["source"],
    )
    yield (
        "measured",
        figure,
        "Machine and models driven by the same inputs; band: two deviations.",
    )


def _loops(subject: Subject, f: Findings) -> Named:
    shown, curves = {}, {}
    for loop, points in f.result["loops"].items():
        for mode, row in points["driven"].items():
            at = f"loops/{loop}/driven/{mode}"
            label = f"{loop}, {mode}"
            curves[label] = f.arrays[f"{at}/L"]
            if row["stable"]:
                shown[label] = {k: f.arrays[f"{at}/{k}"] for k in ("omega", "S", "T")}
    if shown:
        caption = "Sensitivity functions at the plant's input, linearised along a driven run."
        yield "sensitivity", analysis_loops.sensitivity_functions(shown), caption
    caption = "Nyquist curves of the loops, linearised along a driven run; positive frequencies."
    yield "nyquist", analysis_loops.nyquist(curves, modulus=0.5), caption


def _schedule(subject: Subject, f: Findings) -> Named:
    some = _some(subject)
    curves: dict[str, dict[str, Any]] = {}
    for name in _names(subject):
        for point in ("rest", "working"):
            x, gain = (f.arrays[f"schedule/{name}/{point}/{key}"] for key in ("x", "gain"))
            curves.setdefault(name, {})[point] = x[:, 0], gain[:, 0, : some.n_x]
    figure = analysis_loops.gain_schedules(curves, position=some.states[0], states=some.states)
    yield "schedule", figure, "LQR gains over the position: tangent at rest, and friction of working size."


def _sensitivity(subject: Subject, f: Findings) -> Named:
    some = _some(subject)
    first = next(iter(subject.models))
    relative = {name: f.arrays[f"sensitivity/{name}/relative"][:, 0] for name in _names(subject)}
    names = f.result["sensitivity"][first]["parameters"]
    figure = analysis_models.sensitivities(
        f.arrays[f"sensitivity/{first}/t"], relative, names, output_signal=some.states[0]
    )
    yield (
        "sensitivity_parameters",
        figure,
        "Change of a free run per relative change of the prior's parameters.",
    )


def _names(subject: Subject) -> list[str]:
    """Models in the order they are drawn in: priors first, so that what has a network lies above them."""
    return sorted(subject.models, key=lambda name: subject.models[name].n_h)


def _some(subject: Subject) -> Any:
    return next(iter(subject.models.values()))
