"""Errors of the ways to differentiate, against known motions behind an encoder.

``python benchmarks/differentiation.py [--dt 0.01] [--counts 4096] [--out differentiation.json]`` prints a table for
each motion, and writes JSON where asked. Motions of 40 s:

- ``sweep``: a sine of 0.8 rad whose frequency rises from 0.1 to 1.5 Hz: all derivatives are smooth;
- ``jumps``: an acceleration that jumps between +-8 rad/s^2 every 0.25 to 0.8 s, as under a bang-bang input.

Columns: frequency at which value and second derivative have lost 3 dB; delay; what a unit of white noise becomes in the
second derivative; rms errors of first and second derivative over the rms of the true one, each at the instant that the
estimate belongs to: the whole error, the second derivative's without the encoder (``bias``), its within 0.25 s of the
ends, and its as of the newest sample (``now``), where a delay counts as an error.
"""

from __future__ import annotations

import os

os.environ.setdefault("OMP_NUM_THREADS", "1")

import argparse
import json
from dataclasses import asdict, dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from hybrid_mpc import CausalPolynomial, LocalPolynomial, SmoothingSpline, ZeroPhaseFilter, differentiate
from hybrid_mpc.data.differentiate import Differentiator, gcv_cutoff

Array = NDArray[np.float64]
SECONDS, END = 40.0, 0.25
METHODS: tuple[tuple[str, Differentiator], ...] = (
    *((f"local polynomial, {s:g} s", LocalPolynomial(s)) for s in (0.1, 0.2, 0.3)),
    *((f"smoothing spline, {f:g} Hz", SmoothingSpline(f)) for f in (4.0, 8.0)),
    *((f"zero-phase filter, {f:g} Hz", ZeroPhaseFilter(f)) for f in (4.0, 8.0)),
    *((f"causal, {s:g} s, centre", CausalPolynomial(s)) for s in (0.1, 0.2)),
    ("causal, 0.1 s, cubic, now", CausalPolynomial(0.1, order=3, lag=0.0)),
)


@dataclass(frozen=True)
class Motion:
    """A known motion: angle [rad], its first and second derivative, as arrays over ``t``."""

    name: str
    value: Array
    first: Array
    second: Array


def sweep(t: Array) -> Motion:
    """Sine with rising frequency."""
    f0, f1, a = 0.1, 1.5, 0.8
    phase = 2 * np.pi * (f0 * t + (f1 - f0) / (2 * SECONDS) * t**2)
    rate, change = 2 * np.pi * (f0 + (f1 - f0) / SECONDS * t), 2 * np.pi * (f1 - f0) / SECONDS
    return Motion(
        "sweep",
        a * np.sin(phase),
        a * rate * np.cos(phase),
        a * (change * np.cos(phase) - rate**2 * np.sin(phase)),
    )


def jumps(t: Array) -> Motion:
    """Piecewise constant acceleration, integrated exactly; sizes alternate so that the angle stays within a turn."""
    rng = np.random.default_rng(0)
    at = np.concatenate([[0.0], np.cumsum(rng.uniform(0.25, 0.8, 400))])
    q, v, a = np.zeros(len(at)), np.zeros(len(at)), np.zeros(len(at))
    for i, length in enumerate(np.diff(at)):
        a[i] = -8.0 if 4 * q[i] + 3 * v[i] > 0 else 8.0  # back to the middle
        v[i + 1] = v[i] + a[i] * length
        q[i + 1] = q[i] + v[i] * length + a[i] * length**2 / 2
    i = np.searchsorted(at, t, side="right") - 1
    s = t - at[i]
    return Motion("jumps", q[i] + v[i] * s + a[i] * s**2 / 2, v[i] + a[i] * s, a[i])


def errors(method: Differentiator, t: Array, motions: dict[float, Motion], seen: Array) -> dict[str, float]:
    """Relative rms errors; ``motions`` are known now and, where there is a delay, at the instant spoken of."""
    dt = float(t[1] - t[0])
    then, now = motions[method.delay(dt)], motions[0.0]
    coded, exact = differentiate(seen, dt, method), differentiate(now.value, dt, method)
    edge = round(END / dt)
    inner = (t >= END) & (t < t[-1] - END)
    outer = ~inner & np.isfinite(coded.second)
    assert outer.sum() >= edge  # causal ones have no first samples

    def relative(got: Array, true: Array, where: Array) -> float:
        return float(np.sqrt(np.mean((got - true)[where] ** 2) / np.mean(true[inner] ** 2)))

    return {
        "first": relative(coded.first, then.first, inner),
        "second": relative(coded.second, then.second, inner),
        "bias": relative(exact.second, then.second, inner),
        "ends": relative(coded.second, then.second, outer),
        "now": relative(coded.second, now.second, inner),
    }


def rows_of(make, t: Array, step: float) -> list[dict]:
    """A row for each method on one motion."""
    dt = float(t[1] - t[0])
    truth = make(t)
    seen = np.round(truth.value / step) * step
    chosen = gcv_cutoff(seen, dt)
    rows = []
    for name, method in (*METHODS, (f"smoothing spline, {chosen:.3g} Hz (GCV)", SmoothingSpline(chosen))):
        delay = method.delay(dt)
        motions = {0.0: truth, delay: make(np.maximum(t - delay, 0.0))}
        rows.append(
            {
                "motion": truth.name,
                "method": name,
                "settings": asdict(method),
                "bandwidth_hz": [method.bandwidth(dt, i) for i in range(3)],
                "delay_s": delay,
                "noise_gain_second": method.noise_gain(dt, 2),
                **errors(method, t, motions, seen),
            }
        )
    return rows


def show(rows: list[dict]) -> None:
    """A markdown table."""
    print(f"\n{rows[0]['motion']}\n")
    print("| method | -3 dB, value / second [Hz] | delay [ms] | noise | first | second | bias | ends | now |")
    print("| --- | --- | ---: | ---: | ---: | ---: | ---: | ---: | ---: |")
    for r in rows:
        value, _, second = r["bandwidth_hz"]
        shares = " | ".join(f"{100 * r[key]:.1f} %" for key in ("first", "second", "bias", "ends", "now"))
        print(
            f"| {r['method']} | {value:.1f} / {second:.1f} | {1e3 * r['delay_s']:.0f} | "
            f"{r['noise_gain_second']:.0f} | {shares} |"
        )


def main() -> None:
    """Print the tables; write JSON where asked."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--dt", type=float, default=0.01, help="sampling time [s]")
    parser.add_argument("--counts", type=int, default=4096, help="counts of the encoder per turn")
    parser.add_argument("--out", type=Path, help="JSON file to write")
    given = parser.parse_args()
    t = given.dt * np.arange(round(SECONDS / given.dt))
    rows = []
    for make in (sweep, jumps):
        new = rows_of(make, t, 2 * np.pi / given.counts)
        rows += new
        show(new)
    if given.out is not None:
        given.out.write_text(json.dumps(rows, indent=1) + "\n")


if __name__ == "__main__":
    main()
