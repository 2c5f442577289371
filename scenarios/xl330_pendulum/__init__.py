"""A pendulum on an XL330 servo: a real small drive whose dry friction grows with its load."""

from __future__ import annotations

from hybrid_mpc import BenchmarkBudget, BenchmarkSpec, DataSpec, Scenario
from scenarios.common import LazyPrior

DESCRIPTION = """\
0.49 kg at 0.10 m on a small servo, phi = 0 hangs down. Recordings: Rhoban/bam (Apache-2.0); Duclusaud, Passault,
Padois, Ly, Extended friction models for the physics simulation of servo actuators, ICRA 2025 (arXiv 2410.08650). The
voltage at the motor is duty times supply, which sags under load; both are inputs, and so is whether the motor is
switched on: in the lift-and-drop runs it lets the pendulum fall after two seconds. The servo's own position loop is no
part of the model: the runs are open loop, from the duty that was recorded."""


scenario = Scenario(
    name="xl330_pendulum",
    title="Pendulum on an XL330 servo (real recordings)",
    description=DESCRIPTION,
    prior=LazyPrior("scenarios.xl330_pendulum.prior", "Xl330PendulumPrior"),
    data=DataSpec(
        time="time_s",
        inputs=("duty", "supply_V", "torque_enable"),
        outputs=("pos_rad",),
        dt=0.01,
        max_gap=0.03,
        smoothing=0.06,
        warm_up=0.1,
        fractions=(0.75, 0.25, 0.0),
    ),
    benchmark=BenchmarkSpec(
        {
            "quick": BenchmarkBudget(
                8, 4, teacher_steps=150, free_run_steps=150, horizon=80, batch=32, decay=1000.0
            ),
            "full": BenchmarkBudget(
                32, 4, teacher_steps=500, free_run_steps=2000, horizon=250, batch=32, decay=1000.0
            ),
        },
        valid_every=3,
    ),
)
