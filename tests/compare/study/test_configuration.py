"""What a study expands to, and what it refuses."""

import pickle
from dataclasses import replace

import numpy as np
import pytest

from hybrid_mpc import Fault, FaultKind, InputError, LoopSpec, RandomFaults, Study, varied
from hybrid_mpc.compare.controllers import CONTROLLERS
from hybrid_mpc.compare.study import built_in_studies, built_in_study, generator, read_study
from scenarios.golf_robot.rig import Rig
from scenarios.pendulum.plant import DampedPendulum

FAULTS = RandomFaults(
    [FaultKind("input_gain", 0.7, 0.9), FaultKind("late", length=(0.1, 0.2))], at_once=(1, 2)
)


def make(**fields):
    return Study("golf_robot", {"a": "runs/a", "b": "runs/b"}, **fields)


def test_runs_are_the_product_of_all_axes():
    study = make(
        tasks=["track", "stroke_4"], controllers=["prior", "hybrid"], solvers=["rti", "sqp"], horizons=[None, 20],
        monitors=["own", "none"], faults=["none", "input_gain=0.8@1"], vary={"m": 0.2}, draws=3, seeds=[4, 7],
    )  # fmt: skip
    runs = list(study.runs())
    assert len(runs) == study.size == 2 * 3 * 2 * 2 * 2 * 2 * 2 * 3 * 2
    assert len({run.id for run in runs}) == len(set(runs)) == len(runs)
    assert {run.task for run in runs} == {"track_sine", "track_step", "stroke_4"}
    assert {run.seed for run in runs} == {4, 7}
    assert {run.faults for run in runs} == {(), (Fault(1.0, np.inf, "input_gain", 0.8),)}


def test_a_study_is_a_value():
    one, other = (make(seeds=3, controllers=kind(["prior"]), vary={"m": 0.2}) for kind in (list, tuple))
    assert one == other
    assert hash(one) == hash(other)
    assert one != make(seeds=4, controllers=["prior"], vary={"m": 0.2})
    with pytest.raises(AttributeError):
        one.seed = 3
    assert pickle.loads(pickle.dumps(one)) == one  # workers get it so


def test_ids_come_from_the_configuration_alone():
    run = LoopSpec("golf_robot", "a", "track_sine", "prior", faults=(Fault(1.0, np.inf, "input_gain", 0.8),))
    # written down once: a change of this form would make every kept study look like another
    assert run.id == "c9adb22cffde4776d2ee"
    changes = {"model": "b", "solver": "sqp", "horizon": 9, "monitor": "none", "late": ((1.0, 2.0),), "seed": 1,
               "draw": 1, "parameters": (("m", 1.1),), "duration": 1.0, "faults": ()}  # fmt: skip
    assert len({replace(run, **{k: v}).id for k, v in changes.items()} | {run.id}) == len(changes) + 1


def test_draws_are_common_to_all_controllers_and_do_not_hang_on_each_other():
    study = make(
        controllers=["prior", "hybrid"], vary={"m": 0.2, "J": 0.1}, random_faults=FAULTS, draws=40, seeds=1
    )
    runs = [run for run in study.runs() if run.model == "a" and run.task == "track_sine"]
    prior, hybrid = ([r for r in runs if r.controller == name] for name in ("prior", "hybrid"))
    for a, b in zip(prior, hybrid, strict=True):
        assert (a.parameters, a.drawn_faults, a.late, a.noise_seed) == (
            b.parameters, b.drawn_faults, b.late, b.noise_seed,
        )  # fmt: skip
    spans = np.array([[f for _, f in r.parameters] for r in prior])
    assert np.all(np.abs(spans[:, 0] - 1) <= 0.2)
    assert np.all(np.abs(spans[:, 1] - 1) <= 0.1)
    # 40 uniform draws: chance that they all stay within 80 % of the range is 0.8^40, 1 in 7,000
    assert np.abs(spans[:, 0] - 1).max() > 0.16
    alone = next(make(vary={"J": 0.1}, draws=1, seeds=1).runs())
    assert dict(alone.parameters)["J"] == spans[0, 1]  # the same without m beside it
    assert len({r.noise_seed for r in prior}) == 40
    assert prior[0].noise_seed == prior[0].seed  # the first draw is what control runs


def test_random_faults_stay_in_their_ranges():
    kinds = [
        {"target": "plant_push", "low": 0.5, "high": 1.0, "signed": True, "length": [0.1, 0.3]},
        {"target": "input_gain", "low": 0.7, "high": 0.9, "ramp": 2.0},
        {"target": "late"},
    ]
    some = RandomFaults(kinds, at_once=(1, 3), start=(1.0, 2.0), length=(0.2, 0.5), lasting=0.5)
    drawn = [some.drawn(generator(0, i, "faults")) for i in range(200)]
    counts = {len(faults) + len(late) for faults, late in drawn}
    assert counts == {1, 2, 3}
    pushes = [f for faults, _ in drawn for f in faults if f.target == "plant_push"]
    assert {np.sign(f.value) for f in pushes} == {-1.0, 1.0}
    assert all(0.5 <= abs(f.value) <= 1.0 and 0.1 <= f.end - f.start <= 0.3 + 1e-12 for f in pushes)
    gains = [f for faults, _ in drawn for f in faults if f.target == "input_gain"]
    assert all(f.ramp == 2.0 and 1.0 <= f.start <= 2.0 for f in gains)
    # each of about 130 lasts with chance a half: outside 30 to 70 % is beyond 4 standard deviations
    assert 0.3 < np.mean([np.isinf(f.end) for f in gains]) < 0.7
    assert any(late for _, late in drawn)


def test_plants_are_varied():
    rig = varied(Rig(), [("m", 1.1), ("mu_c", 0.9)])
    assert rig.parameters.m == Rig().parameters.m * 1.1
    assert rig.parameters.J == Rig().parameters.J
    pendulum = DampedPendulum()
    name = next(iter(pendulum.parameters.__dataclass_fields__))
    other = varied(pendulum, [(name, 1.2)])
    assert getattr(other.parameters, name) == 1.2 * getattr(pendulum.parameters, name)
    with pytest.raises(
        InputError, match=r"parameter.*of RigParameters 'mu_k'.*did you mean 'mu_.*HM-RECORDS-011"
    ):
        varied(Rig(), [("mu_k", 1.1)])
    with pytest.raises(InputError, match="HM-COMPARE-011"):
        varied(object(), [("m", 1.1)])


@pytest.mark.parametrize(
    ("fields", "told"),
    [
        ({"controllers": ["hybird"]}, r"did you mean 'hybrid'.*HM-RECORDS-011"),
        ({"solvers": ["ipop"]}, r"did you mean 'ipopt'.*HM-RECORDS-011"),
        ({"monitors": ["energie"]}, r"did you mean 'energy'.*HM-RECORDS-011"),
        ({"faults": ["input_gian=0.8"]}, "input_gain"),
        ({"faults": ["input_gain=much"]}, "TARGET:CHANNEL=VALUE@START:END"),
        ({"faults": [3]}, "texts"),
        ({"controllers": []}, r"controllers.*HM-COMPARE-026"),
        ({"controllers": ["prior", "prior"]}, "HM-COMPARE-027"),
        ({"controllers": "prior"}, r"'prior'.*HM-COMPARE-038"),
        ({"seeds": 0}, "HM-COMPARE-037"),
        ({"seeds": [-1]}, r"seeds.*HM-COMPARE-028"),
        ({"seeds": [1.5]}, r"whole number.*HM-RECORDS-006"),
        ({"draws": 0}, r"draws.*HM-COMPARE-028"),
        ({"draws": 5}, "HM-COMPARE-032"),
        ({"horizons": [0]}, r"horizons.*HM-COMPARE-028"),
        ({"vary": {"m": 1.5}}, "HM-COMPARE-029"),
        ({"vary": {"m": "much"}}, r"a number.*HM-RECORDS-006"),
        ({"vary": 3}, "mappings"),
        ({"duration": -1.0}, "positive"),
        ({"controllers": ["oracle"], "solvers": ["rti", "sqp"]}, "HM-COMPARE-030"),
        ({"controllers": ["oracle"], "vary": {"m": 0.2}}, "HM-COMPARE-031"),
        ({"controllers": ["prior"], "monitors": ["energy"]}, "HM-COMPARE-035"),
        ({"random_faults": {"kinds": [], "at_once": [1, 1]}}, "HM-COMPARE-022"),
        ({"random_faults": {"kind": []}}, r"did you mean 'kinds'.*HM-RECORDS-011"),
        (
            {"random_faults": {"kinds": [{"target": "input_gian"}]}},
            r"did you mean 'input_gain'.*HM-RECORDS-011",
        ),
        (
            {"random_faults": {"kinds": [{"target": "late"}], "at_once": [1, 1], "start": [2, 1]}},
            "HM-COMPARE-025",
        ),
        ({"random_faults": {"kinds": [{"target": "late"}], "at_once": [1, 1], "lasting": 2}}, "share"),
    ],
)
def test_impossible_studies(fields, told):
    with pytest.raises(InputError, match=told):
        make(**fields)


def test_unknown_scenarios_and_tasks():
    with pytest.raises(InputError, match=r"'golf'.*HM-SCENARIO-005"):
        _ = Study("golf", "m").size
    with pytest.raises(InputError, match=r"'putt'.*HM-COMPARE-058"):
        list(make(tasks=["putt"]).runs())
    with pytest.raises(InputError, match=r"a name.*HM-COMPARE-060"):
        Study("golf_robot", {"../a": "m"})


def test_yaml_is_the_same_study(tmp_path):
    path = tmp_path / "mine.yaml"
    path.write_text(
        "scenario: golf_robot\nmodels: {a: runs/a}\ntasks: [track]\nhorizons: [null, 20]\nseeds: [1, 2]\n"
        "faults: [none, plant_friction=2@1.5, [input_gain=0.8@1, plant_mass=1.2]]\nvary: {m: 0.2}\ndraws: 2\n"
        "random_faults:\n  at_once: [1, 1]\n  kinds:\n    - {target: input_gain, low: 0.7, high: 0.9}\n"
    )
    python = Study(
        "golf_robot", {"a": tmp_path / "runs/a"}, tasks=["track"], horizons=[None, 20], seeds=[1, 2],
        faults=["none", "plant_friction=2@1.5", "input_gain=0.8@1 + plant_mass=1.2"], vary={"m": 0.2}, draws=2,
        random_faults=RandomFaults([FaultKind("input_gain", 0.7, 0.9)], at_once=(1, 1)), name="mine",
    )  # fmt: skip
    assert read_study(path) == python
    assert [run.id for run in read_study(path).runs()] == [run.id for run in python.runs()]


@pytest.mark.parametrize(
    ("text", "told"),
    [
        (
            "scenario: golf_robot\nmodels: m\ncontrolers: [prior]\n",
            r"did you mean 'controllers'.*HM-RECORDS-011",
        ),
        ("scenario: golf_robot\nmodels: m\nseeds: [1\n", "HM-COMPARE-041"),
        ("- golf_robot\n", "HM-COMPARE-042"),
        ("scenario: golf_robot\n", "HM-COMPARE-040"),
        ("models: m\n", r"scenario.*HM-RECORDS-003"),
        ("scenario: golf_robot\nmodels: m\nseeds: !!python/object/apply:os.getcwd []\n", "HM-COMPARE-041"),
    ],
)
def test_bad_files(tmp_path, text, told):
    path = tmp_path / "mine.yaml"
    path.write_text(text)
    with pytest.raises(InputError, match=told):
        read_study(path)
    with pytest.raises(InputError, match="HM-FILES-010"):
        read_study(tmp_path / "none.yaml")


@pytest.mark.parametrize("name", built_in_studies())
def test_built_in_studies_expand(name):
    study = built_in_study(name, {"z16": "runs/a", "z32": "runs/b"})
    runs = list(study.runs())
    assert len(runs) == study.size
    assert study.name == name
    assert {run.controller for run in runs} <= set(CONTROLLERS)
    if name == "faults_1000":
        assert built_in_study(name, "runs/a").size == 1000
        assert all(run.drawn_faults or run.late for run in runs)
    with pytest.raises(InputError, match=r"did you mean 'faults_1000'.*HM-RECORDS-011"):
        built_in_study("fault_1000", "runs/a")
