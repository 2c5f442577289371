"""``hybrid-mpc monitor`` on recordings whose contents are known."""

import json
import shutil
from dataclasses import replace

import numpy as np
import pytest
from typer.testing import CliRunner

from hybrid_mpc import ChannelLimit, InputError, WatchLimits, load_scenario, set_limits, write_csv
from hybrid_mpc.cli.main import app
from hybrid_mpc.files import write_json
from hybrid_mpc.records import plain
from hybrid_mpc.workflow.monitor import MonitorJob, prepared, read_limits, watch
from scenarios.golf_robot.rig import Rig

DT = 0.02


@pytest.fixture(scope="module")
def folder(tmp_path_factory, noisy_artifact):
    """A recording in which the club is pushed from 8 s on, with a gap before; noise and a detector by hand."""
    out = tmp_path_factory.mktemp("monitor")
    rig, rng, n = Rig(), np.random.default_rng(0), 600
    state, phi = rig.reset(np.zeros(2), 0), []
    u = 0.25 * np.sin(2 * np.pi * 0.8 * DT * np.arange(n))
    for k in range(n):
        phi.append(rig.measure(state, rng)[0])
        state = rig.step(state, np.array([u[k] + (0.2 if k >= 400 else 0.0)]), DT)
    kept = (np.arange(n) < 100) | (np.arange(n) >= 110)
    columns = {"time_s": DT * np.arange(n), "u_nm": u, "phi_rad": np.array(phi)}
    write_csv(out / "pushed.csv", {name: values[kept] for name, values in columns.items()})
    # Wide scales: the network of this artifact is untrained, so the prior's own errors are nominal here.
    force = ChannelLimit("force of phi", "N m", 0, 15.0, 7.5, (0.02, 0.01, 0.0, 0.0), 2.0)
    power = ChannelLimit("power of the free run", "W", 1, 4.0, 2.0, (0.05, 0.1, 0.0, 0.0))
    limits = WatchLimits("energy", DT, (force, power), (5e-3,), (0,))
    write_json(out / "calibration.json", {"energy": plain(limits)})
    return out


def command(folder, model, out, *more):
    arguments = [
        "monitor",
        str(model),
        str(folder / "pushed.csv"),
        "--scenario",
        "golf_robot",
        "--out",
        str(out),
    ]
    return CliRunner().invoke(app, [*arguments, *more])


def test_it_says_where_and_writes_what_it_saw(folder, noisy_artifact, tmp_path):
    done = command(
        folder, noisy_artifact, tmp_path / "out", "--calibration", str(folder / "calibration.json")
    )
    assert done.exit_code == 0, done.output
    found = json.loads((tmp_path / "out" / "monitor.json").read_text())
    first, second = found["recordings"]
    assert first["alarms"] == []
    starts = [alarm["start_s"] for alarm in second["alarms"]]
    assert starts
    assert 8.0 <= starts[0] < 9.0  # half a period of the motion at most
    assert "gap in pushed.csv" in done.output
    rows = (tmp_path / "out" / "pushed_2.csv").read_text().splitlines()
    assert rows[0].startswith("t_s,phi_rad,violation_value_W,violation_alarm,force_of_phi_value_N m")
    assert len(rows) == 1 + round(second["seconds"] / DT)
    assert len(rows) > 480
    assert (tmp_path / "out" / "pushed_2.png").stat().st_size > 10_000


def test_the_kit_s_own_limits_need_no_option(folder, noisy_artifact, tmp_path):
    model = shutil.copytree(noisy_artifact, tmp_path / "model")
    limits = read_limits(folder / "calibration.json", "energy")
    limits = replace(
        limits, false_alarms_per_hour=2.0, hours=0.05, method="by hand", data_hash="0123456789abcdef"
    )
    set_limits(model, {"hybrid": [limits]})
    done = command(folder, model, tmp_path / "out")
    assert done.exit_code == 0, done.output
    told = "channels: force of phi, power of the free run; limits for 2 false alarms per hour, learned from 3 min"
    assert told in done.output
    found = json.loads((tmp_path / "out" / "monitor.json").read_text())
    assert found["limits"]["data_hash"] == limits.data_hash
    # as with the same limits from a file
    assert 8.0 <= found["recordings"][1]["alarms"][0]["start_s"] < 9.0
    without = command(folder, noisy_artifact, tmp_path / "without")
    assert "no limits of energy" in without.output


def test_too_little_nominal_data_says_how_much_is_needed(folder, noisy_artifact, tmp_path):
    done = command(folder, noisy_artifact, tmp_path / "out", "--learn", "1")
    assert "HM-WATCH-024" in str(done.exception)
    assert not (tmp_path / "out" / "calibration.json").exists()


def test_bad_input_speaks(folder, noisy_artifact, tmp_path):
    (tmp_path / "empty.json").write_text("{}")
    done = command(folder, noisy_artifact, tmp_path / "out", "--calibration", str(tmp_path / "empty.json"))
    assert "HM-WORKFLOW-026" in str(done.exception)
    files, scenario = [folder / "pushed.csv"], load_scenario("golf_robot")
    with pytest.raises(InputError, match="HM-WORKFLOW-022"):
        prepared(replace(scenario, control=None), noisy_artifact, files)
    with pytest.raises(InputError, match=r"0\.01.*HM-WORKFLOW-024"):
        prepared(replace(scenario, data=replace(scenario.data, dt=0.01)), noisy_artifact, files)


def test_an_alarm_is_explained_once(folder, noisy_artifact, tmp_path):
    job = prepared(
        load_scenario("golf_robot"), noisy_artifact, [folder / "pushed.csv"],
        calibration=folder / "calibration.json",
    )  # fmt: skip
    assert isinstance(job, MonitorJob)
    (tmp_path / "out").mkdir()
    _, second = watch(job, tmp_path / "out").recordings
    assert second.alarms
    assert all(alarm.diagnosis and alarm.channels for alarm in second.alarms)


def test_a_frozen_sensor_is_told_and_watched_all_the_same(folder, noisy_artifact, tmp_path):
    rows = np.genfromtxt(folder / "pushed.csv", delimiter=",", names=True)
    rows["phi_rad"][300:360] = rows["phi_rad"][300]
    columns = {name: rows[name] for name in ("time_s", "u_nm", "phi_rad")}
    write_csv(tmp_path / "pushed.csv", columns)
    calibration = str(folder / "calibration.json")
    done = command(tmp_path, noisy_artifact, tmp_path / "out", "--calibration", calibration)
    assert done.exit_code == 0, done.output
    found = json.loads((tmp_path / "out" / "monitor.json").read_text())
    (warning,) = found["warnings"]
    assert warning.startswith("pushed.csv: column 'phi_rad' repeats")
    assert f"warning: {warning}" in done.output
    # 10 samples are missing before: the stretch begins at sample 310
    start = 310 * DT
    assert any(
        start < alarm["start_s"] < start + 60 * DT + 0.5
        for row in found["recordings"]
        for alarm in row["alarms"]
    )


def test_a_wrapped_angle_is_refused_where_the_model_knows_no_turns(folder, noisy_artifact, tmp_path):
    """The golf robot's angle is no periodic signal; an estimator takes a jump of a turn for a blow."""
    t = DT * np.arange(600)
    phi = (2.0 * t + np.pi) % (2 * np.pi) - np.pi
    write_csv(tmp_path / "pushed.csv", {"time_s": t, "u_nm": np.sin(t), "phi_rad": phi})
    done = command(tmp_path, noisy_artifact, tmp_path / "out")
    assert isinstance(done.exception, InputError)
    assert "jumps 4 times by about a full turn" in str(done.exception)
