"""One table of all that watches a machine: channels, thresholds, false alarms, how soon faults are seen."""

from __future__ import annotations

from collections.abc import Iterator

from scipy.stats import chi2

from hybrid_mpc.job.stage import Absent
from hybrid_mpc.job.stages.guard import GuardResult
from hybrid_mpc.job.stages.monitor import CleanAlarms, MonitorResult
from hybrid_mpc.job.stages.residuals import ResidualsResult
from hybrid_mpc.report.page import Table

HEADS = ("channel", "threshold", "false alarms an hour (95 % interval)", "faults: alarm after", "taken for")
CAPTION = (
    "All that watches the machine. False alarms are those that begin where nothing disturbs it, with the interval of a "
    "Poisson count. Faults are those of the closed loops below."
)
Row = tuple[str, str, str, str, str]


def watching_table(
    monitor: MonitorResult | Absent,
    guard: GuardResult | Absent,
    residuals: ResidualsResult | Absent,
    force: str,
) -> Table | None:
    """The table of the channels that have limits; None where there are none.

    Args:
        monitor: Result of the stage monitor.
        guard: Result of the stage guard.
        residuals: Result of the stage residuals.
        force: Unit of the level of residual forces.
    """
    rows = [*_energy(monitor, force), *_guard(guard), *_residuals(residuals)]
    return Table(HEADS, rows, CAPTION) if rows else None


def rate_words(alarms: int, seconds: float) -> str:
    """Alarms an hour with their 95 % interval.

    Source: exact interval of a Poisson count (Garwood, 1936).

    Example:
        >>> rate_words(1, 300.0), rate_words(0, 76.0), rate_words(0, 0.0)
        ('12 (0.3 to 67)', '0 (0 to 170)', 'not watched')
    """
    if not seconds > 0:
        return "not watched"
    hours = seconds / 3600.0
    low = 0.5 * float(chi2.ppf(0.025, 2 * alarms)) / hours if alarms else 0.0
    high = 0.5 * float(chi2.ppf(0.975, 2 * alarms + 2)) / hours
    rate, least, most = (
        f"{float(f'{one:.2g}'):g}" for one in (alarms / hours, low, high)
    )  # 170, not 1.7e+02
    return f"{rate} ({least} to {most})"


def _after(delay_s: float | None) -> str:
    return "never" if delay_s is None else f"{delay_s:.2g} s"


def _energy(found: MonitorResult | Absent, force: str) -> Iterator[Row]:
    if isinstance(found, Absent) or found.calibration.threshold_w is None:
        return
    rate = "" if found.clean is None else rate_words(found.clean.alarms, found.clean.seconds)
    load = "" if found.load is None else f"unknown load {_after(found.load.delay_s)}"
    yield "energy", f"{found.calibration.threshold_w:.3g} W", f"{rate}, both levels", load, ""
    if found.calibration.residual_threshold is not None:
        yield "residual force", f"{found.calibration.residual_threshold:.3g} {force}", "", "", ""


def _guard(found: GuardResult | Absent) -> Iterator[Row]:
    if isinstance(found, Absent) or found.detector is None:
        return
    loops = found.faults or ()
    delays = "; ".join(f"{row.fault} {_after(row.delay_s)}" for row in loops)
    told = "; ".join(f"{row.fault}: {row.diagnosis or 'nothing'}" for row in loops)
    rate = f"{rate_words(found.test.alarms, found.test.seconds)}, whole guard"
    yield "guard: sum of forces", f"{found.detector.force_threshold:.3g} deviations", rate, delays, told
    if found.detector.energy:
        yield "guard: power of free runs", f"{found.detector.energy_threshold:.3g} deviations", "", "", ""


def _residuals(found: ResidualsResult | Absent) -> Iterator[Row]:
    if isinstance(found, Absent) or not found.limits:
        return
    limits = tuple(found.limits.values())[-1]
    loops = found.faults or ()
    for i, channel in enumerate(limits.channels):
        unit = found.units[i] if i < len(found.units) else ""
        short, long = limits.threshold[i]
        own = found.by_channel.get(channel, CleanAlarms())
        seen = [row for row in loops if channel in row.channels[:1]]
        delays = "; ".join(f"{row.fault} of {row.channel} {_after(row.delay_s)}" for row in seen)
        told = "; ".join(f"{row.fault} of {row.channel}: {row.diagnosis or 'nothing'}" for row in seen)
        yield (
            channel,
            f"{short:.3g}, lasting {long:.3g} {unit}",
            rate_words(own.alarms, own.seconds),
            delays,
            told,
        )
    frozen = [row for row in loops if not row.channels or row.channels[0] not in limits.channels]
    if frozen:
        delays = "; ".join(f"{row.fault} of {row.channel} {_after(row.delay_s)}" for row in frozen)
        told = "; ".join(f"{row.fault} of {row.channel}: {row.diagnosis or 'nothing'}" for row in frozen)
        yield "frozen sensor, or no channel", "", "", delays, told
