"""``hybrid-mpc new``: a recording becomes a scenario that passes the check, with what is left to decide."""

import ast
import csv
import re
import shlex
import sys
import tempfile
from pathlib import Path

import numpy as np
import pytest
from hypothesis import HealthCheck, example, given, settings
from hypothesis import strategies as st
from scipy.io import savemat

from hybrid_mpc import InputError, load_scenario, load_trajectories, write_csv
from hybrid_mpc.check.new import left_to_decide, write_scenario
from hybrid_mpc.check.preflight import preflight
from hybrid_mpc.rules import column_problem


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


def test_a_wrapped_direction_becomes_a_periodic_disturbance(call, tmp_path):
    """A drift by a wind that turns through north: the first prior is linear in sine and cosine, with their gains."""
    rng = np.random.default_rng(2)
    u, angle = np.repeat(rng.choice([-1.0, 0.0, 1.0], 45), 20), np.cumsum(8.0 * rng.standard_normal(900))
    speed = [0.0]
    for push, wind in zip(u[:-1], np.radians(angle[:-1]), strict=True):
        rest = push + 0.5 * np.sin(wind)
        speed.append(rest + (speed[-1] - rest) * np.exp(-0.5 / 5.0))
    noisy = np.array(speed) + 0.001 * rng.standard_normal(900)
    columns = {
        "time [s]": 0.5 * np.arange(900),
        "push [V]": u,
        "wind [deg]": angle % 360,
        "speed [m/s]": noisy,
    }
    file, machine = write_csv(tmp_path / "monday.csv", columns), tmp_path / "boat.py"
    words = ("--input-column", "push", "--output-column", "speed", "--disturbance-column", "wind")
    code, _, error = call("new", machine, "--data", file, *words)
    assert code == 0, error
    prior = load_scenario(str(machine)).prior()
    assert [(s.name, s.period) for s in prior.disturbances] == [("wind", 360.0)]
    # means over a period against values held over it: some per cent of the gain
    assert prior.values["k_speed_sin_wind"] == pytest.approx(0.5, rel=0.1)
    assert prior.values["k_speed_cos_wind"] == pytest.approx(0.0, abs=0.05)
    code, told, _ = call("check", machine, "--data", file)
    assert code == 0, told


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


def heated_room(path, rows, dt, seed):
    """An oven of 0.5 K/% and 40 s in a measured room that nothing heats; sensors with errors of 0.15 and 0.02 K."""
    rng, t = np.random.default_rng(seed), dt * np.arange(rows)
    u = np.repeat(rng.choice([0.0, 40.0, 100.0], rows // 20 + 1), 20)[:rows]
    room = 20 + 1.5 * np.sin(2 * np.pi * t / 900 + seed) + 0.02 * rng.standard_normal(rows)
    warmth = [room[0]]
    for power, outside in zip(u[:-1], room[:-1], strict=True):
        rest = outside + 0.5 * power
        warmth.append(rest + (warmth[-1] - rest) * np.exp(-dt / 40.0))
    noisy = np.array(warmth) + 0.15 * rng.standard_normal(rows)
    return write_csv(
        path, {"time [s]": t, "Heizung [%]": u, "Raumtemperatur [K]": room, "Temperatur [K]": noisy}
    )


def test_a_room_that_no_input_affects_in_recordings_of_three_periods(call, tmp_path):
    sampled = [("a", 900, 2.0, 1), ("b", 450, 4.0, 2), ("c", 1200, 1.0, 3)]
    files = [heated_room(tmp_path / f"{name}.csv", rows, dt, seed) for name, rows, dt, seed in sampled]
    machine = tmp_path / "oven.py"
    code, told, error = call("new", machine, *(word for file in files for word in ("--data", file)))
    assert code == 0, error
    assert "sampled every 1 s, 2 s, 4 s" in told
    prior = load_scenario(str(machine)).prior()
    assert [s.name for s in prior.disturbances] == ["Raumtemperatur"]
    assert [s.name for s in prior.states] == ["Temperatur"]
    assert (prior.inputs[0].lower, prior.inputs[0].upper) == (0.0, 100.0)
    assert prior.values["T_Temperatur"] == pytest.approx(40.0, rel=0.05)
    assert "slowest significant time constant is 39.8 s" in told
    (sigma,) = re.findall(r"# sensor_sigma=\(([\d.]+),\)", machine.read_text())
    assert 0.15 <= float(sigma) < 0.2  # the machine's motion within three samples counts, too
    assert not [line for line in left_to_decide(machine) if "sensor_sigma" in line or "limits" in line]


def test_an_output_given_by_the_user_that_no_input_affects_sets_no_horizon(call, tmp_path):
    file = heated_room(tmp_path / "a.csv", 900, 2.0, 1)
    words = ("--output-column", "Raumtemperatur", "--output-column", "Temperatur")
    code, told, error = call("new", tmp_path / "oven.py", "--data", file, *words)
    assert code == 0, error
    assert re.search(r"significant time constant is .* of Temperatur", told)


def test_a_recording_without_visible_noise_and_without_limits_leaves_both_to_decide(tmp_path):
    t = 0.1 * np.arange(600)
    columns = {"time [s]": t, "pump [l/min]": 3 + np.sin(t), "flow [l/min]": 5 + np.sin(t - 0.5)}
    file = write_csv(tmp_path / "a.csv", columns)
    write_scenario(tmp_path / "pump.py", file, ["pump"], ["flow"])
    left = left_to_decide(tmp_path / "pump.py")
    assert any("sensor_sigma" in line for line in left)
    assert any("limits of the actuator" in line for line in left)


@pytest.mark.parametrize("late", [0.0, 0.3])
def test_an_output_that_integrates(tmp_path, late):
    """A slide of 12 mm/s per V and 1.5 mm/s without, at once or behind a lag; the sensor's error is 0.02 mm."""
    rng, n, dt, x, speed, aim = np.random.default_rng(3), 3000, 0.02, 0.0, 0.0, 0.0
    u, y = np.zeros(n), np.zeros(n)
    for k in range(n):
        aim = rng.uniform(-10, 10) if k % 40 == 0 else aim
        u[k], y[k] = np.clip(aim - 0.05 * x, -10, 10), x + 0.02 * rng.standard_normal()
        goal = 12 * u[k] + 1.5
        speed = speed + dt * (goal - speed) / late if late else goal
        x += dt * speed
    file = write_csv(tmp_path / "a.csv", {"time [s]": dt * np.arange(n), "u [V]": u, "way [mm]": y})
    write_scenario(tmp_path / "slide.py", file)
    scenario = load_scenario(str(tmp_path / "slide.py"))
    prior = scenario.prior()
    assert prior.values["k_way_u"] == pytest.approx(12.0, rel=0.05)
    assert prior.values["drift_way"] == pytest.approx(1.5, rel=0.1)
    assert len(prior.states) == (2 if late else 1)
    assert (prior.inputs[0].lower, prior.inputs[0].upper) == (-10.0, 10.0)
    assert preflight(scenario).problems == ()
    assert re.search(r"# sensor_sigma=\(0\.02\d*,\)", (tmp_path / "slide.py").read_text())


def test_a_swing_has_two_states(machine, tmp_path):
    draft = write_scenario(tmp_path / "swing.py", machine / "monday.csv")
    assert (draft.time.full, [c.full for c in draft.inputs]) == ("time_s", ["tau_nm"])
    scenario = load_scenario(str(tmp_path / "swing.py"))
    assert [s.name for s in scenario.prior.states] == ["phi_rad", "phi_rad_rate"]
    assert scenario.prior.corrects == ("phi_rad_rate",)
    # sqrt(J / mgl) = 0.30 s for small swings; these reach 1.4 rad, where it is longer
    assert 0.28 < scenario.prior().values["T_phi_rad"] < 0.36
    assert preflight(scenario).problems == ()
    assert [s.unit for s in (*scenario.prior.inputs, *scenario.prior.states)] == ["N m", "rad", "rad/s"]


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
    assert "continue with 'hybrid-mpc run'" in " ".join(told.split())


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
    assert any("the sampling period [s]" in line for line in left_to_decide(tmp_path / "b.py"))


def test_what_cannot_be_is_refused(tmp_path):
    file = oven(tmp_path / "a.csv")
    (tmp_path / "there.py").write_text("mine")
    for path, words in ((tmp_path / "there.py", "HM-CHECK-010"), (tmp_path / "a.txt", "HM-CHECK-009")):
        with pytest.raises(InputError, match=words):
            write_scenario(path, file)
    assert (tmp_path / "there.py").read_text() == "mine"
    with pytest.raises(InputError, match="HM-DATA-085"):
        write_scenario(tmp_path / "b.py", file, inputs=("volt",))
    still = write_csv(tmp_path / "still.csv", {"t": np.arange(50.0), "u": np.zeros(50)})
    with pytest.raises(InputError, match=r"(?s)an input.*t, u.*HM-CHECK-014"):
        write_scenario(tmp_path / "b.py", still)
    short = write_csv(tmp_path / "short.csv", {"t": np.arange(5.0), "u": np.arange(5.0)})
    with pytest.raises(InputError, match=r"20.*HM-CHECK-004"):
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
        assert "--data takes one value; repeat it: --data A --data B" in told
    code, _, told = call("check", path, "something")
    assert (code, "give it once" in told) == (2, False)


# Names: nothing of a recording becomes code

PWNED = 't,"u"",),open(""pwned"",""w"").write(""x"") and (""",y'
NAMES = st.text(st.characters(exclude_categories=("Cs",)), max_size=25) | st.sampled_from([
    'in"put', "u\n1", "u\r", "a\u2028b", "back\\", "\\", "'", '"""', "'''", "x [V\n]", "# TODO: y", "{u}", "%s",
    "class", "None", "x", "p", "u_rate", "T_u", "__class__", "1", "2 x [m", "count [1/s]", "größe (°C)", "温度",
    "a.b", "y(1)", "\x00", "[V]", 'u ["]', "open('pwned', 'w')", "k_y_u", "rest_y", "\u202e", "y\x85", "\x0c", " ",
])  # fmt: skip
EXPECTED = {"Signal", "Parameter", "DataSpec", "Scenario"}


def with_header(path, header, rows=250, seed=0):
    """Steps and lags under names of any kind."""
    rng = np.random.default_rng(seed)
    u = np.repeat(rng.standard_normal(rows // 5), 5)
    columns = [0.1 * np.arange(rows), u]
    columns += [np.convolve(u, np.exp(-np.arange(9) / k))[:rows] for k in range(2, len(header))]
    with path.open("w", newline="", encoding="utf-8") as file:
        writer = csv.writer(file)
        writer.writerow(header)
        writer.writerows(zip(*columns[: len(header)], strict=True))
    return path


def calls_of(text):
    """Names of all that is called; nothing else but literals, classes and sums of products may stand there."""
    tree = ast.parse(text)
    calls = [node for node in ast.walk(tree) if isinstance(node, ast.Call)]
    assert all(isinstance(call.func, ast.Name) for call in calls)
    kinds = {type(node) for node in ast.walk(tree)}
    assert not kinds & {
        ast.Import,
        ast.Lambda,
        ast.JoinedStr,
        ast.Await,
        ast.ListComp,
        ast.Global,
        ast.Try,
        ast.With,
    }
    return {call.func.id for call in calls}


def loaded(path):
    """The scenario of a file; its folder and module are forgotten."""
    before = list(sys.path)
    try:
        return load_scenario(str(path))
    finally:
        sys.path[:] = before
        sys.modules.pop(f"hybrid_mpc_user_{path.stem}", None)


def roles_are_read_back(folder, stem, file, header):
    """Either it is refused, or the file has the expected calls alone and names the very columns."""
    path = folder / f"{stem}.py"
    try:
        draft = write_scenario(path, file, inputs=[header[1]], outputs=header[2:])
    except InputError:
        assert not path.exists()
        return False
    text = path.read_text(encoding="utf-8")
    assert calls_of(text) <= EXPECTED
    assert len(text.splitlines()) == text.count("\n")  # no other end of a line
    scenario = loaded(path)
    assert (scenario.data.inputs, scenario.data.outputs) == ((header[1],), tuple(header[2:]))
    assert scenario.data.time == (draft.time.full if draft.time else 1.0)
    names = [s.name for s in (*scenario.prior.states, *scenario.prior.inputs)]
    assert all(re.fullmatch(r"[A-Za-z]\w*", name, re.ASCII) for name in names)
    scenario.prior().equations  # noqa: B018  (every name is found)
    return True


@settings(max_examples=30, deadline=None, suppress_health_check=list(HealthCheck))
@given(st.lists(NAMES.filter(lambda name: name.strip() != "t"), min_size=2, max_size=4, unique_by=str.strip))
@example(next(csv.reader([PWNED]))[1:])
@example(['in"put', "u\n1"])
@example(["back\\", '"""', "# TODO: \u2028import os"])
@example(["b_c", "a", "a_b", "c"])
@example(["u", "phi", "phi_rate", "T_phi"])
def test_no_header_becomes_code(names):
    header = ["t", *(name.strip() for name in names)]
    with tempfile.TemporaryDirectory() as folder:
        file = with_header(Path(folder) / "a.csv", header)
        done = roles_are_read_back(Path(folder), "machine", file, header)
        table = not any(mark in name for name in header for mark in ";\t\r\n")
        assert done or not table or any(map(column_problem, header))
        assert not (Path(folder) / "pwned").exists()
    assert not Path("pwned").exists()


@pytest.mark.parametrize(
    ("stem", "name"),
    [
        ('c"d', 'c"d.csv'), ("a\nb", "a\nb.csv"), ('"""', '"""open(1)"""'), ("back\\", "b\\"),
        ("data_spec", "a.csv"), ("none", "a.csv"), ("scenario", "x"), ("1st", "1.csv"), ("größe", "ü.csv"),
        ("--", "-"), ("coding: utf-7", "a"),
        ("x\u2028y", "x\u2028y.csv"), ("{0}", "%s.csv"), ("signal", "# TODO"),
    ],
)  # fmt: skip
def test_no_file_name_becomes_code(tmp_path, stem, name):
    header = ["time_s", "u", "y"]
    file = with_header(tmp_path / name, header)
    assert roles_are_read_back(tmp_path, stem, file, header)


def test_the_command_that_is_proposed_is_one_command(call, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    name = "a b; $(touch pwned).csv"
    with_header(tmp_path / name, ["t", "u", "[31my"])
    code, told, _ = call("new", "m.py", "--data", name)
    assert code == 0
    assert shlex.split(told.splitlines()[-1].partition("Next: ")[2]) == [
        "hybrid-mpc",
        "check",
        "m.py",
        "--data",
        name,
    ]
    assert "\x1b" not in told


# Time


def logged(path, time, name="t", more=(), rows=300, before=True, separator=","):
    """Steps and a lag beside a time, as it is written, and other columns; cells are texts."""
    rng = np.random.default_rng(3)
    u = np.repeat(rng.standard_normal(rows // 10), 10)
    columns = {name: list(time)} if name is not None else {}
    rest = {key: list(map(str, column)) for key, column in dict(more).items()}
    signals = {"u": list(map(str, u)), "y": list(map(str, np.convolve(u, 0.7 ** np.arange(20))[:rows]))}
    columns = {**rest, **columns, **signals} if before else {**columns, **signals, **rest}
    lines = [separator.join(columns), *(separator.join(row) for row in zip(*columns.values(), strict=False))]
    path.write_text("\n".join(lines), encoding="utf-8")
    return path


def stamps(dt=0.02, rows=300, start=0.0):
    return [f"{start + dt * k:.10g}" for k in range(rows)]


@pytest.mark.parametrize(
    ("name", "unit"),
    [
        *((name, 1.0) for name in ("t", "TIME [s]", "Zeit in s", "时间", "header.stamp", "T", "X_Value")),
        ("timeMs", 1e-3), ("Time (µs)", 1e-6), ("t [h]", 3600.0),
        *(pytest.param(name, 1.0, marks=pytest.mark.full) for name in (
            "time", "Time", "Time (s)", "time_s", "timestamp", "TimeStamp", "Zeit", "temps", "Temps (s)", "tiempo",
            "Tempo_s", "čas", "czas [s]", "время", "時間（s）", "시간", "seconds", "elapsed", "Elapsed Time (s)",
            "sim_time", "ros_time", "t / s", "Time; s", "T [s]", "Laufzeit", "aika", "tid", "%time", "time1",
            "camera_time", "s", "tijd [s]", "Uhrzeit (s)",
        )),
        *(pytest.param(name, 1e-3, marks=pytest.mark.full) for name in (
            "t_ms", "Time (ms)", "time [msec]", "millis", "t[ms]", "zeit_ms",
        )),
        *(pytest.param(name, 1e-6, marks=pytest.mark.full) for name in ("time_us", "t [us]", "time in μs")),
        pytest.param("Time (min)", 60.0, marks=pytest.mark.full),
        pytest.param("time (hr)", 3600.0, marks=pytest.mark.full),
    ],
)  # fmt: skip
def test_the_column_that_says_time_is_the_time(tmp_path, name, unit):
    """Behind an index that rises as evenly, and with jitter; its period is the scenario's, in seconds."""
    rng = np.random.default_rng(0)
    jitter = 0.001 * rng.random(300)
    jitter = jitter * (0 if name in ("T", "s", "X_Value", "camera_time") else 1)
    time = [f"{(0.02 * k + j) / unit:.12g}" for k, j in enumerate(jitter)]
    file = logged(
        tmp_path / "a.csv", time, name, {"": range(300), "n": range(300), "Data_Point": range(1, 301)}
    )
    draft = write_scenario(tmp_path / "m.py", file)
    assert (draft.time.full, [c.full for c in draft.inputs], [c.full for c in draft.outputs]) == (
        name,
        ["u"],
        ["y"],
    )
    assert draft.period == pytest.approx(0.02, rel=0.05)
    scenario = loaded(tmp_path / "m.py")
    assert scenario.data.dt == pytest.approx(0.02, rel=0.05)
    data = load_trajectories([file], scenario.prior(), scenario.data)
    assert data.sampling[0] == pytest.approx(0.02, rel=0.05)
    assert not preflight(scenario, None, lambda: data).problems


REPEATED = stamps()[:100] + stamps()[99:299]
RESTARTED = stamps(rows=150) + stamps(rows=150)
BROKEN = stamps(rows=150) + stamps(rows=150, start=1.0)


@pytest.mark.parametrize(
    ("time", "match"),
    [
        (REPEATED, r"row 102, column 't': time repeats.*HM-CHECK-006"),
        (BROKEN, r"row 152, column 't': time decreases.*HM-CHECK-006"),
        (stamps()[::-1], r"time decreases.*HM-CHECK-006"),
        (["1.5"] * 300, r"time repeats.*HM-CHECK-006"),
        (["", *stamps()[1:]], r"row 2, column 't' is empty.*HM-CHECK-006"),
        ([*stamps()[:299], "Mean"], r"row 301, column 't' is 'Mean'.*HM-CHECK-006"),
        ([f"10:{k // 60:02d}" for k in range(300)], "HM-CHECK-006"),
        (["s", *stamps(rows=299)], r"row 2, column 't' is 's'.*HM-CHECK-006"),
        ([f"{0.02 * k:.2f} {'s' if k else 'V'}" for k in range(300)], "HM-CHECK-006"),
    ],
)
@pytest.mark.parametrize("asked", ["", "t"])
def test_a_time_that_cannot_be_used_is_refused_with_its_reason(tmp_path, time, match, asked):
    """It is no signal, and the index beside it does not stand for it."""
    file = logged(tmp_path / "a.csv", time, "t", {"index": range(300)})
    with pytest.raises(InputError, match=match):
        write_scenario(tmp_path / "m.py", file, time=asked)
    assert not (tmp_path / "m.py").exists()


@pytest.mark.parametrize(
    ("time", "period"),
    [
        (RESTARTED, 0.02),
        ([f"2024-01-01 10:{k // 60:02d}:{k % 60:02d}" for k in range(300)], 1.0),
        ([f"10:{k // 60:02d}:{k % 60:02d}" for k in range(300)], 1.0),
        ([f"{0.02 * k:.2f} s" for k in range(300)], 0.02),
    ],
)
def test_dates_units_in_cells_and_restarts_are_a_time(tmp_path, time, period):
    draft = write_scenario(tmp_path / "m.py", logged(tmp_path / "a.csv", time, "t", {"index": range(300)}))
    assert draft.time.name == "t"
    assert draft.period == pytest.approx(period)


@pytest.mark.parametrize("name", ["Time [ticks]", "time [V]", "Date", "Datum"])
def test_a_time_in_units_that_nobody_knows_is_refused(tmp_path, name):
    with pytest.raises(InputError, match="HM-CHECK-006"):
        write_scenario(tmp_path / "m.py", logged(tmp_path / "a.csv", stamps(start=45000.0), name))


@pytest.mark.parametrize(("unit", "first"), [(1.0, 1.7e9), (1e-3, 1.7e12), (1e-6, 1.7e15), (1e-9, 1.7e18)])
@pytest.mark.parametrize(
    "name", ["time", *(pytest.param(n, marks=pytest.mark.full) for n in ("timestamp", "date"))]
)
def test_time_since_1970(tmp_path, unit, first, name):
    time = [
        f"{first + round(0.5 * k / unit):.0f}" if unit < 1 else f"{first + 0.5 * k:.1f}" for k in range(300)
    ]
    draft = write_scenario(tmp_path / "m.py", logged(tmp_path / "a.csv", time, name))
    assert draft.period == pytest.approx(0.5, rel=1e-6)
    scenario = loaded(tmp_path / "m.py")
    data = load_trajectories([tmp_path / "a.csv"], scenario.prior(), scenario.data)
    assert data.sampling[0] == pytest.approx(0.5, rel=1e-6)


def test_the_good_one_of_two_times_is_taken(tmp_path):
    days = {"date": ["2024-01-01"] * 300, "Time": [f"10:00:{k % 7:02d}" for k in range(300)]}
    draft = write_scenario(tmp_path / "m.py", logged(tmp_path / "a.csv", stamps(), "elapsed [s]", days))
    assert draft.time.full == "elapsed [s]"
    assert set(draft.left_out) == {"Time [s]"}
    assert draft.left_out["Time [s]"] == "the time by its name"


@pytest.mark.parametrize(
    "name",
    [
        "index",
        "n",
        "Data_Point",
        *(pytest.param(n, marks=pytest.mark.full) for n in ("sample", "Unnamed: 0", "No.", "k", "row")),
    ],
)
def test_a_count_of_samples_is_no_signal_and_the_last_to_stand_for_time(tmp_path, call, name):
    """Also where it begins again; beside a name that says nothing and rises evenly it is not taken."""
    file = logged(tmp_path / "a.csv", map(str, range(300)), name, before=False)
    code, told, _ = call("new", tmp_path / "m.py", "--data", file)
    assert code == 0
    assert "the column counts samples" in told
    scenario = loaded(tmp_path / "m.py")
    assert (scenario.data.time, scenario.data.inputs, scenario.data.outputs) == (name, ("u",), ("y",))
    assert scenario.data.units == {name: 1.0}
    assert any("counts samples" in line for line in left_to_decide(tmp_path / "m.py"))
    file = logged(tmp_path / "b.csv", map(str, range(300)), name, {"stempel": stamps()}, before=False)
    draft = write_scenario(tmp_path / "n.py", file)
    assert (draft.time.full, draft.period) == ("stempel", pytest.approx(0.02))
    if name not in ("n", "No.", "k"):  # these may be speeds and constants: their numbers decide
        again = [str(k % 150) for k in range(300)]
        draft = write_scenario(tmp_path / "o.py", logged(tmp_path / "c.csv", stamps(), "t", {name: again}))
        assert [c.full for c in draft.signals] == ["u", "y"]


def test_names_that_only_sound_like_time_are_signals(tmp_path):
    rng = np.random.default_rng(0)
    more = {
        name: rng.standard_normal(300)
        for name in ("T", "n", "valve_time_ms", "t_room", "T_min [degC]", "x", "i")
    }
    draft = write_scenario(tmp_path / "m.py", logged(tmp_path / "a.csv", stamps(), "t", more))
    assert {c.full for c in draft.outputs} == {*more, "y"}


@pytest.mark.parametrize(
    "name", ["dt", "t_s", *(pytest.param(n, marks=pytest.mark.full) for n in ("Ts", "time", "sampling_time"))]
)
@pytest.mark.parametrize("ending", ["mat", "npz"])
def test_a_single_number_is_the_sampling_time(tmp_path, name, ending):
    u = np.repeat(np.random.default_rng(0).standard_normal(30), 10)
    columns = {"u": u, "y": np.convolve(u, 0.7 ** np.arange(20))[:300], name: 0.05, "mass": 3.0}
    file = tmp_path / f"a.{ending}"
    savemat(file, columns) if ending == "mat" else np.savez(file, **columns)
    draft = write_scenario(tmp_path / "m.py", file)
    assert (draft.time.full, draft.period) == (name, 0.05)
    scenario = loaded(tmp_path / "m.py")
    assert scenario.data.dt == 0.05
    assert not preflight(
        scenario, None, lambda: load_trajectories([file], scenario.prior(), scenario.data)
    ).problems


# What the reader knows


@pytest.mark.parametrize(
    ("change", "match"),
    [
        (lambda rows: [*rows[:50], "1,2", *rows[50:]], r"51.*the header.*HM-DATA-093"),
        (lambda rows: ["t,u,u", *rows[1:]], r"its name appears 2 times.*HM-CHECK-014"),
    ],
)
def test_the_readers_reason_is_passed_on(tmp_path, change, match):
    rows = logged(tmp_path / "a.csv", stamps()).read_text().splitlines()
    (tmp_path / "a.csv").write_text("\n".join(change(rows)))
    with pytest.raises(InputError, match=match):
        write_scenario(tmp_path / "m.py", tmp_path / "a.csv")


def test_an_index_is_no_unit(tmp_path):
    header = ["t", "cmd[0]", "state[0]", "state[1]", "y(1)"]
    draft = write_scenario(tmp_path / "m.py", with_header(tmp_path / "a.csv", header), inputs=["cmd[0]"])
    assert [(c.name, c.unit) for c in draft.outputs] == [(name, "") for name in header[2:]]
    names = [s.name for s in loaded(tmp_path / "m.py").prior.outputs]
    assert names == ["state_0", "state_1", "y_1"]


# What is written passes the check


KINDS = {
    "steps": lambda rng, m: np.repeat(rng.standard_normal(m // 8 + 1), 8)[:m],
    "binary": lambda rng, m: np.repeat(rng.integers(0, 2, m // 8 + 1), 8)[:m].astype(float),
    "noise": lambda rng, m: rng.standard_normal(m),
    "sine": lambda rng, m: np.sin(2 * np.pi * np.arange(m) / m * rng.uniform(5, 20)),
    "walk": lambda rng, m: np.cumsum(rng.standard_normal(m)),
    "swing": lambda rng, m: np.convolve(
        rng.standard_normal(m), 0.97 ** np.arange(m) * np.sin(np.arange(m) / 4)
    )[:m],
    "quantised": lambda rng, m: np.round(3 * np.sin(np.arange(m) / 30)),
    "rare": lambda rng, m: (np.arange(m) == m // 5) * 1.0,
    "constant": lambda rng, m: np.full(m, 3.0),
    "blanks": lambda rng, m: np.where(rng.random(m) < 0.8, np.nan, np.sin(np.arange(m) / 9)),
    "angle [rad]": lambda rng, m: np.mod(np.cumsum(rng.uniform(0.05, 0.3, m)), 2 * np.pi) - np.pi,
    "angle [deg]": lambda rng, m: np.mod(np.cumsum(rng.uniform(3, 20, m)), 360),
}


# a switch between 0 and 1e20 is refused: 1e20 is a code for missing values
COLUMNS = st.tuples(
    st.sampled_from(sorted(KINDS)), st.sampled_from([1e-20, 1e-6, 1.0, 1e3, 1e14]),
    st.sampled_from([0.0, 0.0, 1.0, -10.0, 1e3]),
)  # fmt: skip
TABLES = (
    st.integers(0, 2**32), st.sampled_from([1e-6, 1e-3, 0.02, 1.0, 3600.0]),
    st.sampled_from(["steps", "binary", "noise"]), st.lists(COLUMNS, min_size=1, max_size=3),
)  # fmt: skip


@settings(max_examples=10, deadline=None, suppress_health_check=list(HealthCheck))
@given(*TABLES)
@example(0, 1.0, "steps", [("noise", 0.01, 1e5)])  # 1013.20 to 1013.24
def test_what_is_written_passes_the_check_on_that_file(seed, dt, drive, columns):
    passes_the_check(seed, dt, drive, columns)


@pytest.mark.full
@settings(max_examples=300, deadline=None, suppress_health_check=list(HealthCheck))
@given(*TABLES)
def test_what_is_written_of_many_recordings_passes_the_check(seed, dt, drive, columns):
    passes_the_check(seed, dt, drive, columns)


def passes_the_check(seed, dt, drive, columns):
    """Of any scale, offset, shape and sampling; what has no output that moves is refused, and so is nothing else."""
    rng = np.random.default_rng(seed)
    table = {"t": dt * (np.arange(400) + 0.2 * rng.random(400)), "u": KINDS[drive](rng, 400)}
    for j, (kind, scale, offset) in enumerate(columns):
        values = KINDS[kind](rng, 400)
        scaled = values if "angle" in kind else scale * (values + offset)
        table[f"y{j} {kind}"] = scaled
    with tempfile.TemporaryDirectory() as folder:
        file, path = Path(folder) / "a.npz", Path(folder) / "m.py"
        np.savez(file, **table)
        outputs = [name for name in table if name not in ("t", "u") and not name.endswith("constant")]
        for kind in ("rare", "quantised"):  # these are the same each time: all but one are copies
            alike = [name for name in outputs if name.endswith(kind)]
            outputs = [name for name in outputs if name not in alike[1:]]
        if not outputs:
            with pytest.raises(InputError, match="no column is left for an output"):
                write_scenario(path, file, inputs=("u",))
            return
        draft = write_scenario(path, file, inputs=("u",))
        assert {c.full for c in draft.outputs} >= set(outputs)
        scenario = loaded(path)
        found = preflight(scenario, None, lambda: load_trajectories([file], scenario.prior(), scenario.data))
        assert found.problems == ()
        for column, signal in zip(draft.outputs, scenario.prior.outputs, strict=True):
            if not signal.periodic:
                low, high = column.span
                assert signal.lower < low < high < signal.upper
                assert signal.upper - signal.lower < 4 * (high - low)


@pytest.mark.parametrize(
    ("name", "value", "dt"), [("dt", "0.1", 0.1), ("Ts [ms]", "20", 0.02), ("delta_t", "2", 2.0)]
)
def test_the_same_sampling_time_in_every_row(tmp_path, name, value, dt):
    draft = write_scenario(tmp_path / "m.py", logged(tmp_path / "a.csv", [value] * 300, name))
    assert (draft.time, draft.period) == (None, pytest.approx(dt))
    assert [c.full for c in draft.signals] == ["u", "y"]
    assert loaded(tmp_path / "m.py").data.time == pytest.approx(dt)
    uneven = [value, *[f"{float(value) + 0.01 * (k % 7)}" for k in range(299)]]
    draft = write_scenario(tmp_path / "n.py", logged(tmp_path / "b.csv", uneven, name))
    assert ([c.full for c in draft.signals], "no column" in draft.doubt) == (["u", "y"], True)


def test_a_column_named_as_the_mark_is_no_open_point(tmp_path):
    t = 0.1 * np.arange(400)
    drive = np.sign(np.sin(t))
    counts = []
    for i, name in enumerate(("speed", "# TODO")):
        file, path = tmp_path / f"{i}.csv", tmp_path / f"machine{i}.py"
        write_csv(file, {"t": t, "volts": drive, name: np.convolve(drive, np.ones(9) / 9)[:400]})
        write_scenario(path, file, inputs=("volts",), outputs=(name,))
        assert f'"{name}"' in path.read_text()
        counts.append(len(left_to_decide(path)))
    assert counts[0] == counts[1]
    (tmp_path / "text.py").write_text('a = "# TODO: no"\nb = 1  # TODO: yes\n# see # TODO\n')
    assert left_to_decide(tmp_path / "text.py") == ["line 2: yes"]
