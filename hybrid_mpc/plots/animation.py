"""Animation of a closed loop as GIF: the machine, its planned motion, its input, faults and alarms."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from matplotlib.artist import Artist
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.layout_engine import ConstrainedLayoutEngine
from matplotlib.lines import Line2D
from matplotlib.patches import Polygon
from numpy.typing import NDArray
from PIL import Image

from hybrid_mpc.errors import InputError
from hybrid_mpc.files import replacing
from hybrid_mpc.machine.signals import Signal
from hybrid_mpc.plots.style import (
    ALARM,
    FAINT,
    INK,
    Array,
    axis_label,
    checked,
    colour,
    dress,
    plain,
    shared_legend,
)

Draw = Callable[[Array], Sequence[Array]]

DPI = 96
SIZE = (8.0, 4.1)  # [inch], with one curve and one input
PANEL = 1.1  # height of each further curve or input [inch]
GHOSTS = 6  # maximum number of planned positions in a frame
PLAN = colour("hybrid")
FPS = 25.0
"""Largest number of frames a second; there is at most one frame a sample."""
MOST_FRAMES = 250  # a longer loop gets fewer frames a second and still plays in real time
LAST = 1.2  # duration of the last frame, before the animation starts again [s]


@dataclass(frozen=True)
class AnimatedLoop:
    """Checked arguments of an animation; ``moving`` says which polylines a state moves."""

    t: Array
    x: Array
    u: Array
    plans: Array
    dt: float
    draw: Draw
    moving: tuple[bool, ...]
    alarm: NDArray[np.bool_] | None = None
    events: tuple[tuple[float, str], ...] = ()


class Scene:
    """The picture of an animation: the static parts are drawn once, each frame's lines over a copy of them."""

    def __init__(
        self,
        loop: AnimatedLoop,
        title: str,
        curves: Sequence[tuple[int, Signal]],
        inputs: Sequence[Signal],
        limits: tuple[Sequence[float] | Array, Sequence[float] | Array] | None,
    ) -> None:
        self._loop = loop
        self._columns = [column for column, _ in curves]
        size = (SIZE[0], SIZE[1] + PANEL * max(0, len(curves) + len(inputs) - 2))
        self._figure = Figure(figsize=size, dpi=DPI, layout=ConstrainedLayoutEngine(w_pad=0.1, h_pad=0.06))
        self._canvas = FigureCanvasAgg(self._figure)
        self._figure.suptitle(plain(title), fontsize=12, fontweight="bold", color=INK)
        n, heights = len(curves), [1.5] * len(curves) + [1.0] * len(inputs)
        grid = self._figure.add_gridspec(len(heights), 2, height_ratios=heights)
        machine = self._figure.add_subplot(grid[:, 0])
        panels: list[Axes] = []
        for i in range(len(heights)):
            first = panels[0] if panels else None
            panels.append(self._figure.add_subplot(grid[i, 1], sharex=first))
        self._live: list[tuple[Axes, Artist]] = []
        self._machine_panel(machine)
        self._curves: list[tuple[Line2D, Line2D, Line2D]] = []
        for ax, (column, signal) in zip(panels, curves, strict=False):
            self._curve_panel(ax, column, signal)
        self._applied: list[Line2D] = []
        for i, (ax, signal) in enumerate(zip(panels[n:], inputs, strict=True)):
            self._input_panel(ax, i, signal, None if limits is None else (limits[0][i], limits[1][i]))
        self._bars = [  # at the top of each panel, in axes coordinates, while the monitor alarms
            self._line(
                ax, color=ALARM, linewidth=6, solid_capstyle="butt", transform=ax.get_xaxis_transform(),
                label="monitor alarms",
            )
            for ax in (panels if loop.alarm is not None else ())
        ]  # fmt: skip
        for at, _ in loop.events:
            for ax in panels:
                ax.axvline(at, color=ALARM, linestyle="--", linewidth=1.2)
        panels[-1].set_xlabel("time [s]")
        for ax in panels[:-1]:
            ax.tick_params(labelbottom=False)
        self._figure.align_ylabels(panels)
        shared_legend(self._figure)

    def _line(self, ax: Axes, **style: object) -> Line2D:
        """Add a line that each frame draws anew, above the lines added before."""
        (line,) = ax.plot([], [], animated=True, **style)  # type: ignore[arg-type]
        self._live.append((ax, line))
        return line

    def _body(
        self, ax: Axes, index: int, ink: str, alpha: float, width: float
    ) -> tuple[int, Line2D | Polygon]:
        if not _closed(self._loop.draw(self._loop.x[0])[index]):
            return index, self._line(ax, color=ink, linewidth=width, alpha=alpha, solid_capstyle="round")
        shape = Polygon([(0.0, 0.0)], color=ink, linewidth=0.0, alpha=alpha, zorder=2, animated=True)
        ax.add_patch(shape)
        self._live.append((ax, shape))
        return index, shape

    def _machine_panel(self, ax: Axes) -> None:
        loop = self._loop
        first = loop.draw(loop.x[0])
        for line, moves in zip(first, loop.moving, strict=True):
            if not moves:
                ax.plot(*np.asarray(line).T, color=FAINT, linewidth=1.4, zorder=2)
                if _closed(line):
                    ax.fill(*np.asarray(line).T, color="white", ec=FAINT, linewidth=1.4, zorder=2)
        dress(ax)
        ax.set_aspect("equal")
        low, high = self._view()
        ax.set_xlim(low[0], high[0])
        ax.set_ylim(low[1], high[1])
        ax.set_xlabel("horizontal [m]")
        ax.set_ylabel("vertical [m]")
        bodies = [i for i, moves in enumerate(loop.moving) if moves]
        self._ghosts = [
            [self._body(ax, i, PLAN, float(alpha), 2.0) for i in bodies]
            for alpha in np.linspace(0.12, 0.5, GHOSTS)
        ]
        self._machine = [self._body(ax, i, INK, 1.0, 2.8) for i in bodies]
        self._clock = ax.text(0.03, 0.96, "", transform=ax.transAxes, fontsize=10, color=INK, va="top")
        self._said = ax.text(
            0.03, 0.89, "", transform=ax.transAxes, fontsize=10, color=ALARM, va="top", weight="bold"
        )
        for text in (self._clock, self._said):
            text.set_animated(True)
            self._live.append((ax, text))

    def _view(self) -> tuple[Array, Array]:
        """Corners of the machine's panel: all true positions, and planned positions up to 25 % beyond these."""
        loop = self._loop
        states = loop.x[:: max(1, len(loop.x) // 100)]
        true = np.concatenate([np.asarray(line) for state in states for line in loop.draw(state)])
        low, high = true.min(axis=0), true.max(axis=0)
        planned = [row[np.all(np.isfinite(row), axis=1)] for row in loop.plans[:: max(1, len(loop.x) // 30)]]
        ends = [np.asarray(line) for row in planned for state in row[-1:] for line in loop.draw(state)]
        room = 0.25 * max(float(np.max(high - low)), 1e-3)
        for points in ends:
            low = np.maximum(np.minimum(low, points.min(axis=0)), true.min(axis=0) - room)
            high = np.minimum(np.maximum(high, points.max(axis=0)), true.max(axis=0) + room)
        margin = 0.06 * max(float(np.max(high - low)), 1e-3)
        return low - margin, high + margin

    def _curve_panel(self, ax: Axes, column: int, signal: Signal) -> None:
        loop, values, planned = self._loop, self._loop.x[:, column], self._loop.plans[:, :, column]
        dress(ax)
        low, high = float(values.min()), float(values.max())
        room = 0.4 * max(high - low, 1e-6)  # so a diverging plan does not flatten the true motion
        seen = planned[np.isfinite(planned)]
        seen = np.concatenate([seen, [low, high]])
        low, high = max(float(np.nanmin(seen)), low - room), min(float(np.nanmax(seen)), high + room)
        margin = 0.06 * max(high - low, 1e-6)
        ax.set_ylim(low - margin, high + margin)
        ax.set_xlim(loop.t[0], max(loop.t[-1], loop.t[0] + loop.dt))
        ax.set_ylabel(axis_label(signal))
        past = self._line(ax, color=INK, linewidth=1.8, label="true motion")
        plan = self._line(ax, color=PLAN, linewidth=1.6, linestyle=(0, (4, 2)), label="planned motion")
        self._curves.append((past, plan, self._line(ax, color=INK, marker="o", markersize=4.5, linestyle="")))

    def _input_panel(self, ax: Axes, index: int, signal: Signal, bounds: tuple[float, float] | None) -> None:
        dress(ax)
        for bound in filter(math.isfinite, bounds or ()):
            ax.axhline(bound, color=INK, linestyle=":", linewidth=1.1, label="input limits")
        values = np.append(self._loop.u[:, index], bounds or ())
        values = values[np.isfinite(values)]
        low, high = (float(values.min()), float(values.max())) if values.size else (0.0, 0.0)
        margin = 0.1 * max(high - low, 1e-6)
        ax.set_ylim(low - margin, high + margin)
        ax.set_ylabel(axis_label(signal))
        self._applied.append(self._line(ax, color=colour("prior"), drawstyle="steps-post", label="input"))

    def pictures(self, shown: Sequence[int]) -> Iterator[Image.Image]:
        """Draw one RGB picture for each of these samples."""
        self._canvas.draw()
        still = self._canvas.copy_from_bbox(self._figure.bbox)
        for k in shown:
            self._canvas.restore_region(still)
            self._set(k)
            for ax, artist in self._live:
                ax.draw_artist(artist)
            yield Image.fromarray(np.array(self._canvas.buffer_rgba())).convert("RGB")

    def _set(self, k: int) -> None:
        loop = self._loop
        times = loop.t[k] + loop.dt * np.arange(loop.plans.shape[1])
        ahead = np.all(np.isfinite(loop.plans[k]), axis=1)
        for column, (past, plan, dot) in zip(self._columns, self._curves, strict=True):
            past.set_data(loop.t[: k + 1], loop.x[: k + 1, column])
            dot.set_data(loop.t[k : k + 1], loop.x[k : k + 1, column])
            plan.set_data(times[ahead], loop.plans[k, ahead, column])
        held = min(k + 1, len(loop.t) - 1)  # the input of sample k is held until sample k + 1
        for i, line in enumerate(self._applied):
            line.set_data(
                np.append(loop.t[: k + 1], loop.t[held]), np.append(loop.u[: k + 1, i], loop.u[k, i])
            )
        self._clock.set_text(f"t = {loop.t[k]:.2f} s")
        said = [what for at, what in loop.events if at <= loop.t[k]]
        if loop.alarm is not None:
            on = loop.alarm[: k + 1]
            for bar in self._bars:
                bar.set_data(loop.t[: k + 1], np.where(on, 0.97, np.nan))
            said += ["ALARM"] if on[k] else []
        self._said.set_text("\n".join(plain(line) for line in said))
        _place(self._machine, loop.draw(loop.x[k]))
        later = np.flatnonzero(ahead)[1:]
        even = np.linspace(0, len(later) - 1, GHOSTS + 1)[1:].astype(int)
        chosen = later[np.unique(even)] if len(later) else later
        drawn: list[Sequence[Array] | None]
        drawn = [
            loop.draw(loop.plans[k, j]) for j in reversed(chosen)
        ]  # the latest one first: it is the faintest
        hidden = GHOSTS - len(drawn)
        for lines, ghost in zip([None] * hidden + drawn, self._ghosts, strict=True):
            _place(ghost, lines)


def _place(bodies: Sequence[tuple[int, Line2D | Polygon]], lines: Sequence[Array] | None) -> None:
    """Move artists to a state's lines, or hide them without lines."""
    for i, artist in bodies:
        points = np.full((2, 2), np.nan) if lines is None else np.asarray(lines[i])
        if isinstance(artist, Polygon):
            artist.set_xy(points)
        else:
            artist.set_data(*points.T)


def _closed(line: Array) -> bool:
    return len(line) > 2 and bool(np.allclose(line[0], line[-1], rtol=0.0, atol=1e-9))


def animate(
    path: str | Path,
    t: Array,
    x: Array,
    plans: Array,
    *,
    dt: float,
    draw: Draw,
    u: Array,
    title: str,
    curves: Sequence[tuple[int, Signal]] | None = None,
    inputs: Sequence[Signal] | None = None,
    limits: tuple[Sequence[float] | Array, Sequence[float] | Array] | None = None,
    alarm: Array | None = None,
    events: Sequence[tuple[float, str]] = (),
) -> Path:
    """Write a closed loop as GIF that plays in real time: the machine, its planned motion, its input.

    The machine is drawn in its true state. Its planned positions are fading outlines, and the planned states are dashed
    curves that continue the past ones. A line that no state moves (floor, target) is drawn once, in grey. Closed lines
    are filled.

    Args:
        path: Target file, ``.gif``; a missing folder is created. The file is written completely or not at all.
        t: Times ``(n,)`` [s], increasing.
        x: True states ``(n, n_x)``, finite.
        plans: Predicted states ``(n, N + 1, n_x)`` at ``t_k, t_k + dt, ...``; NaN where there was no plan.
        dt: Period of the predictions [s].
        draw: Returns the machine's polylines ``(m, 2)`` [m] in a state ``(n_x,)``: the same number of lines in the same
            order for every state.
        u: Inputs ``(n, n_u)``, held from ``t_k`` on.
        title: The loop in one line.
        curves: States with a curve: columns of ``x``, and signals for the axes. Default: all, named ``x_0, ...``,
            without units.
        inputs: Signals of ``u``. Default: ``u_0, ...`` without units.
        limits: Lower and upper bounds of the inputs, drawn as lines where finite. Default: none.
        alarm: Whether the monitor alarms ``(n,)``. Default: no monitor.
        events: Instants [s] and texts of events, such as a fault. Default: none.

    Raises:
        InputError: If the name does not end in ``.gif``, shapes do not fit, times do not increase, a true state
            is not finite, or ``dt`` is not positive.

    Example:
        >>> import tempfile
        >>> t = np.array([0.0, 0.1])
        >>> x, u, plans = np.array([[0.0], [0.1]]), np.zeros((2, 1)), np.full((2, 4, 1), np.nan)
        >>> cart = lambda x: [np.array([[x[0] - 0.1, 0.0], [x[0] + 0.1, 0.0]])]
        >>> with tempfile.TemporaryDirectory() as folder:
        ...     path = animate(Path(folder) / "a.gif", t, x, plans, dt=0.1, draw=cart, u=u, title="A cart")
        ...     path.read_bytes()[:6]
        b'GIF89a'
    """
    path = Path(path)
    if path.suffix != ".gif":
        raise InputError(
            f"animation {path}: an animation is a GIF file; end its name with .gif [HM-PLOTS-010]"
        )
    if not dt > 0:
        raise InputError(f"animation {path}: dt must be positive, got {dt} [HM-PLOTS-011]")
    loop = _checked(path, t, x, plans, dt, draw, u)
    n_u = loop.u.shape[1]
    signals = tuple(inputs) if inputs is not None else tuple(Signal(f"u_{i}", "-") for i in range(n_u))
    if len(signals) != n_u or (limits is not None and {len(bound) for bound in limits} != {n_u}):
        raise InputError(
            f"animation {path}: each of the {n_u} inputs needs a signal and both limits [HM-PLOTS-012]"
        )
    if curves is None:
        curves = [(i, Signal(f"x_{i}", "-")) for i in range(loop.x.shape[1])]
    if not curves or not all(0 <= column < loop.x.shape[1] for column, _ in curves):
        raise InputError(
            f"animation {path}: curves must be states 0 to {loop.x.shape[1] - 1}, got {list(curves)} [HM-PLOTS-013]"
        )
    if alarm is not None:
        loop = replace(loop, alarm=checked("alarm", alarm, len(loop.t)) > 0.5)
    scene = Scene(replace(loop, events=tuple(events)), title, curves, signals, limits)
    shown = _frames(loop.t)
    ends = np.append(loop.t[shown[1:]], loop.t[shown[-1]] + LAST)
    # GIF durations are hundredths of a second: the instants are rounded, not the durations, so no error accumulates.
    ticks = np.diff(np.round(100 * (ends - loop.t[0])).astype(int), prepend=0)
    _write(path, scene.pictures(shown), [10 * max(2, int(tick)) for tick in ticks])
    return path


def _checked(path: Path, t: Array, x: Array, plans: Array, dt: float, draw: Draw, u: Array) -> AnimatedLoop:
    t, x, u = (np.asarray(a, dtype=float) for a in (t, x, u))
    plans = np.asarray(plans, dtype=float)
    n = len(t) if t.ndim == 1 else 0
    x, u = (a[:, None] if a.ndim == 1 else a for a in (x, u))
    fits = x.ndim == u.ndim == 2 and plans.ndim == 3 and len(x) == len(u) == len(plans) == n > 0
    if not fits or plans.shape[2] != x.shape[1] or plans.shape[1] == 0:
        raise InputError(
            f"animation {path}: the shapes must be t (n,), x (n, n_x), u (n, n_u), plans (n, N + 1, n_x) with n > 0,"
            f" got {t.shape}, {x.shape}, {u.shape}, {plans.shape} [HM-PLOTS-014]"
        )
    if not np.all(np.isfinite(x)) or not np.all(np.diff(t) > 0) or not np.all(np.isfinite(t)):
        raise InputError(
            f"animation {path}: times must increase and true states must be finite; cut the loop before its first"
            " bad sample [HM-PLOTS-015]"
        )
    first = draw(x[0])
    ends = plans[:, -1][np.all(np.isfinite(plans[:, -1]), axis=1)]
    others = [draw(state) for states in (x, ends) for state in states[:: max(1, n // 50)]]
    if any(len(lines) != len(first) for lines in others):
        raise InputError(
            f"animation {path}: draw must return the same number of lines for every state [HM-PLOTS-016]"
        )
    moving = tuple(any(not np.array_equal(o[i], line) for o in others) for i, line in enumerate(first))
    return AnimatedLoop(t, x, u, plans, dt, draw, moving)


def _frames(t: Array) -> list[int]:
    """Indices of the samples that are drawn: the first at or after each frame's instant, and the last sample."""
    length = float(t[-1] - t[0])
    rate = min(FPS, (MOST_FRAMES - 1) / length) if length > 0 else FPS
    instants = t[0] + np.arange(math.floor(length * rate + 1e-6) + 1) / rate
    chosen = np.searchsorted(t, instants - 1e-6 / rate)
    return sorted({*chosen.tolist(), len(t) - 1})


def _write(path: Path, pictures: Iterator[Image.Image], durations: Sequence[int]) -> None:
    """Write the GIF with one palette for all frames and no dithering: GIF then stores only the moving parts."""
    frames = list(pictures)
    few = frames[:: max(1, len(frames) // 6)]
    width, height = few[0].size
    sheet = Image.new("RGB", (width, height * len(few)))
    for i, picture in enumerate(few):
        sheet.paste(picture, (0, i * height))
    palette = sheet.quantize(128, dither=Image.Dither.NONE)
    colours = np.array(palette.getpalette()).reshape(-1, 3)
    colours[colours.min(axis=1) >= 248] = 255  # Pillow looks colours up coarsely: keep the paper white
    palette.putpalette(colours.ravel().tolist())
    flat = [picture.quantize(palette=palette, dither=Image.Dither.NONE) for picture in frames]
    with replacing(path) as file:
        flat[0].save(file, "GIF", save_all=True, append_images=flat[1:], duration=list(durations), loop=0)
