"""A scenario to begin with, written from a recording; what only its user knows is marked TODO."""

from __future__ import annotations

import keyword
import re
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from hybrid_mpc.data.files import Source, name_and_unit, opened
from hybrid_mpc.data.recording import MIN_SCORED, UNITS
from hybrid_mpc.errors import InputError
from hybrid_mpc.files import write_text

Array = NDArray[np.float64]
MARK = "TODO"
"""What stands before everything that is left to decide."""
ACTING = "what only acts: new ... --disturbance-column NAME"
"""What to do about a column that is no output although it is measured."""
HELD = 0.5
"""Share of samples equal to the one before from which on a column looks commanded."""
EVEN = 0.2
"""Share by which the distances of time stamps may spread."""
MOST = 2000
"""Most samples from which a first model is taken."""
BETTER = 0.8
"""Error of two states over that of one below which two are taken."""
FEWEST = 20
"""Fewest rows of a recording that tell anything."""


@dataclass(frozen=True)
class Column:
    """A column of a recording: full name, name and unit as the header has them, numbers ``(m,)``."""

    full: str
    name: str
    unit: str
    values: Array

    @property
    def span(self) -> tuple[float, float]:
        """Smallest and largest number."""
        return float(np.nanmin(self.values)), float(np.nanmax(self.values))

    @property
    def identifier(self) -> str:
        """The name as Python can write it after a dot."""
        text = re.sub(r"\W+", "_", self.name, flags=re.ASCII).strip("_") or "signal"
        return f"c_{text}" if text[0].isdigit() or keyword.iskeyword(text) else text


@dataclass(frozen=True)
class Draft:
    """What a recording shows: its time, what looks commanded and what measured, and what is neither.

    ``period`` is the sampling time [s]; ``time`` is None where no column looks like one. ``disturbances`` are measured
    and act on the machine, but nobody commands them; no number tells them from outputs, so they are named or none.
    """

    time: Column | None
    period: float
    inputs: tuple[Column, ...]
    outputs: tuple[Column, ...]
    left_out: tuple[str, ...]
    disturbances: tuple[Column, ...] = ()

    @property
    def drives(self) -> tuple[Column, ...]:
        """All that acts on the machine."""
        return (*self.inputs, *self.disturbances)


@dataclass(frozen=True)
class Lag:
    """A first linear model of one output: ``states`` 1 or 2, its time constant [s], damping, gains, offset."""

    states: int
    seconds: float
    damping: float
    gains: tuple[float, ...]
    offset: float


def write_scenario(
    path: Path, data: Path, inputs: Sequence[str] = (), outputs: Sequence[str] = (), time: str = "",
    disturbances: Sequence[str] = (),
) -> Draft:  # fmt: skip
    """Write a scenario for a recording; returned is what it was made from.

    Args:
        path: Python file to make; there must be none.
        data: The recording (CSV, npz, mat).
        inputs: Columns of the inputs. Default: those that are held from one sample to the next.
        outputs: Columns of the outputs. Default: all others that move.
        time: Column of the time. Default: one that rises evenly.
        disturbances: Columns of measured disturbances. Default: none.

    Raises:
        InputError: If the file is there, the recording is bad or too short, or shows no input or no output.

    Example:
        ``write_scenario(Path("my_machine.py"), Path("monday.csv"))``
    """
    if path.suffix != ".py":
        raise InputError(f"{path}: a scenario is a Python file; give a name that ends with .py")
    if path.exists():
        raise InputError(f"{path} is there already; give another name, or remove it")
    draft = drafted(opened(data), inputs, outputs, time, disturbances)
    write_text(path, scenario_text(path, data, draft))
    return draft


def left_to_decide(path: Path) -> list[str]:
    r"""Lines of a scenario's file that are marked, with their numbers.

    Example:
        >>> import tempfile
        >>> with tempfile.TemporaryDirectory() as folder:
        ...     path = Path(folder) / "a.py"
        ...     _ = path.write_text("x = 1\ny = 2  # TODO: is it?\n")
        ...     left_to_decide(path)
        ['line 2: is it?']
    """
    found = []
    for number, line in enumerate(path.read_text(encoding="utf-8").splitlines(), 1):
        _, mark, text = line.partition(f"# {MARK}")
        if mark:
            found.append(f"line {number}: {text.lstrip(': ')}")
    return found


def drafted(
    source: Source, inputs: Sequence[str], outputs: Sequence[str], time: str, disturbances: Sequence[str] = ()
) -> Draft:
    """Roles of a recording's columns: as they are given, or as their numbers look."""
    columns, left_out = _columns(source)
    by_name = {column.full: column for column in columns}

    def named(names: Sequence[str]) -> tuple[Column, ...]:
        missing = [name for name in map(source.find, names) if name not in by_name]
        if missing:
            raise InputError(f"{source.path}: column {missing[0]!r} holds no numbers that move")
        return tuple(by_name[source.find(name)] for name in names)

    stamps = named([time])[0] if time else next((c for c in columns if _rises(c.values)), None)
    taken = {stamps.full} if stamps else set()
    others = [c for c in columns if c.full not in taken]
    given = named(inputs), named(outputs), named(disturbances)
    chosen = {c.full for group in given for c in group}
    free = [c for c in others if c.full not in chosen]
    held = tuple(c for c in free if _is_held(c.values))
    u = given[0] or held or tuple(free[: 1 if len(free) > 1 else 0])
    y = given[1] or tuple(c for c in free if c not in u and not _rises(c.values))
    if not u or not y:
        there = ", ".join(source.header)
        raise InputError(
            f"{source.path}: no column is left for {'an output' if u else 'an input'}; it has {there}. Say which is "
            "which: --input-column, --output-column, --disturbance-column"
        )
    scale = 1.0 if stamps is None else _seconds(stamps)
    period = 1.0 if stamps is None else scale * float(np.median(np.diff(stamps.values)))
    unused = tuple(c.full for c in others if c not in (*u, *y, *given[2]))
    return Draft(stamps, period, u, y, (*left_out, *unused), given[2])


def _columns(source: Source) -> tuple[list[Column], tuple[str, ...]]:
    """Columns whose numbers move, and the names of the others."""
    found, left_out = [], []
    for full in dict.fromkeys(source.header):
        try:
            values = source.read(None, [full], [full]).values[:, 0]
        except InputError:
            left_out.append(full)
            continue
        known = values[np.isfinite(values)]
        if len(known) < FEWEST or np.ptp(known) == 0:
            left_out.append(full)
            continue
        name, unit = name_and_unit(full.rpartition(".")[2] or full)
        found.append(Column(full, name, unit, values))
    if not found:
        raise InputError(
            f"{source.path}: no column has {FEWEST} numbers that move; give a recording in which the machine moves"
        )
    return found, tuple(left_out)


def _rises(values: Array) -> bool:
    """Whether numbers rise evenly, as time does."""
    steps = np.diff(values)
    if not (np.isfinite(values).all() and (steps > 0).all()):
        return False
    return bool(np.quantile(np.abs(steps / np.median(steps) - 1), 0.9) < EVEN)


def _is_held(values: Array) -> bool:
    known = values[np.isfinite(values)]
    return bool((np.diff(known) == 0).mean() >= HELD)


def _seconds(stamps: Column) -> float:
    """Factor from a time column's unit to seconds."""
    return {"s": 1.0, **UNITS["s"]}.get(stamps.unit, 1.0)


def first_model(draft: Draft, output: Column) -> Lag:
    """A lag of one or two states whose free run is nearest to an output."""
    every = np.column_stack([output.values, *(c.values for c in draft.drives)])
    every = every[np.isfinite(every).all(axis=1)]
    stride = max(1, len(every) // MOST)
    y, u = every[::stride, 0], every[::stride, 1:]
    dt = stride * draft.period
    best: tuple[float, Lag] | None = None
    for order in (1, 2):
        rows = [y[order - 1 - i : len(y) - 1 - i] for i in range(order)]
        a = np.column_stack([*rows, u[order - 1 : -1], np.ones(len(y) - order)])
        theta = np.linalg.lstsq(a, y[order:], rcond=None)[0]
        poles = np.roots(np.concatenate([[1.0], -theta[:order]]))
        if not (np.isfinite(theta).all() and (np.abs(poles) < 1).all() and (np.abs(poles) > 0.05).all()):
            continue
        if order == 1 and not poles[0].real > 0:
            continue
        run = y[:order].tolist()
        for k in range(order, len(y)):
            run.append(float(theta @ np.concatenate([run[: -order - 1 : -1], u[k - 1], [1.0]])))
        error = float(np.sqrt(np.mean((np.array(run) - y) ** 2)))
        rates = np.log(poles.astype(complex)) / dt
        size = float(np.sqrt(np.abs(np.prod(rates)))) if order == 2 else float(np.abs(rates[0]))
        damping = float(-rates.real.sum() / (2 * size)) if order == 2 else 1.0
        still = 1.0 - theta[:order].sum()
        lag = Lag(order, 1 / size, damping, tuple(theta[order:-1] / still), float(theta[-1] / still))
        if best is None or error < BETTER * best[0]:
            best = error, lag
    if best is not None:
        return best[1]
    return Lag(1, 20 * draft.period, 1.0, (0.0,) * len(draft.drives), float(np.mean(y)))


def _rounded(value: float, digits: int = 3) -> str:
    return f"{float(f'{value:.{digits}g}') + 0.0!r}"


def _wide(column: Column) -> tuple[str, str]:
    """A range twice as wide again as what was recorded, on either side."""
    low, high = column.span
    return _rounded(low - (high - low), 2), _rounded(high + (high - low), 2)


def _signal(column: Column, name: str) -> tuple[str, str]:
    """A Signal as it is written, and what stands behind it."""
    low, high = _wide(column)
    recorded = f"recorded: {column.span[0]:.4g} to {column.span[1]:.4g}"
    unit = f"unit by the header; {recorded}" if column.unit else f"{MARK}: its unit; {recorded}"
    return f'Signal("{name}", "{column.unit or "-"}", {low}, {high})', unit


def _names(columns: Sequence[Column], taken: set[str]) -> list[str]:
    names = []
    for column in columns:
        name, k = column.identifier, 2
        while name in taken:
            name, k = f"{column.identifier}_{k}", k + 1
        taken.add(name)
        names.append(name)
    return names


def scenario_text(path: Path, data: Path, draft: Draft) -> str:
    """The file: signals, a first prior of lags, and how the recording is read."""
    y_names = _names(draft.outputs, set())
    u_names, w_names = _names(draft.inputs, set()), _names(draft.disturbances, set())
    drives = [*(("u", n) for n in u_names), *(("w", n) for n in w_names)]
    lags = [first_model(draft, column) for column in draft.outputs]
    kind = "".join(part.capitalize() for part in re.findall(r"[A-Za-z0-9]+", path.stem)) or "Machine"
    kind = f"Machine{kind}" if kind[0].isdigit() else kind
    states, rates, parameters, steady = [], [], [], list[str]()
    gains, offsets = list[list[float]](), list[float]()
    for name, column, lag in zip(y_names, draft.outputs, lags, strict=True):
        text, note = _signal(column, name)
        states.append((text, note))
        unit = column.unit or "-"
        towards = " + ".join([f"p.rest_{name}", *(f"p.k_{name}_{n} * {of}.{n}" for of, n in drives)])
        steady.append(f"{name}_steady = {towards}")
        if lag.states == 1:
            rates.append((f"({name}_steady - x.{name}) / p.T_{name}", "a lag of first order"))
        else:
            rates.append((f"x.{name}_rate", f"exact: the rate of {name}"))
        lower, upper = _wide(column)
        rest = float(lower), float(upper)
        if draft.disturbances:  # what they leave of the output may lie far from all that it was
            rest = min(rest[0], lag.offset - np.ptp(rest)), max(rest[1], lag.offset + np.ptp(rest))
        parameters.append(
            (f"T_{name}", lag.seconds, "s", lag.seconds / 20, lag.seconds * 20, "time constant")
        )
        if lag.states == 2:
            parameters.append((f"D_{name}", min(max(lag.damping, 0.01), 5.0), "-", 0.0, 10.0, "damping"))
        middle = min(max(lag.offset, rest[0]), rest[1])
        offsets.append(float(_rounded(middle)))
        gains.append([float(_rounded(gain)) for gain in lag.gains])
        parameters.append((f"rest_{name}", middle, unit, *rest, "value without inputs"))
        for (_, u), source, gain in zip(drives, draft.drives, lag.gains, strict=True):
            reach = max(10 * abs(gain), 10 * np.ptp(column.span) / np.ptp(source.span))
            per = f"{unit}/({source.unit})" if source.unit and source.unit != "-" else unit
            parameters.append((f"k_{name}_{u}", gain, per, -float(reach), float(reach), f"gain from {u}"))
    for name, column, lag in zip(y_names, draft.outputs, lags, strict=True):
        if lag.states == 2:
            unit = f"{column.unit or '-'}/s" if column.unit not in ("", "-") else "1/s"
            fast = 10 * np.ptp(column.span) / lag.seconds
            low, high = _rounded(-fast, 2), _rounded(fast, 2)
            states.append((f'Signal("{name}_rate", "{unit}", {low}, {high})', "not measured"))
            pull = f"({name}_steady - x.{name}) / p.T_{name}**2"
            rates.append((f"{pull} - 2 * p.D_{name} / p.T_{name} * x.{name}_rate", "second order"))
    exact = [name for name, lag in zip(y_names, lags, strict=True) if lag.states == 2]
    corrected = [n for n, lag in zip(y_names, lags, strict=True) if lag.states == 1] + [
        f"{n}_rate" for n in exact
    ]
    slowest = max(lag.seconds for lag in lags)
    length = draft.period * len(draft.outputs[0].values)
    dt = draft.period
    # a fifth of the recording validates and a fifth tests: each must hold a warm-up and what is scored
    smoothing = max(5 * dt, min(10 * dt, length / 40))
    warm = max(
        2 * dt, min(max(10 * dt, slowest), length / 10, length / 5 - smoothing - (MIN_SCORED + 2) * dt)
    )
    time = f'"{draft.time.full}"' if draft.time else _rounded(draft.period)
    time_note = "rises evenly; in seconds?" if draft.time and not draft.time.unit else ""
    if draft.time is None:
        time_note = "the sampling time [s]; no column of the recording looks like time"
    x0, u0, w0 = _first_rest(draft, np.array(gains), np.array(offsets))
    point = f"x={_numbers([*x0, *[0.0] * (len(states) - len(x0))], 6)}, u={_numbers(u0)}"
    point += f", w={_numbers(w0)}" if w_names else ""
    lines = [
        f'"""{path.stem}: written from {data.name} by hybrid-mpc new. Lines marked {MARK} are yours to decide."""',
        "",
        "from hybrid_mpc import OCP, DataSpec, OperatingPoint, Parameter, Prior, Scenario, Signal",
        "",
        "",
        f"class {kind}(Prior):",
        '    """A first prior: each output is a lag of all that acts."""',
        "",
        f"    # {MARK}: write the machine's own equations in xdot; its states need not be measured",
        "    states = (",
        *(f"        {text},  # {note}" for text, note in states),
        "    )",
        "    inputs = (",
        *(
            f"        {text},  # {note}"
            for text, note in (_signal(c, n) for c, n in zip(draft.inputs, u_names, strict=True))
        ),
        "    )",
        f"    outputs = states[:{len(y_names)}]",
        *(["    disturbances = ("] if w_names else []),
        *(
            f"        {text},  # {note}"
            for text, note in (_signal(c, n) for c, n in zip(draft.disturbances, w_names, strict=True))
        ),
        *(["    )"] if w_names else []),
        "    parameters = (  # name, value, unit, bounds of the fit",
        *(
            f'        Parameter("{n}", {_rounded(v)}, "{unit}", {_rounded(low)}, {_rounded(high)}, "{text}"),'
            for n, v, unit, low, high, text in parameters
        ),
        "    )",
        f"    corrects = ({', '.join(f'{n!r}' for n in corrected)},)".replace("'", '"'),
        f"    # {MARK}: where the machine works; your own equations rest elsewhere: see check",
        f"    # operating_point = OperatingPoint({point})",
        f"    # {MARK}: balances(self, x, u, w, p), if something is stored: energy, mass, heat",
        "",
        "    def xdot(self, x, u, w, p):",
        *(f"        {text}" for text in steady),
        "        return (",
        *(f"            {text},  # {note}" for text, note in rates),
        "        )",
        "",
        "",
        "scenario = Scenario(",
        f'    "{path.stem}",',
        f'    "{path.stem}",  # {MARK}: a title',
        f'    "",  # {MARK}: a few words for the report',
        f"    prior={kind},",
        "    data=DataSpec(",
        f"        {time}," + (f"  # {MARK}: {time_note}" if time_note else ""),
        f"        {_tuple(c.full for c in draft.inputs)},  # {MARK}: are these commanded?",
        f"        {_tuple(c.full for c in draft.outputs)},  # {MARK}: does the machine move these? {ACTING}",
        *([f"        # {MARK}: not used: {', '.join(draft.left_out)}"] if draft.left_out else []),
        f"        dt={_rounded(dt)},  # s, as it was sampled; a tenth of the fastest motion is enough",
        f"        max_gap={_rounded(5 * draft.period)},",
        f"        smoothing={_rounded(smoothing)},",
        f"        warm_up={_rounded(warm)},  # s of the past that start a free run",
        *([f"        disturbances={_tuple(c.full for c in draft.disturbances)},"] if w_names else []),
        "    ),",
        *_first_control(draft, len(states), min(max(round(2 * slowest / dt), 20), 100)),
        ")",
        "",
    ]
    return "\n".join(line.rstrip() for line in lines)


def _first_rest(draft: Draft, gains: Array, offsets: Array) -> tuple[Array, Array, Array]:
    """Outputs, inputs and disturbances at which the lags rest: as near to the recording's middle as they can."""
    n_u = len(draft.inputs)
    y, drives = (np.array([np.nanmedian(c.values) for c in cs]) for cs in (draft.outputs, draft.drives))
    u, w = drives[:n_u], drives[n_u:]
    missing = y - offsets - gains @ drives
    u = np.array([float(_rounded(v)) for v in u + np.linalg.pinv(gains[:, :n_u]) @ missing])
    w = np.array([float(_rounded(v)) for v in w])
    return offsets + gains @ np.concatenate([u, w]), u, w


def _first_control(draft: Draft, n_x: int, horizon: int) -> list[str]:
    """A control problem for a first loop, commented out: what only the user knows is marked.

    Outputs are weighed by one over the square of a twentieth of what was recorded, changes of inputs of a tenth
    (Bryson's rule); inputs stay within what was recorded.
    """

    def each(columns: Sequence[Column], share: float) -> str:
        return _numbers(1 / (share * np.ptp(c.span)) ** 2 for c in columns)

    low, high = (_numbers(c.span[i] for c in draft.inputs) for i in (0, 1))
    free = f"q={_numbers([0.0] * n_x)}, r={_numbers([0.0] * len(draft.inputs))}"
    return [
        f"    # {MARK}: what a controller is to do. For a first loop take away the # before:",
        f"    # control=OCP({horizon}, {free}, u_min={low}, u_max={high},",
        "    #             # weights: one over the square of a deviation that you tolerate",
        f"    #             r_delta={each(draft.inputs, 0.1)}, q_y={each(draft.outputs, 0.05)}),",
        f"    # sensor_sigma={_numbers(0.005 * np.ptp(c.span) for c in draft.outputs)},  # how much each sensor errs",
        "    # safe_input=(...),  # within these limits, and no harm when a sensor is lost: nobody can guess it",
    ]


def _numbers(values: Iterable[float], digits: int = 3) -> str:
    """Numbers as a tuple is written."""
    given = [_rounded(float(v), digits) for v in values]
    return f"({', '.join(given)},)" if len(given) == 1 else f"({', '.join(given)})"


def _tuple(names: Iterable[str]) -> str:
    given = list(names)
    quoted = ", ".join(f'"{name}"' for name in given)
    return f"({quoted},)" if len(given) == 1 else f"({quoted})"
