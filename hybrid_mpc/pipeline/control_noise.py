"""The process noise of the filters where there is no run at hand that has just estimated it."""

from __future__ import annotations

import tempfile
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from hybrid_mpc.artifact import Kit
from hybrid_mpc.errors import InputError
from hybrid_mpc.files import read_object
from hybrid_mpc.pipeline.contenders import CONTENDERS, ORACLES, no_surer_than_prior, noise_of
from hybrid_mpc.records import record
from hybrid_mpc.scenario import Scenario

Array = NDArray[np.float64]


@dataclass(frozen=True)
class _Noise:
    """What is read of ``control.json``."""

    sigma_x: Mapping[str, tuple[float, ...]]


def find_noise(
    scenario: Scenario,
    artifact: Kit,
    controllers: Sequence[str],
    seed: int,
    given: Path | None,
) -> tuple[Mapping[str, Array], str]:
    """Process noise of the filters of contenders, and in words where it came from.

    Args:
        scenario: The machine.
        artifact: Prior and hybrid.
        controllers: Names of contenders.
        seed: Seed of the recordings that the machine makes where there is no run.
        given: ``control.json`` of a run, which is taken first. Default: what the artifact holds.

    Raises:
        InputError: If the file does not hold what is needed, or there is no noise and no way to make data.

    Example:
        ``noise, source = find_noise(scenario, hm.load("runs/golf"), ("hybrid_observer",), 0, None)``
    """
    needed = [name for name in controllers if not CONTENDERS[name].truth]
    n_x = artifact.models["prior"].n_x
    if given is None and (own := artifact.loop.process_noise) and set(needed) <= set(own):
        return no_surer_than_prior(
            scenario, {name: np.array(own[name]) for name in needed}
        ), "the model's own"
    if given is not None:
        path = given
        held = record(_Noise, {"sigma_x": read_object(path).get("sigma_x")}, str(path)).sigma_x
        noise = {name: np.asarray(values, dtype=float) for name, values in held.items()}
        if lacking := [name for name in needed if name not in noise]:
            raise InputError(
                f"{path}: no process noise sigma_x for {', '.join(lacking)} in it; --noise needs "
                "checkpoints/control.json of a run"
            )
        if not all(v.shape == (n_x,) and np.all(v >= 0) and np.all(np.isfinite(v)) for v in noise.values()):
            raise InputError(f"{path}: sigma_x must hold {n_x} finite numbers that are not negative")
        names = path.parent.parent.name, path.parent.name, path.name
        return no_surer_than_prior(scenario, noise), "/".join(name for name in names if name)
    if not needed:
        return {}, "no filter"
    if not any(name in ORACLES for name in needed):
        scenario = replace(scenario, oracle=None)  # whose noise takes the longest
    return _estimated_noise(scenario, artifact, seed), (
        f"recordings of the simulated machine (quick, seed {seed}), smoothed by the prior"
    )


def _estimated_noise(scenario: Scenario, artifact: Kit, seed: int) -> Mapping[str, Array]:
    from hybrid_mpc.data.trajectories import load_trajectories
    from hybrid_mpc.identification.smoothing import fit_smoother
    from hybrid_mpc.pipeline.machine_benchmark.physics import shifted, with_states

    if scenario.make_data is None or scenario.control is None:
        raise InputError(
            f"scenario {scenario.name} makes no data to estimate the filters' process noise on; give "
            "--noise checkpoints/control.json of a run"
        )
    prior = scenario.prior(artifact.provenance.prior_parameters)
    with tempfile.TemporaryDirectory() as folder:
        files = scenario.make_data(Path(folder), seed, "quick")
        data = load_trajectories(files, scenario.data, outputs=prior.outputs, inputs=prior.inputs)
    train = [t for t in data.trajectories if t.role == "train"]
    delay = artifact.input_delay
    smoother = fit_smoother(prior, shifted(train, delay), scenario.data.dt)
    return noise_of(scenario, artifact, with_states(train, smoother, delay))
