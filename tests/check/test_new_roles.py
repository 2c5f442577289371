"""Roles that ``hybrid-mpc new`` finds: machines from their recordings, made-up loops, copies, flags, several files."""

import ast
import csv
import sys
from pathlib import Path

import numpy as np
import pytest

from hybrid_mpc import InputError, load_scenario, write_csv
from hybrid_mpc.check import first_model
from hybrid_mpc.check.first_model import Runs, first_lag, growth_of, slowest
from hybrid_mpc.check.new import horizon_of, left_to_decide, write_scenario
from hybrid_mpc.check.roles import Trait, copy_of, follows, is_rate, judge_roles
from hybrid_mpc.data.names import role_said_by, unit_behind

sys.path.append(str(Path(__file__).parents[2] / "benchmarks"))
import new_scenarios as benchmark

SHARED = Path(__file__).parents[3] / "shared"


# Machines


QUICK = ("data/cascaded_tanks", "data/emps", "data/temperature_lab", "data/unbalanced_disk")
"""Machines with short recordings; the full set has all."""


def of_machines(names):
    """Names of machines, of which the quick set takes few."""
    marked = [name if name in QUICK else pytest.param(name, marks=pytest.mark.full) for name in names]
    return pytest.mark.parametrize("name", marked)


@of_machines(benchmark.MACHINES)
def test_machines_are_told_right_without_options(name):
    if not (SHARED / name).is_dir():
        pytest.skip(f"the recordings of {name} are not here")
    rows = list(benchmark.machines(SHARED, nameless=False, only=[name]))
    assert [row["right"] for row in rows] == [True] * len(benchmark.MACHINES[name])
    for row, group in zip(rows, benchmark.MACHINES[name], strict=True):
        assert set(row["disturbances"]) == set(group.disturbances)


CLOSED = {
    "data/emps", "data/quarter_drone", "data/torque_pendulum", "data/xl330_pendulum", "cases/propeller_arm",
    "cases/rotary_pendulum",
}  # fmt: skip
OPEN = {
    "data/cascaded_tanks",
    "data/coupled_drives",
    "data/heat_exchanger",
    "data/race_car",
    "data/unbalanced_disk",
}


@of_machines(sorted(CLOSED | OPEN))
def test_closed_loops_are_seen_without_names(name):
    """By the numbers alone, but for one: a servo of small gain whose recordings hold a set-point."""
    if not (SHARED / name).is_dir():
        pytest.skip(f"the recordings of {name} are not here")
    for row in benchmark.machines(SHARED, nameless=False, only=[name]):
        assert ("closed loop" in row["said"]) is (name in CLOSED)
        assert ("unstable" in row["said"]) is (name == "cases/rotary_pendulum")


@pytest.mark.full
def test_how_many_are_told_right_otherwise():
    """The figures of docs/columns.md."""
    rows = list(benchmark.simulated())
    assert sum(row["right"] for row in rows) >= 16
    assert len(rows) == 20
    if (SHARED / "data").is_dir() and (SHARED / "cases").is_dir():
        assert benchmark.table_of(list(benchmark.machines(SHARED, nameless=True)))[-1].startswith("10 of 15")


# Made-up recordings, whose names say nothing

TOLD = [make for make in benchmark.MADE_UP if make.__name__ not in ("heating", "loop_without_reference")]


@pytest.mark.parametrize("make", TOLD, ids=lambda make: make.__name__)
def test_made_up_loops_are_told_right(make):
    for seed in range(3):
        table, truth = make(np.random.default_rng(100 + seed))
        found = judge_roles([Trait(name, "", (values,)) for name, values in table.items()])
        for kind, names in (
            ("input", truth.inputs),
            ("output", truth.outputs),
            ("set-point", truth.set_points),
        ):
            assert {name for name, verdict in found.items() if verdict.kind == kind} == set(names), (
                seed,
                kind,
            )


def test_the_growth_of_an_unstable_machine(tmp_path):
    """a'' = 15 a - 0.1 a': it leaves its rest with 3.82 1/s."""
    table, truth = benchmark.unstable(np.random.default_rng(7))
    file = write_csv(tmp_path / "a.csv", {"t": 0.01 * np.arange(6000), **table})
    draft = write_scenario(tmp_path / "m.py", file, inputs=truth.inputs, outputs=truth.outputs)
    assert draft.growth == pytest.approx(3.82, rel=0.1)
    assert draft.loop
    said = [line for line in left_to_decide(tmp_path / "m.py") if "closed loop" in line or "unstable" in line]
    assert len(said) == 2


def levitated(seed, noise, dt=1e-3):
    """Gap, current and voltage of a ball below a magnet, which leaves its rest with 40 1/s, under two controllers."""
    rng, x, v, i, smooth, reference, rows = np.random.default_rng(seed), 0.0, 0.0, 0.0, 0.0, 0.0, []
    for k in range(20_000):
        gap, current = x + noise * rng.normal(), i + 0.15 * noise * rng.normal()
        reference = rng.uniform(-1.0, 1.0) if k % 500 == 0 else reference
        smooth, before = smooth + (gap - smooth) / 3.0, smooth
        wanted = 0.34 * (gap - reference) + 7e-3 * (smooth - before) / dt
        voltage = 65.0 * (wanted - current) + 11.0 * wanted + 0.3 * rng.normal()
        rows.append((gap, current, voltage))
        for _ in range(4):
            h, a = dt / 4, 1600.0 * (x - 4.5 * i)
            x, v, i = x + h * v, v + h * a, i + h * (voltage - 11.0 * i) / 0.3
    table = np.array(rows)
    return Runs(table[:, :2], table[:, 2:])


def test_the_growth_of_a_machine_whose_noise_exceeds_the_motion_of_a_sample(monkeypatch):
    runs = [levitated(seed, 0.025) for seed in range(2)]
    # noise reduces the rate of the fitted poles
    assert growth_of(runs, 1e-3) == pytest.approx(40.0, rel=0.4)
    monkeypatch.setattr(first_model, "FINEST", (1,))
    assert growth_of(runs, 1e-3) == 0.0


def test_a_carriage_with_friction_is_not_unstable(tmp_path):
    for seed in range(3):
        table, truth = benchmark.servo_steps(np.random.default_rng(seed))
        file = write_csv(tmp_path / f"{seed}.csv", {"t": 0.01 * np.arange(4000), **table})
        draft = write_scenario(tmp_path / f"m{seed}.py", file, inputs=truth.inputs, outputs=truth.outputs)
        assert (bool(draft.loop), draft.growth) == (True, 0.0)


# Kinds of columns


def lag(u, steps=20, noise=0.02, seed=0):
    return benchmark.lagged(u, 1.0, steps, np.random.default_rng(seed), noise)


def steps(m=1500, seed=0):
    return benchmark.steps_of(np.random.default_rng(seed), m, 30)


def kinds(table, units=None, given=None):
    found = judge_roles([Trait(name, (units or {}).get(name, ""), (v,)) for name, v in table.items()], given)
    return {name: verdict.kind for name, verdict in found.items()}


def test_copies():
    u = steps()
    a = Trait("a", "", (u,))

    def copy(values):
        return copy_of(a, Trait("b", "", (values,)))

    assert (copy(3 * u), copy(273.15 - u), copy(np.round(u, 3))) == ("scaled", "scaled", "scaled")
    assert (copy(np.clip(u, -0.5, 0.7)), copy(np.clip(2 * u, -9, 1.0))) == ("cut off", "cut off")
    assert (copy(lag(u)), copy(u**3), copy(u + 0.02 * np.random.default_rng(1).standard_normal(len(u)))) == (
        "",
        "",
        "",
    )
    y = lag(u)
    assert kinds({"a": u, "b": 2 * u, "y": y}) == {"a": "input", "b": "none", "y": "output"}
    assert kinds({"a": 2 * u, "valve": u, "y": y}) == {"a": "none", "valve": "input", "y": "output"}
    assert kinds({"a": 2 * u, "valve": u, "y": y}, given={"a": "input"})["valve"] == "none"
    # what is sent to the machine is cut off; a sensor that is cut off is the worse one
    assert kinds({"cmd": 2 * u, "sent": np.clip(2 * u, -1, 1), "y": y})["cmd"] == "none"
    assert kinds({"u": u, "level_1": y, "level_2": np.clip(y, -0.3, 0.3)})["level_2"] == "none"
    # a machine without memory: of two columns one is the output
    assert kinds({"u": u, "y": 2 * u}) == {"u": "input", "y": "output"}


def test_flags_and_levels():
    u, m = steps(), 1500
    y = lag(u)
    late = (np.arange(m) > 900) * 1.0
    assert kinds({"u": u, "y": y, "motor_enable": late})["motor_enable"] == "none"
    assert kinds({"a": u, "b": y, "c": late})["c"] == "none"
    assert kinds({"u": u, "y": y, "mode": np.repeat([0, 1, 2, 3, 2], 300).astype(float)})["mode"] == "none"
    # a switch that moves the machine, two levels that are no switch, and a heater that is on or off alone
    on = np.repeat(np.random.default_rng(3).integers(0, 2, 60), 25).astype(float)
    assert kinds({"a": u, "b": y + lag(2 * on), "c": on})["c"] == "input"
    assert kinds({"a": 20 + 20 * on, "b": lag(on)}) == {"a": "input", "b": "output"}
    assert kinds({"a": on, "b": lag(on)}) == {"a": "input", "b": "output"}


def test_a_coarse_sensor_is_not_commanded():
    """It repeats itself in most rows, as a command does; it moves by single steps."""
    u = benchmark.smooth_of(np.random.default_rng(0), 4000, 0.001, 0.004)
    y = np.round(20 * lag(u, 40, 0.0)) / 20
    assert (np.diff(y) == 0).mean() > 0.5
    assert not Trait("y", "", (y,)).is_held
    assert kinds({"y": y, "u": u}) == {"y": "output", "u": "input"}


def test_set_points_drive_where_nothing_else_does():
    u = steps()
    y = lag(u)
    assert kinds({"T_ref": u, "T": y}) == {"T_ref": "input", "T": "output"}
    three = kinds({"T_ref": u, "temp_1": y, "temp_2": lag(u, 40, seed=1), "level": lag(u, 60, seed=2)})
    assert [name for name, kind in three.items() if kind == "input"] == ["T_ref"]
    assert kinds({"speed_target": u, "speed": y, "pwm": u - y}) == {
        "speed_target": "set-point", "speed": "output", "pwm": "input",
    }  # fmt: skip


def test_a_set_point_that_nothing_follows_is_to_be_decided():
    """The command of a jacket, by its name a set-point, and a feed: the jacket itself is not recorded."""
    u, feed = steps(), np.cumsum(0.1 * np.random.default_rng(3).standard_normal(1500))
    table = {"jacket_set": u, "feed": feed, "temp": 0.4 * lag(u, 60) + 0.2 * feed}
    found = judge_roles([Trait(n, "", (v,)) for n, v in table.items()])
    assert (found["jacket_set"].kind, found["jacket_set"].sure) == ("set-point", False)
    followed = judge_roles([Trait(n, "", (v,)) for n, v in {**table, "jacket": lag(u, 3)}.items()])
    assert followed["jacket_set"].sure


def test_a_set_point_that_nothing_follows_is_no_sign_of_a_closed_loop(tmp_path):
    u, feed = steps(), steps(seed=3)
    table = {"jacket_set": u, "feed": feed, "temp": 0.4 * lag(u, 60) + 0.2 * lag(feed)}
    for name, more in (("a", {}), ("b", {"jacket": lag(u, 3)})):
        file = write_csv(tmp_path / f"{name}.csv", {"t": np.arange(1500.0), **table, **more})
        draft = write_scenario(tmp_path / f"{name}.py", file, inputs=["feed"], outputs=["temp"])
        assert [c.full for c in draft.set_points] == ["jacket_set"]
        assert bool(draft.loop) == bool(more)


def test_what_a_drive_measures_stands_in_for_a_command_that_is_not_recorded():
    u = steps()
    answer = lag(u, 2)
    q = lag(u, 30, seed=1)
    assert kinds({"tau_meas": answer, "angle": q}) == {"tau_meas": "input", "angle": "output"}
    assert kinds({"tau_meas": answer, "angle": q, "c": u})["tau_meas"] == "none"
    assert kinds({"tau": answer, "tau_cmd": u, "angle": q}) == {
        "tau": "none",
        "tau_cmd": "input",
        "angle": "output",
    }


def test_units_decide_where_names_do_not():
    u = benchmark.smooth_of(np.random.default_rng(0), 3000)
    y = lag(u)
    found = kinds({"a": y, "b": u}, {"a": "rad", "b": "N m"})
    assert found == {"a": "output", "b": "input"}


def test_what_no_input_reaches_and_what_acts():
    rng = np.random.default_rng(0)
    m = 3000
    u, w = benchmark.steps_of(rng, m, 50), np.cumsum(0.1 * rng.standard_normal(m))
    y = benchmark.lagged(u + 0.5 * w, 1.0, 20, rng, 0.02)
    idle = rng.standard_normal(m)
    found = judge_roles([Trait(n, "", (v,)) for n, v in {"a": u, "b": y, "c": w, "d": idle}.items()])
    assert {name: verdict.kind for name, verdict in found.items()} == {
        "a": "input", "b": "output", "c": "disturbance", "d": "output",
    }  # fmt: skip
    assert [name for name, verdict in found.items() if not verdict.sure] == ["c", "d"]


@pytest.mark.parametrize("seed", range(4))
def test_a_supply_that_acts_beside_a_stronger_input_is_a_disturbance(seed):
    """Its effect shows only if the input is known; the input seems to affect it by chance."""
    rng, k = np.random.default_rng(seed), np.arange(3000)
    duty = benchmark.steps_of(rng, len(k), 20)
    supply = 0.05 * np.sin(0.05 * k) - 0.2 * (k % 900 > 500) + 0.005 * rng.standard_normal(len(k))
    out = benchmark.lagged(10 * duty + 2 * supply, 1.0, 20, rng, 0.01)
    found = judge_roles(
        [Trait("duty", "-", (duty,)), Trait("v_out", "V", (out,)), Trait("v_in", "V", (12 + supply,))]
    )
    assert [verdict.kind for verdict in found.values()] == ["input", "output", "disturbance"]


def test_a_rate_and_a_follower():
    t = 0.01 * np.arange(3000)
    x = np.sin(t) + 0.3 * np.sin(3.1 * t)
    noise = 0.02 * np.random.default_rng(0).standard_normal(3000)
    place, rate = Trait("x", "", (x,)), Trait("v", "", (57.3 * np.gradient(x, t) + noise,))
    assert (is_rate(rate, place), is_rate(place, rate)) == (True, False)
    assert follows(place, Trait("y", "", (np.roll(x, 20),))) > 0.95
    assert follows(place, Trait("y", "", (0.5 * x,))) == 0.0
    assert follows(place, Trait("y", "", (x + 1.0,))) == 0.0


@pytest.mark.parametrize(
    ("name", "unit", "role"),
    [
        ("angle_deg", "deg", "quantity"), ("T_reactor_K", "K", ""), ("command_pct", "%", "command"),
        ("tau1_nm", "N m", "actuator"), ("torque_mNm", "mNm", "actuator"), ("vel_rad_s", "rad/s", "quantity"),
        ("speedRpm", "rpm", "quantity"), ("temp_degC", "degC", "quantity"), ("flow_l_per_min", "l/min", ""),
        ("supply_V", "V", "disturbance"), ("load_torque_Nm", "N m", "disturbance"), ("heater_degc", "degC", ""),
        ("Sollwert", "", "set-point"), ("set_point_1", "", "set-point"), ("offset", "", "label"),
        ("reset", "", ""), ("spin", "", ""), ("Stellgröße", "", "command"), ("motor_voltage_meas", "", "answer"),
        ("q1_kw", "kW", ""), ("q1_rad", "rad", "quantity"), ("deg", "", ""), ("x", "", "quantity"),
        ("y2", "", "measured"), ("force_y", "", ""), ("sog_kn", "kn", ""), ("thrust_kN", "kN", "actuator"),
        ("gyro_dps", "deg/s", "measured"),
    ],
)  # fmt: skip
def test_what_a_name_says(name, unit, role):
    assert unit_behind(name).unit == unit
    assert role_said_by(name, unit) == role


# Several recordings


def written(path, seed, names=("time_s", "valve", "level_m"), more=(), dt=2.0, m=900):
    u = steps(m, seed)
    values = (dt * np.arange(m), 50 + 40 * u, 1 + 0.2 * lag(u, 15, 0.01, seed))
    return write_csv(path, {**dict(zip(names, values, strict=True)), **dict(more)})


def test_several_recordings(call, tmp_path):
    files = [written(tmp_path / "a.csv", 0), written(tmp_path / "b.csv", 1, dt=4.0)]
    files.append(written(tmp_path / "c.csv", 2, more={"push": np.sin(np.arange(900) / 9)}))
    words = [word for file in files for word in ("--data", file)]
    code, told, error = call("new", tmp_path / "m.py", *words)
    assert code == 0, error
    assert [line for line in told.splitlines() if "push" in line] == ["not used: push (missing in a.csv)"]
    assert all(f"--data {file}" in told.splitlines()[-1] for file in files)
    scenario = load_scenario(str(tmp_path / "m.py"))
    assert (scenario.data.inputs, scenario.data.outputs) == (("valve",), ("level_m",))
    assert scenario.data.dt == 4.0  # the longest: no recording has samples in between
    assert scenario.prior.outputs[0].unit == "m"
    code, told, error = call("check", tmp_path / "m.py", *words)
    assert code == 0, told + error


def test_columns_that_move_in_one_recording_alone(tmp_path):
    still = written(tmp_path / "a.csv", 0, more={"fan_pct": np.full(900, 30.0)})
    moving = written(tmp_path / "b.csv", 1, more={"fan_pct": 30 + 10 * steps(900, 5)})
    draft = write_scenario(tmp_path / "m.py", [still, moving])
    assert [c.full for c in draft.inputs] == ["valve", "fan_pct"]
    assert write_scenario(tmp_path / "n.py", still).left_out == {"fan_pct": "constant at 30"}


def test_recordings_that_do_not_fit_together(tmp_path):
    files = [written(tmp_path / "a.csv", 0), written(tmp_path / "b.csv", 1, ("stamp_s", "valve", "level_m"))]
    with pytest.raises(InputError, match=r"b\.csv.*'time_s'.*HM-CHECK-005"):
        write_scenario(tmp_path / "m.py", files)
    with pytest.raises(InputError, match=r"(?s)an input.*HM-CHECK-014"):
        write_scenario(
            tmp_path / "m.py", [files[0], written(tmp_path / "c.csv", 1, ("time_s", "v", "level_m"))]
        )
    with pytest.raises(InputError, match="HM-CHECK-011"):
        write_scenario(tmp_path / "m.py", [])
    assert not (tmp_path / "m.py").exists()


def test_a_recording_that_diverges_is_refused(tmp_path):
    grown = np.sin(np.arange(900) / 20)
    grown[700:] *= np.logspace(0, 57, 200)
    file = written(tmp_path / "a.csv", 0, more={"x": grown})
    with pytest.raises(InputError, match=r"a\.csv.*'x'.*HM-CHECK-003"):
        write_scenario(tmp_path / "m.py", [written(tmp_path / "b.csv", 1, more={"x": grown / 2e57}), file])
    # a code for missing values is one number, a wide range no divergence
    coded = np.where(np.arange(900) > 800, 9.96921e36, np.sin(np.arange(900) / 20))
    draft = write_scenario(tmp_path / "n.py", written(tmp_path / "c.csv", 0, more={"x": coded}))
    assert "x" in draft.left_out
    wide = np.logspace(-6, 3, 900)
    draft = write_scenario(tmp_path / "o.py", written(tmp_path / "d.csv", 0, more={"p": wide}))
    assert "p" not in draft.left_out


# Horizons


def runs_of(y, u):
    return [Runs(np.column_stack(y), np.column_stack([u]))]


def test_the_horizon_is_that_of_what_inputs_move(tmp_path):
    """A lag of 40 s beside a drift of an hour that no input reaches; the sensor is noisy."""
    rng = np.random.default_rng(0)
    m, dt = 3000, 2.0
    u = benchmark.steps_of(rng, m, 60)
    y = benchmark.lagged(u, 1.0, 20, rng, 0.05)
    drift = np.cumsum(rng.standard_normal(m)) * 0.05 + np.linspace(0, 3, m)
    lags = [first_lag(runs_of([y, drift], u), i, dt, 1) for i in range(2)]
    assert lags[0].seconds == pytest.approx(40.0, rel=0.1)
    pace, i = slowest(lags, m * dt)
    assert (i, pace) == (0, pytest.approx(lags[0].matters))
    columns = {"time_s": dt * np.arange(m), "u": u, "y": y, "T": drift}
    draft = write_scenario(tmp_path / "m.py", write_csv(tmp_path / "a.csv", columns))
    assert 20 <= horizon_of(draft)[0] <= 44


def test_an_integrator_has_the_time_in_which_inputs_carry_it_over_its_span():
    rng = np.random.default_rng(1)
    u = benchmark.steps_of(rng, 4000, 20)
    x = 0.01 * np.cumsum(u) + 0.002 * rng.standard_normal(4000)
    lag = first_lag(runs_of([x], u), 0, 0.01, 1)
    crossing = np.ptp(x) / np.ptp(u)  # x' = u
    assert lag.matters == pytest.approx(crossing, rel=0.5)


# Nothing of a recording becomes code


def test_reasons_are_comments(tmp_path):
    """Names stand in reasons of other columns, too."""
    evil = [
        'ref"""); open("pwned", "w")#',
        "u\\'); import os  # TODO",
        "cmd\u2028import os",
        "a\tb'",
        "set {0} %s",
    ]
    u = steps(600)
    columns = [0.1 * np.arange(600), u, 2 * u, lag(u), np.clip(u, -0.3, 0.3), lag(u, 5)]
    with (tmp_path / "a.csv").open("w", newline="", encoding="utf-8") as file:
        writer = csv.writer(file)
        writer.writerow(["t", *evil])
        writer.writerows(zip(*columns, strict=True))
    write_scenario(tmp_path / "m.py", tmp_path / "a.csv")
    text = (tmp_path / "m.py").read_text(encoding="utf-8")
    calls = {node.func.id for node in ast.walk(ast.parse(text)) if isinstance(node, ast.Call)}
    assert calls <= {"Signal", "Parameter", "Scenario", "DataSpec"}
    assert sum(isinstance(node, ast.Import | ast.ImportFrom) for node in ast.walk(ast.parse(text))) == 1
    assert len(text.splitlines()) == text.count("\n")


def test_a_coarse_measurement_of_a_command_is_no_second_input():
    rng = np.random.default_rng(0)
    command = np.repeat(rng.integers(10, 30, 60) * 50.0, 20)
    lag = np.convolve(command, np.full(3, 1 / 3))[: len(command)]
    measured = 100 * np.round(lag / 100)  # held between steps of the sensor
    ship = np.convolve(command, 0.95 ** np.arange(200))[: len(command)] + rng.standard_normal(len(command))
    columns = {"rpm_cmd": command, "speed": ship, "prop_rpm": measured}
    found = judge_roles([Trait(name, "", (column,)) for name, column in columns.items()])
    assert [verdict.kind for verdict in found.values()] == ["input", "output", "none"]


def test_a_second_flow_that_nothing_affects_is_an_input_too():
    rng = np.random.default_rng(1)
    feed, coolant = (np.convolve(rng.standard_normal(1500), np.ones(9) / 9)[:1500] for _ in range(2))
    coolant = coolant + 0.05 * np.roll(feed, 1)  # one controller moves both
    jacket = np.convolve(coolant, 0.9 ** np.arange(80))[:1500]
    reactor = np.convolve(jacket + 4 * feed, 0.95 ** np.arange(120))[:1500]
    columns = {"feed_lpm": feed, "coolant_lpm": coolant, "reactor": reactor, "jacket": jacket}
    noisy = {name: c + 0.02 * np.std(c) * rng.standard_normal(1500) for name, c in columns.items()}
    units = {"feed_lpm": "l/min", "coolant_lpm": "l/min"}
    found = judge_roles([Trait(name, units.get(name, ""), (c,)) for name, c in noisy.items()])
    assert [verdict.kind for verdict in found.values()] == ["input", "input", "output", "output"]


def servo_cylinder(seed=0, m=4000, dt=0.005):
    """A cylinder that integrates its valve's flow, in closed loop: valve, position, pressure, set-point."""
    rng = np.random.default_rng(seed)
    x, v, p, goal, wanted, rows = 0.0, 0.0, 0.0, 0.0, 0.0, []
    for k in range(m):
        wanted = rng.uniform(0, 1) if k % 200 == 0 else wanted
        goal = goal + 0.02 * (wanted - goal) if k else wanted
        u = 30 * (goal - x)
        rows.append((u, x, p, goal))
        h = dt / 40
        for _ in range(40):
            p += h * 500 * (u - 10 * v)
            v += h * 20 * (p - 2 * np.tanh(v / 0.02))
            x += h * v
    table = np.array(rows)
    table[:, :3] += rng.normal(0, 1, (m, 3)) * table[:, :3].std(axis=0) * [0.003, 0.001, 0.005]
    return dict(zip(("u_V", "xp_mm", "pA_bar", "xset_mm"), table.T, strict=True))


def test_the_set_point_of_an_integrator_whose_rate_is_its_input():
    right = {"u_V": "input", "xp_mm": "output", "pA_bar": "output", "xset_mm": "set-point"}
    table, units = servo_cylinder(), {"u_V": "V", "xp_mm": "mm", "pA_bar": "bar", "xset_mm": "mm"}
    assert kinds(table, units) == right
    given = {name: kind for name, kind in right.items() if kind != "set-point"}
    assert kinds(table, units, given) == right


def test_a_set_point_named_in_one_word_with_its_output():
    u, slow = steps(), np.cumsum(0.1 * np.random.default_rng(3).standard_normal(1500))
    table = {"u": u, "xset_mm": slow, "x_mm": lag(u)}
    assert kinds(table)["xset_mm"] == "set-point"
    assert kinds({"u": u, "offset": slow, "x": lag(u)})["offset"] != "set-point"
