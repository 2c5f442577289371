"""The report's table of the monitor: channels, thresholds, false alarms, detection delays of faults."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

from scipy.stats import chi2

from hybrid_mpc.report.page import Table
from hybrid_mpc.rules import two_digits
from hybrid_mpc.watch.detector import WatchLimits
from hybrid_mpc.workflow.stages.watch import CleanAlarms, FaultedLoop, WatchResult

HEADS = (
    "channel",
    "threshold",
    "false alarms an hour (95 % interval)",
    "detection delay of faults",
    "diagnosis",
)
CAPTION = (
    "Channels of the monitor. A false alarm begins while no fault or disturbance acts; their interval is that of a "
    "Poisson count. Each simulated fault stands beside the channel that alarms first."
)


def watching_table(found: WatchResult, limits: WatchLimits) -> Table:
    """Table of the channels with limits, of the frozen-sensor checks, and of all together."""
    rows, faults = [], found.faults or ()
    for channel in found.channels:
        own = limits.of(channel.name)
        if own:
            threshold = "; ".join(limit.words(limits.dt) for limit in own)
            rows.append(_row(channel.name, threshold, found.by_channel, faults))
    frozen = [name for name in found.by_channel if name.endswith(" frozen")]
    for name, far, often in zip(frozen, limits.travel, limits.repeats, strict=True):
        rows.append(_row(name, f"travel {far:.3g}, {often} repeats", found.by_channel, faults))
    clean = found.clean or CleanAlarms()
    never = [row for row in faults if row.delay_s is None]
    rows.append(("all together", "", rate_words(clean.alarms, clean.seconds), *_seen(never)))
    return Table(HEADS, rows, CAPTION)


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
    rate, least, most = map(two_digits, (alarms / hours, low, high))
    return f"{rate} ({least} to {most})"


def _row(
    name: str, threshold: str, by_channel: Mapping[str, CleanAlarms], faults: Sequence[FaultedLoop]
) -> tuple[str, str, str, str, str]:
    own = by_channel.get(name, CleanAlarms())
    seen = [row for row in faults if row.channels[:1] == (name,)]
    return (name, threshold, rate_words(own.alarms, own.seconds), *_seen(seen))


def _seen(faults: Sequence[FaultedLoop]) -> tuple[str, str]:
    """Detection delays and diagnoses of faults, as text."""
    after = [f"{row.fault} {'never' if row.delay_s is None else f'{row.delay_s:.2g} s'}" for row in faults]
    causes = [f"{row.fault}: {row.diagnosis or 'none'}" for row in faults if row.delay_s is not None]
    return "; ".join(after), "; ".join(causes)
