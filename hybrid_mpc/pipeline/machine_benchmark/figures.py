"""The free runs of a benchmark as pictures, one for each test file."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from hybrid_mpc.pipeline.machine_benchmark.free_runs import Run
from hybrid_mpc.pipeline.machine_benchmark.recordings import benchmark_of
from hybrid_mpc.scenario import Scenario


def draw(
    scenario: Scenario, results: Mapping[str, Any], runs: Mapping[str, Sequence[Run]], out: Path
) -> list[Path]:
    """Draw the longest free run of every test file into ``out/figures``.

    Args:
        scenario: The machine.
        results: What stands in ``results.json``.
        runs: Free runs by test file.
        out: The benchmark's folder.

    Returns:
        The files.
    """
    from hybrid_mpc.plots.machines import benchmark_run
    from hybrid_mpc.plots.style import save

    kind, _, mean = results["model"]["hybrid"].partition(" ")
    chosen = "fitted prior" if kind == "phy" else kind.upper() + (", mean" if mean else "")
    made, prior, spec = [], scenario.prior(), benchmark_of(scenario)
    for file, parts in runs.items():
        run = max(parts, key=lambda part: len(part.t))
        shown = {
            "phy": run.y_hat["phy"],
            "rnn": run.y_hat["rnn"],
            "hybrid": run.y_hat[results["model"]["hybrid"]],
        }
        figure = benchmark_run(
            run.t, run.y[:, 0], {name: y[:, 0] for name, y in shown.items()}, run.u,
            output=prior.outputs[0], inputs=prior.inputs, unit=spec.unit, scale=spec.scale,
            title=f"{scenario.title}: free run over {file}", names={"hybrid": f"hybrid ({chosen})"},
        )  # fmt: skip
        made.append(save(figure, out / "figures" / f"{Path(file).stem}.png"))
    return made
