"""A synthetic main job: every figure and the whole report, from made-up signals."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from hybrid_mpc import Signal
from hybrid_mpc.plots import analysis, data, estimation, fit, loops, monitor
from hybrid_mpc.plots.style import name_of, save
from hybrid_mpc.report.page import KeyFigure, Report, Section, Table, words
from hybrid_mpc.watch.detector import ChannelLimit, WatchLimits
from hybrid_mpc.watch.readings import Channel
from hybrid_mpc.watch.replay import Trace
from hybrid_mpc.workflow.stages.report import TITLES

STATES = (Signal("phi", "rad"), Signal("phi_dot", "rad/s"))
INPUTS = (Signal("tau", "N m"),)
OUTPUTS = (Signal("phi", "rad"),)
MODELS = ("phy_nominal", "phy", "rnn", "pgrnn", "mopgrnn")


@dataclass(frozen=True)
class Piece:
    name: str
    role: str
    t: np.ndarray
    u: np.ndarray
    y: np.ndarray
    x: np.ndarray


def swing(t, amplitude=0.9, omega=2.4, late=0.0, scale=1.0):
    envelope = amplitude * scale * (0.6 + 0.4 * np.cos(0.31 * t))
    phase = omega * (t - late)
    return np.column_stack([envelope * np.sin(phase), envelope * omega * np.cos(phase)])


def pieces():
    out = []
    for i, (stem, parts) in enumerate(
        {
            "sine_01": [("train", 0, 20)],
            "chirp_02": [("train", 0, 12), ("valid", 12.5, 20)],
            "step_$3": [("train", 0, 8), ("test", 9, 20)],
            "sine_04": [("test", 0, 20)],
            "sine_05": [("train", 0, 20)],
        }.items()
    ):
        for k, (role, start, end) in enumerate(parts):
            t = np.arange(start, end, 0.02)
            x = swing(t, 0.5 + 0.12 * i, 1.6 + 0.25 * i)
            u = 0.2 * np.sign(np.sin((0.5 + 0.2 * i) * t))[:, None]
            name = stem if k == 0 else f"{stem}#{k + 1}"
            out.append(Piece(name, role, t, u, x[:, :1], x))
    return out


def free_run_figure():
    t = np.arange(0.0, 20.0, 0.02)
    x = swing(t)
    how = {"phy_nominal": (0.012, 1.35), "phy": (0.004, 1.1), "rnn": (-0.006, 0.9), "mopgrnn": (0.001, 1.01)}
    runs = {}
    for model, (drift, scale) in how.items():
        runs[model] = swing(t, late=drift * t, scale=1 + (scale - 1) * t / 20)
        runs[model][t < 0.5] = np.nan
    u = 0.2 * np.sin(1.1 * t)[:, None]
    rng = np.random.default_rng(0)
    measured = 0.03 * np.sin(2.4 * t) ** 2 + 0.004 * rng.standard_normal(len(t))
    model = 0.028 * np.sin(2.4 * t + 0.1) ** 2
    balances = [
        fit.BalanceRun("energy", "W", measured, model),
        fit.BalanceRun("water", "kg/s", 3 * model, measured),
    ]
    return fit.free_run(t, x, runs, u, signals=STATES, inputs=INPUTS, balances=balances)


def training_figure():
    step = np.arange(0.0, 500.0, 2.0)
    rng = np.random.default_rng(1)
    out = {}
    for i, model in enumerate(("rnn", "pgrnn", "mopgrnn")):
        fall = (1.5 - 0.4 * i) * np.exp(-step / 120) + 0.05 * (3 - i)
        noisy = fall * np.exp(0.08 * rng.standard_normal(len(step)))
        out[model] = {"step": step, "loss_error": noisy}
        out[model]["validation"] = np.where(np.arange(len(step)) % 10 == 0, 0.4 * fall, np.nan)
    energy = 0.03 * np.exp(-step / 150) + 0.002
    bound = 1.1 * np.minimum.accumulate(out["mopgrnn"]["loss_error"])
    out["mopgrnn"] |= {"loss_energy": energy, "bound_error": bound, "bound_energy": 1.15 * energy}
    starts = dict.fromkeys(out, 300.0)
    return fit.curves(out, free_run_start=starts, units={"energy": "W"})


def loop_figure():
    t = np.arange(0.0, 8.0, 0.02)
    reference = swing(t, 0.5)
    how = {"prior": 0.10, "hybrid": 0.03, "oracle": 0.01}
    results = {
        name: loops.Motion(t, swing(t, 0.5, late=late), np.clip(0.3 * np.sin(2.4 * t + late), -0.25, 0.25))
        for name, late in how.items()
    }
    return loops.closed_loops(
        "Track a sinusoid", t, reference, results, states=STATES, inputs=INPUTS, limits=((-0.25,), (0.25,))
    )


def times_figure():
    rng = np.random.default_rng(2)
    times = {"prior": rng.lognormal(0.0, 0.15, 2000), "hybrid": rng.lognormal(1.0, 0.2, 2000)}
    return loops.solve_times(times, 20.0)


def innovations_figure():
    rng = np.random.default_rng(5)
    nis = [rng.chisquare(1, 300), rng.chisquare(1, 200)]
    r = 0.05 * rng.normal(size=(20, 1))
    return estimation.innovations(
        nis, r, dt=0.02, outputs=OUTPUTS, mean_band=(0.88, 1.12), correlation_band=0.09
    )


def monitor_trace(t, values, levels, share, frozen=False):
    """A trace of a violation and of a mean of a force."""
    n, none = len(t), np.zeros((len(t), 1))
    alarm = share > 1.0
    return Trace(
        t, (Channel("violation", "W"), Channel("force of phi", "N m")), ("phi",), values, np.zeros((n, 2, 0)), levels,
        share, np.column_stack([alarm & False, alarm]), (none > 0) | frozen, none, none.astype(int), none < 1,
        np.ones(n, bool), alarm, np.zeros(n, int), alarm & False,
    )  # fmt: skip


LIMITS = WatchLimits("energy", 0.02, (ChannelLimit("force of phi", "N m", 50, 0.06, 0.03),), (0.01,), (0,))


def monitor_figure():
    t = np.arange(0.0, 60.0, 0.02)
    rng = np.random.default_rng(3)
    push = np.exp(-(((t - 24) / 1.0) ** 2)) + 0.7 * np.exp(-(((t - 43) / 1.5) ** 2))
    violation = np.abs(0.02 * rng.standard_normal(len(t))) + 0.4 * push * np.abs(np.sin(4 * t))
    level = np.convolve(violation, np.full(50, 0.02))[: len(t)]
    level[t < 1.0] = np.nan
    values = np.column_stack([violation, violation])
    trace = monitor_trace(t, values, level[:, None], np.nan_to_num(level) / 0.06)
    y = swing(t)[:, 0] + 0.8 * push
    windows = ((0.0, 20.0), (48.0, 60.0))
    return monitor.channels(trace, y, outputs=OUTPUTS, limits=LIMITS, windows=windows)


def poles_figure():
    pair = np.exp(0.02 * (-0.4 + 1j * 4.0))
    hybrid = np.exp(0.02 * (-0.7 + 1j * 3.7))
    memory = 0.6 * np.exp(1j * np.linspace(-0.8, 0.8, 7)) * np.linspace(0.2, 1.0, 7)
    poles = {"phy": [pair, np.conj(pair)], "mopgrnn": [hybrid, np.conj(hybrid), *memory]}
    return analysis.pole_map(poles, 0.02)


def bode_figure():
    omega = np.geomspace(0.1, np.pi / 0.02, 400)
    out = {}
    for model, (damping, natural) in {"phy": (0.4, 4.0), "mopgrnn": (0.7, 3.7)}.items():
        g = 7.0 / (natural**2 - omega**2 + 2j * damping * omega)
        out[model] = (omega, np.abs(g), np.unwrap(np.angle(g)))
    return analysis.bode(out, input_signal=INPUTS[0], output_signal=OUTPUTS[0], nyquist=np.pi / 0.02)


ERRORS = {
    "phy_nominal": {"rmse": 0.42, "e_sim": 1.03, "violation": 0.031},
    "phy": {"rmse": 0.11, "e_sim": 0.21, "violation": 0.017},
    "rnn": {"rmse": 0.15, "e_sim": 0.48, "violation": 0.025},
    "pgrnn": {"rmse": 0.09, "e_sim": 0.17, "violation": 0.016},
    "mopgrnn": {"rmse": 0.08, "e_sim": 0.15, "violation": 0.012},
}
METRICS = {
    "rmse": "RMSE of phi [rad]",
    "e_sim": "simulation error [-]",
    "violation": "violation of energy [W]",
}
SPREAD = {m: {k: 0.12 * v for k, v in ERRORS[m].items()} for m in ("rnn", "pgrnn", "mopgrnn")}


def parity_figure():
    rng = np.random.default_rng(4)
    values = 10 ** rng.normal(-15.6, 0.3, 300)
    errors = {"values": np.where(rng.random(300) < 0.3, 0.0, values), "Jacobians": 10 * values}
    return fit.parity(errors, {"values": 1e-12, "Jacobians": 1e-10})


def fault_figure():
    t = np.arange(0.0, 6.0, 0.02)
    late = np.maximum(t - 3.0, 0.0)
    trace = monitor_trace(t, np.column_stack([0.02 * late, 0.1 * late]), 0.1 * late[:, None], 8 * late)
    marks = ((3.0, "friction doubles"), (3.1, "guard: rest"))
    title = "something breaks at 3 s"
    return monitor.channels(trace, np.sin(2 * t), outputs=OUTPUTS, limits=LIMITS, marks=marks, title=title)


FIGURES = {
    "recordings": lambda: data.recordings(pieces(), OUTPUTS, INPUTS),
    "coverage": lambda: data.coverage(pieces(), STATES, [(0, 1)]),
    "training": training_figure,
    "free_run": free_run_figure,
    "errors": lambda: fit.errors_bar(ERRORS, METRICS, spread=SPREAD),
    "parity": parity_figure,
    "loops": loop_figure,
    "times": times_figure,
    "innovations": innovations_figure,
    "monitor": monitor_figure,
    "fault": fault_figure,
    "poles": poles_figure,
    "bode": bode_figure,
}
PLACES = {
    "promises": (),
    "data": ("recordings", "coverage"),
    "models": (),
    "training": ("training",),
    "free_run": ("free_run", "errors"),
    "export": ("parity",),
    "control": ("loops",),
    "estimation": ("innovations",),
    "timing": ("times",),
    "watch": ("monitor", "fault"),
    "analysis": ("poles", "bode"),
    "glossary": (),
}


def report(folder: Path) -> Report:
    """Draw all figures into ``folder`` and describe the report."""
    paths = {name: save(make(), folder / f"{name}.png") for name, make in FIGURES.items()}
    table = Table(
        ("parameter", "meaning", "nominal", "fitted", "unit"),
        (("J", "inertia", 0.1445, 0.1391, "kg m²"), ("d", "damping <&>", 0.0132, 0.0201, "kg m²/s")),
        "Parameters of the prior.",
    )
    results = Table(
        ("model", "RMSE of phi [rad]", "E_sim [-]", "violation of energy [W]"),
        tuple((name_of(m), *ERRORS[m].values()) for m in MODELS),
        "Errors on test data.",
    )
    tables = {"models": (table,), "free_run": (results,)}
    sections = tuple(
        Section(
            TITLES[key],
            words("run_words.html")[key],
            tuple((paths[n], f"Figure of {n}: what it shows, in one sentence.") for n in names),
            tables.get(key, ()),
        )
        for key, names in PLACES.items()
    )
    summary = (
        KeyFigure("Controller step, p99", 4.2, "ms", "period 20 ms", "good"),
        KeyFigure("False alarms", 2.0, "per hour", "target: below 1", "bad"),
        KeyFigure("Detectable", None, "", "no plant"),
    )
    return Report(
        "Report of the main job",
        "A <synthetic> pendulum & its motor",
        "A pendulum on a geared motor. Its friction is not in the prior, and only the angle is measured.",
        "hybrid-mpc run pendulum --budget quick --out runs/<pendulum>",
        summary,
        sections,
        "seed 0 · budget quick · data 3f2a…",
    )
