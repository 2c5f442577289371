"""The networks of a benchmark: settings from the budget, training in processes of their own."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

from hybrid_mpc.benchmark_spec import BenchmarkBudget
from hybrid_mpc.data.trajectories import Trajectory
from hybrid_mpc.identification.settings import KINDS, TrainingSettings
from hybrid_mpc.identification.trained import Trained
from hybrid_mpc.identification.training import train
from hybrid_mpc.job.engine import run_jobs
from hybrid_mpc.pipeline.trained_files import is_trained, load_trained, save_trained
from hybrid_mpc.scenario import load_scenario

Report = Callable[[str, int, int, str], None]


def settings_of(kind: str, budget: BenchmarkBudget, *, seed: int, warm: int) -> TrainingSettings:
    """Settings of one kind: free runs are trained on the error of the position, by which they are judged.

    Example:
        >>> budget = BenchmarkBudget(16, 2, teacher_steps=100, free_run_steps=200, horizon=40)
        >>> settings_of("mopgrnn", budget, seed=0, warm=10).objectives
        ('position', 'energy')
    """
    return TrainingSettings(
        kind=kind,  # type: ignore[arg-type]
        hidden=budget.hidden,
        networks=budget.networks,
        teacher_steps=budget.teacher_steps,
        free_run_steps=budget.free_run_steps,
        seed=seed,
        warm=warm,
        horizon=budget.horizon,
        batch=budget.batch,
        decay=budget.decay,
        anchors=budget.anchors,
        objectives=("position", "energy"),
        fused=True,
    )


def train_all(
    scenario: str,
    values: Mapping[str, float],
    training: Sequence[Trajectory],
    validation: Sequence[Trajectory],
    settings: Callable[[str], TrainingSettings],
    folder: Path,
    *,
    workers: int,
    on_progress: Report = lambda key, done, total, text: None,
) -> dict[str, Trained]:
    """Train the networks of every kind that ``folder`` does not hold yet; an interrupted one goes on.

    Args:
        scenario: Registered name or path, which every process loads for itself.
        values: Parameters of the fitted prior.
        training: Smoothed training pieces.
        validation: Smoothed validation pieces.
        settings: ``kind -> settings``.
        folder: Where checkpoints and finished networks lie.
        workers: Kinds trained side by side.
        on_progress: ``(kind, done, total, text)``.
    """
    jobs: dict[str, tuple[Callable[..., Any], tuple[Any, ...]]] = {
        kind: (_train, (scenario, dict(values), list(training), list(validation), settings(kind), folder))
        for kind in reversed(KINDS)
        if not is_trained(folder, settings(kind))
    }
    run_jobs(jobs, on_progress, workers)
    return {str(kind): load_trained(folder, kind) for kind in KINDS}


def _train(
    scenario: str,
    values: dict[str, float],
    training: Sequence[Trajectory],
    validation: Sequence[Trajectory],
    settings: TrainingSettings,
    folder: Path,
    report: Callable[[int, int, str], None],
) -> None:
    trained = train(
        load_scenario(scenario).prior(values),
        training,
        validation,
        settings,
        checkpoint=folder / f"{settings.kind}.safetensors",
        on_progress=lambda done, total, error: report(done, total, f"validation RMSE {error:.4g}"),
    )
    save_trained(folder, trained)
