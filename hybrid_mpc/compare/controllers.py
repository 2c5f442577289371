"""The compared controllers by name: same control problem, period, horizon and safeguards."""

from __future__ import annotations

import tempfile
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from hybrid_mpc.control.best_of import BestOf
from hybrid_mpc.control.ocp import OCP
from hybrid_mpc.control.rti import CondensedController
from hybrid_mpc.control.safeguard import SafeController
from hybrid_mpc.control.sqp import SQPController
from hybrid_mpc.data.trajectories import Trajectory, load_trajectories
from hybrid_mpc.errors import InputError
from hybrid_mpc.estimate.kalman import Estimator, TrueState
from hybrid_mpc.estimate.tuning import process_noise
from hybrid_mpc.kit.artifact import Kit
from hybrid_mpc.kit.assembly import make_controller, make_estimator, make_ocp, tuned_noise
from hybrid_mpc.model.model import HybridModel
from hybrid_mpc.records import known
from hybrid_mpc.scenario import Scenario

Array = NDArray[np.float64]
ORACLE_ITERATIONS = 1
FIRST_ITERATIONS = 10
"""SQP iterations of an oracle from each of its starts: in a period, and for its first plan. In a period it starts from
its last plan, and from the rival plan that is cheapest by its own equations."""


@dataclass(frozen=True)
class NamedController:
    """A controller of a ``"prior"``, ``"hybrid"`` or ``"oracle"`` model with its estimator.

    With ``observer`` it estimates an unknown load at the input; with ``truth`` it gets the plant's true state. With
    ``tracking`` it also estimates the kit's tracked parameters, with ``blended`` the share of the network's correction.
    """

    model: str
    observer: bool = False
    truth: bool = False
    tracking: bool = False
    blended: bool = False

    @property
    def compared(self) -> bool:
        """Whether every run compares it, and a monitor of the hybrid's limits can watch it."""
        return not (self.tracking or self.blended)


CONTROLLERS: Mapping[str, NamedController] = {
    "prior": NamedController("prior"),
    "prior_observer": NamedController("prior", observer=True),
    "hybrid": NamedController("hybrid"),
    "hybrid_observer": NamedController("hybrid", observer=True),
    "prior_tracking": NamedController("prior", observer=True, tracking=True),
    "hybrid_tracking": NamedController("hybrid", observer=True, tracking=True),
    "blended_observer": NamedController("hybrid", observer=True, blended=True),
    "oracle": NamedController("oracle", observer=True),
    "oracle_state": NamedController("oracle", truth=True),
}
"""Fitted prior and hybrid: each without and with disturbance observer, and with tracked parameters; their blend; two
oracles with the plant's own equations, one with the same measurements and the same kind of estimator, one with the true
state."""
ORACLES = ("oracle", "oracle_state")
COMPARED = tuple(name for name, c in CONTROLLERS.items() if c.compared)
"""Controllers that a run compares."""
OBSERVERS = ("prior_observer", "hybrid_observer")
LEAST_NOISE: Mapping[str, str] = {"hybrid": "prior", "hybrid_observer": "prior_observer"}
"""Controller whose process noise is a lower bound, for scenarios whose tasks go beyond the recordings."""


def noise_name(controller: str) -> str:
    """The controller whose process noise a controller uses: the observer of the same model."""
    own = CONTROLLERS[controller]
    return controller if own.compared else f"{own.model}_observer"


def build(
    name: str, scenario: Scenario, kit: Kit, control: OCP, *, solver: str = "rti", share: float | None = None
) -> tuple[Estimator, SafeController]:
    """Build estimator and controller by name for a task's control problem; oracles have a solver of their own.

    ``share`` is the share of the network's correction that a blend starts with (:meth:`Kit.blended`).

    Raises:
        InputError: If the controller is unknown, the scenario has no oracle, or the kit has no noise.
    """
    c, prior = CONTROLLERS[known(name, CONTROLLERS, "controller")], kit.models["prior"]
    if not c.compared:
        own = kit.blended(share) if c.blended else kit
        own = replace(own, loop=replace(own.loop, control={"": control}))
        return own.tracking_observer(c.model), own.controller(c.model, solver=solver, tracking=True)
    if c.model != "oracle":
        model = kit.models[c.model]
        estimator = make_estimator(model, kit, kit.noise(name), control, observer=c.observer)
        return estimator, make_controller(model, prior, control, solver=solver, safe_input=kit.safe_input)
    if scenario.oracle is None:
        raise InputError(
            f"controller {name}: scenario {scenario.name} has no oracle; choose another [HM-COMPARE-001]"
        )
    model = _make_oracle(scenario, prior)
    ocp = make_ocp(prior, control)
    rivals = [CondensedController(kit.models[m], ocp) for m in ("prior", "hybrid")]
    best = BestOf(SQPController(model, ocp, iterations=ORACLE_ITERATIONS), rivals=rivals, most=1)
    first = BestOf(SQPController(model, ocp, iterations=FIRST_ITERATIONS), starts=ocp.starts, rivals=rivals)
    safe = SafeController(best, prior, first=first, safe_input=kit.safe_input)
    if c.truth:
        return TrueState(model), safe
    return make_estimator(model, kit, kit.noise(name), control, observer=c.observer), safe


def noise_of(scenario: Scenario, artifact: Kit, recordings: Sequence[Trajectory]) -> dict[str, Array]:
    """Process noise of every controller with an estimator, by maximum likelihood on the same recordings.

    The recordings are training recordings with smoothed states.
    """
    models = dict(artifact.models)
    if scenario.oracle is not None:
        models["oracle"] = _make_oracle(scenario, artifact.models["prior"])
    errors = {name: process_noise(model, recordings) for name, model in artifact.models.items()}
    # errors of the plant's own equations come from the smoothing only: start from the better model's errors
    errors["oracle"] = errors["hybrid"]
    found = {
        name: tuned_noise(
            models[c.model], scenario, errors[c.model], recordings, observer=c.observer, known=scenario.state_noise
        )
        for name, c in CONTROLLERS.items()
        if c.model in models and not c.truth and c.compared
    }  # fmt: skip
    return no_surer_than_prior(scenario, found)


def _make_oracle(scenario: Scenario, prior: HybridModel) -> HybridModel:
    """The oracle's model, with the operating point and disturbance model of the prior."""
    assert scenario.oracle is not None
    return replace(
        scenario.oracle(prior.dt), nominal_x=prior.nominal_x, nominal_u=prior.nominal_u,
        disturbance_model=prior.disturbance_model,
    )  # fmt: skip


def no_surer_than_prior(scenario: Scenario, noise: Mapping[str, Array]) -> dict[str, Array]:
    """Process noise by controller; if tasks go beyond the recordings, a hybrid has at least the noise of the prior."""
    found = dict(noise)
    if scenario.beyond_recordings:
        for hybrid, prior in LEAST_NOISE.items():
            if hybrid in found and prior in found:
                found[hybrid] = np.maximum(found[hybrid], found[prior])
    return found


def find_noise(
    scenario: Scenario, artifact: Kit, controllers: Sequence[str], seed: int
) -> tuple[Mapping[str, Array], str]:
    """Process noise of the controllers' filters, and a text that names its source.

    Args:
        scenario: The machine.
        artifact: Prior and hybrid.
        controllers: Names of controllers.
        seed: Seed of the simulated recordings that are used if the artifact has no noise.

    Raises:
        InputError: If the artifact's noise does not match its models, or if it has no noise and the scenario cannot
            simulate recordings.

    Example:
        ``noise, source = find_noise(scenario, hm.load("runs/golf"), ("hybrid_observer",), 0)``
    """
    needed = list(dict.fromkeys(noise_name(name) for name in controllers if not CONTROLLERS[name].truth))
    held = {name: artifact.noise(name) for name in artifact.loop.process_noise}
    lacking = [name for name in needed if name not in held]
    if not lacking:
        return no_surer_than_prior(scenario, held), "the model's own" if needed else "no filter"
    machine = scenario
    if not any(name in ORACLES for name in lacking):
        machine = replace(scenario, oracle=None)  # tuning its noise takes the longest
    source = f"recordings of the simulated machine (quick, seed {seed}), smoothed by the prior"
    if own := [name for name in needed if name in held]:
        source = f"{', '.join(lacking)}: {source}; {', '.join(own)}: the model's own"
    return no_surer_than_prior(
        scenario, {**_estimate_noise(machine, artifact, lacking, seed), **held}
    ), source


def _estimate_noise(
    scenario: Scenario, artifact: Kit, lacking: Sequence[str], seed: int
) -> Mapping[str, Array]:
    from hybrid_mpc.identify.delay import shifted
    from hybrid_mpc.identify.fit import with_states
    from hybrid_mpc.identify.smooth import fit_smoother

    if scenario.make_data is None or scenario.control is None:
        raise InputError(
            f"model: no process noise for {', '.join(lacking)}, and scenario {scenario.name} cannot simulate "
            "recordings to estimate it. Run the scenario again [HM-COMPARE-002]"
        )
    prior = scenario.prior(artifact.provenance.prior_parameters)
    with tempfile.TemporaryDirectory() as folder:
        files = scenario.make_data(Path(folder), seed, "quick")
        data = load_trajectories(files, prior, scenario.data)
    train = data.by_role("train")
    delay = artifact.input_delay
    smoother = fit_smoother(prior, shifted(train, delay), scenario.data.dt)
    return noise_of(scenario, artifact, with_states(train, smoother, delay))
