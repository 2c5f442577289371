"""The golf robot as lines in the plane, for pictures and animations. No torch in here."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from hybrid_mpc import InputError
from scenarios.golf_robot.dynamics import RigParameters

Array = NDArray[np.float64]

SHAFT = 0.7  # [m], from the axis to the tip
FLOOR = 0.72  # [m] beneath the axis: the tip passes 2 cm above it
BALL = 0.02135  # radius of a golf ball by the rules [m]
FACE = 0.015  # [m] from the shaft's middle to the face that meets the ball
HEAD = 0.55  # distance [m] from the axis at which the head begins; it ends with the shaft
REACH = 0.62  # half the length of the floor line [m]


def draw(x: Array) -> list[Array]:
    """The club in one state: polylines in the plane of its motion, the axis at the origin.

    ``phi = 0`` hangs straight down, positive ``phi`` swings to the right. The ball waits on a tee where the
    face meets its centre at ``phi = 0``, 0.6 m beneath the axis as in
    :class:`~scenarios.golf_robot.dynamics.RigParameters`; it is drawn where it waits, also after the impact.
    Polylines ``(m, 2)`` [m], always in this order: shaft, head, pivot, ball, tee, floor.
    """
    x = np.ravel(np.asarray(x, dtype=float))
    if x.size == 0 or not np.isfinite(x[0]):
        raise InputError(
            f"drawing of the golf robot: needs a state with a finite angle first, got {x} [HM-SCENARIOS-005]"
        )
    sine, cosine = np.sin(x[0]), np.cos(x[0])
    turn = np.array([[cosine, sine], [-sine, cosine]])  # rows rotate counter-clockwise: right for phi > 0
    shaft = np.array([[0.0, 0.0], [0.0, -SHAFT]])
    height = RigParameters().ball_radius
    ball = np.array([FACE + BALL, -height])
    tee = np.array([[ball[0], -height - BALL], [ball[0], -FLOOR]])
    floor = np.array([[-REACH, -FLOOR], [REACH, -FLOOR]])
    return [shaft @ turn, _head() @ turn, _circle(np.zeros(2), 0.022), _circle(ball, BALL), tee, floor]


def _head() -> Array:
    """Outline of the head of the hanging club: a blade that is flat on the ball's side, round behind."""
    top, bottom = -HEAD, -SHAFT
    back = np.linspace(np.pi / 2, 3 * np.pi / 2, 13)
    middle, half = (top + bottom) / 2, (top - bottom) / 2
    round_side = np.column_stack([0.045 * np.cos(back), middle + half * np.sin(back)])
    return np.vstack([[FACE, top], round_side, [FACE, bottom], [FACE, top]])


def _circle(centre: Array, radius: float) -> Array:
    angle = np.linspace(0.0, 2 * np.pi, 25)
    angle[-1] = 0.0  # closed to the last bit
    return centre + radius * np.column_stack([np.cos(angle), np.sin(angle)])
