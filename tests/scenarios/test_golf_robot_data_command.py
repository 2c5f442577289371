"""``hybrid-mpc data``: what it writes can be read back, and what it refuses."""

from dataclasses import replace
from functools import partial

import numpy as np
import pytest

from hybrid_mpc import InputError, Window, load_trajectories, write_csv
from hybrid_mpc.cli.data import readme, write_data
from scenarios.golf_robot import scenario
from scenarios.torque_pendulum import scenario as torque_pendulum


@pytest.fixture
def call(call):
    """Run the command in this process: ``(exit code, stdout, stderr)``."""
    return partial(call, "data")


@pytest.fixture
def few(monkeypatch):
    sizes = {"quick": {"train": 2, "valid": 1, "test": 1}, "full": {"train": 15, "valid": 6, "test": 15}}
    monkeypatch.setattr("scenarios.golf_robot.data.SIZES", sizes)


def test_it_writes_what_a_run_reads(call, few, tmp_path):
    code, said, _ = call(
        "golf_robot", "--out", tmp_path / "d", "--budget", "quick", "--seed", 3, "--set", "a"
    )
    assert (code, said.count("4 recordings")) == (0, 1)
    files = sorted((tmp_path / "d").glob("*.csv"))
    assert [file.stem for file in files if "train" in file.stem] == ["train_01_step", "train_02_chirp"]
    prior = scenario.prior()
    data = load_trajectories(files, prior, scenario.data)
    assert [len(data.by_role(role)) for role in ("train", "valid", "test")] == [2, 1, 1]
    text = (tmp_path / "d" / "README.md").read_text()
    for words in (
        "| u_nm | N m |", "| phi_rad | rad |", "--seed 3 --budget quick --set a", "Sampling: 10 ms",
        "the recorded time stamps jitter by 0.", "| test_01_sine.csv | test |", "quartic over 0.25 s",
    ):  # fmt: skip
        assert words in text


def test_data_sets_share_what_judges_them(few, tmp_path):
    folders = [write_data(scenario, tmp_path / s, 0, "quick", s)[0].parent for s in ("a", "b")]
    a, b = ({f.name: f.read_bytes() for f in folder.glob("*.csv")} for folder in folders)
    same = {name for name in a if not name.startswith("train")}
    assert same == {name for name in b if not name.startswith("train")}
    assert len(same) == 2
    assert all(a[name] == b[name] for name in same)
    assert not any("sine" in name for name in a if name.startswith("train"))


def test_what_it_refuses(call, few, tmp_path):
    full = tmp_path / "full"
    full.mkdir()
    (full / "mine.txt").write_text("keep")
    for words, need in (
        (("golf_robot", "--out", full), "empty"),
        (("golf_robot", "--out", full / "mine.txt"), "empty"),
        (("golf_robot", "--out", tmp_path / "x", "--set", "c"), "a, b"),
        (("golf_robot", "--out", tmp_path / "x", "--budget", "huge"), "quick, full"),
        (("golf_robott", "--out", tmp_path / "x"), "golf_robot"),
        (("torque_pendulum", "--out", tmp_path / "x"), "HM-CLI-001"),
    ):
        code, _, said = call(*words)
        assert code == 2, words
        assert need in said, words
    assert [path.name for path in tmp_path.iterdir()] == ["full"]  # nothing is left behind
    assert (full / "mine.txt").read_text() == "keep"


def test_a_machine_with_one_data_set_takes_no_set(tmp_path):
    def make(folder, seed, budget):
        t = 0.01 * np.arange(3000)
        return [write_csv(folder / "one.csv", {"time_s": t, "u_nm": 0 * t, "phi_rad": np.sin(t)})]

    mine = replace(scenario, name="mine", make_data=make)
    with pytest.raises(InputError, match="HM-CLI-003"):
        write_data(mine, tmp_path / "x", 0, "quick", "a")
    files = write_data(mine, tmp_path / "y", 0, "quick")
    assert "first 60 % training, next 20 % validation" in (tmp_path / "y" / "README.md").read_text()
    windows = {"one": (Window(0, 10, "train"), Window(10, 20, "test"))}
    two = replace(mine, data=replace(mine.data, windows=windows))
    assert "| train 0 to 10 s, test 10 to 20 s |" in readme(two, files, "a command")
    assert torque_pendulum.make_data is None
