"""``hybrid-mpc new``: a recording becomes a scenario that passes the check, with what is left to decide."""

import re
from pathlib import Path

import numpy as np
import pytest

from hybrid_mpc import InputError, load_scenario, write_csv
from hybrid_mpc.job.check import preflight
from hybrid_mpc.job.new import left_to_decide, write_scenario


def oven(path, names=("time [ms]", "heater [W]", "warmth [K]", "sample")):
    """An oven of first order: 0.05 K/W, 40 s, 20 K without heat; sampled every 2 s."""
    rng = np.random.default_rng(0)
    t = 2.0 * np.arange(900)
    u = np.repeat(rng.choice([0.0, 400.0, 1000.0], 45), 20)
    warmth = [20.0]
    for power in u[:-1]:
        warmth.append(20 + 0.05 * power + (warmth[-1] - 20 - 0.05 * power) * np.exp(-2.0 / 40.0))
    noisy = np.array(warmth) + 0.01 * rng.standard_normal(len(t))
    return write_csv(path, dict(zip(names, (1e3 * t, u, noisy, 7.0 + 0 * t), strict=True)))


def test_an_oven(call, tmp_path):
    file, machine = oven(tmp_path / "monday.csv"), tmp_path / "my_oven.py"
    code, told, _ = call("new", machine, "--data", file)
    assert code == 0
    assert "time: time [ms], sampled every 2 s" in told
    assert "inputs: heater [W]" in told
    assert "outputs: warmth [K]" in told
    assert "not used: sample" in told
    scenario = load_scenario(str(machine))
    prior = scenario.prior()
    assert [(s.name, s.unit) for s in (*prior.inputs, *prior.states)] == [("heater", "W"), ("warmth", "K")]
    # 45 steps under noise of 0.01 K: least squares is within a few per cent
    assert prior.values["T_warmth"] == pytest.approx(40.0, rel=0.05)
    assert prior.values["k_warmth_heater"] == pytest.approx(0.05, rel=0.05)
    assert prior.values["rest_warmth"] == pytest.approx(20.0, rel=0.05)
    assert scenario.data.dt == 2.0
    code, told, _ = call("check", machine, "--data", file)
    assert code == 0, told
    left = left_to_decide(machine)
    assert f"{len(left)} left to decide" in told
    assert left[0] in told
    assert len(left) >= 6


def test_a_disturbance_that_is_measured(call, tmp_path):
    """An oven whose room is measured: what it does is learned beside the heater's gain."""
    rng = np.random.default_rng(1)
    u = np.repeat(rng.choice([0.0, 400.0, 1000.0], 45), 20)
    room = 20.0 + np.cumsum(0.2 * rng.standard_normal(900))
    warmth = [20.0]
    for power, outside in zip(u[:-1], room[:-1], strict=True):
        rest = outside + 0.05 * power
        warmth.append(rest + (warmth[-1] - rest) * np.exp(-2.0 / 40.0))
    noisy = np.array(warmth) + 0.01 * rng.standard_normal(900)
    columns = {"time [s]": 2.0 * np.arange(900), "heater [W]": u, "room [K]": room, "warmth [K]": noisy}
    file, machine = write_csv(tmp_path / "monday.csv", columns), tmp_path / "oven.py"
    words = ("--input-column", "heater", "--output-column", "warmth", "--disturbance-column", "room")
    code, told, error = call("new", machine, "--data", file, *words)
    assert code == 0, error
    assert "measured disturbances: room [K]" in told
    prior = load_scenario(str(machine)).prior()
    assert [(s.name, s.unit) for s in prior.disturbances] == [("room", "K")]
    assert prior.values["k_warmth_heater"] == pytest.approx(0.05, rel=0.05)
    assert prior.values["k_warmth_room"] == pytest.approx(1.0, rel=0.1)
    assert re.search(
        r"# operating_point = OperatingPoint\(x=\(.*,\), u=\(.*,\), w=\(.*,\)\)", machine.read_text()
    )
    code, told, error = call("check", machine, "--data", file)
    assert code == 0, told + error


def test_a_swing_has_two_states(machine, tmp_path):
    draft = write_scenario(tmp_path / "swing.py", machine / "monday.csv")
    assert (draft.time.full, [c.full for c in draft.inputs]) == ("time_s", ["tau_nm"])
    scenario = load_scenario(str(tmp_path / "swing.py"))
    assert [s.name for s in scenario.prior.states] == ["phi_rad", "phi_rad_rate"]
    assert scenario.prior.corrects == ("phi_rad_rate",)
    # sqrt(J / mgl) = 0.30 s for small swings; these reach 1.4 rad, where it is longer
    assert 0.28 < scenario.prior().values["T_phi_rad"] < 0.36
    assert preflight(scenario).problems == ()
    assert any("its unit" in line for line in left_to_decide(tmp_path / "swing.py"))


RECORDINGS = Path(__file__).parents[3] / "shared" / "data"


@pytest.mark.parametrize(
    ("file", "inputs", "outputs"),
    [
        ("cascaded_tanks/estimation.csv", ["pump_v"], ["level_v"]),
        (
            "temperature_lab/prbs.csv",
            ["heater1_pct", "heater2_pct"],
            ["temperature1_degc", "temperature2_degc"],
        ),
        ("race_car/run_07.csv", ["steering_rad"], ["x_m", "y_m", "heading_rad", "speed_m_s"]),  # 3 s alone
    ],
)
def test_what_is_written_from_a_real_recording_passes_the_check_with_it(
    call, tmp_path, file, inputs, outputs
):
    if not (RECORDINGS / file).is_file():
        pytest.skip(f"the recording {file} is not here")
    machine = tmp_path / "mine.py"
    draft = write_scenario(machine, RECORDINGS / file)
    assert [c.full for c in draft.inputs] == inputs
    assert [c.full for c in draft.outputs] == outputs
    code, told, _ = call("check", machine, "--data", RECORDINGS / file)
    assert code == 0, told
    assert "'hybrid-mpc run' may start" in told


def test_columns_may_be_named_and_may_have_any_names(tmp_path):
    file = oven(tmp_path / "a.csv", ("t", "class", "2 x", "p"))
    write_scenario(tmp_path / "b.py", file, inputs=("2 x",), outputs=("class",))
    scenario = load_scenario(str(tmp_path / "b.py"))
    assert (scenario.data.inputs, scenario.data.outputs) == (("2 x",), ("class",))
    assert (scenario.prior.inputs[0].name, scenario.prior.outputs[0].name) == ("c_2_x", "c_class")
    scenario.prior().equations  # noqa: B018


def test_without_a_column_of_time(tmp_path):
    rng = np.random.default_rng(0)
    u = np.repeat(rng.standard_normal(20), 10)
    file = write_csv(tmp_path / "a.csv", {"u": u, "y": np.convolve(u, np.ones(9) / 9)[:200]})
    draft = write_scenario(tmp_path / "b.py", file)
    assert draft.time is None
    assert load_scenario(str(tmp_path / "b.py")).data.time == 1.0
    assert any("the sampling time [s]" in line for line in left_to_decide(tmp_path / "b.py"))


def test_what_cannot_be_is_refused(tmp_path):
    file = oven(tmp_path / "a.csv")
    (tmp_path / "there.py").write_text("mine")
    for path, words in ((tmp_path / "there.py", "is there already"), (tmp_path / "a.txt", "ends with .py")):
        with pytest.raises(InputError, match=words):
            write_scenario(path, file)
    assert (tmp_path / "there.py").read_text() == "mine"
    with pytest.raises(InputError, match="no column 'volt'"):
        write_scenario(tmp_path / "b.py", file, inputs=("volt",))
    still = write_csv(tmp_path / "still.csv", {"t": np.arange(50.0), "u": np.zeros(50)})
    with pytest.raises(InputError, match=r"no column is left for an input; it has t, u\. Say which"):
        write_scenario(tmp_path / "b.py", still)
    short = write_csv(tmp_path / "short.csv", {"t": np.arange(5.0), "u": np.arange(5.0)})
    with pytest.raises(InputError, match="no column has 20 numbers that move"):
        write_scenario(tmp_path / "b.py", short)
    assert not (tmp_path / "b.py").exists()


def test_the_control_that_it_proposes_closes_a_first_loop(tmp_path):
    """Its comments, without their marks, are Python; the check finds nothing wrong, and default tasks are made."""
    file, path = oven(tmp_path / "monday.csv"), tmp_path / "my_oven.py"
    write_scenario(path, file)
    text = path.read_text()
    block = text[text.index("    # control=OCP") :]
    proposed = "\n".join(line.replace("    # ", "    ", 1) for line in block.splitlines())
    text = text.replace(block, proposed.replace("(...)", "(0.0,)"))
    text = text.replace("    # operating_point", "    operating_point")
    path.write_text(text.replace("import DataSpec", "import OCP, OperatingPoint, DataSpec"))
    scenario = load_scenario(str(path))
    assert scenario.control is not None
    low, high = (bound[0] for bound in (scenario.control.u_min, scenario.control.u_max))
    assert (low, high, scenario.safe_input) == (0.0, 1000.0, (0.0,))
    assert scenario.control.q_y[0] == pytest.approx(
        1 / (0.05 * 50) ** 2, rel=0.1
    )  # 50 K are reached but for a tail
    found = preflight(scenario)
    assert not found.problems
    assert [task.name for task in found.default_tasks] == ["step", "hold"]
    point = scenario.prior().operating_point
    assert point.x[0] == pytest.approx(
        20 + 0.05 * point.u[0], abs=1.0
    )  # the oven's own rest, but for the fit's noise


def test_several_files_after_one_option_are_explained(call, tmp_path):
    file, path = oven(tmp_path / "monday.csv"), tmp_path / "my_oven.py"
    write_scenario(path, file)
    for command in ("check", "run"):
        code, _, told = call(command, path, "--data", file, file)
        assert code == 2
        assert "--data takes one value; give it once for each: --data A --data B" in told
    code, _, told = call("check", path, "something")
    assert (code, "give it once" in told) == (2, False)
