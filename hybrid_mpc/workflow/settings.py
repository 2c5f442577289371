"""Settings of a run, network settings from a file, and the check of the device."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

from hybrid_mpc.errors import InputError, named_extra
from hybrid_mpc.files import read_json, sha256
from hybrid_mpc.folder import JobNote

WHOLE = ("hidden", "networks", "teacher_steps", "free_run_steps", "horizon", "validation_horizon", "batch")
MOST = {
    "hidden": 4096, "networks": 1024, "teacher_steps": 10**8, "free_run_steps": 10**8, "horizon": 10**5,
    "validation_horizon": 10**6, "batch": 10**6, "decay": 1e12, "learning_rates": 1.0, "prior_replay": 1e12,
}  # fmt: skip
"""Largest allowed values: a settings file must not request more memory than a computer has."""
NETWORK = (*WHOLE, "decay", "learning_rates", "prior_replay")
"""Fields of a file of network settings: arguments of :class:`~hybrid_mpc.identify.settings.TrainingSettings`."""


@dataclass(frozen=True)
class RunSettings:
    """Everything that the results of a run depend on.

    Args:
        scenario: Registered name or path of a user's Python file.
        data: Recordings of the user, in order; empty for a simulated machine.
        seed: Seed of data, training and closed loops.
        budget: Name of the scenario's budget.
        inputs: Columns that replace the scenario's inputs; default: the scenario's.
        outputs: Columns that replace the scenario's outputs; default: the scenario's.
        time: Column that replaces the scenario's time; default: the scenario's.
        network_file: JSON object with settings of the networks that replace the budget's, as ``hybrid-mpc tune``
            writes them; default: none.
        device: Torch device of the training, ``"cpu"`` or e.g. ``"cuda"``. Default: cpu.
        deploy: Model to recommend regardless of the validation: ``"phy"`` (the fitted prior), ``"pgrnn"`` or
            ``"mopgrnn"``. Default: the validation decides.
        explain: Whether to search for missing terms first; later stages then use the prior with the found terms.
            Default: False.
        track: Whether to find the parameters that differ between recordings, for an observer that tracks them. Default:
            False.
    """

    scenario: str
    data: tuple[Path, ...] = ()
    seed: int = 0
    budget: str = "quick"
    inputs: tuple[str, ...] = ()
    outputs: tuple[str, ...] = ()
    time: str = ""
    network_file: Path | None = None
    device: str = "cpu"
    deploy: str = ""
    explain: bool = False
    track: bool = False

    def network(self) -> dict[str, Any]:
        """Checked settings from the file, which replace those of the budget; empty without a file."""
        return {} if self.network_file is None else read_network(self.network_file)

    def options(self, name: Callable[[Path], str]) -> list[str]:
        """Command-line options for the recordings and their columns; ``name`` turns a file into text."""
        words = [word for path in self.data for word in ("--data", name(path))]
        for option, columns in (("--input-column", self.inputs), ("--output-column", self.outputs)):
            words += [word for column in columns for word in (option, column)]
        return words + (["--time-column", self.time] if self.time else [])

    def identity(self) -> dict[str, Any]:
        """Settings as plain data; files are given by name and content hash, not by their path."""
        files = [{"name": path.name, "sha256": sha256(path)} for path in self.data]
        scenario = self.scenario
        if scenario.endswith(".py") and Path(scenario).is_file():
            scenario = f"{Path(scenario).name} {sha256(Path(scenario))}"
        plain = {**asdict(replace(self, data=(), scenario=scenario)), "data": files}
        return plain | {"network_file": self.network()}


def read_network(path: Path) -> dict[str, Any]:
    """Read network settings from a JSON file with any fields of ``NETWORK``; ``learning_rates`` are four numbers.

    Raises:
        InputError: If the file is missing or damaged, or holds unknown fields or wrong values.
    """
    held = read_json(path)
    if not isinstance(held, dict) or (unknown := sorted(set(held) - set(NETWORK))):
        what = "no JSON object" if not isinstance(held, dict) else f"also {', '.join(unknown)}"
        raise InputError(
            f"{path}: holds {what}. Write a JSON object with any of: {', '.join(NETWORK)} [HM-WORKFLOW-034]"
        )
    for name, value in held.items():
        numbers = value if name == "learning_rates" and isinstance(value, list) else [value]
        kinds = (int,) if name in WHOLE else (int, float)
        good = all(isinstance(v, kinds) and not isinstance(v, bool) and abs(v) <= MOST[name] for v in numbers)
        positive = good and all(v > 0 or (v == 0 and name in ("decay", "prior_replay")) for v in numbers)
        if not positive or (name == "learning_rates" and len(numbers) != 4):
            needed = f"a whole number from 1 to {MOST[name]}" if name in WHOLE else "a number of 0 or more"
            needed = "four positive numbers of at most 1" if name == "learning_rates" else needed
            raise InputError(f"{path}: {name} is {str(value)[:40]}; it must be {needed} [HM-WORKFLOW-035]")
    return {name: tuple(v) if isinstance(v, list) else v for name, v in held.items()}


def run_note(settings: RunSettings) -> JobNote:
    """Note in the run's folder. Only the scenario must stay the same; stages compare everything else themselves."""
    return JobNote("run", {"scenario": Path(settings.scenario).name}, {"run": settings.identity()})


def check_device(device: str) -> None:
    """Refuse a device that cannot compute with 64-bit floats, before the training starts."""
    if device == "cpu":
        return
    with named_extra(f"--device {device}"):
        import torch

    try:
        torch.ones(1, dtype=torch.float64, device=device).sum().item()
    except (RuntimeError, AssertionError, TypeError, ImportError) as error:  # torch may raise any of these
        reason = str(error).strip().splitlines()[0]
        raise InputError(
            f"--device {device}: torch cannot compute on this device ({reason}). Omit --device to use the CPU "
            "[HM-WORKFLOW-036]"
        ) from error
