"""Settings of a reproduction. No torch in here."""

from __future__ import annotations

import hashlib
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

from hybrid_mpc.errors import InputError
from hybrid_mpc.scenario import Scenario, load_scenario, registered_scenarios
from scenarios.paper.experiment import Effort, Experiment, PaperScenario

FORMS = ("hybrid", "paper")


@dataclass(frozen=True)
class ReproductionSettings:
    """Everything that decides what a reproduction computes.

    Args:
        scenario: Registered name or path of a user's Python file.
        budget: Name of one of the experiment's efforts. Default: full.
        networks: Networks of each ensemble. Default: the budget's.
        sequences: Amounts of training data, in runs. Default: the budget's.
        seed: Seed of data and training.
        form: ``"hybrid"`` (exact kinematics, the network corrects the prior's acceleration) or ``"paper"``
            (the paper's: it gives the whole derivative, explicit Euler integrates).
        device: Where the networks are trained, ``"cpu"`` or e.g. ``"cuda"``. Default: cpu.
    """

    scenario: str
    budget: str = "full"
    networks: int | None = None
    sequences: tuple[int, ...] | None = None
    seed: int = 0
    form: str = "hybrid"
    device: str = "cpu"

    def effort(self, experiment: Experiment) -> Effort:
        """The budget's effort with these networks and sequences."""
        if self.budget not in experiment.efforts:
            raise InputError(
                f"budget: no budget {self.budget!r} for this experiment; choose one of: {', '.join(experiment.efforts)}"
                " [HM-SCENARIOS-024]"
            )
        if self.form not in FORMS:
            raise InputError(
                f"form: unknown form {self.form!r}; choose one of: {', '.join(FORMS)} [HM-SCENARIOS-025]"
            )
        effort = experiment.efforts[self.budget]
        networks = effort.networks if self.networks is None else self.networks
        if networks < 1:
            raise InputError(
                f"--networks: got {networks}; give at least 1 (the paper has 16) [HM-SCENARIOS-026]"
            )
        return replace(effort, networks=networks, sequences=self._sequences(experiment, effort))

    def identity(self) -> dict[str, Any]:
        """Settings as plain data, with the content of a user's own scenario file in place of where it lies."""
        scenario, path = self.scenario, Path(self.scenario)
        if scenario.endswith(".py") and path.is_file():
            scenario = f"{path.name} {hashlib.sha256(path.read_bytes()).hexdigest()}"
        effort = self.effort(experiment_of(load_scenario(self.scenario)))
        own = {"command": "reproduce", **asdict(replace(self, scenario=scenario)), "effort": asdict(effort)}
        return own | {"networks": effort.networks, "sequences": effort.sequences}

    def _sequences(self, experiment: Experiment, effort: Effort) -> tuple[int, ...]:
        chosen = tuple(sorted(set(effort.sequences if self.sequences is None else self.sequences)))
        if not chosen or chosen[0] < 1 or chosen[-1] > experiment.most:
            raise InputError(
                f"--sequences {','.join(map(str, chosen)) or '(none)'}: {self.scenario} has {experiment.most} "
                f"training runs; give numbers between 1 and {experiment.most}, e.g. 3,6,9,12,15 [HM-SCENARIOS-027]"
            )
        return chosen


def parsed_sequences(text: str) -> tuple[int, ...]:
    """Amounts of training data as the command line has them."""
    try:
        return tuple(int(word) for word in text.split(","))
    except ValueError:
        raise InputError(
            f"--sequences: {text!r} is not a list of whole numbers; write e.g. --sequences 3,6,9,12,15 "
            "[HM-SCENARIOS-028]"
        ) from None


def experiment_of(scenario: Scenario) -> Experiment:
    """The scenario's experiment."""
    if not isinstance(scenario, PaperScenario):
        names = [name for name in registered_scenarios() if isinstance(load_scenario(name), PaperScenario)]
        raise InputError(
            f"scenario {scenario.name}: no experiment to reproduce; choose one of: {', '.join(names)}"
            " [HM-SCENARIOS-029]"
        )
    return scenario.experiment


def case_key(data_set: str, sequences: int, model: str = "") -> str:
    """Name of a job and its files."""
    return "_".join([data_set, f"{sequences:02d}", *([model] if model else [])])
