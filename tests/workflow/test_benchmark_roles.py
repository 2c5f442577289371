"""What a benchmark's recordings are used for, and which model it recommends."""

from dataclasses import replace

import pytest
from cart import recording, written

from hybrid_mpc import BenchmarkSpec, InputError, Signal, Window, load_scenario
from hybrid_mpc.workflow.benchmark import recommended
from hybrid_mpc.workflow.benchmark_runs import read_training, scored_signals


@pytest.fixture(scope="module")
def machine(tmp_path_factory):
    return written(tmp_path_factory.mktemp("cart"))


def test_roles_do_not_overlap_and_long_recordings_are_cut(machine):
    scenario = load_scenario(str(machine[0]))
    data = read_training(scenario, [machine[1]])
    assert [len(p.t) for p in data.train] == 3 * [
        199
    ]  # 60 s in pieces of 20 s, less the smoothing's distance
    times = [{round(v, 3) for p in part for v in p.t} for part in (data.train, data.valid, data.held_back)]
    assert all(times)
    assert not times[0] & times[1]
    assert not (times[0] | times[1]) & times[2]


@pytest.mark.parametrize("name", ["pgrnn", "mopgrnn"])
def test_a_network_that_drifts_or_diverges_is_not_recommended(name):
    short = {"phy": 2.0, "pgrnn": 1.4, "mopgrnn": 1.9} | {name: 1.0}
    assert recommended(short, {}) == name
    for long in (2.1, float("inf")):
        assert recommended(short, {**dict.fromkeys(short, 1.5), "phy": 2.0, name: long}) != name
    # where the prior itself diverges on long runs, what does not is better, and what does too is worse
    assert recommended(short, {**dict.fromkeys(short, float("inf")), name: 1.0}) == name
    assert recommended(short, dict.fromkeys(short, float("inf"))) == "phy"
    # and one that does not surely beat the prior where it was not trained is not recommended, whatever else it does
    others = [kind for kind in ("pgrnn", "mopgrnn") if kind != name]
    assert recommended(short, {}, sure=others) in others
    assert recommended(short, {}, sure=()) == "phy"


def test_runs_of_full_length_end_where_validation_does(machine):
    scenario = load_scenario(str(machine[0]))
    data = read_training(scenario, [machine[1]])
    (long,) = data.long
    # a minute of the 80 s that are not held back
    assert (long.t[0], long.t[-1]) == (0.0, pytest.approx(60.0))
    (short,) = read_training(scenario, [machine[2]]).long
    assert short.t[-1] == pytest.approx(data_end(machine[2], scenario))


def data_end(file, scenario):
    """Last time [s] of a file's validation part."""
    return max(piece.t[-1] for piece in read_training(scenario, [file]).valid)


def test_every_so_many_th_file_validates_as_a_whole(machine):
    scenario = load_scenario(str(machine[0]))
    scenario = replace(scenario, benchmark=replace(scenario.benchmark, valid_every=2))
    data = read_training(scenario, [machine[1], machine[2]])  # by name: test.csv, train.csv
    assert {p.file for p in data.train} == {"test"}
    assert {p.file for p in data.valid} == {"train"}
    # all of it in pieces; the last sample's input has no end
    assert sum(len(p.t) for p in data.valid) == 5 * 199
    assert (data.held_back, data.long) == ((), ())
    alone = read_training(scenario, [machine[1]])  # too few files: parts in order of time
    assert len(alone.train) == 3
    assert alone.held_back


def test_files_that_gaps_leave_nothing_of_are_named(machine, tmp_path):
    scenario = load_scenario(str(machine[0]))
    scenario = replace(scenario, benchmark=replace(scenario.benchmark, valid_every=2))
    gap = recording(tmp_path / "z_gap.csv", seed=3, seconds=3.0)
    lines = gap.read_text().splitlines()
    gap.write_text("\n".join(lines[:15] + lines[19:]) + "\n")
    with pytest.raises(InputError, match=r"(?s)validate on.*HM-WORKFLOW-047"):
        read_training(scenario, [machine[1], gap])


def test_files_with_windows_do_not_validate_as_wholes(machine):
    scenario = load_scenario(str(machine[0]))
    windows = {"train": (Window(0.0, 50.0, "train"), Window(51.0, 90.0, "test"))}
    scenario = replace(
        scenario,
        benchmark=replace(scenario.benchmark, valid_every=2),
        data=replace(scenario.data, windows=windows),
    )
    with pytest.raises(InputError, match=r"train\.csv.*HM-WORKFLOW-014"):
        read_training(scenario, [machine[1], machine[2]])


def test_what_begins_after_a_gap_is_no_run_of_full_length(machine, tmp_path):
    scenario = load_scenario(str(machine[0]))
    gap = recording(tmp_path / "gap.csv", seed=4, seconds=50.0)
    lines = gap.read_text().splitlines()
    gap.write_text("\n".join(lines[:250] + lines[260:]) + "\n")
    (long,) = read_training(scenario, [gap]).long
    assert (long.t[0], long.t[-1] < 25.0) == (0.0, True)


@pytest.mark.parametrize(
    "given", [{"valid_every": 1}, {"valid_every": -3}, {"valid_every": 2, "cycle": ("train", "valid")}]
)
def test_a_bad_choice_of_validating_files_is_refused(given):
    with pytest.raises(InputError, match="valid_every"):
        BenchmarkSpec({}, **given)


def test_figures_of_an_output_may_have_a_unit_of_their_own():
    signals = Signal("x", "m"), Signal("y", "m"), Signal("heading", "rad")
    scored = scored_signals(signals, BenchmarkSpec(units={"y": ("mm", 1e3)}))
    assert [(s.label, factor) for s, factor in scored] == [
        ("x [m]", 1.0),
        ("y [mm]", 1e3),
        ("heading [rad]", 1.0),
    ]
    with pytest.raises(
        InputError, match=r"output.*in the units of the benchmark 'yy'.*did you mean 'y'.*HM-RECORDS-011"
    ):
        scored_signals(signals, BenchmarkSpec(units={"yy": ("mm", 1e3)}))
    with pytest.raises(InputError, match=r"units\.y.*HM-RECORDS-007"):
        BenchmarkSpec(units={"y": ("mm", 0.0)})
