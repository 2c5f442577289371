"""Jobs of a reproduction, each in a process of its own; each leaves its files and is done when they are there."""

from __future__ import annotations

import importlib
import time
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from hybrid_mpc.data.trajectories import Trajectory
from hybrid_mpc.files import write_arrays, write_json
from hybrid_mpc.scenario import load_scenario
from scenarios.paper.table import METRICS, Divergence, Network, Row

if TYPE_CHECKING:
    from hybrid_mpc.identify.evaluate import FreeRun
    from hybrid_mpc.identify.prior_result import PriorFit
    from hybrid_mpc.identify.settings import TrainingSettings
    from hybrid_mpc.identify.step import RecurrentStep
    from hybrid_mpc.identify.train import Trained

Progress = Callable[[int, int, str], None]
Array = NDArray[np.float64]
BEYOND = 10.0
"""An output beyond so many times the largest one measured in any test run counts as diverged."""
RULE = (
    f"A network has diverged if in any test run a state of its free run is not finite, or an output goes beyond "
    f"{BEYOND:g} times the largest one measured in all test runs. Diverged networks are counted; means and standard "
    "deviations are over the others, medians over all (a diverged one counting as infinite)."
)
NEAR = 1.1
"""A training has converged where its validation error is first within this factor of its best."""
SHOWN = ("t", "u", "x", "x_hat", "balances", "balances_hat")


def divergence(runs: Sequence[FreeRun]) -> Divergence | None:
    """Where the free runs of one network left all bounds (``RULE``); None if they did not."""
    largest = np.max([np.abs(run.y).max(0) for run in runs], axis=0)
    found: list[tuple[FreeRun, int]] = []
    for run in runs:
        with np.errstate(invalid="ignore"):
            bad = ~np.isfinite(run.x_hat).all(1) | (np.abs(run.y_hat) > BEYOND * largest).any(1)
        if bad.any():
            found.append((run, int(np.argmax(bad))))
    if not found:
        return None
    run, step = found[0]
    return Divergence(run.name, step, float(run.t[step] - run.t[0]), len(found))


def network_figures(
    runs: Sequence[FreeRun], validation: float | None = None, converged: int | None = None
) -> Network:
    """Figures of one network, or where it diverged."""
    where = divergence(runs)
    figures = {} if where is not None else figures_of(runs)
    known = validation if validation is not None and np.isfinite(validation) else None
    return Network(figures, known, converged if known is not None else None, where)


def figures_of(runs: Sequence[FreeRun]) -> dict[str, float]:
    """All figures of free runs by name (``METRICS``), as the paper has them of a pendulum: means over the runs.

    ``e_sim_s`` is the simulation error in duration form: errors of the rates are added up in their own units.
    ``e_sim_lambda1_s`` discounts them by ``1 / (1 + λ t)`` with λ = 1 1/s; ``e_sim_paper_s`` is the paper's form, the
    integral over a run divided by its number of samples. ``rmse_rad`` is of the angle, ``energy_violation_w`` of the
    energy, the first balance.
    """
    every: dict[str, list[float]] = {}
    for run in runs:
        error = np.abs(run.xdot_hat - run.xdot).sum(1)
        t, dt = run.t - run.t[0], float(np.mean(np.diff(run.t)))
        own = {
            "e_sim_s": error.mean(),
            "e_sim_lambda1_s": (error / (1.0 + t)).mean(),
            "e_sim_paper_s": error.mean() * dt,
            "square": np.square(run.y_hat[:, 0] - run.y[:, 0]).mean(),
            "energy_violation_w": np.abs(run.balances_hat[:, 0] - run.balances[:, 0]).mean(),
        }
        for name, value in own.items():
            every.setdefault(name, []).append(float(value))
    means = {name: float(np.mean(values)) for name, values in every.items()}
    figures = {**means, "rmse_rad": float(np.sqrt(means.pop("square")))}
    return {name: figures[name] if np.isfinite(figures[name]) else float("inf") for name in METRICS}


def converged_steps(trained: Trained) -> list[int]:
    """Optimiser steps after which each network's validation error was within ``NEAR`` of its best."""
    best = np.minimum.accumulate(trained.curve["validation"], axis=0)
    first = np.argmax(best <= NEAR * best[-1], axis=0)
    return [int(trained.curve["step"][row, i]) for i, row in enumerate(first)]


def shown_run(runs: Sequence[FreeRun], name: str) -> dict[str, Any]:
    """Arrays of the run that is drawn; of the first one if there is none of that name."""
    run = next((r for r in runs if r.name == name), runs[0])
    return {key: getattr(run, key) for key in SHOWN}


@dataclass(frozen=True)
class EvaluationSet:
    """What all models of a reproduction are evaluated on: test runs whose starts are smoothed from their warm-ups
    alone.

    The prior with the parameters ``values`` gives the energy balance; ``shown`` is the run that is drawn.
    """

    test: Sequence[Trajectory]
    values: dict[str, float]
    warm: int
    shown: str


@dataclass(frozen=True)
class Case:
    """One amount of training data of one data set, as a process gets it, with the prior fitted to it.

    The fit is None where states are exact. ``form`` of the models is ``"hybrid"`` or
    ``"paper"``.
    """

    scenario: str
    data_set: str
    training: Sequence[Trajectory]
    validation: Sequence[Trajectory]
    values: dict[str, float]
    fit: PriorFit | None
    evaluation: EvaluationSet
    folder: Path
    device: str = "cpu"
    form: str = "hybrid"

    @property
    def dt(self) -> float:
        """Model period [s]."""
        return self.training[0].dt


def step_class(form: str) -> type[RecurrentStep]:
    """The class of a form's steps."""
    from hybrid_mpc.identify.step import HybridStep
    from scenarios.paper.step import PaperStep

    return PaperStep if form == "paper" else HybridStep


def fit_job(
    scenario: str, train: Sequence[Trajectory], valid: Sequence[Trajectory], path: Path, report: Progress
) -> None:
    """Fit the prior to one amount of training data and smooth by it, as the main job does."""
    from hybrid_mpc.identify.fit import fit_prior, smoothed

    started, make, dt = time.monotonic(), load_scenario(scenario).prior, train[0].dt
    fit = fit_prior(make, train, valid, dt=dt, on_progress=report)
    parts = [t for part in (train, valid) for t in smoothed(make, fit, part, dt)]
    arrays = {f"{t.name}/{key}": getattr(t, key) for t in parts for key in ("x", "xdot")}
    write_arrays(path.with_suffix(".npz"), arrays)
    write_json(path.with_suffix(".json"), {**asdict(fit), "seconds": time.monotonic() - started})


def physics_job(cases: Sequence[tuple[Case, int]], path: Path, report: Progress) -> None:
    """Evaluate the nominal and the fitted prior of all amounts of training data."""
    from hybrid_mpc.identify.evaluate import free_runs
    from hybrid_mpc.identify.step import PriorStep

    start, rows = time.monotonic(), []
    arrays: dict[str, Any] = {}
    for i, (case, count) in enumerate(cases):
        report(i, len(cases), f"{case.data_set}, {count} sequences")
        make, evaluation = load_scenario(case.scenario).prior, case.evaluation
        for model, values in (("phy_nominal", None), ("phy", case.values)):
            step = PriorStep(make(values), case.dt, case.fit.substeps if case.fit and values else 0)
            runs = free_runs(step, make(evaluation.values), evaluation.test, evaluation.warm)
            rows.append(Row(case.data_set, count, model, (network_figures(runs),)))
            arrays |= {
                f"{case.data_set}_{count:02d}_{model}/{k}": v
                for k, v in shown_run(runs, evaluation.shown).items()
            }
    write_arrays(path.with_suffix(".npz"), arrays)
    _finish(path, rows, {}, start)


def ensemble_job(
    case: Case, count: int, model: str, settings: TrainingSettings, key: str, report: Progress
) -> None:
    """Train the networks of one model on one amount of data and evaluate all of them."""
    from hybrid_mpc.identify.evaluate import stacked_free_runs
    from hybrid_mpc.identify.train import train

    start, path = time.monotonic(), case.folder / key
    make, evaluation = load_scenario(case.scenario).prior, case.evaluation
    prior = make(case.values)
    trained = train(
        prior, case.training, case.validation, settings, form=step_class(case.form),
        checkpoint=case.folder / f"{key}.safetensors", device=case.device,
        on_progress=lambda done, total, error: report(done, total, f"validation E_sim {error:.4g}"),
    )  # fmt: skip
    with np.errstate(over="ignore", invalid="ignore"):  # a network that diverges counts as such
        runs = stacked_free_runs(
            trained, prior, case.dt, make(evaluation.values), evaluation.test, evaluation.warm
        )
        networks = tuple(
            network_figures(own, float(error), steps)
            for own, error, steps in zip(runs, trained.validation, converged_steps(trained), strict=True)
        )
    arrays = {f"weights.{name}": value for name, value in trained.weights.items()}
    arrays |= {f"curve.{name}": value for name, value in trained.curve.items()}
    arrays |= {f"shown.{k}": v for k, v in shown_run(runs[trained.best], evaluation.shown).items()}
    write_arrays(path.with_suffix(".npz"), arrays)
    details = {
        "scaling": asdict(trained.scaling),
        "skipped": trained.skipped.tolist(),
        "failures": [asdict(failure) for failure in trained.failures],
        "best_by_validation": trained.best,
    }
    _finish(path, [Row(case.data_set, count, model, networks)], details, start)


def sindy_job(case: Case, count: int, key: str, report: Progress) -> None:
    """Identify a sparse equation on one amount of data and evaluate it."""
    from hybrid_mpc.identify.evaluate import evaluation_trajectories, free_runs

    start, path = time.monotonic(), case.folder / key
    make, evaluation = load_scenario(case.scenario).prior, case.evaluation
    prior, validation = make(case.values), list(case.validation)
    report(0, 1, "searching libraries of terms")
    if case.fit is not None:
        validation = evaluation_trajectories(validation, case.fit.smoother(prior, case.dt), evaluation.warm)
    fit_sindy = importlib.import_module("scenarios.paper.sindy").fit_sindy
    step = fit_sindy(case.training, prior, case.dt, validation=validation, warm=evaluation.warm)
    with np.errstate(over="ignore", invalid="ignore"):
        runs = free_runs(step, make(evaluation.values), evaluation.test, evaluation.warm)
        network = network_figures(runs)
    write_arrays(
        path.with_suffix(".npz"), {f"shown.{k}": v for k, v in shown_run(runs, evaluation.shown).items()}
    )
    _finish(path, [Row(case.data_set, count, "sindy", (network,))], {"equations": step.text()}, start)


def _finish(path: Path, rows: Sequence[Row], details: dict[str, Any], start: float) -> None:
    """Write what means that the job is done."""
    value = {"rows": [asdict(row) for row in rows], "details": details, "seconds": time.monotonic() - start}
    write_json(path.with_suffix(".json"), value)
