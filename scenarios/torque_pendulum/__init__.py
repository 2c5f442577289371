"""The torque-driven simple pendulum, a real rig: swing-ups recorded under several controllers."""

from __future__ import annotations

from collections.abc import Mapping

from hybrid_mpc import OCP, BenchmarkBudget, BenchmarkSpec, Budget, DataSpec, Scenario, Window
from scenarios.common import LazyPrior

DESCRIPTION = """\
A point mass of 0.546 kg on a rod of 0.5 m, driven through a 6:1 gear; phi = 0 hangs down. Recordings:
DFKI Robotics Innovation Center, torque_limited_simple_pendulum (BSD-3-Clause, 2021). Input is the
commanded torque: it explains the motion as well as the measured current does, is free of its noise, and
the measured torque lags it by 7 to 20 ms. In most runs a person pushes the pendulum outside the windows
used here: never trained on, and just what the online monitor should notice. Recordings named
*_closed_loop have a drive with an inner controller and no column of commanded torque; their input is the
measured torque, which reaches more than twice what the other recordings do. They are for test only."""

WINDOWS: Mapping[str, tuple[Window, ...]] = {
    "energy_shaping_0p9Nm": (
        Window(0.0, 4.4, "train"),  # swing-up
        Window(8.0, 9.8, "test"),  # fall through the bottom and catch on the other side
        Window(10.0, 11.0, "nominal"),
        Window(13.0, 14.6, "valid"),  # the same in the other direction
        Window(14.8, 16.0, "nominal"),
    ),
    "energy_shaping_1p5Nm": (
        Window(0.0, 3.4, "train"),  # swing-up with the larger torque: tells k_u and friction apart
        Window(3.6, 20.0, "nominal"),
    ),
    "sac_0p9Nm": (Window(0.1, 4.2, "test"), Window(4.4, 7.0, "nominal")),
    "ilqr_0p9Nm": (
        Window(0.0, 2.0, "test"),
        Window(4.0, 5.2, "test"),
        Window(5.4, 9.0, "nominal"),
        Window(11.5, 14.0, "test"),
        Window(14.2, 17.0, "test"),
        Window(17.2, 18.0, "nominal"),
    ),
    "ddp_closed_loop": (Window(0.0, 6.0, "test"),),
    "dircol_closed_loop": (Window(0.0, 3.5, "test"),),
}
"""Windows without a hand on the pendulum. Swings are trained on and judged; a window ends when the pendulum
settles at the top, for there friction sticks, which a smooth prior does not know, and a free run is a coin
flip. Standing at the top is only "nominal": the monitor must stay quiet there. Both swing-ups are trained on,
since only together they tell torque constant and friction apart; the later swings of the first recording are
kept for validation and test, and so is all of the two further recordings."""


scenario = Scenario(
    name="torque_pendulum",
    title="Torque-driven pendulum (real recordings)",
    description=DESCRIPTION,
    prior=LazyPrior("scenarios.torque_pendulum.prior", "TorquePendulumPrior"),
    data=DataSpec(
        time="time_s",
        inputs=("tau_cmd_Nm",),
        outputs=("pos_rad",),
        dt=0.02,
        max_gap=0.05,
        smoothing=0.2,
        warm_up=0.5,
        windows=WINDOWS,
        # near the top an error doubles every 0.16 s: many short runs, not one long one
        free_run=1.0,
        inputs_of={"ddp_closed_loop": ("tau_meas_Nm",), "dircol_closed_loop": ("tau_meas_Nm",)},
    ),
    control=OCP(
        horizon=50,
        # Bryson: 1 / (largest acceptable deviation)^2: 0.2 rad, 2 rad/s, 0.9 N m, 0.5 N m a period
        q=(25.0, 0.25),
        r=(1.23,),
        r_delta=(4.0,),
        u_min=(-0.9,),
        u_max=(0.9,),
    ),
    # encoder step 0.0029 rad / sqrt(12), doubled for backlash and vibration
    sensor_sigma=(0.0017,),
    first_sigma=(0.1,),
    safe_input=(0.0,),
    # Eight seconds of training: few steps, much decay. Chosen on sac_0p9Nm and ilqr_0p9Nm, of which nothing
    # is trained on (docs/results): 300, 1500, 3000, 6000 gave 1.2, 0.8, 0.8, 0.7 of the prior's error there.
    budgets={
        "quick": Budget(hidden=8, networks=4, teacher_steps=300, free_run_steps=400, seeds=2, decay=6000.0),
        "full": Budget(hidden=8, networks=4, teacher_steps=300, free_run_steps=800, seeds=10, decay=6000.0),
    },
    benchmark=BenchmarkSpec(
        {
            "quick": BenchmarkBudget(16, 4, teacher_steps=300, free_run_steps=400, horizon=50, decay=6000.0),
            "full": BenchmarkBudget(16, 16, teacher_steps=300, free_run_steps=1200, horizon=50, decay=6000.0),
        },
        length=2.5,  # a swing-up, from hanging down
    ),
)
