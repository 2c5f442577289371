"""Whether recordings excite a machine enough for its parameters to be found."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from hybrid_mpc.data.spectra import hann_spectrum
from hybrid_mpc.data.trajectories import Trajectory
from hybrid_mpc.errors import InputError, refuse
from hybrid_mpc.signals import Signal

Array = NDArray[np.float64]
NOTHING = 1e-6
"""Spread of a signal over its size at or below which it counts as constant: rounding of a file, far below any
converter."""
WEAKEST = 0.1
"""Amplitude of a spectral line over that of the strongest, from which on it counts."""
LOBE = 2
"""Bins to either side of a line that its Hann window fills above ``WEAKEST``."""


@dataclass(frozen=True)
class Excitation:
    """What one input does over a set of trajectories.

    Args:
        name: The input.
        spread: Standard deviation over all samples [input unit].
        lines: Frequencies [Hz] of sines that the recordings tell apart, increasing; the mean is none of them.

    Each sine gives two numbers of a linear machine's response, its gain and its phase.
    """

    name: str
    spread: float
    lines: tuple[float, ...]


def excitation_of(
    trajectories: Sequence[Trajectory], inputs: Sequence[Signal] = ()
) -> tuple[Excitation, ...]:
    """Spread and spectral lines of each input.

    Each trajectory's spectrum is taken without its mean under a Hann window. Lines are counted from the strongest on,
    each with the two bins to either side that it fills, down to a tenth of the strongest of all trajectories; ones of
    several trajectories closer than these bins are one. So the count is low rather than high.

    Args:
        trajectories: At least one.
        inputs: Signals of the inputs, for their names. Default: ``input 1`` and so on.

    Raises:
        InputError: If there is no trajectory.

    Example:
        >>> t = 0.02 * np.arange(500)
        >>> u = np.sin(2 * np.pi * 0.5 * t) + 0.5 * np.sin(2 * np.pi * 2.0 * t)
        >>> zero = np.zeros((500, 1))
        >>> run = Trajectory("run", "train", 0.02, t, u[:, None], zero, zero, zero)
        >>> [round(f, 3) for f in excitation_of([run])[0].lines]
        [0.5, 2.0]
    """
    if not trajectories:
        raise InputError("excitation: no trajectories given")
    found = []
    for j in range(trajectories[0].u.shape[1]):
        name = inputs[j].name if j < len(inputs) else f"input {j + 1}"
        every = np.concatenate([piece.u[:, j] for piece in trajectories])
        found.append(Excitation(name, float(every.std()), _lines([(p.u[:, j], p.dt) for p in trajectories])))
    return tuple(found)


def check_excitation(
    trajectories: Sequence[Trajectory],
    *,
    inputs: Sequence[Signal] = (),
    outputs: Sequence[Signal] = (),
    parameters: int = 0,
) -> tuple[str, ...]:
    """Refuse inputs that excite nothing; warn of ones that excite too little for a number of parameters.

    Args:
        trajectories: All that a model is fitted to; one input at rest in some of them is no fault.
        inputs: Signals of the inputs, for names and for the size of what counts as constant. Default: unnamed.
        outputs: Signals of the outputs, likewise.
        parameters: Number of parameters to be fitted. A linear model needs a sine for every two of them; a nonlinear
            one may get by with fewer, so this is a warning. Default: not checked.

    Returns:
        Warnings; none if all is well.

    Raises:
        InputError: If there is no trajectory, an input is constant over all of them, or an output is.

    Source: L. Ljung, System Identification, 2nd edition, section 13.2: a sum of n sines is persistently exciting of
    order 2 n.

    Example:
        >>> t = 0.02 * np.arange(500)
        >>> u = np.sin(2 * np.pi * 0.5 * t)[:, None]
        >>> run = Trajectory("run", "train", 0.02, t, u, u, np.hstack([u, u]), np.hstack([u, u]))
        >>> check_excitation([run], parameters=2)
        ()
        >>> print(check_excitation([run], parameters=5)[0])
        input 1 has 1 line (0.5 Hz), 5 parameters of a linear model need 3. Add a multisine, a chirp or steps.
    """
    found, problems = excitation_of(trajectories, inputs), []
    names = ", ".join(dict.fromkeys(piece.name.split("#")[0] for piece in trajectories))
    for j, one in enumerate(found):
        if one.spread <= NOTHING * _size([piece.u[:, j] for piece in trajectories], inputs, j):
            level = trajectories[0].u[0, j]
            problems.append(
                f"{names}: the input {one.name} is {level:g} throughout; what it does cannot be learned. Add a "
                "recording in which it moves, or check that the DataSpec names the right column."
            )
    for j in range(trajectories[0].y.shape[1]):
        every = np.concatenate([piece.y[:, j] for piece in trajectories])
        if float(every.std()) <= NOTHING * _size([every], outputs, j):
            name = outputs[j].name if j < len(outputs) else f"output {j + 1}"
            problems.append(
                f"{names}: the output {name} is {every[0]:g} throughout: the machine never moved. Excite it harder "
                "than its friction, or check that the DataSpec names the right column."
            )
    refuse(problems)
    need = -(-parameters // 2)
    return tuple(_too_few(one, parameters, need) for one in found if len(one.lines) < need)


def _too_few(one: Excitation, parameters: int, need: int) -> str:
    count = len(one.lines)
    told = ", ".join(f"{f:.3g}" for f in one.lines)
    lines = f"{count} line{'s' * (count != 1)} ({told} Hz)" if count else "no line"
    return (
        f"{one.name} has {lines}, {parameters} parameters of a linear model need {need}. Add a multisine, a chirp or "
        "steps."
    )


def _size(pieces: Sequence[Array], signals: Sequence[Signal], j: int) -> float:
    """Largest value of a signal, or of its plausible range where that is bounded."""
    size = max(float(np.abs(piece).max()) for piece in pieces)
    if j < len(signals):
        size = max([size, *(abs(b) for b in (signals[j].lower, signals[j].upper) if np.isfinite(b))])
    return size


def _lines(pieces: Sequence[tuple[Array, float]]) -> tuple[float, ...]:
    """Frequencies of distinct lines of one input over all pieces."""
    spectra = [hann_spectrum(u, dt) for u, dt in pieces if len(u) > 2 * LOBE]
    strongest = max((float(a.max()) for _, a in spectra), default=0.0)
    if strongest <= NOTHING * max(float(np.abs(u).max()) for u, _ in pieces):
        return ()  # constants, and what rounding makes of them
    found: list[tuple[float, float]] = []
    for f, amplitude in spectra:
        left = amplitude.copy()
        while left.max() >= WEAKEST * strongest:
            k = int(np.argmax(left))
            found.append((float(f[k]), LOBE * float(f[1])))
            left[max(k - LOBE, 0) : k + LOBE + 1] = 0.0
    distinct: list[tuple[float, float]] = []
    for line, width in sorted(found):
        if not distinct or line - distinct[-1][0] > max(width, distinct[-1][1]):
            distinct.append((line, width))
    return tuple(line for line, _ in distinct)
