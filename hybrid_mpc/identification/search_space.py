"""What a search of settings may change, and between which bounds. No torch in here."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, fields, replace
from typing import TYPE_CHECKING

from hybrid_mpc.errors import InputError

if TYPE_CHECKING:
    from optuna.distributions import BaseDistribution

    from hybrid_mpc.identification.settings import TrainingSettings

Values = Mapping[str, float]
WHOLE = ("hidden", "batch", "horizon")
"""Settings that are whole numbers."""
USUAL: Mapping[str, tuple[float, float]] = {
    "hidden": (4, 64),
    "learning_rate": (2e-3, 5e-2),
    "free_run_learning_rate": (5e-4, 2e-2),
    "decay": (10.0, 30000.0),
    "batch": (8, 128),
    "horizon": (20, 100),
    "anchors": (0.3, 300.0),
}
"""Bounds of a setting that is searched without bounds of its own."""


@dataclass(frozen=True)
class SearchSpace:
    """Settings that are searched, each between two bounds on a logarithmic scale; None leaves one as it is.

    Args:
        hidden: Hidden units z, whole numbers. Default: 4 to 64.
        learning_rate: Start of the schedule of teacher forcing; its end keeps the ratio that the base has.
            Default: 0.002 to 0.05.
        free_run_learning_rate: The same of the free runs. Default: 0.0005 to 0.02.
        decay: Weight decay times the number of training samples. Default: 10 to 30000.
        batch: Windows a step, whole numbers. Default: not searched; twice the batch is twice the work.
        horizon: Most scored periods of a free-run window, whole numbers. Default: not searched; twice the
            horizon is twice the work.
        anchors: Weight of fading corrections where nothing was measured. Default: not searched. Zero, none, is on no
            logarithmic scale: whoever has none compares with a search without them.

    Raises:
        InputError: If nothing is searched, or bounds are not positive, not rising, or not whole where they must be.

    Example:
        >>> SearchSpace(hidden=(8, 32), decay=None).names
        ('hidden', 'learning_rate', 'free_run_learning_rate')
    """

    hidden: tuple[int, int] | None = (4, 64)
    learning_rate: tuple[float, float] | None = (2e-3, 5e-2)
    free_run_learning_rate: tuple[float, float] | None = (5e-4, 2e-2)
    decay: tuple[float, float] | None = (10.0, 30000.0)
    batch: tuple[int, int] | None = None
    horizon: tuple[int, int] | None = None
    anchors: tuple[float, float] | None = None

    def __post_init__(self) -> None:
        for field in fields(self):
            bounds = getattr(self, field.name)
            if bounds is not None:
                object.__setattr__(self, field.name, _checked(field.name, bounds))
        if not self.names:
            raise InputError(f"the search has nothing to vary; give bounds to one of: {', '.join(USUAL)}")

    @property
    def names(self) -> tuple[str, ...]:
        """Settings that are searched."""
        return tuple(name for name, bounds in asdict(self).items() if bounds is not None)

    def bounds(self, name: str) -> tuple[float, float]:
        """Bounds of a setting that is searched."""
        low, high = getattr(self, name)
        return low, high

    def values_of(self, settings: TrainingSettings) -> dict[str, float]:
        """What the searched settings are in ``settings``."""
        rates = settings.learning_rates
        own = {"learning_rate": rates[0], "free_run_learning_rate": rates[2]}
        return {name: own[name] if name in own else getattr(settings, name) for name in self.names}

    def holds(self, values: Values) -> bool:
        """Whether all values lie within the bounds."""
        return all(self.bounds(n)[0] <= values[n] <= self.bounds(n)[1] for n in self.names)

    def apply(self, base: TrainingSettings, values: Values) -> TrainingSettings:
        """``base`` with the values in it."""
        start, end, free_start, free_end = base.learning_rates
        rate = values.get("learning_rate", start)
        free = values.get("free_run_learning_rate", free_start)
        rates = (rate, rate * (end / start), free, free * (free_end / free_start))
        changes = {name: value for name, value in values.items() if not name.endswith("learning_rate")}
        return replace(base, learning_rates=rates, **changes)  # type: ignore[arg-type]

    def distributions(self) -> dict[str, BaseDistribution]:
        """Optuna's distributions of the searched settings."""
        from optuna.distributions import FloatDistribution, IntDistribution

        made: dict[str, BaseDistribution] = {}
        for name in self.names:
            low, high = self.bounds(name)
            whole = name in WHOLE
            made[name] = (
                IntDistribution(int(low), int(high), log=True)
                if whole
                else FloatDistribution(low, high, log=True)
            )
        return made


def parsed_space(texts: Sequence[str]) -> SearchSpace:
    """A space from ``NAME`` or ``NAME=LOW:HIGH`` for each setting; all that are not named stay as they are.

    Args:
        texts: e.g. ``["hidden=8:32", "batch"]``; a name alone has its usual bounds. None at all is the default
            space.

    Raises:
        InputError: If a name is not known or given twice, or bounds are no numbers.

    Example:
        >>> parsed_space(["hidden=8:32", "batch"]).batch
        (8, 128)
    """
    if not texts:
        return SearchSpace()
    found: dict[str, tuple[float, float] | None] = {}
    for text in texts:
        name, _, given = text.partition("=")
        if name not in USUAL:
            raise InputError(f"no setting {name!r} to vary; there are: {', '.join(USUAL)}")
        if name in found:
            raise InputError(f"{name} is varied twice; give it once")
        found[name] = _parsed_bounds(text, given) if given else USUAL[name]
    return SearchSpace(**(dict.fromkeys(USUAL) | found))


def _parsed_bounds(text: str, given: str) -> tuple[float, float]:
    low, _, high = given.partition(":")
    try:
        return float(low), float(high)
    except ValueError as error:
        raise InputError(f"{text!r}: the form is NAME=LOW:HIGH, e.g. hidden=8:32") from error


def _checked(name: str, bounds: Sequence[float]) -> tuple[float, float]:
    if len(bounds) != 2 or not 0 < bounds[0] < bounds[1] < float("inf"):
        raise InputError(
            f"{name} is to be varied between {list(bounds)}; needed are two positive numbers, the lower one first"
        )
    if name not in WHOLE:
        return float(bounds[0]), float(bounds[1])
    if any(b != int(b) for b in bounds):
        raise InputError(f"{name} is to be varied between {list(bounds)}; its bounds must be whole numbers")
    return int(bounds[0]), int(bounds[1])
