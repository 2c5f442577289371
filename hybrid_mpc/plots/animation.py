"""A closed loop as a moving picture: the machine, its planned motion, its input."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from pathlib import Path

import numpy as np
from PIL import Image

from hybrid_mpc.errors import InputError
from hybrid_mpc.files import replacing
from hybrid_mpc.plots.scene import Draw, Loop, Scene
from hybrid_mpc.plots.style import Array, checked
from hybrid_mpc.signals import Signal

MOST_FRAMES = 250  # of a longer loop fewer frames a second are drawn; it still plays in real time
LAST = 1.2  # [s] for which the last frame stays before the loop starts again


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
    fps: float = 25,
    position: Signal | None = None,
    inputs: Sequence[Signal] | None = None,
    limits: tuple[Sequence[float] | Array, Sequence[float] | Array] | None = None,
    reference: Array | None = None,
) -> Path:
    """Write a closed loop as GIF that plays in real time: the machine, its planned motion, its input.

    The machine is drawn in its true state; the positions planned at that instant follow as fading ghosts, and
    as a dashed curve of ``x[0]`` that goes on from the past one. A line that no state moves (floor, target) is
    drawn once, in grey; closed lines are filled.

    Args:
        path: Target file, ``.gif``; its folder is made if missing. Written whole or not at all.
        t: Times ``(n,)`` [s], increasing.
        x: True states ``(n, n_x)``, finite.
        plans: Predicted states ``(n, N + 1, n_x)`` at ``t_k, t_k + dt, ...``; NaN where there was no plan.
        dt: Period of the predictions [s].
        draw: The machine's polylines ``(m, 2)`` [m] in a state ``(n_x,)``: always as many, in the same order.
        u: Inputs ``(n, n_u)``, held from ``t_k`` on.
        title: The loop in one line.
        fps: Frames a second at most; also never more than one a sample nor 250 in all.
        position: Signal of ``x[0]``, for its axis. Default: ``x_0`` without a unit.
        inputs: Signals of ``u``. Default: ``u_0, ...`` without units.
        limits: Lower and upper bounds of the inputs, drawn as lines where finite. Default: none.
        reference: Reference of ``x[0]``, ``(n,)``. Default: none.

    Returns:
        The path.

    Raises:
        InputError: If the name does not end in ``.gif``, shapes do not fit, times do not increase, a true state
            is not finite, or ``dt`` or ``fps`` is not positive.

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
        raise InputError(f"animation {path}: animations are written as GIF; end the name in .gif")
    if not dt > 0 or not fps > 0:
        raise InputError(f"animation {path}: dt and fps must be positive, got {dt} and {fps}")
    loop = _checked(path, t, x, plans, dt, draw, u)
    n_u = loop.u.shape[1]
    signals = tuple(inputs) if inputs is not None else tuple(Signal(f"u_{i}", "-") for i in range(n_u))
    if len(signals) != n_u or (limits is not None and {len(bound) for bound in limits} != {n_u}):
        raise InputError(f"animation {path}: needs a signal and both limits for each of the {n_u} inputs")
    target = None if reference is None else checked("reference", reference, len(loop.t))
    scene = Scene(loop, title, position or Signal("x_0", "-"), signals, limits, target)
    shown = _frames(loop.t, fps)
    ends = np.append(loop.t[shown[1:]], loop.t[shown[-1]] + LAST)
    # GIF knows hundredths of a second: rounded as a sum, so that the film never drifts from real time.
    ticks = np.diff(np.round(100 * (ends - loop.t[0])).astype(int), prepend=0)
    _write(path, scene.pictures(shown), [10 * max(2, int(tick)) for tick in ticks])
    return path


def _checked(path: Path, t: Array, x: Array, plans: Array, dt: float, draw: Draw, u: Array) -> Loop:
    t, x, u = (np.asarray(a, dtype=float) for a in (t, x, u))
    plans = np.asarray(plans, dtype=float)
    n = len(t) if t.ndim == 1 else 0
    x, u = (a[:, None] if a.ndim == 1 else a for a in (x, u))
    fits = x.ndim == u.ndim == 2 and plans.ndim == 3 and len(x) == len(u) == len(plans) == n > 0
    if not fits or plans.shape[2] != x.shape[1] or plans.shape[1] == 0:
        raise InputError(
            f"animation {path}: needs t (n,), x (n, n_x), u (n, n_u), plans (n, N + 1, n_x) with n > 0, got "
            f"{t.shape}, {x.shape}, {u.shape}, {plans.shape}"
        )
    if not np.all(np.isfinite(x)) or not np.all(np.diff(t) > 0) or not np.all(np.isfinite(t)):
        raise InputError(f"animation {path}: times must increase and the true states be finite; cut the loop")
    first = draw(x[0])
    ends = plans[:, -1][np.all(np.isfinite(plans[:, -1]), axis=1)]
    others = [draw(state) for states in (x, ends) for state in states[:: max(1, n // 50)]]
    if any(len(lines) != len(first) for lines in others):
        raise InputError(f"animation {path}: draw must return the same number of lines for every state")
    moving = tuple(any(not np.array_equal(o[i], line) for o in others) for i, line in enumerate(first))
    return Loop(t, x, u, plans, dt, draw, moving)


def _frames(t: Array, fps: float) -> list[int]:
    """Samples that are drawn: the first at or after each frame's instant, and the last one."""
    length = float(t[-1] - t[0])
    rate = min(fps, (MOST_FRAMES - 1) / length) if length > 0 else fps
    instants = t[0] + np.arange(math.floor(length * rate + 1e-6) + 1) / rate
    chosen = np.searchsorted(t, instants - 1e-6 / rate)
    return sorted({*chosen.tolist(), len(t) - 1})


def _write(path: Path, pictures: Iterator[Image.Image], durations: Sequence[int]) -> None:
    """One palette for all frames and no dithering, so that only what moves is stored again."""
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
