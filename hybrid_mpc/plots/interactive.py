"""Interactive form of a figure over time: zoom, read values and switch signals in a browser."""

from __future__ import annotations

import html
import json
import re
from dataclasses import dataclass, field
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.artist import Artist
from matplotlib.axes import Axes
from matplotlib.collections import PolyCollection
from matplotlib.colors import to_hex, to_rgba
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Rectangle
from numpy.typing import NDArray

from hybrid_mpc.files import write_text

Array = NDArray[np.float64]
PIXELS = 92.0
"""Pixels for each inch of the drawn figure."""
AROUND, LINE = 60, 24
"""Pixels of a panel's frame, and of a line of its title or legend."""
COLUMNS = 4
"""Signals in a line of a legend."""
MOST = 4000
"""Maximum points of a curve; a longer curve is thinned to the minimum and maximum of each stretch."""
DASHES = {"-": "solid", "--": "dashed", ":": "dotted", "-.": "dashdot"}
SCALES = {"log": "log"}
"""Scale of an axis in Bokeh by that in matplotlib; all others are linear."""
STEPS = {"steps-post": "after", "steps-pre": "before", "steps": "before", "steps-mid": "center"}


def over_time(figure: Figure) -> bool:
    """Whether the horizontal axis of all of a figure's panels is the time.

    Example:
        >>> from hybrid_mpc.plots.style import new_figure
        >>> over_time(new_figure(1, 1)[0])
        False
    """
    return {ax.get_xlabel() for ax in figure.axes} - {""} == {"time [s]"}


def write_interactive(figure: Figure, picture: Path) -> Path:
    """Write the interactive form of a figure beside its picture, ``NAME.json`` for ``NAME.png``; return its path.

    The file holds curves, bands, marked stretches and lines, with the figure's colours, units and legends. Texts inside
    the axes are left out. Panels with a shared time axis zoom together. A legend entry switches its signal in all
    panels.

    Args:
        figure: The drawn figure; it is not changed.
        picture: Path of its picture.

    Raises:
        StorageError: If the file cannot be written.

    Example:
        >>> import tempfile
        >>> from hybrid_mpc.plots.style import new_figure
        >>> drawn, axes = new_figure(1, 1)
        >>> _ = axes[0, 0].plot([0.0, 1.0], [0.0, 2.0], label="prior")
        >>> with tempfile.TemporaryDirectory() as folder:
        ...     write_interactive(drawn, Path(folder) / "a.png").name
        'a.json'
    """
    from bokeh.embed import json_item
    from bokeh.layouts import gridplot

    panels, rows = _Panels(figure), dict[int, dict[int, Any]]()
    for number, ax in enumerate(figure.axes):
        place = ax.get_subplotspec()
        row, column = (number, 0) if place is None else (place.rowspan.start, place.colspan.start)
        rows.setdefault(row, {})[column] = panels.add(ax)
    width = 1 + max(max(row) for row in rows.values())
    grid = gridplot(
        [[rows[i].get(j) for j in range(width)] for i in sorted(rows)],
        sizing_mode="stretch_width", merge_tools=True, toolbar_location="right",
    )  # fmt: skip
    text = json.dumps(json_item(grid), separators=(",", ":"))
    path = picture.with_suffix(".json")
    write_text(path, text)
    return path


@dataclass
class _Panels:
    """Panels of a figure, and the objects that they share.

    Args:
        drawn: The figure.
        ranges: Axes converted so far, with the horizontal range of their panel.
        abscissas: Time arrays by their bytes, so that each is stored once.
        signals: The first curve of each label, which switches the other curves of that label.
    """

    drawn: Figure
    ranges: list[tuple[Axes, Any]] = field(default_factory=list)
    abscissas: dict[bytes, Any] = field(default_factory=dict)
    signals: dict[str, Any] = field(default_factory=dict)

    def add(self, ax: Axes) -> Any:
        """Convert axes to a panel."""
        from bokeh.models import HoverTool
        from bokeh.plotting import figure

        shared = [x for other, x in self.ranges if ax.get_shared_x_axes().joined(ax, other)]
        height = ax.get_position().height * self.drawn.get_figheight()
        title = ax.get_title() or self.drawn.get_suptitle() * (not self.ranges)
        panel = figure(
            title=plain(title) or None, x_axis_label=plain(ax.get_xlabel()), y_axis_label=plain(ax.get_ylabel()),
            x_axis_type=SCALES.get(ax.get_xscale(), "linear"), y_axis_type=SCALES.get(ax.get_yscale(), "linear"),
            tools="xpan,xwheel_zoom,xbox_zoom,reset,save", active_drag="xbox_zoom", active_scroll=None,
            x_range=shared[0] if shared else ax.get_xlim(), height=round(PIXELS * height) + AROUND,
        )  # fmt: skip
        self.ranges.append((ax, panel.x_range))
        for artist in (*ax.patches, *ax.collections):
            _shade(panel, ax, artist)
        named = ax.get_legend() is not None or (bool(self.drawn.legends) and ax is self.drawn.axes[0])
        curves = [self._curve(panel, line, named) for line in ax.lines if not _straight(panel, ax, line)]
        curves = [curve for curve in curves if curve is not None]
        tooltip = "<b>$name</b>: $snap_y{0.[0000]} at $snap_x{0.[000]}"
        panel.add_tools(HoverTool(renderers=curves, mode="vline", line_policy="nearest", tooltips=tooltip))
        panel.height += LINE * bool(title)
        for legend in list(panel.legend):
            panel.height += LINE * (1 + len(legend.items) // COLUMNS)
            legend.update(
                click_policy="hide", orientation="horizontal", ncols=COLUMNS, label_text_font_size="11px"
            )
            panel.add_layout(legend, "above")
        return panel

    def _curve(self, panel: Any, line: Line2D, named: bool) -> Any:
        """Add a curve or points to a panel; None for a curve without finite values."""
        from bokeh.models import ColumnDataSource, CustomJS

        x, y = (np.asarray(v, dtype=np.float64) for v in line.get_data(orig=False))
        if not np.isfinite(y).any():
            return None
        x, y = thinned(x, y)
        x = self.abscissas.setdefault(x.tobytes(), x)
        source = ColumnDataSource({"x": x, "y": y.astype(np.float32)})
        label = plain(str(line.get_label()))
        label = "" if label.startswith("_") else label
        # Bokeh inserts the name into the tooltip's HTML without escaping it
        ink = {
            "color": to_hex(line.get_color()),
            "alpha": line.get_alpha() or 1.0,
            "name": html.escape(label or "value"),
        }
        legend = {"legend_label": label} if named and label else {}
        dash = DASHES.get(str(line.get_linestyle()))
        if dash is None:
            made = panel.scatter("x", "y", source=source, size=line.get_markersize(), **ink, **legend)
        else:
            ink |= {"line_width": line.get_linewidth(), "line_dash": dash}
            mode = STEPS.get(str(line.get_drawstyle()))
            made = (
                panel.line("x", "y", source=source, **ink, **legend)
                if mode is None
                else panel.step("x", "y", source=source, mode=mode, **ink, **legend)
            )
        if label:
            first = self.signals.setdefault(label, made)
            if first is not made:
                for one, other in ((first, made), (made, first)):
                    switch = CustomJS(args={"other": other}, code="other.visible = cb_obj.visible")
                    one.js_on_change("visible", switch)
        return made


def _straight(panel: Any, ax: Axes, line: Line2D) -> bool:
    """Add a line across the whole panel (axhline, axvline) and return True; False for any other line."""
    from bokeh.models import Span

    across = line.get_transform().contains_branch_seperately(ax.transData)
    if all(across):
        return False
    along = "height" if across[0] else "width"
    where = np.asarray(line.get_xdata() if across[0] else line.get_ydata(), dtype=float)
    ink = {"line_color": to_hex(line.get_color()), "line_width": line.get_linewidth()}
    dash = DASHES.get(str(line.get_linestyle()), "solid")
    if any(across):
        panel.add_layout(Span(location=float(where[0]), dimension=along, line_dash=dash, **ink))
    return True


def _shade(panel: Any, ax: Axes, artist: Artist) -> None:
    """Add a marked stretch of time or the area of a band to a panel; ignore all other artists."""
    from bokeh.models import BoxAnnotation

    if isinstance(artist, Rectangle):
        if artist.get_transform().contains_branch_seperately(ax.transData) == (True, False):
            (low, _), width = artist.get_xy(), artist.get_width()
            ink = to_rgba(artist.get_facecolor())
            box = BoxAnnotation(
                left=low, right=low + width, fill_color=to_hex(ink), fill_alpha=ink[3], line_alpha=0
            )
            panel.add_layout(box)
    elif isinstance(artist, PolyCollection) and len(artist.get_facecolor()):
        ink = to_rgba(np.asarray(artist.get_facecolor())[0])
        edges = [np.asarray(path.vertices, dtype=np.float32) for path in artist.get_paths()]
        xs, ys = ([edge[:, i] for edge in edges] for i in (0, 1))
        panel.patches(xs, ys, fill_color=to_hex(ink), fill_alpha=ink[3], line_alpha=0)


def thinned(x: Array, y: Array, most: int = MOST) -> tuple[Array, Array]:
    """Thin a curve ``(n,)`` to at most ``most`` points: the minimum and maximum of each stretch stay.

    Example:
        >>> x = np.arange(10000.0)
        >>> short, y = thinned(x, np.where(x == 777, 1.0, 0.0), 100)
        >>> len(short), float(short[np.argmax(y)])
        (100, 777.0)
    """
    if len(x) <= most:
        return x, y
    edges, empty, kept = np.linspace(0, len(x), most // 2 + 1).astype(int), np.isnan(y), list[int]()
    for a, b in pairwise(edges.tolist()):
        low = a + int(np.argmin(np.where(empty[a:b], np.inf, y[a:b])))
        high = a + int(np.argmax(np.where(empty[a:b], -np.inf, y[a:b])))
        kept += sorted((low, high))
    return x[kept], y[kept]


def plain(text: str) -> str:
    r"""Convert a label to one line without mathematical typesetting.

    Example:
        >>> plain(r"simulation error $E_{sim}$ [-]"), plain(r"$\dot\varphi$ [rad/s]")
        ('simulation error E_sim [-]', 'φ̇ [rad/s]')
    """
    text = re.sub(r"\\([(\[])", r"\1", text.replace("\n", " "))  # \( and \[ begin a formula in a browser
    if "$" not in text:
        return text
    greek = {"varphi": "φ", "phi": "φ", "omega": "ω", "tau": "τ", "sigma": "σ", "Delta": "Δ", "theta": "θ"}
    for name, letter in greek.items():
        text = text.replace(f"\\{name}", letter)
    text = re.sub(r"\\dot\s*\{?(\w)\}?", "\\1\u0307", text)
    return re.sub(r"[${}\\]", "", text)
