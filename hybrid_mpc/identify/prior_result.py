"""Result of a fit of the prior: values, standard errors, unidentifiable parameters. No torch in here."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any

from hybrid_mpc.data.scales import SmootherSettings
from hybrid_mpc.errors import named_extra
from hybrid_mpc.identify.smooth import Smoother
from hybrid_mpc.machine.prior import Prior
from hybrid_mpc.machine.signals import Parameter

if TYPE_CHECKING:
    import pandas as pd

CORRELATED = 0.99
"""Correlation of the errors of two parameters above which the two are reported."""
ENOUGH = 1.01
"""Ratio to the least error up to which the longest windows are used: long windows identify the parameters best."""
FROM_WARM_UP = "free runs from the warm-up"
"""Name of the stage that is fitted to free runs from a warm-up."""
PREDICTIONS = "predictions"
"""Name of the stage that is fitted by predictions one period ahead instead of free runs."""
LEAST_T = 2.0
"""Ratio of a value to its standard error below which the parameter may be zero."""


def winner(stages: Sequence[str], errors: Sequence[float]) -> int:
    """Index of the stage to use: the last stage (longest windows) whose error is within 1 % of the least error.

    The stage ``PREDICTIONS`` is used only if its error is more than 1 % below that of all others; the stage
    ``FROM_WARM_UP`` is always used, because a fit only has it if it predicts better.

    Example:
        >>> winner(["nominal", "short", "long", "longer"], [0.5, 0.1, 0.1005, 0.2])
        2
    """
    if FROM_WARM_UP in stages:
        return stages.index(FROM_WARM_UP)
    runs = [i for i, stage in enumerate(stages) if stage != PREDICTIONS]
    least = min(errors[i] for i in runs)
    found = max(i for i in runs if errors[i] <= ENOUGH * least)
    others = [i for i, stage in enumerate(stages) if stage == PREDICTIONS and ENOUGH * errors[i] < least]
    return min(others, key=errors.__getitem__, default=found)


@dataclass(frozen=True)
class Combination:
    """Parameters that are not identifiable one by one, and the combination of them that is.

    Args:
        parameters: Their names. A single parameter is not identifiable within its range.
        weights: Weight of each parameter in the identifiable combination; the largest is 1. Default: no combination.
        product: True: the combination is the product of the parameters, each to the power of its weight. Default: the
            combination is the sum of the parameters, each times its weight.
        error: Standard error of the combination: relative [-] for a product, in its unit for a sum.

    Example:
        >>> print(Combination(("k", "m"), (1.0, -1.0), True, 0.01))
        only a combination of k, m is identifiable: k * m^-1, standard error 1 %
    """

    parameters: tuple[str, ...]
    weights: tuple[float, ...] = ()
    product: bool = False
    error: float = 0.0

    def __str__(self) -> str:
        if not self.weights:
            return f"{', '.join(self.parameters)} is not identifiable within its range"
        of = [(name, w) for name, w in zip(self.parameters, self.weights, strict=True) if abs(w) >= 0.005]
        if self.product:
            text = " * ".join(name if abs(w - 1.0) < 0.005 else f"{name}^{w:.2g}" for name, w in of)
            text += f", standard error {100 * self.error:.2g} %"
        else:
            text = " + ".join(name if abs(w - 1.0) < 0.005 else f"{w:.3g} {name}" for name, w in of)
            text = text.replace("+ -", "- ") + f", standard error {self.error:.2g}"
        return f"only a combination of {', '.join(self.parameters)} is identifiable: {text}"


@dataclass(frozen=True)
class PriorFit(SmootherSettings):
    """Fitted parameters with their standard errors, and the settings of the smoother around the fitted prior.

    Args:
        values: Values [SI] of all parameters by name, fitted and fixed.
        standard_errors: Standard errors [SI] of the fitted parameters, from the scatter over parts of the windows. They
            assume a model without structural error, so they are lower bounds. At most half of the parameter's range.
        warnings: Parameters at a bound, and parameters that are not identifiable.
        stages: One row for each stage of the fit: its name and its validation error, which selects the stage.
        correlations: Correlation of the errors of every two fitted parameters, by ``"a, b"``. Default: none known.
        delay: Delay of the inputs [s]. Default: none.
        unidentified: Parameters that are not identifiable one by one. Default: none.
        lacking_delay: Delay of the inputs [s] that the recordings show and the prior lacks. Default: none.
    """

    values: dict[str, float]
    standard_errors: dict[str, float]
    warnings: tuple[str, ...]
    stages: tuple[dict[str, Any], ...]
    correlations: dict[str, float] = field(default_factory=dict)
    delay: float = 0.0
    unidentified: tuple[Combination, ...] = ()
    lacking_delay: float = 0.0

    def smoother(self, prior: Prior, dt: float) -> Smoother:
        """The smoother around the fitted prior."""
        return Smoother(prior, dt, **self.smoother_settings)

    @property
    def best(self) -> str:
        """Name of the stage that was selected."""
        names, errors = ([row[key] for row in self.stages] for key in ("stage", "validation_error"))
        return str(names[winner(names, errors)])

    @property
    def t_ratios(self) -> dict[str, float]:
        """Ratio of value to standard error of every fitted parameter, by name; infinite if the error is zero."""
        return {
            name: self.values[name] / error if error else float("inf")
            for name, error in self.standard_errors.items()
        }

    @property
    def identifiability(self) -> tuple[str, ...]:
        """Texts about poorly identifiable parameters: :attr:`warnings`, correlations above 0.99, t-ratios below 2."""
        close = [
            f"{names.replace(', ', ' and ')} are hardly identifiable separately: the correlation of their errors is "
            f"{value:.3f}"
            for names, value in self.correlations.items()
            if abs(value) > CORRELATED
        ]
        small = [
            f"{name} may be zero: its value is {abs(ratio):.1f} standard errors"
            for name, ratio in self.t_ratios.items()
            if abs(ratio) < LEAST_T
        ]
        return (*self.warnings, *close, *small)

    def covariance(self, parameters: Sequence[Parameter]) -> tuple[tuple[float, ...], ...]:
        """Covariance matrix of the values, row by row, as an artifact stores it; zero for fixed parameters.

        Empty if a standard error is not known.
        """
        errors = [0.0 if p.fixed else self.standard_errors.get(p.name, math.nan) for p in parameters]
        rows = tuple(
            tuple(a * b * self._correlation(p.name, q.name) for q, b in zip(parameters, errors, strict=True))
            for p, a in zip(parameters, errors, strict=True)
        )
        return rows if all(math.isfinite(value) for row in rows for value in row) else ()

    def rows(self, parameters: Sequence[Parameter]) -> list[dict[str, Any]]:
        """One row for each parameter: name, unit, nominal and fitted value, standard error, t-ratio, correlation.

        ``correlation`` is that with the parameter whose error is most correlated.
        """
        ratios = self.t_ratios
        return [
            {
                "parameter": p.name,
                "unit": p.unit,
                "nominal": p.value,
                "fitted": self.values[p.name],
                "standard_error": self.standard_errors.get(p.name),
                "t_ratio": ratios.get(p.name),
                "correlation": self._closest(p.name),
            }
            for p in parameters
        ]

    def table(self, parameters: Sequence[Parameter]) -> pd.DataFrame:
        """Return :meth:`rows` as a data frame; ``fit.table(prior.parameters).to_csv(path)`` writes it."""
        with named_extra("the table (rows() gives the same without)"):
            import pandas as pd
        return pd.DataFrame(self.rows(parameters)).set_index("parameter")

    def _correlation(self, first: str, second: str) -> float:
        known = (self.correlations.get(f"{a}, {b}") for a, b in ((first, second), (second, first)))
        return 1.0 if first == second else next((value for value in known if value is not None), 0.0)

    def _closest(self, name: str) -> float | None:
        own = [value for names, value in self.correlations.items() if name in names.split(", ")]
        return max(own, key=abs) if own else None
