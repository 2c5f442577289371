"""The guard that adapts, made of a scenario's control problem: what it adapts to, what it refuses, that it pays."""

from dataclasses import replace

import numpy as np
import pytest
from closed_loop_parts import ScriptedMonitor, run
from monitor_parts import MGL, J, pendulum
from online_models import pendulum_model

from hybrid_mpc import (
    OCP,
    DataSpec,
    InputError,
    Mode,
    Scenario,
    make_adaptive_guard,
    make_controller,
    make_estimator,
    with_input_delay,
)
from hybrid_mpc.kit.assembly import adaptable
from hybrid_mpc.loop.plant import ModelPlant

CONTROL = OCP(20, q=(300.0, 1.0), r=(0.05,), r_delta=(0.05,), u_min=(-6.0,), u_max=(6.0,))
CAUSES = {"mass": ("J", "mgl"), "friction": ("gamma",), "motor": ("gain of u",)}
SPEC = DataSpec("t", ("u",), ("y",), dt=0.02, max_gap=0.05, smoothing=0.1, warm_up=0.1)
SCENARIO = Scenario(
    "pendulum", "", "", prior=pendulum, data=SPEC, control=CONTROL, sensor_sigma=(1e-4,), causes=CAUSES
)
LATE = with_input_delay(pendulum(), 0.02)
SIGMA_X = np.array([1e-5, 1e-3])
HEAVY = ModelPlant(pendulum(inertia=1.5 * J, mgl=1.5 * MGL), (1e-4,))
"""A pendulum half as heavy again from the start; its sensor is good to 0.1 mrad."""


def test_gains_are_left_to_the_mass():
    assert set(adaptable(pendulum(), CAUSES)) == {"mass", "friction"}
    assert set(adaptable(pendulum(), {"motor": ("gain of u",)})) == {"motor"}


def test_it_switches_once_the_alarm_has_lasted_and_pays():
    model = pendulum()
    guard = make_adaptive_guard(model, model, SCENARIO, SIGMA_X, patience=0.2)
    safe = make_controller(model, model, CONTROL, safe_input=[0.0])
    estimator = make_estimator(model, SCENARIO, SIGMA_X)
    plain, guarded = (
        run(
            model,
            safe,
            plant=HEAVY,
            estimator=estimator,
            monitor=ScriptedMonitor([(5, 10**9)]),
            guard=g,
            duration=3.0,
        )
        for g in (None, guard)
    )
    assert [s.after for s in guarded.switches] == [Mode.BACKUP]
    # the alarm is on from period 5 on, has lasted for 0.2 s at 0.3 s, and acts a period later
    assert guarded.switches[0].t == pytest.approx(0.32, abs=1e-9)
    late = plain.t > 1.0
    missed = [np.sqrt(np.mean((r.x - r.reference)[late, 0] ** 2)) for r in (plain, guarded)]
    assert missed[1] < 0.2 * missed[0]  # 1.5 mrad with a load that is held constant, 0.14 mrad with the mass


def test_what_it_needs():
    def made(**changes):
        return make_adaptive_guard(pendulum(), pendulum(), replace(SCENARIO, **changes), SIGMA_X)

    with pytest.raises(InputError, match="HM-KIT-020"):
        made(causes={})
    with pytest.raises(InputError, match=r"pendulum.*HM-KIT-019"):
        made(control=None)
    with pytest.raises(InputError, match="HM-KIT-021"):
        adaptable(pendulum_model(), CAUSES)
    with pytest.raises(InputError, match="HM-KIT-022"):
        adaptable(LATE, CAUSES)
    with pytest.raises(InputError, match=r"'typo'.*HM-ESTIMATE-017"):
        made(causes={"typo": (), "mass": ("J",)})
    with pytest.raises(InputError, match=r"weight.*HM-MODEL-032"):
        made(causes={"mass": ("weight",)})
