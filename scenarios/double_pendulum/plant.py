"""The double pendulum in MuJoCo: dry friction as a constraint, drives that act late and lag, sensors with steps.

MuJoCo is the extra ``mujoco`` of the package; nothing but this plant needs it.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache
from typing import Any

import numpy as np
from numpy.typing import NDArray

from hybrid_mpc import InputError

Array = NDArray[np.float64]
TIMESTEP = 0.0005
"""Step of the simulation [s]."""
MODEL = """
<mujoco>
  <option timestep="{TIMESTEP}" integrator="implicitfast" gravity="0 0 -9.81"><flag contact="disable"/></option>
  <worldbody>
    <body>
      <joint name="q1" axis="0 -1 0" armature="{rotor}" damping="{b_1}" frictionloss="{F_1}"
             solreffriction="{soft} 1"/>
      <inertial pos="0 0 -{r_1}" mass="{m_1}" diaginertia="{J_1} {J_1} {J_1}"/>
      <body pos="0 0 -{l_1}">
        <joint name="q2" axis="0 -1 0" armature="{rotor}" damping="{b_2}" frictionloss="{F_2}"
               solreffriction="{soft} 1"/>
        <inertial pos="0 0 -{r_2}" mass="{m_2}" diaginertia="{J_2} {J_2} {J_2}"/>
      </body>
    </body>
  </worldbody>
  <actuator>
    <general joint="q1" dyntype="filterexact" dynprm="{lag}" gainprm="1"/>
    <general joint="q2" dyntype="filterexact" dynprm="{lag}" gainprm="1"/>
  </actuator>
</mujoco>
"""


@dataclass(frozen=True)
class PendulumState:
    """State of the simulation, as MuJoCo gives it out, and the torques ``(2,)`` [N m] commanded last."""

    z: Array
    u: Array


@dataclass(frozen=True)
class DoublePendulumPlant:
    """Two links in MuJoCo (a :class:`hybrid_mpc.loop.plant.Plant`).

    The prior's dry friction changes its sign over a width, its rotors couple the joints, and its torques act at once.
    Here dry friction is a constraint that holds a joint until it is overcome, the rotors are inertia of their joints
    alone (``armature``), a command acts ``late`` and through a lag of the current, and angle and speed come in the
    steps of the recordings. Inertias, moments and dry friction are within 20 % of those fitted to the recordings.

    Args:
        m_1: Mass of the first link [kg].
        m_2: Of the second.
        r_1: From its joint to its centre of mass [m].
        r_2: Of the second.
        J_1: Inertia of the first link about its centre of mass [kg m^2].
        J_2: Of the second.
        l_1: Length of the first link [m].
        rotor: Inertia of a motor's rotor, as its joint feels it [kg m^2].
        b_1: Viscous friction of the first joint [N m s/rad].
        b_2: Of the second.
        F_1: Dry friction of the first joint [N m].
        F_2: Of the second.
        soft: Time in which dry friction stops a joint [s].
        late: From a command until it acts [s].
        lag: Of the torque behind that [s].
        sigma_q: Noise of the angles [rad].
        sigma_v: Of the speeds [rad/s].
        step_q: Steps of the angles [rad], as recorded.
        step_v: Of the speeds [rad/s].
    """

    m_1: float = 0.55
    m_2: float = 0.66
    r_1: float = 0.155
    r_2: float = 0.24
    J_1: float = 0.0160
    J_2: float = 0.0130
    l_1: float = 0.2
    rotor: float = 0.0025
    b_1: float = 0.002
    b_2: float = 0.005
    F_1: float = 0.21
    F_2: float = 0.14
    soft: float = 0.004
    late: float = 0.004
    lag: float = 0.002
    sigma_q: float = 2e-4
    sigma_v: float = 0.05
    step_q: float = 3.81e-4
    step_v: float = 0.19

    def reset(self, x0: Array, seed: int) -> PendulumState:
        """State at the angles and speeds ``x0`` ``(4,)``, without torque. Nothing is random: ``seed`` changes nothing.

        Raises:
            InputError: If MuJoCo is not installed.
        """
        mujoco, model, data = simulation(self)
        mujoco.mj_resetData(model, data)
        data.qpos[:], data.qvel[:] = x0[:2], x0[2:]
        return PendulumState(_taken(mujoco, model, data), np.zeros(2))

    def step(self, state: PendulumState, u: Array, dt: float) -> PendulumState:
        """State after ``dt`` [s], in the first ``late`` of which the torques of before act, then ``u`` ``(2,)``.

        Raises:
            InputError: If ``dt`` is no longer than that, or no multiple of the simulation's step.
        """
        steps, before = round(dt / TIMESTEP), round(self.late / TIMESTEP)
        if abs(steps * TIMESTEP - dt) > 1e-9 or steps <= before:
            raise InputError(
                f"double pendulum: a period of {dt:g} s is not possible. Give a multiple of {TIMESTEP:g} s, longer "
                f"than the delay of {self.late:g} s of a command [HM-SCENARIOS-002]"
            )
        mujoco, model, data = simulation(self)
        mujoco.mj_setState(model, data, state.z, mujoco.mjtState.mjSTATE_INTEGRATION)
        for torques, n in ((state.u, before), (u, steps - before)):
            data.ctrl[:] = torques
            if n:
                mujoco.mj_step(model, data, n)
        return PendulumState(_taken(mujoco, model, data), np.array(u, dtype=np.float64))

    def measure(self, state: PendulumState, rng: np.random.Generator) -> Array:
        """Angles and speeds ``(4,)`` with white noise, in steps."""
        size = np.repeat([self.sigma_q, self.sigma_v], 2)
        step = np.repeat([self.step_q, self.step_v], 2)
        return np.asarray(np.round((self.truth(state) + size * rng.standard_normal(4)) / step) * step)

    def truth(self, state: PendulumState) -> Array:
        """Angles and speeds ``(4,)``."""
        return state.z[1:5].copy()  # after the time

    def hidden(self, state: PendulumState) -> Array:
        """Nothing: there is no oracle."""
        return np.zeros(0)


@cache
def simulation(plant: DoublePendulumPlant) -> tuple[Any, Any, Any]:
    """MuJoCo, and its model and data of a plant.

    Raises:
        InputError: If MuJoCo is not installed.
    """
    try:
        import mujoco
    except ImportError as missing:
        raise InputError(
            f"double pendulum: its closed loops need MuJoCo ({missing}); install it with: pip install "
            "'hybrid-mpc[mujoco]' [HM-SCENARIOS-003]"
        ) from None
    model = mujoco.MjModel.from_xml_string(MODEL.format(TIMESTEP=TIMESTEP, **vars(plant)))
    return mujoco, model, mujoco.MjData(model)


def _taken(mujoco: Any, model: Any, data: Any) -> Array:
    """All that the next step depends on: time, angles, speeds, torques, and where the solver begins."""
    z = np.empty(mujoco.mj_stateSize(model, mujoco.mjtState.mjSTATE_INTEGRATION))
    mujoco.mj_getState(model, data, z, mujoco.mjtState.mjSTATE_INTEGRATION)
    return z
