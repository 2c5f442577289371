"""A machine that runs under a controller alone: every command evaluates models by free runs of one length."""

from pathlib import Path

import numpy as np
import pytest

from hybrid_mpc.workflow.check_fit import check_fit
from hybrid_mpc.workflow.explain import explain
from hybrid_mpc.workflow.settings import RunSettings

MACHINE = """
from hybrid_mpc import DataSpec, OperatingPoint, Parameter, Prior, Scenario, Signal


class Lever(Prior):
    states = (Signal("angle", "rad", -1, 1), Signal("speed", "rad/s", -5, 5))
    inputs = (Signal("force", "N", -20, 20),)
    outputs = (Signal("angle", "rad", -1, 1),)
    parameters = (Parameter("k", {k}, "1/s^2", 1, 1000), Parameter("b", {b}, "1/(kg m)", 1, 100))
    corrects = ("speed",)
    operating_point = OperatingPoint(x=(0, 0), u=(0,))

    def xdot(self, x, u, w, p):
        return x.speed, p.k * x.angle + p.b * u.force


scenario = Scenario(
    "lever", "Lever", "An inverted lever.", prior=Lever, sensor_sigma=(0.002,),
    data=DataSpec("time_s", ("force_N",), ("angle_rad",), dt=0.02, max_gap=0.05, smoothing=0.14, warm_up=0.3{more}),
)
"""
K, B, DT = 100.0, 20.0, 0.02
GROWTH = np.log(10) / np.sqrt(K)


def record(path, seed, seconds=14.0):
    """A recording in closed loop: the true machine has a force of its own, a controller, and steps of its reference."""
    rng, x, load, lines = np.random.default_rng(seed), np.zeros(2), 0.0, ["time_s,force_N,angle_rad"]
    before, reference = 0.0, 0.0
    for k in range(round(seconds / DT)):
        y = x[0] + 0.002 * rng.normal()
        reference = rng.uniform(-0.3, 0.3) if k % 40 == 0 else reference
        force = float(
            np.clip(-15.0 * (y - reference) - 1.2 * (y - before) / DT + rng.normal() - 5 * reference, -20, 20)
        )
        before = y
        lines.append(f"{k * DT:.2f},{force:.5f},{y:.5f}")
        load += 0.05 * rng.normal() - 0.02 * load
        for _ in range(20):
            x = x + DT / 20 * np.array([x[1], K * np.sin(x[0]) + B * (force + load)])
    path.write_text("\n".join(lines) + "\n")
    return path


@pytest.fixture(scope="module")
def files(tmp_path_factory):
    folder = tmp_path_factory.mktemp("lever")
    return tuple(record(folder / f"{name}.csv", seed) for seed, name in enumerate(("mon", "tue", "wed")))


def machine(folder, k=80.0, b=15.0, more=""):
    path = Path(folder) / "lever.py"
    path.write_text(MACHINE.format(k=k, b=b, more=more))
    return str(path)


def test_check_and_explain_evaluate_by_free_runs_of_one_length(files, tmp_path, call):
    settings = RunSettings(machine(tmp_path), data=files)
    fitted = check_fit(settings)
    # loads in closed loop bias the fitted stiffness
    assert fitted.longest_run == pytest.approx(GROWTH, rel=0.3)
    words = [word for path in files for word in ("--data", str(path))]
    code, told, error = call(
        "explain", settings.scenario, *words, "--terms", "viscous", "--most", "1", "--out", tmp_path / "out"
    )
    assert code == 0, error
    found = explain(settings, tmp_path / "out", terms=("viscous",), most=1)
    assert found.run_length == fitted.longest_run
    assert found.explanation.evidence.length <= fitted.longest_run + 0.5 * DT
    assert found.tests["fitted"].error == pytest.approx(fitted.errors["phy"].error, rel=1e-6)
    assert f"free runs of {fitted.longest_run:.3g} s over the test recordings" in " ".join(told.split())


def test_a_length_in_the_data_specification_holds(files, tmp_path):
    settings = RunSettings(machine(tmp_path, more=", free_run=0.4"), data=files)
    assert check_fit(settings).longest_run == 0.4
