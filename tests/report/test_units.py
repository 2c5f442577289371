"""A machine with two inputs in per cent and two outputs in degrees: the whole job's page and figures have its units."""

import re

import numpy as np
import pytest
from engine_jobs import jobs_in_this_process

from hybrid_mpc import write_csv
from hybrid_mpc.workflow.run import run
from hybrid_mpc.workflow.settings import RunSettings
from hybrid_mpc.workflow.stages import figures as stage

MACHINE = """
import numpy as np

from hybrid_mpc import OCP, Budget, DataSpec, OperatingPoint, Parameter, Prior, Scenario, Signal, Task


class Heaters(Prior):
    states = outputs = (Signal("front", "degC", 0.0, 150.0), Signal("back", "degC", 0.0, 150.0))
    inputs = (Signal("heater", "%", 0.0, 100.0), Signal("blower", "%", 0.0, 100.0))
    disturbances = (Signal("room", "degC", 0.0, 40.0),)
    parameters = (Parameter("gain", 0.02, "K/s/%", 0.005, 0.1), Parameter("loss", 0.01, "1/s", 0.002, 0.05))
    operating_point = OperatingPoint(x=(50.0, 30.0), u=(25.0, 10.0), w=(20.0,))

    def xdot(self, x, u, w, p):
        across = 0.01 * (x.front - x.back) + 0.001 * (u.blower - 10.0)
        return p.gain * u.heater - p.loss * (x.front - w.room) - across, across - 0.02 * (x.back - w.room)


class Plant:
    # the same heaters with more loss, and a little of it by radiation
    def reset(self, x0, seed):
        return np.asarray(x0, dtype=float)

    def step(self, x, u, dt, w):
        x = np.array(x)
        for _ in range(10):
            across = 0.01 * (x[0] - x[1]) + 0.001 * (u[1] - 10.0)
            front = 0.022 * u[0] - 0.012 * (x[0] - w[0]) - 2e-5 * (x[0] - w[0]) ** 2 - across
            x = x + 0.1 * dt * np.array([front, across - 0.02 * (x[1] - w[0])])
        return x

    def measure(self, x, rng):
        return x + 0.05 * rng.normal(size=2)

    def truth(self, x):
        return x

    def hidden(self, x):
        return np.zeros(0)


def up(t):
    return np.where(t[:, None] < 60.0, (50.0, 30.0), (55.0, 31.0))


scenario = Scenario(
    "heaters", "Two heaters", "", prior=Heaters, plant=Plant,
    data=DataSpec("t", ("h", "b"), ("f", "k"), disturbances=("r",), dt=4.0, max_gap=9.0, smoothing=20.0, warm_up=20.0),
    control=OCP(
        15, q=(0.0, 0.0), r=(0.01, 0.01), r_delta=(0.1, 0.1), u_min=(0.0, 0.0), u_max=(100.0, 100.0), q_y=(1.0, 1.0),
        y_max=(58.0, 40.0),
    ),
    tasks=(Task("warmer", "To 55 and 31 degC", 160.0, (50.0, 30.0), up),),
    sensor_sigma=(0.05, 0.05), safe_input=(0.0, 0.0),
    budgets={"quick": Budget(hidden=4, networks=2, teacher_steps=10, free_run_steps=5, seeds=1)},
)
"""
WRONG = re.compile(r"\[(rad|rad/s|W|N m|N|m|m/s|J|SI|output unit.*|V)\]|RMSE \[|\bangle\b|\btorque\b")
"""Units and words that this machine has nothing to do with."""
UNIT = re.compile(r"\[([^\]]+)\]$")
OWN = {"degC", "%", "s", "-", "ms", "1/s", "rad/s", "degC/%", "samples", "°", "periods"}
"""Its units, those of time and of shares; ``rad/s`` and ``°`` are of frequency responses."""


def recording(path, seed, namespace):
    """Both inputs move by steps of their own, the room warms up."""
    rng, n, plant = np.random.default_rng(seed), 500, namespace["Plant"]()
    u = np.column_stack(
        [np.repeat(rng.uniform(10.0, 45.0, 25), 20), np.repeat(rng.uniform(0.0, 60.0, 50), 10)]
    )
    room, x, y = 20.0 + 2.0 * np.sin(np.arange(n) / 80.0), np.array([48.0, 29.0]), np.empty((n, 2))
    for k in range(n):
        y[k] = plant.measure(x, rng)
        x = plant.step(x, u[k], 4.0, room[k : k + 1])
    columns = {"t": 4.0 * np.arange(n), "h": u[:, 0], "b": u[:, 1], "f": y[:, 0], "k": y[:, 1], "r": room}
    return write_csv(path, columns)


@pytest.fixture(scope="module")
def job(tmp_path_factory):
    """Results, the page's text without pictures and glossary, and axes' labels by figure."""
    folder, drawn = tmp_path_factory.mktemp("heaters"), {}
    (folder / "heaters.py").write_text(MACHINE)
    namespace = {"__name__": "heaters"}
    exec(MACHINE, namespace)
    data = tuple(recording(folder / f"run{i}.csv", i, namespace) for i in range(3))
    save = stage.save

    def noted(figure, path):
        drawn[path.stem] = [t for ax in figure.axes for t in (ax.get_xlabel(), ax.get_ylabel()) if t]
        return save(figure, path)

    with pytest.MonkeyPatch.context() as patch, jobs_in_this_process():
        patch.setattr(stage, "save", noted)
        results = run(RunSettings(str(folder / "heaters.py"), data), folder / "run")
    text = re.sub(
        r"<(style|figure).*?</\1>|<[^>]+>", " ", (folder / "run" / "report.html").read_text(), flags=re.DOTALL
    )
    return results, " ".join(text.rpartition("Names and definitions")[0].split()), drawn, folder / "run"


@pytest.mark.full
def test_the_page_names_every_signal_in_its_unit_and_no_other(job):
    _, text, _, _ = job
    for words in (
        "RMSE of front [degC]", "RMSE of back [degC]", "FIT of front [%]", "FIT of back [%]", "loss [1/s]",
    ):  # fmt: skip
        assert words in text
    assert not WRONG.search(text), WRONG.search(text)


@pytest.mark.full
def test_every_axis_of_every_figure_has_a_unit_of_this_machine(job):
    _, _, drawn, _ = job
    assert {"recordings", "training", "errors", "loop_warmer", "bode_rest_from_heater_to_back"} <= set(drawn)
    for name, labels in drawn.items():
        assert labels, name
        for label in labels:
            found = UNIT.search(label)
            assert found, f"{name}: no unit in {label!r}"
            assert found[1] in OWN, f"{name}: {label!r}"


@pytest.mark.full
def test_a_loop_shows_every_output_with_its_reference_and_every_input_and_disturbance(job):
    results, text, drawn, _ = job
    labels = [label.replace("\n", " ") for label in drawn["loop_warmer"]]
    assert labels == [
        "front [degC]", "back [degC]", "error of front [degC]", "error of back [degC]", "heater [%]", "blower [%]",
        "time [s]", "room [degC]",
    ]  # fmt: skip
    errors = results.control.tracking("hybrid_observer")
    assert set(errors) == {"front [degC]", "back [degC]"}
    assert all(0.0 < value < 10.0 for value in errors.values())
    assert "task controller RMSE of front [degC] RMSE of back [degC]" in text
