"""Cascaded tanks with overflow: a real laboratory process whose upper level is never measured."""

from __future__ import annotations

from hybrid_mpc import BenchmarkBudget, BenchmarkSpec, DataSpec, Scenario
from scenarios.common import LazyPrior

DESCRIPTION = """\
A pump fills the upper of two tanks; water runs from there into the lower one, and out. Both can run over, and part of
what runs over the upper edge falls into the lower tank. Measured is the lower level alone, as the voltage of a
capacitive sensor that ends at 10 V. Recording: M. Schoukens, P. Mattsson, T. Wigren, J.-P. Noël, Cascaded tanks
benchmark combining soft and hard nonlinearities, Workshop on Nonlinear System Identification Benchmarks, 2016
(4TU.ResearchData 10.4121/12960104, CC BY-SA 4.0). One record trains, another of the same length judges; their first
five samples are given."""


scenario = Scenario(
    name="cascaded_tanks",
    title="Cascaded tanks with overflow (real recording)",
    description=DESCRIPTION,
    prior=LazyPrior("scenarios.cascaded_tanks.prior", "CascadedTanksPrior"),
    data=DataSpec(
        time="time_s",
        inputs=("pump_v",),
        outputs=("level_v",),
        dt=4.0,
        max_gap=10.0,
        smoothing=20.0,
        warm_up=16.0,  # the benchmark gives the first five samples
        fractions=(0.75, 0.25, 0.0),
    ),
    benchmark=BenchmarkSpec(
        {
            "quick": BenchmarkBudget(
                8, 4, teacher_steps=0, free_run_steps=200, horizon=100, batch=16, decay=3000.0
            ),
            "full": BenchmarkBudget(
                16, 4, teacher_steps=0, free_run_steps=1000, horizon=250, batch=16, decay=3000.0
            ),
        },
        piece=5000.0,  # uncut: an error of the start fades within some hundred seconds, drift shows later
    ),
)
