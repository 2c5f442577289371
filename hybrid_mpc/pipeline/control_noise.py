"""The process noise of the filters where there is no run at hand that has just estimated it."""

from __future__ import annotations

import tempfile
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from hybrid_mpc.artifact import Kit
from hybrid_mpc.errors import InputError
from hybrid_mpc.pipeline.contenders import CONTENDERS, ORACLES, no_surer_than_prior, noise_of
from hybrid_mpc.scenario import Scenario

Array = NDArray[np.float64]


def find_noise(
    scenario: Scenario,
    artifact: Kit,
    controllers: Sequence[str],
    seed: int,
) -> tuple[Mapping[str, Array], str]:
    """Process noise of the filters of contenders, and in words where it came from.

    Args:
        scenario: The machine.
        artifact: Prior and hybrid.
        controllers: Names of contenders.
        seed: Seed of the recordings that the machine makes where the artifact holds no noise.

    Raises:
        InputError: If the artifact's noise does not fit its models, or it holds none and there is no way to make data.

    Example:
        ``noise, source = find_noise(scenario, hm.load("runs/golf"), ("hybrid_observer",), 0)``
    """
    needed = [name for name in controllers if not CONTENDERS[name].truth]
    own = {name: np.array(values) for name, values in artifact.loop.process_noise.items()}
    if set(needed) <= set(own):
        n_x = artifact.models["prior"].n_x
        if wrong := [name for name in needed if own[name].shape != (n_x,)]:
            raise InputError(f"the model's process noise of {wrong[0]} must be {n_x} numbers; train it anew")
        return no_surer_than_prior(scenario, own), "the model's own"
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
            f"the model holds no process noise for its filters, and scenario {scenario.name} makes no data to "
            "estimate it on; run the scenario again"
        )
    prior = scenario.prior(artifact.provenance.prior_parameters)
    with tempfile.TemporaryDirectory() as folder:
        files = scenario.make_data(Path(folder), seed, "quick")
        data = load_trajectories(files, scenario.data, outputs=prior.outputs, inputs=prior.inputs)
    train = [t for t in data.trajectories if t.role == "train"]
    delay = artifact.input_delay
    smoother = fit_smoother(prior, shifted(train, delay), scenario.data.dt)
    return noise_of(scenario, artifact, with_states(train, smoother, delay))
