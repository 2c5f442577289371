"""``hybrid-mpc search``: the main job's data and prior, then a search of the networks' settings; its files."""

from __future__ import annotations

import csv
import io
import shlex
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, field, fields
from pathlib import Path
from typing import TYPE_CHECKING, Any

from hybrid_mpc.errors import InputError
from hybrid_mpc.files import write_json, write_text
from hybrid_mpc.identify.tune import SearchSpace
from hybrid_mpc.job.check import check_scenario
from hybrid_mpc.job.context import Context, Progress, Silent, versions
from hybrid_mpc.job.folder import open_folder
from hybrid_mpc.job.settings import RunSettings, claim
from hybrid_mpc.job.stage import bring_up_to_date
from hybrid_mpc.job.stages.identify import DATA, MODELS, PRIOR, check_data, training_settings
from hybrid_mpc.scenario import load_scenario

if TYPE_CHECKING:
    from hybrid_mpc.identify.tune import SearchResult, TrialRow

SCHEMA_VERSION = 1
RATES = ("learning_rate", "free_run_learning_rate")


@dataclass(frozen=True)
class SearchSettings(RunSettings):
    """What ``hybrid-mpc search`` computes: a run's settings, of which the networks' are the first trial, and these.

    Args:
        kind: ``"rnn"``, ``"pgrnn"`` or ``"mopgrnn"``.
        space: What is searched.

    Raises:
        InputError: If there is no such kind, or an rnn is to be anchored to a prior that it does not have.

    Example:
        >>> SearchSettings("golf_robot", kind="gru")
        Traceback (most recent call last):
        hybrid_mpc.errors.InputError: kind has no 'gru'; there are: rnn, pgrnn, mopgrnn
    """

    kind: str = "mopgrnn"
    space: SearchSpace = field(default_factory=SearchSpace)

    def __post_init__(self) -> None:
        kinds = [name for name in MODELS if not name.startswith("phy")]
        if self.kind not in kinds:
            raise InputError(f"kind has no {self.kind!r}; there are: {', '.join(kinds)}")
        if self.kind == "rnn" and self.space.prior_replay is not None:
            raise InputError(
                "an rnn has no prior to be anchored to; leave prior_replay out of what is varied"
            )

    def identity(self) -> dict[str, Any]:
        """Settings as plain data; without prior_replay where they are not searched, as in searches from before."""
        plain = super().identity()
        if plain["space"]["prior_replay"] is None:
            del plain["space"]["prior_replay"]
        return plain


def run_search(
    settings: SearchSettings,
    out: Path,
    *,
    trials: int = 20,
    timeout: float | None = None,
    resume: bool = False,
    progress: Progress | None = None,
) -> dict[str, Any]:
    """Search the settings of one kind of network and leave tables and figures in ``out``.

    Data and prior are the main job's stages with the same seed, so a run with the settings found trains what the
    search trained. Only training and validation recordings are looked at.

    Args:
        settings: What to compute.
        out: Folder to make; new or empty unless ``resume``.
        trials: Trials in all; a search that is resumed may be given more.
        timeout: No further trial starts after this time of searching [s]. Default: none.
        resume: Go on with the search that ``out`` holds.
        progress: Where to report; default: nowhere.

    Returns:
        What ``results.json`` holds (docs/search.md).

    Raises:
        InputError: For any bad input.
    """
    from hybrid_mpc.identify.tune import check_numbers, search

    check_numbers(trials, settings.seed, timeout)
    context = Context(settings, load_scenario(settings.scenario), out, progress or Silent())
    check_scenario(context.scenario, context.budget)
    check_data(context)
    with open_folder(out, claim(settings), resume=resume):
        for stage in (DATA, PRIOR):
            context.progress.start(stage.title)
            context.progress.finish(bring_up_to_date(context, stage))
        context.progress.start(f"searching, {trials} trials")
        found = search(
            context.scenario.prior(context.prior.fit.values),
            context.smoothed("train"),
            context.smoothed("valid"),
            training_settings(context, settings.kind),
            settings.space,
            trials=trials,
            storage=out / "search.jsonl",
            seed=settings.seed,
            timeout=timeout,
            on_progress=lambda number, done, total, error: context.progress.update(
                "trials",
                number * total + done,
                trials * total,
                f"trial {number}: validation E_sim {error:.4g}",
            ),
        )
        context.progress.finish(f"{len(found.trials)} trials")
        return _write(context, settings, found)


def overrides(found: SearchResult, space: SearchSpace) -> dict[str, Any]:
    """The best settings as a file of network settings holds them: what was searched and what goes with it."""
    names = {"learning_rates" if name in RATES else name: None for name in space.names}
    if "horizon" in names:
        names["validation_horizon"] = None
    return {name: getattr(found.settings, name) for name in names}


def usage(settings: RunSettings, out: Path) -> str:
    """The command line of a run with the settings found."""
    words = ["hybrid-mpc", "run", settings.scenario, *(w for f in settings.data for w in ("--data", str(f)))]
    for option, values in (("--input-column", settings.inputs), ("--output-column", settings.outputs)):
        words += [w for v in values for w in (option, v)]
    words += ["--time-column", settings.time] if settings.time else []
    words += ["--seed", str(settings.seed), "--budget", settings.budget]
    return shlex.join([*words, "--settings", str(out / "settings.json"), "--out", f"{out}-run"])


def table(rows: Sequence[TrialRow], names: Sequence[str]) -> str:
    """The trials as CSV."""
    text = io.StringIO()
    own = [f.name for f in fields(rows[0]) if f.name != "values"]
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow([*(f"{n}_s" if n == "duration" else n for n in own), *names])
    for row in rows:
        writer.writerow([*(getattr(row, n) for n in own), *(row.values[n] for n in names)])
    return text.getvalue()


def _write(context: Context, settings: SearchSettings, found: SearchResult) -> dict[str, Any]:
    """Settings, table, figures, and results.json last."""
    from hybrid_mpc.plots import tune as plots
    from hybrid_mpc.plots.style import save

    out, space, best = context.out, settings.space, overrides(found, settings.space)
    data = context.read(DATA)
    rows = [_plain(row) for row in found.trials]
    results = {
        "schema": "hybrid-mpc search",
        "schema_version": SCHEMA_VERSION,
        "scenario": context.scenario.name,
        "seed": settings.seed,
        "budget": settings.budget,
        "kind": settings.kind,
        "space": {name: space.bounds(name) for name in space.names},
        "base_settings": asdict(training_settings(context, settings.kind)),
        "versions": versions(),
        "data": {"hash": data.hash, "warnings": data.warnings},
        "base_value": found.base,
        "best": _plain(found.best),
        "settings": best,
        "importance": dict(found.importance),
        "trials": rows,
    }
    write_text(out / "trials.csv", table(found.trials, space.names))
    save(plots.history(rows, base=found.base), out / "figures" / "search_history.png")
    save(plots.settings(rows, space.names), out / "figures" / "search_settings.png")
    write_json(out / "settings.json", best)
    write_json(out / "results.json", results)
    return results


def _plain(row: TrialRow) -> Mapping[str, Any]:
    return asdict(row)
