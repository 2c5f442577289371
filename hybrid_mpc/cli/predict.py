"""``hybrid-mpc predict``: predictions of recordings by a model, from its folder alone."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from hybrid_mpc.cli.options import ArtifactFolder, EmptyFolder

if TYPE_CHECKING:
    from collections.abc import Sequence

    from hybrid_mpc.identify.predict import Prediction

EXAMPLES = (
    "Examples:\n\n"
    "  hybrid-mpc predict runs/golf/model today.csv --out today\n\n"
    "  hybrid-mpc predict runs/mine monday.csv tuesday.csv --model prior --out week"
)


def predict(
    kit: ArtifactFolder,
    recordings: Annotated[list[Path], typer.Argument(help="Recordings: CSV, .npz or .mat.")],
    out: EmptyFolder,
    model: Annotated[str, typer.Option(help="prior or hybrid. Default: the recommended one.")] = "",
) -> None:
    """Write free runs and one-step predictions of recordings, with bands and residuals.

    The folder describes how to read recordings; scenario and checkpoints are not needed.
    """
    from hybrid_mpc.cli.progress import make_progress, print_summary, say
    from hybrid_mpc.files import check_folder
    from hybrid_mpc.kit.artifact import load
    from hybrid_mpc.workflow.predict import predict_recordings, read_recordings_of

    check_folder(out)
    loaded = load(kit)
    trajectories, doubts = read_recordings_of(loaded, recordings)
    for doubt in doubts:
        say(f"warning: {doubt}")
    with make_progress() as progress:
        found = predict_recordings(loaded, trajectories, out, model, progress)
    print_summary(summary(found), out / "predict.json")


def summary(found: Sequence[Prediction]) -> list[str]:
    """One line per recording, kind of prediction and output."""
    lines = [f"{'recording':16} {'':22} {'output':20} {'RMSE':>10} {'FIT [%]':>8} {'in band':>8} {'of':>5}"]
    for one in found:
        for kind, run in ((one.title, one.free_run), ("one step", one.one_step)):
            if run is None:
                lines.append(f"{one.name:16} one step: {one.reason}")
                continue
            lines += [
                f"{one.name:16} {kind:22} {label:20} {_number(error):>10} {_number(run.fit_percent[label], 3):>8} "
                f"{_share(run.inside[label]):>8} {100 * run.share:>3.0f} %"
                for label, error in run.rmse.items()
            ]
    return lines


def _number(value: float | None, digits: int = 4) -> str:
    return "-" if value is None else f"{value:.{digits}g}"


def _share(value: float | None) -> str:
    return "-" if value is None else f"{100 * value:.0f} %"
