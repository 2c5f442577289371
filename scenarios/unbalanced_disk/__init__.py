"""The unbalanced disk: a real voltage-driven disk with a mass off its centre, two recordings."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING

from hybrid_mpc.benchmark_spec import BenchmarkBudget, BenchmarkSpec
from hybrid_mpc.scenario import ControlSpec, DataSpec, Scenario

if TYPE_CHECKING:
    from hybrid_mpc.physics import Prior

DESCRIPTION = """\
A small motor turns a disk with a mass off its centre; phi = 0 hangs down, the input is the motor's voltage, only the
angle is measured (40 Hz, encoder step 0.0031416 rad). Recordings: GerbenBeintema/gym-unbalanced-disk (TU Eindhoven,
course 5SC28; BSD-3-Clause), multisines of 2022 and 2024. In the recording of 2024 the input acts a period later than in
that of 2022, so the delay is found with the prior's parameters. The angle's zero is some hundredths of a radian off."""


def make_prior(values: Mapping[str, float] | None = None) -> Prior:
    """The prior with the given parameter values; torch is imported here and not before."""
    from scenarios.unbalanced_disk.prior import UnbalancedDiskPrior

    return UnbalancedDiskPrior(values)


scenario = Scenario(
    name="unbalanced_disk",
    title="Unbalanced disk (real recordings)",
    description=DESCRIPTION,
    prior=make_prior,
    data=DataSpec(
        time="dt",  # one number, the sampling time
        inputs=("u",),
        outputs=("th",),
        dt=0.025,
        max_gap=0.06,
        smoothing=0.2,
        # the benchmark gives the first 50 samples: 49 periods
        warm_up=1.225,
        fractions=(0.7, 0.15, 0.15),
        free_run=25.0,
    ),
    control=ControlSpec(
        horizon=40,
        # Bryson: 1 / (largest acceptable deviation)^2: 0.2 rad, 3 rad/s, 3 V, 2 V a period
        q=(25.0, 0.11),
        r=(0.11,),
        r_delta=(0.25,),
        u_min=(-3.0,),
        u_max=(3.0,),
        # encoder step 0.0031416 rad / sqrt(12), rounded up
        estimator_sigma=(0.001,),
    ),
    benchmark=BenchmarkSpec(
        {
            "quick": BenchmarkBudget(16, 2, teacher_steps=200, free_run_steps=200, horizon=60, batch=32),
            "full": BenchmarkBudget(32, 4, teacher_steps=500, free_run_steps=1500, horizon=80, batch=48),
        },
        largest_delay=0.06,
        # the swings grow along the recordings (standard deviation 0.47, 0.49, 0.52 rad over their first 70, next 15 and
        # last 15 %), so the last part is no fair sample: every seventh piece chooses, every seventh is held back
        cycle=("train", "train", "valid", "train", "train", "test", "train"),
    ),
)
