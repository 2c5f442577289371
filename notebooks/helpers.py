"""Pictures and small tools of the notebooks, so that their cells show what the library does."""

from __future__ import annotations

import os
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from time import process_time
from typing import Any

import casadi as ca
import numpy as np
import pandas as pd

from hybrid_mpc.plots import Motion, closed_loops, colour, name_of, new_figure, shared_legend, title_axes
from nn_export import build

MODEL = Path(__file__).parent / "golf_robot"
"""The trained model of the notebooks, a kit; ``make_model.py`` makes it."""
INKS = ("rnn", "pgrnn", "phy", "reference", "oracle", "phy_nominal")
"""Colours of curves that are no models, in turn."""


def lines(
    t: Any, curves: Mapping[str, Any], xlabel: str, ylabel: str, *, log: bool = False, size: Any = (9, 3)
) -> Any:
    """One panel of curves by name over a common axis."""
    figure, axes = new_figure(1, 1, size=size)
    ax = axes[0, 0]
    for ink, (name, values) in zip(INKS, curves.items(), strict=False):
        (ax.loglog if log else ax.plot)(t, values, color=colour(ink), label=name)
    ax.set(xlabel=xlabel, ylabel=ylabel)
    shared_legend(figure)
    return figure


# Loops


def table_of_loops(results: Mapping[str, Any], unit: str = "mrad") -> pd.DataFrame:
    """Cost, error of the first state (in thousandths) and share of checked solutions of each loop."""
    return pd.DataFrame(
        {
            name: {
                "cost": r.cost,
                f"RMSE [{unit}]": 1e3 * r.tracking_rmse[0],
                "solved [%]": 100 * np.mean(np.array(r.source) == "MPC"),
            }
            for name, r in results.items()
        }
    ).T.round(2)


def picture_of_loops(results: Mapping[str, Any], title: str, model: Any, ocp: Any) -> Any:
    """Loops of one task beside each other, with reference and limits."""
    first = next(iter(results.values()))
    loops = {name: Motion(r.t, r.x, r.u) for name, r in results.items()}
    limits = ocp.u_min, ocp.u_max
    return closed_loops(
        title, first.t, first.reference, loops, states=model.states, inputs=model.inputs, limits=limits
    )


def picture_of_plans(solutions: Mapping[str, Any], dt: float, reference: str) -> Any:
    """Planned inputs, and planned first states less those of one solver."""
    figure, axes = new_figure(2, 1, sharex=True, size=(9, 4.6))
    for ink, (name, plan) in zip(INKS, solutions.items(), strict=False):
        t, dashes = dt * np.arange(len(plan.x)), "--" if name == reference else "-"
        style = {"color": colour(ink), "linestyle": dashes, "label": name}
        axes[0, 0].step(t[:-1], plan.u[:, 0], where="post", **style)
        axes[1, 0].plot(t, 1e3 * (plan.x[:, 0] - solutions[reference].x[:, 0]), **style)
    axes[0, 0].set_ylabel("planned torque [N m]")
    axes[1, 0].set(ylabel=f"planned angle\nless that of {reference} [mrad]", xlabel="time from now on [s]")
    shared_legend(figure)
    return figure


def picture_of_limits(results: Mapping[str, Any], limit: float) -> Any:
    """Angle, speed and torque of loops with different limits of the speed."""
    figure, axes = new_figure(3, 1, sharex=True, size=(10, 5.6))
    for ink, (name, r) in zip(("phy_nominal", "hybrid"), results.items(), strict=False):
        for ax, values in zip(axes[:, 0], (r.x[:, 0], r.x[:, 1], r.u[:, 0]), strict=True):
            ax.plot(r.t, values, color=colour(ink), label=name)
    axes[0, 0].plot(r.t, r.reference[:, 0], "k--", linewidth=1, label="reference")
    for bound in (-limit, limit):
        axes[1, 0].axhline(bound, color="black", linestyle=":", label="limit")
    for ax, label in zip(axes[:, 0], ("angle [rad]", "speed [rad/s]", "torque [N m]"), strict=True):
        ax.set_ylabel(label)
    axes[2, 0].set_xlabel("time [s]")
    shared_legend(figure)
    return figure


def picture_of_errors(results: Mapping[str, Mapping[str, Any]], faults: Mapping[str, Sequence[Any]]) -> Any:
    """Errors of the first state in loops by fault; the time in which the fault acts is grey."""
    figure, axes = new_figure(2, 2, sharex=True, sharey=True, size=(10, 5.4))
    for ax, (title, loops) in zip(axes.flat, results.items(), strict=True):
        for name, r in loops.items():
            ax.plot(r.t, 1e3 * (r.x[:, 0] - r.reference[:, 0]), color=colour(name), label=name_of(name))
        end = min(max(fault.end for fault in faults[title]), r.t[-1])
        ax.axvspan(faults[title][0].start, end, color="#eeeeee", zorder=0, label="fault acts")
        title_axes(ax, title)
    for ax in axes[:, 0]:
        ax.set_ylabel("error of the angle [mrad]")
    for ax in axes[1]:
        ax.set_xlabel("time [s]")
    shared_legend(figure)
    return figure


def picture_of_guard(results: Mapping[str, Mapping[str, Any]], onset: float, frame: float) -> Any:
    """Angle and torque of loops without and with a guard, by case."""
    figure, axes = new_figure(2, len(results), sharex=True, sharey="row", size=(11, 5.2))
    looks = {"guard off": colour("hybrid"), "guard on": colour("phy")}
    for column, (title, loops) in zip(axes.T, results.items(), strict=True):
        for name, r in loops.items():
            column[0].plot(r.t, r.x[:, 0], color=looks[name], label=name)
            column[1].step(r.t, r.u[:, 0], where="post", color=looks[name], label=name)
        column[0].plot(r.t, r.reference[:, 0], "k--", linewidth=1, label="reference")
        column[0].axhspan(-frame, frame, color="#eeeeee", zorder=0, label="angle that the frame leaves free")
        for ax in column:
            ax.axvline(onset, color="black", linestyle=":", label="onset")
        title_axes(column[0], title)
        column[1].set_xlabel("time [s]")
    axes[0, 0].set(ylabel="true angle [rad]", ylim=(-2.5, 2.5))
    axes[1, 0].set_ylabel("torque [N m]")
    shared_legend(figure)
    return figure


def picture_of_late_torques(runs: Mapping[str, Any], columns: int = 2) -> Any:
    """Torques of loops by name, a panel each."""
    rows = -(-len(runs) // columns)
    figure, axes = new_figure(rows, columns, sharex=True, sharey=True, size=(10, 2.2 * rows))
    for ax, (name, run) in zip(axes.flat, runs.items(), strict=False):
        ax.step(run.t, run.u[:, 0], where="post", color=colour("hybrid"), linewidth=1)
        title_axes(ax, name)
    for ax in axes[:, 0]:
        ax.set_ylabel("torque [N m]")
    for ax in axes[-1]:
        ax.set_xlabel("time [s]")
    return figure


def cpu_times(estimator: Any, controller: Any, loop: Any, reference: Any, horizon: int) -> Any:
    """CPU time of each period's work [ms], observer and solver, replayed on the measurements of a loop."""
    dt = loop.t[1] - loop.t[0]
    ahead, spent = dt * np.arange(horizon + 1), []
    estimate = estimator.start(loop.y[0])
    decision = controller.initial(estimate, None, reference(ahead))
    for k in range(1, len(loop.t)):
        begin = process_time()
        estimate = estimator.update(estimate, loop.y[k], loop.u[k - 1])
        decision = controller.decide(decision, estimate, reference(loop.t[k] + ahead))
        spent.append(1e3 * (process_time() - begin))
    return np.array(spent)


# The monitor


def swings(seed: int) -> Callable[[Any], Any]:
    """A reference: three sinusoids of random size and frequency, faded in over 1 s, and their derivative."""
    rng = np.random.default_rng(seed)
    a, w, shift = rng.uniform(0.1, 0.3, 3), 2 * np.pi * rng.uniform(0.2, 0.9, 3), rng.uniform(0, 2 * np.pi, 3)

    def reference(t: Any) -> Any:
        s, angle = np.clip(t, 0.0, 1.0), np.multiply.outer(t, w) + shift
        fade, slope = s**3 * (10 - 15 * s + 6 * s**2), 30 * s**2 * (1 - s) ** 2
        wave, rate = np.sin(angle) @ a, np.cos(angle) @ (a * w)
        return np.column_stack([fade * wave, slope * wave + fade * rate])

    return reference


def picture_of_thresholds(seen: Sequence[Any], fresh: Any, limits: Any) -> Any:
    """The learned deviation of the force over the speed; shares of the thresholds in a new loop."""
    force, terms = (
        np.concatenate([part[50:] for part in parts])
        for parts in zip(*((t.of("force of phi"), t.terms[:, 1]) for t in seen), strict=True)
    )
    deviation = np.sqrt(terms @ limits.of("force of phi")[0].scale)
    speed, tops = np.sqrt(terms[:, 1]), np.array([limit.threshold for limit in limits.channels])
    figure, axes = new_figure(1, 2, size=(11, 3.6))
    left, right = axes[0]
    left.plot(speed, 1e3 * force, ".", color="#9a9a9a", markersize=2, label="force, nominal")
    for sign in (1, -1):
        left.plot(
            speed, sign * 3e3 * deviation, ".", color=colour("hybrid"), markersize=2, label="3 deviations"
        )
    left.set(xlabel="speed [rad/s]", ylabel="force [mN m]")
    for ink, limit, share in zip(INKS, limits.channels, np.abs(fresh.levels / tops).T, strict=False):
        right.plot(fresh.t, share, color=colour(ink), label=limit.channel)
    right.axhline(1.0, color="black", linestyle="--", label="threshold")
    right.set(xlabel="time [s]", ylabel="share of the threshold [-]")
    shared_legend(figure)
    return figure


def delay(condition: Any, t: Any, onset: float) -> float:
    """Time from the onset to the first sample at which a condition holds [s]; NaN for never."""
    found = t[np.asarray(condition, dtype=bool) & (t > onset - 1e-6)]
    return round(float(found[0] - onset), 2) if found.size else np.nan


def picture_of_faults(traces: Mapping[str, Any], onset: float) -> Any:
    """Readings and largest share of a threshold by fault; alarms are shaded."""
    figure, axes = new_figure(3, len(traces), sharex=True, sharey="row", size=(13, 6.2))
    names = "force of phi", "power of the free run"
    for column, (title, trace) in zip(axes.T, traces.items(), strict=True):
        for ink, ax, name in zip(INKS, column, names, strict=False):
            ax.plot(trace.t, np.abs(trace.of(name)), color=colour(ink), label=name)
        column[2].plot(trace.t, trace.share, color="#555555", label="largest share of a threshold")
        column[2].axhline(1.0, color="black", linestyle="--", linewidth=1, label="threshold")
        for ax in column:
            ax.fill_between(
                trace.t, 0, 1, where=trace.alarm, transform=ax.get_xaxis_transform(), color=colour("oracle"),
                alpha=0.25, linewidth=0, label="alarm",
            )  # fmt: skip
            ax.axvline(onset, color="black", linestyle=":", label="onset")
            ax.set_xlim(onset - 1.0, onset + 3.0)
        title_axes(column[0], title)
        column[2].set_xlabel("time [s]")
    labels = "|force| [N m]", "|power| [W]", "share of the threshold [-]"
    ranges = (1e-3, 3), (1e-4, 3), (3e-2, 30)
    for ax, label, shown in zip(axes[:, 0], labels, ranges, strict=True):
        ax.set(ylabel=label, yscale="log", ylim=shown)
    shared_legend(figure)
    return figure


# Linear analysis


def response_of(system: Any, omega: Any) -> Any:
    """Complex frequency response of the first input and output."""
    from hybrid_mpc import frequency_response

    r = frequency_response(system, omega)
    return r.magnitude[0, 0] * np.exp(1j * r.phase[0, 0])


def central_differences(function: Callable[[Any], Any], at: Any, step: float = 1e-5) -> Any:
    """Jacobian of a function of one vector by central differences."""
    ends = [(function(at + step * e), function(at - step * e)) for e in np.eye(len(at))]
    return np.column_stack([(up - down) / (2 * step) for up, down in ends])


def picture_of_responses(
    systems: Mapping[str, Mapping[str, Any]], machine: Any, dashes: Mapping[str, str]
) -> Any:
    """Magnitude and phase of linearizations by model and point (lines), and of a machine (circles)."""
    figure, axes = new_figure(2, 1, sharex=True, size=(9, 5.6))
    omega = np.geomspace(0.4, 25.0, 300)
    for name, of_model in systems.items():
        for point, dash in dashes.items():
            response = response_of(of_model[point], omega)
            label = f"{name_of(name)}, {point}"
            style = {"color": colour(name), "linestyle": dash, "label": label}
            axes[0, 0].loglog(omega, np.abs(response), **style)
            axes[1, 0].semilogx(omega, np.degrees(np.unwrap(np.angle(response))), **style)
    marks = {"marker": "o", "markersize": 4, "linestyle": "none", "color": "black", "fillstyle": "none"}
    axes[0, 0].loglog(machine.omega, np.abs(machine.response), label="rig, measured", **marks)
    axes[1, 0].semilogx(machine.omega, np.degrees(np.unwrap(np.angle(machine.response))), **marks)
    axes[0, 0].set(ylabel="angle per torque\n[rad/(N m)]", ylim=(2e-2, 20))
    axes[1, 0].set(ylabel="phase [°]", xlabel="angular frequency [rad/s]", yticks=(-180, -90, 0))
    axes[1, 0].set_xticks([0.5, 1, 2, 5, 10, 20], ["0.5", "1", "2", "5", "10", "20"])
    axes[1, 0].minorticks_off()
    shared_legend(figure, columns=3)
    return figure


def picture_of_truncation(whole: Any, hankel: Any, small: Mapping[int, Any], dt: float) -> Any:
    """Hankel singular values; errors of truncated systems by their order, with their bounds."""
    omega = np.geomspace(0.1, np.pi / dt, 400)
    figure, axes = new_figure(1, 2, size=(10, 3.8))
    left, right = axes[0]
    left.semilogy(1 + np.arange(len(hankel)), hankel, "o", color=colour("hybrid"))
    left.set(
        xlabel="state of the balanced system", ylabel="Hankel singular value\n[rad/(N m)]", ylim=(1e-9, 30)
    )
    full = response_of(whole, omega)
    for ink, (order, one) in zip(("phy", "pgrnn", "oracle"), small.items(), strict=False):
        error = np.abs(response_of(one.system, omega) - full)
        right.loglog(omega, error, color=colour(ink), label=f"{order} states")
        right.axhline(one.bound, color=colour(ink), linestyle="--", linewidth=1)
    right.loglog(omega, np.abs(full), color="black", linestyle=":", label="the response itself")
    right.set(
        xlabel="angular frequency [rad/s]",
        ylabel="error, and its bound (dashed)\n[rad/(N m)]",
        ylim=(1e-9, 10),
    )
    shared_legend(figure)
    return figure


def table_of_margins(margins: Mapping[str, Any]) -> pd.DataFrame:
    """Margins of loops by name."""
    return pd.DataFrame(
        {
            name: {
                "gain up": m.gain_up,
                "phase [°]": np.degrees(m.phase),
                "delay [ms]": 1e3 * m.delay,
                "delay [periods]": m.delay_periods,
                "disk": m.disk,
                "peak of S": 1 / m.modulus,
            }
            for name, m in margins.items()
        }
    ).T.round(2)


# Export


def jacobian_by_ad(program: Any, *, inlined: bool = False) -> Any:
    """CasADi's own derivative of a step by all inputs: of a call of it, or of its graph copied in."""
    plain = build(program, plain=True)
    names = [ca.MX.sym(name, plain.size1_in(i)) for i, name in enumerate(("x", "h", "u", "w"))]
    whole = ca.jacobian(ca.vertcat(*plain.call(names, inlined, False)), ca.vertcat(*names))
    return ca.Function("by_ad", names, [ca.densify(whole)])


def microseconds(calls: Mapping[str, Callable[[], Any]], rounds: int = 7, n: int = 60) -> dict[str, float]:
    """Best time of each call, all of them taken in turn [µs]."""
    best = dict.fromkeys(calls, np.inf)
    for _ in range(rounds):
        for name, call in calls.items():
            begin = process_time()
            for _ in range(n):
                call()
            best[name] = min(best[name], 1e6 * (process_time() - begin) / n)
    return best


# A machine in simulation


class Carriage:
    """A carriage between two springs, simulated by Runge-Kutta with sub-steps of 1 ms; a plant.

    It knows what its prior does not: dry friction that is larger at low speed, drag that grows with the square of the
    speed, a motor that gives 4 % too little.
    """

    def __init__(self) -> None:
        x, u = ca.SX.sym("x", 2), ca.SX.sym("u")
        length = ca.sqrt(x[0] ** 2 + 0.2**2)
        springs = 2 * 210 * (1 - 0.12 / length) * x[0]
        friction = (1.2 + 0.8 * ca.exp(-((x[1] / 0.05) ** 2))) * ca.tanh(x[1] / 0.005)
        rates = ca.vertcat(x[1], (0.96 * u - springs - friction - 4 * x[1] - 6 * x[1] * ca.fabs(x[1])) / 3.1)
        self.one = ca.simpleRK(ca.Function("rates", [x, u], [rates]), 1, 4)  # (x, u, h) -> x after h

    def reset(self, x0: Any, seed: int) -> Any:
        """State at the model state x0."""
        return np.asarray(x0, dtype=float)

    def step(self, state: Any, u: Any, dt: float) -> Any:
        """State after dt [s] with the input held."""
        n = max(1, round(dt / 1e-3))
        for _ in range(n):
            state = self.one(state, u, dt / n)
        return state.full().ravel()

    def measure(self, state: Any, rng: Any) -> Any:
        """Position [m] with a noise of 0.1 mm."""
        return np.array([state[0] + 1e-4 * rng.standard_normal()])

    def truth(self, state: Any) -> Any:
        """The model's states."""
        return np.array(state)

    def hidden(self, state: Any) -> Any:
        """None."""
        return np.zeros(0)


def moves(t: Any) -> Any:
    """Quintic moves of 0.5 s between -30 and 30 mm, one every 1.5 s: position [m] and speed [m/s]."""
    s = np.clip((t % 1.5) / 0.5, 0.0, 1.0)
    side = np.where((t // 1.5) % 2 == 0, 1.0, -1.0)
    start = np.where(t < 1.5, 0.0, -0.03 * side)
    way = 0.03 * side - start
    position = start + way * s**3 * (10 - 15 * s + 6 * s**2)
    return np.column_stack([position, way * 30 * s**2 * (1 - s) ** 2 / 0.5])


# Real recordings

SOURCES = {
    "cascaded_tanks": (
        "take the benchmark from https://doi.org/10.4121/12960104 and write its estimation data to "
        "cascaded_tanks/estimation.csv with the columns time_s, pump_v, level_v (every 4 s)"
    ),
    "temperature_lab": (
        "take them from https://github.com/rawlings-group/mlid_2024 and write prbs.csv and setpoints_1.csv with the "
        "columns time_s, heater1_pct, heater2_pct, temperature1_degc, temperature2_degc (every second) to "
        "temperature_lab"
    ),
    "double_pendulum": (
        "take the system identification data of design C.1 from "
        "https://github.com/dfki-ric-underactuated-lab/double_pendulum and write them to double_pendulum as CSV with "
        "the columns time_s, tau1_command_nm, tau2_command_nm, q1_rad, q2_rad, dq1_rad_s, dq2_rad_s"
    ),
}
"""Where the recordings of a machine come from, and the form in which a notebook reads them."""


def recordings_of(machine: str) -> Path:
    """Folder with the recordings of a real machine.

    Raises:
        FileNotFoundError: If they are not there; the message says where to get them.
    """
    folder = Path(os.environ.get("HYBRID_MPC_RECORDINGS", "../../shared/data")) / machine
    if not folder.is_dir():
        raise FileNotFoundError(
            f"no recordings of {machine}: {SOURCES[machine]}; let the environment variable HYBRID_MPC_RECORDINGS name "
            "the folder around it"
        )
    return folder
