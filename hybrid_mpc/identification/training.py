"""Training of recurrent corrections: teacher forcing, then free runs; checkpointed and resumable."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Callable, Sequence
from dataclasses import asdict
from pathlib import Path

import numpy as np
import torch

from hybrid_mpc.data.trajectories import Trajectory
from hybrid_mpc.identification.checkpoint import load_checkpoint, save_checkpoint
from hybrid_mpc.identification.settings import KINDS, Kind, TrainingSettings
from hybrid_mpc.identification.trained import Fault, Trained
from hybrid_mpc.identification.training_run import TrainingRun
from hybrid_mpc.physics import Prior

__all__ = ["train", "TrainingSettings", "Trained", "Fault", "Kind", "KINDS", "Progress"]

Progress = Callable[[int, int, float], None]


def train(
    prior: Prior,
    training: Sequence[Trajectory],
    validation: Sequence[Trajectory],
    settings: TrainingSettings,
    *,
    checkpoint: Path | None = None,
    device: str = "cpu",
    on_progress: Progress = lambda done, total, error: None,
) -> Trained:
    """Train a stack of networks on trajectories; the best weights of each by validation free runs are kept.

    First teacher forcing (the paper's training), then free runs with back-propagation through the
    integrator. All kinds get the same steps, batches and data. A network whose gradient is no number skips
    that update; after several in a row it stops with its best weights, and ``Trained.faults`` says what for.
    With ``settings.anchors`` corrections fade where no training trajectory comes near.

    Args:
        prior: The fitted prior.
        training: Training trajectories.
        validation: Validation trajectories; they choose weights, they are not trained on.
        settings: See :class:`TrainingSettings`.
        checkpoint: File to save to and to resume from; default: none.
        device: Where the tensors live, ``"cpu"`` or e.g. ``"cuda"``; the result is on the CPU in any case.
        on_progress: ``(done, total, best validation error)`` at every evaluation.

    Raises:
        InputError: If no trajectory is long enough, a value is not finite, or the checkpoint is of another
            training.
    """
    torch.set_num_threads(1)  # tensors this small only lose by threads
    run = TrainingRun(prior, training, validation, settings, device)
    key = _key(settings, training, validation, prior)
    total = settings.teacher_steps + settings.free_run_steps
    if checkpoint is not None and checkpoint.is_file():
        run.restore(*load_checkpoint(checkpoint, key))
    while not run.over:
        if run.done in (0, settings.teacher_steps):
            run.enter_stage()
        for _ in range(min(settings.every, run.stage_end - run.done)):
            run.update()
        run.evaluate()
        if checkpoint is not None:
            save_checkpoint(checkpoint, key, *run.snapshot())
        on_progress(run.done, total, float(run.best.min()))
    return run.result()


def _key(
    s: TrainingSettings, training: Sequence[Trajectory], validation: Sequence[Trajectory], prior: Prior
) -> str:
    settings = asdict(s)
    if s.prior_parameters == "fixed":
        del settings["prior_parameters"]  # the key is then that of trainings that could do nothing else
    if not s.anchors:
        del settings["anchors"]  # likewise
    digest = hashlib.sha256(json.dumps([settings, prior.values], sort_keys=True).encode())
    for trajectory in (*training, *validation):
        digest.update(np.ascontiguousarray(trajectory.x).tobytes())
        digest.update(np.ascontiguousarray(trajectory.u).tobytes())
        if s.form == "literal":
            digest.update(np.ascontiguousarray(trajectory.xdot).tobytes())
    return digest.hexdigest()
