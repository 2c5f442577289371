"""Kernels fed with frozen inputs: what they gave, they give. There is no plant in it, so no difference can grow."""

import json

import golden_parts as parts
import numpy as np
import pytest
from golden_parts import HERE, POINTS, artifact_of, held, under

from hybrid_mpc import holding_input

TOLERANCE = 1e-9
"""One and two threads give the same bits; other processors' sums change these by 1e-11 (README.md). A change of what is
computed changes them by far more."""
DECIDED = 1e-6
"""Of QPs, whose active bounds they solve for: 8e-8."""
COST, CONVERGED = 1e-8, 1e-3
"""SQP ends when it promises to lower the cost by less than 1e-10 of it: a plan is then known to the root of that, over
the flatness of the cost; inputs differed by 5e-5."""
TERMINAL = 1e-4
"""The terminal weight is a Schur complement over hidden states that cost next to nothing (a pseudoinverse): rounding
changes it by 1e-5. So everything else here takes the frozen one."""


def test_models(m):
    found = parts.model_values(m)
    for name in m.models:
        held(under(found, name), under(m.arrays, f"model/{name}"), TOLERANCE)


def test_many_points_are_as_one_by_one(m):
    for name, model in m.models.items():
        assert model.side_by_side is not None
        wanted = under(m.arrays, f"model/{name}")
        wanted["x_next"] = wanted["x_next"][POINTS]
        many = dict(zip(("x_next", "h_next", "A", "B"), parts.many_points(m, name), strict=True))
        held(many, {key: wanted[key].reshape(many[key].shape) for key in many}, TOLERANCE)


@pytest.mark.parametrize("kind", ["single", "switching"])
def test_estimators(m, kind):
    held(parts.estimates(m, m.replay, kind), under(m.arrays, f"{m.replay}/{kind}"), TOLERANCE)


def test_the_controller_on_frozen_estimates(m):
    for replay in m.data["replays"]:
        found = {f"decide/{key}": values for key, values in parts.decisions(m, replay).items()}
        for group in ("decide", "decide/first", "decide/plan"):
            held(under(found, group), under(m.arrays, f"{replay}/{group}"), DECIDED)


def test_sqp_converges_to_the_same_plans(m):
    for case in m.data["sqp"]:
        found, frozen = parts.converged(m, case), under(m.arrays, f"sqp/{case}")
        held({"cost": found.pop("cost")}, {"cost": frozen.pop("cost")}, COST)
        held(found, frozen, CONVERGED)


def test_terminal_weights(m):
    for name, problem in m.data["problems"].items():
        # as one signal: its entries are of one quadratic form
        held({name: m.terminal_weight(name).ravel()}, {name: np.ravel(problem["terminal"])}, TERMINAL)


def test_monitor(m):
    held(parts.readings(m), under(m.arrays, "guard"), TOLERANCE)


def test_detector(m):
    held(parts.detections(m), under(m.arrays, "detector"), TOLERANCE)


def test_the_replay_meets_all_that_a_monitor_can_say(m):
    """Else the tests above would hold less than they seem to."""
    said = {name: set(m.arrays[f"guard/{name}"].tolist()) for name in parts.SAID}
    assert said["alarm"] == {0, 1}
    assert said["frozen"] == {0, 1}
    assert said["validity"] >= {0, 1, 2}


def test_the_artifact_is_the_plain_form(m, tmp_path):
    """The library's own reader finds the same in an artifact."""
    models, limits = artifact_of(m, tmp_path / "kit")
    assert limits == m.limits
    assert list(models) == list(m.models)
    x, h, u = (m.arrays[f"{m.replay}/{key}"][50] for key in ("switching/x", "switching/h", "u"))
    for name, model in models.items():
        point = x, h[: model.n_h], u, model.w, model.p
        both = zip(model.step(*point), m.models[name].step(*point), strict=True)
        for found, wanted in both:
            np.testing.assert_array_equal(found.full(), wanted.full())


def test_the_folders_are_small():
    for name in parts.MACHINES:
        sizes = {path.name: path.stat().st_size for path in (HERE / name).iterdir()}
        assert sizes.pop("arrays.npz") < 500_000
        assert sum(sizes.values()) < 300_000
        assert json.loads((HERE / name / "golden.json").read_text())["made"]["commit"]


def test_inputs_that_hold_the_arm_follow_its_angle():
    """Newton's method stays on one branch although the network is curved: whole steps leave it at -0.7 rad."""
    robot = parts.machine("golf_robot").models["hybrid"]
    held = np.array([holding_input(robot, [q])[0] for q in np.linspace(-0.8, 0.8, 17)])
    assert (np.diff(held) > 0.0).all()
    assert np.abs(held).max() < 0.5  # the prior's is 0.44 N m
