"""What identification refuses, with the codes of the messages."""

import math
from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from example_priors import Tanks
from simulated_pendulum import DT, SMALL, TRUTH, Pendulum, record

from hybrid_mpc import (
    DEFAULT_BUDGETS,
    BenchmarkBudget,
    ChoiceRule,
    FirstStates,
    InputError,
    Parameter,
    Prior,
    PriorStep,
    SearchSpace,
    Signal,
    find_varying,
    fit_prior,
    tune,
)
from hybrid_mpc.identify.bands import RunParts, fit_bands
from hybrid_mpc.identify.choose import recommend
from hybrid_mpc.identify.delay import delayed
from hybrid_mpc.identify.evaluate import output_errors
from hybrid_mpc.identify.objectives import objectives_of
from hybrid_mpc.identify.simulation import MAX_SUBSTEPS, required_substeps, substeps_for
from hybrid_mpc.identify.step import TrainedParameters, shift_to
from hybrid_mpc.identify.tune import parsed_space
from scenarios.pendulum.prior import PublishedPendulumPrior

RUN = record(0, seconds=1.0)


class Odometer(Prior):
    """Its way is measured nowhere, and it has no balance."""

    states = (Signal("way", "m"), Signal("speed", "m/s"))
    inputs = (Signal("force", "N"),)
    outputs = (Signal("speed", "m/s"),)
    parameters = (Parameter("d", 1.0, "1/s", 0.1, 10.0),)
    rate = 1.0

    def xdot(self, x, u, w, p):
        return x.speed, u.force - self.rate * p.d * x.speed


class Running(Pendulum):
    """Away from where it is, faster and faster."""

    def force(self, q, v, u, w, p):
        return u.torque + 1e3 * v.phi_dot * (1 + v.phi_dot**2 + q.phi**2)


class Side(Pendulum):
    outputs = (Signal("side", "m"),)


def fit(prior=Pendulum, runs=(RUN,), **options):
    return fit_prior(prior, list(runs), [RUN], dt=DT, **options)


@cache
def fitted():
    return fit()


def stiff(rate):
    prior = Odometer()
    prior.rate = rate
    return prior


def search(**options):
    return tune(
        Pendulum(TRUTH), [RUN], [RUN], SMALL, SearchSpace(), storage=None, **({"trials": 1} | options)
    )


PARTS = RunParts(np.ones((10, 1)), np.ones((10, 1, 1)))
WEIGHTS = (-1.0, math.nan, math.inf)
REFUSED = {
    # first states
    "no kind of first states": ("066", lambda: FirstStates("guessed")),
    "known states without values": ("067", lambda: FirstStates("known")),
    "values of free states": ("067", lambda: FirstStates("free", {"phi": 0.0})),
    "a known state that is no number": ("068", lambda: FirstStates("known", {"phi": math.nan})),
    "a warm-up without a length": ("069", lambda: FirstStates("warm_up")),
    "a length without a warm-up": ("069", lambda: FirstStates("shared", seconds=1.0)),
    "a known state of another prior": ("070", lambda: fit(first_states=FirstStates("known", {"speed": 0.0}))),
    "outputs that are no states": ("071", lambda: FirstStates("measured").check(Side(), 0.0)),
    "known states under a delay": (
        "072", lambda: fit(first_states=FirstStates("known", {"phi": 0.0}), largest_delay=0.1),
    ),
    # fit
    "no recording": ("017", lambda: fit(runs=())),
    "two samples": ("017", lambda: fit(runs=[RUN.part(slice(2))])),
    "a state that no output sees": ("019", lambda: fit(Odometer)),
    "a prior that diverges": ("049", lambda: fit(Running)),
    "a prior too stiff for its period": ("049", lambda: required_substeps(stiff(1e3), 1.01e-3 * MAX_SUBSTEPS)),
    "a step of a stiff prior": ("049", lambda: PriorStep(stiff(1e3), 1.0)),
    "rates that are no number": (
        "049", lambda: substeps_for(stiff(math.nan).equations.xdot, [0, 0], [0], [], [1.0], 0.1, "the prior"),
    ),
    "no delay": ("008", lambda: delayed(RUN, 0.0)),
    "a negative delay": ("008", lambda: delayed(RUN, -1.0)),
    "an infinite delay": ("008", lambda: delayed(RUN, math.inf)),
    "a delay longer than the recording": ("007", lambda: delayed(RUN, 5.0)),
    "recordings too short to vary": (
        "078", lambda: find_varying(Pendulum, fitted(), 2 * [RUN.part(slice(20))], dt=DT, length=0.5),
    ),
    # training
    "no objective": ("046", lambda: replace(SMALL, objectives=())),
    "prior parameters of a network alone": ("047", lambda: replace(SMALL, kind="rnn", prior_parameters="trained")),
    "one part": ("048", lambda: replace(SMALL, parts=1)),
    "an unknown objective": ("040", lambda: objectives_of(Tanks(), ("error", "energy"))),
    "balances of a prior without": ("040", lambda: objectives_of(Odometer(), ("balances",))),
    "no free parameter": ("050", lambda: TrainedParameters(PublishedPendulumPrior(), 2)),
    "trained parameters of another prior": ("051", lambda: shift_to(PublishedPendulumPrior(), TRUTH)),
    "an unknown kind": ("RECORDS-006", lambda: replace(SMALL, kind="gru")),
    "unknown prior parameters": ("RECORDS-006", lambda: replace(SMALL, prior_parameters="free")),
    **{f"replay {w}": ("RECORDS-007", lambda w=w: replace(SMALL, prior_replay=w)) for w in WEIGHTS},
    **{
        f"replay {w} of a budget": ("RECORDS-007", lambda w=w: replace(DEFAULT_BUDGETS["quick"], prior_replay=w))
        for w in WEIGHTS
    },
    "replay of a benchmark": ("RECORDS-007", lambda: BenchmarkBudget(4, 1, 1, 1, 1, prior_replay=-1.0)),
    # search of settings
    "no trial": ("062", lambda: search(trials=0)),
    "a negative seed": ("062", lambda: search(seed=-1)),
    "no time": ("062", lambda: search(timeout=0.0)),
    "a timeout that is no number": ("062", lambda: search(timeout=math.nan)),
    "bounds in the wrong order": ("060", lambda: SearchSpace(hidden=(8, 4))),
    "half a unit": ("061", lambda: SearchSpace(hidden=(4.5, 8))),
    "a bound of zero": ("060", lambda: SearchSpace(decay=(0.0, 8.0))),
    "an infinite bound": ("060", lambda: SearchSpace(decay=(1.0, math.inf))),
    "a bound that is no number": ("060", lambda: SearchSpace(learning_rate=(1e-3, math.nan))),
    "an empty space": ("056", lambda: SearchSpace(None, None, None, None)),
    "an unknown setting": ("057", lambda: parsed_space(["units=4:8"])),
    "a setting given twice": ("058", lambda: parsed_space(["hidden=4:8", "hidden"])),
    "one bound": ("059", lambda: parsed_space(["hidden=4"])),
    "bounds in words": ("059", lambda: parsed_space(["hidden=a:b"])),
    # evaluation and choice
    "bands without runs": ("001", lambda: fit_bands([])),
    **{f"bands of {share:g}": ("002", lambda s=share: fit_bands([PARTS], s)) for share in (0.0, 1.0, 1.5)},
    "no free run": ("009", lambda: output_errors([], [], Pendulum.outputs)),
    "a choice without runs": ("004", lambda: recommend({"phy": [], "pgrnn": []})),
    "a certain choice": ("RECORDS-007", lambda: ChoiceRule(confidence=1.0)),
    **{
        f"a parameter that varies by {size:g}": (code, lambda v=size: Parameter("k", 1.0, "-", 0.0, 2.0, varies=v))
        for size, code in ((0.0, "MACHINE-045"), (-1.0, "MACHINE-045"), (math.nan, "RECORDS-012"))
    },
    "a drift without time": ("MACHINE-045", lambda: Parameter("k", 1.0, "-", 0.0, 2.0, varies=(0.1, 0.0))),
}  # fmt: skip


@pytest.mark.parametrize("case", REFUSED)
def test_what_cannot_be_is_refused(case):
    code, make = REFUSED[case]
    with pytest.raises(InputError, match=code if code.startswith(("R", "M")) else f"IDENTIFY-{code}"):
        make()
