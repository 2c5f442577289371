"""The shared look of all figures: colours (Okabe-Ito, safe for colour-blind readers), names, saving."""

from __future__ import annotations

import io
import math
import warnings
from collections.abc import Mapping, Sequence
from pathlib import Path
from types import MappingProxyType
from typing import Any, Literal

import numpy as np
from matplotlib.axes import Axes
from matplotlib.axis import Axis
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.layout_engine import ConstrainedLayoutEngine
from matplotlib.lines import Line2D
from matplotlib.ticker import FuncFormatter, LogLocator, NullFormatter
from numpy.typing import NDArray
from PIL import Image

from hybrid_mpc.errors import InputError
from hybrid_mpc.files import replacing
from hybrid_mpc.machine.signals import Signal

Array = NDArray[np.float64]
Share = bool | Literal["none", "all", "row", "col"]

DPI = 110
IN_PALETTE = 256
"""Colours of a PNG's palette: enough for lines and their smoothed edges; the file is a third as large as in RGB."""
INK, FAINT, PALE = "#222222", "#8a8a8a", "#9a9a9a"
MUTED = "#6b6b6b"
"""Colour of secondary text; text on white needs a contrast of 4.5 to 1, so lines may be fainter than text."""
ALARM, GOOD = "#CC79A7", "#009E73"

_ROLES = {
    "measured": ("#000000", "measured"),
    "reference": ("#000000", "reference"),
    "phy_nominal": ("#7f7f7f", "prior, nominal"),
    "phy": ("#0072B2", "prior, fitted"),
    "prior": ("#0072B2", "prior, fitted"),
    "prior_observer": ("#56B4E9", "prior with observer"),
    "rnn": ("#E69F00", "RNN"),
    "pgrnn": ("#D55E00", "PGRNN"),
    "mopgrnn": ("#D55E00", "MOPGRNN"),
    "hybrid": ("#D55E00", "hybrid"),
    "hybrid_observer": ("#E69F00", "hybrid with observer"),
    "prior_tracking": ("#117733", "prior, tracking"),
    "hybrid_tracking": ("#999933", "hybrid, tracking"),
    "blended_observer": ("#882255", "blend with observer"),
    "oracle": ("#CC79A7", "oracle"),
    "oracle_state": ("#009E73", "oracle, true state"),
    "train": ("#56B4E9", "training"),
    "valid": ("#F0E442", "validation"),
    "test": ("#555555", "test"),
}
"""Colour and name of each role or model. All hybrids share one colour, in free runs and in loops. The PGRNN is dashed
and its bar is hatched, which separates it from the MOPGRNN."""
COLOURS: Mapping[str, str] = MappingProxyType({role: ink for role, (ink, _) in _ROLES.items()})
NAMES: Mapping[str, str] = MappingProxyType({role: name for role, (_, name) in _ROLES.items()})
_DASHED = frozenset({"phy_nominal", "pgrnn", "reference"})
_SYMBOLS = {
    "phi": r"$\varphi$",
    "phi_dot": r"$\dot{\varphi}$",
    "theta": r"$\theta$",
    "theta_dot": r"$\dot{\theta}$",
    "tau": r"$\tau$",
}


def colour(role: str) -> str:
    """Colour of a role or model; an unknown name gets a middle grey.

    Example:
        >>> colour("phy"), colour("someone's own")
        ('#0072B2', '#8a8a8a')
    """
    return COLOURS.get(role, FAINT)


def name_of(role: str) -> str:
    """Human name of a role or model; an unknown name stays as it is.

    Example:
        >>> name_of("mopgrnn")
        'MOPGRNN'
    """
    return NAMES.get(role, plain(role))


def plain(text: str) -> str:
    """Escape a user's text so that matplotlib prints it literally (a dollar sign starts no formula)."""
    return text.replace("$", r"\$")


def line_style(role: str) -> dict[str, Any]:
    """Keyword arguments of a role's line: colour, dashes, width, drawing order and legend label.

    A variant of a known role, such as ``"hybrid, reduced"``, is a dashed line in the role's colour, above the role's
    line.

    Example:
        >>> line_style("phy_nominal")["linestyle"], line_style("prior, reduced")["label"]
        ('--', 'prior, fitted, reduced')
    """
    base, _, variant = role.partition(", ")
    if variant and base in COLOURS:
        label = f"{name_of(base)}, {plain(variant)}"
        return line_style(base) | {"linestyle": "--", "zorder": 3.5, "label": label}
    measured = role in ("measured", "reference")
    return {
        "color": colour(role),
        "linestyle": "--" if role in _DASHED else "-",
        "linewidth": 1.5 if measured else 1.3,
        "zorder": 2.5 if measured else 3,
        "label": name_of(role),
    }


def axis_label(signal: Signal) -> str:
    """Label of an axis: symbol or name of the signal, then its unit.

    Example:
        >>> axis_label(Signal("torque", "N m"))
        'torque [N m]'
    """
    return f"{_SYMBOLS.get(signal.name, plain(signal.name.replace('_', ' ')))} [{plain(signal.unit)}]"


def ratio_unit(numerator: Signal, denominator: Signal) -> str:
    """Unit of one signal per unit of another.

    Example:
        >>> phi, tau = Signal("phi", "rad"), Signal("tau", "N m")
        >>> ratio_unit(phi, tau), ratio_unit(tau, phi)
        ('rad/(N m)', 'N m/rad')
    """
    over, under = numerator.unit, denominator.unit
    return f"{f'({over})' if '/' in over else over}/{f'({under})' if set(' /') & set(under) else under}"


def new_figure(
    rows: int,
    cols: int,
    *,
    title: str = "",
    size: tuple[float, float] | None = None,
    sharex: Share = False,
    sharey: Share = False,
    heights: Sequence[float] | None = None,
) -> tuple[Figure, NDArray[np.object_]]:
    """Create an empty figure in the project's look, with its axes ``(rows, cols)``.

    Args:
        rows: Rows of axes.
        cols: Columns of axes.
        title: Title over all axes. Default: none.
        size: Width and height [inch]. Default: width 10, height 2.2 for each row and at least 3.6.
        sharex: As in ``matplotlib.figure.Figure.subplots``.
        sharey: As in ``matplotlib.figure.Figure.subplots``.
        heights: Relative heights of the rows. Default: equal.

    Returns:
        The figure, on its own Agg canvas (nothing global is touched), and the axes.

    Example:
        >>> figure, axes = new_figure(2, 1)
        >>> axes.shape
        (2, 1)
    """
    layout = ConstrainedLayoutEngine(w_pad=0.1, h_pad=0.06)
    figure = Figure(figsize=size or (10.0, max(3.6, 2.2 * rows)), dpi=DPI, layout=layout)
    FigureCanvasAgg(figure)
    ratios = None if heights is None else list(heights)
    axes = figure.subplots(rows, cols, squeeze=False, sharex=sharex, sharey=sharey, height_ratios=ratios)
    for ax in axes.flat:
        dress(ax)
    if title:
        figure.suptitle(plain(title), fontsize=12, fontweight="bold", color=INK)
    return figure, axes


def new_column(
    heights: Sequence[float], *, height: float = 1.2, title: str = ""
) -> tuple[Figure, list[Axes]]:
    """Create an empty figure whose panels lie one above the other and share their horizontal axis.

    ``heights`` are relative; a panel of relative height 1 is ``height`` inches high.
    """
    size = (10.0, 0.8 + height * sum(heights))
    figure, axes = new_figure(len(heights), 1, sharex=True, heights=heights, title=title, size=size)
    return figure, list(axes[:, 0])


def finish_column(figure: Figure, panels: Sequence[Axes], *, columns: int = 7) -> None:
    """Complete a column of panels over time: remove margins, label the time axis, align labels, add one legend."""
    for ax in panels:
        ax.margins(x=0)
    panels[-1].set_xlabel("time [s]")
    figure.align_ylabels(list(panels))
    shared_legend(figure, columns=columns)


def plot_inputs(panels: Sequence[Axes], t: Array, u: Array, inputs: Sequence[Signal], **style: Any) -> None:
    """Draw inputs ``(n, n_u)``, held between samples, one panel for each input."""
    look: dict[str, Any] = {"color": INK, "linewidth": 1.0} | style
    for ax, values, signal in zip(panels, u.T, inputs, strict=True):
        ax.plot(t, values, drawstyle="steps-post", **look)
        ax.set_ylabel(axis_label(signal))


def dress(ax: Axes) -> None:
    """Give axes the project's look: two spines, a faint grid, small ticks."""
    for side in ("top", "right"):
        ax.spines[side].set_visible(False)
    for side in ("left", "bottom"):
        ax.spines[side].set_color(FAINT)
    ax.grid(True, color="#dddddd", linewidth=0.6)
    ax.set_axisbelow(True)
    ax.tick_params(labelsize=9, colors=INK)
    ax.xaxis.label.set_fontsize(10)
    ax.yaxis.label.set_fontsize(10)


def title_axes(ax: Axes, text: str) -> None:
    """Set a small title at the left edge of axes."""
    ax.set_title(text, loc="left", fontsize=10, color=INK)


def shared_legend(figure: Figure, *, columns: int = 7, ink: bool = False) -> None:
    """Add one legend below all axes of a figure; each label appears once, in the order of drawing.

    Args:
        figure: The figure.
        columns: Maximum number of columns.
        ink: True: the legend shows the dashes of lines and not their colours.
    """
    seen: dict[str, Any] = {}
    for ax in figure.axes:
        for handle, label in zip(*ax.get_legend_handles_labels(), strict=True):
            shown = Line2D([], [], color=INK, linestyle=handle.get_linestyle()) if ink else handle  # type: ignore[attr-defined]
            seen.setdefault(label, shown)
    figure.legend(
        list(seen.values()),
        list(seen),
        loc="outside lower center",
        ncols=max(1, min(columns, len(seen))),
        frameon=False,
        fontsize=9,
    )


def plain_log(axis: Axis, lowest: float, highest: float) -> None:
    """Print plain numbers (0.1, 1, 10) on a logarithmic axis, and also 2 and 5 on one of less than two decades."""
    narrow = highest < 100 * lowest
    axis.set_major_locator(LogLocator(subs=(1.0, 2.0, 5.0) if narrow else (1.0,)))
    axis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:g}"))
    axis.set_minor_formatter(NullFormatter())


def number(value: float) -> str:
    """Format a number for figures and tables: three significant digits.

    Example:
        >>> number(0.0255), number(1.023e-4), number(50.0)
        ('0.0255', '0.000102', '50.0')
    """
    if value == 0 or not math.isfinite(value):
        return f"{value:g}"
    size = abs(value)
    if size < 1e-3 or size >= 1e5:
        return f"{value:.3g}"
    return f"{value:.{max(0, 2 - math.floor(math.log10(size)))}f}"


def checked(name: str, values: Any, length: int, columns: int | None = None) -> Array:
    """Convert values to an array and check its shape: ``(length,)``, or ``(length, columns)`` with ``columns``."""
    array = np.asarray(values, dtype=float)
    if columns is not None and array.ndim == 1:
        array = array[:, None]
    needed = (length,) if columns is None else (length, columns)
    if array.shape != needed:
        raise InputError(
            f"plot: {name} has shape {array.shape}; its time axis and signals need {needed} [HM-PLOTS-032]"
        )
    return array


def save(figure: Figure, path: str | Path) -> Path:
    """Write a figure as PNG. The file is written completely or not at all; the same data give the same bytes.

    Args:
        figure: The figure.
        path: Target file, ``.png``; a missing folder is created.

    Raises:
        InputError: If the name does not end in ``.png``.
        StorageError: If the file cannot be written.

    Example:
        >>> import tempfile
        >>> with tempfile.TemporaryDirectory() as folder:
        ...     save(new_figure(1, 1)[0], Path(folder) / "a.png").name
        'a.png'
    """
    path = Path(path)
    if path.suffix != ".png":
        raise InputError(f"figure {path}: figures are written as PNG; end the name in .png [HM-PLOTS-033]")
    drawn = io.BytesIO()
    with warnings.catch_warnings():
        # a user's name may have characters that the font lacks; matplotlib's warning would print them unescaped
        warnings.filterwarnings("ignore", "Glyph .* missing from")
        figure.savefig(drawn, format="png", dpi=DPI, facecolor="white", metadata={"Software": None})
    picture = Image.open(drawn).convert("RGB").quantize(IN_PALETTE, dither=Image.Dither.NONE)
    with replacing(path) as file:
        picture.save(file, format="png")
    return path
