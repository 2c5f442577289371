"""Names, units, texts and sizes: one rule each, and every record that a user writes keeps them, field by field."""

import collections.abc
import csv
import dataclasses
import math
import typing

import casadi as ca
import numpy as np
import pytest

import hybrid_mpc as hm
from hybrid_mpc import OCP, DataSpec, HardBound, InputError, Parameter, Scenario, Signal, SoftBound, Task
from hybrid_mpc.compare.study import FaultKind, Study
from hybrid_mpc.identify.settings import TrainingSettings
from hybrid_mpc.kit.parts import BalanceInfo, LoopSettings, ModelInfo
from hybrid_mpc.loop.faults import Fault
from hybrid_mpc.machine.prior import Balance, OperatingPoint
from hybrid_mpc.machine.specification import BenchmarkBudget, BenchmarkSpec, Window
from hybrid_mpc.model.disturbance import Disturbance
from hybrid_mpc.report.page import Table
from hybrid_mpc.rules import csv_cell, line_problem, markdown, name_problem, printable, unit_problem
from hybrid_mpc.scenario import Budget, registered_scenarios

GOOD_NAMES = (
    "phi",
    "phi_dot",
    "x[0]",
    "T 2",
    "a.b",
    "a-b",
    "1st",
    "_x",
    "φ",
    "Länge",
    "温度",
    "θ_1",
    "T2²",
    "x" * 100,
)
BAD_NAMES = (
    "", " ", " a", "a ", ".a", "a.", "..", "../../x", "a/b", "a\\b", "-rf", "[0]", "a*/", "/*a", "a//b", "a\nb", "a\n",
    "a\0", "a\tb", "a\rb", "a\x1b[2J", "a??/", "a?", "a%n", "a$b", "a`b", "a;b", "a|b", "a&b", "a<b", "a>b",
    'a"b', "a'b", "a{b}", "a(b)", "a=b", "a#b", "a@b", "a:b", "a,b", "a!b", "a~b",
    "a\u202eb", "a\u2028b", "a\u200bb", "a\ud800", "x" * 101,
    "温" * 40,
)  # fmt: skip
GOOD_UNITS = (
    "-", "m", "N m", "rad/s", "1/min", "m/s^2", "kg*m^2", "W/(m^2*K)", "degC", "°C", "%", "‰", "Ω", "µm", "m²", "N·m",
    "V/√Hz",     "m^-1", "s⁻¹", "m^0.5",
)  # fmt: skip
BAD_UNITS = (
    "", " ", " m", "m ", "m*/", "m /* x", "m//s", "m\n", "m\\", "m?", "m??/", '"', "'", "<b>", "m;", "m#", "m@", "{m}",
    "$m$", "`m`", "m&", "m|", "m\0", "m\u202e", "m" * 51,
)  # fmt: skip


def test_what_a_name_is():
    assert [n for n in GOOD_NAMES if name_problem(n)] == []
    assert [n for n in BAD_NAMES if not name_problem(n)] == []


def test_what_a_unit_is():
    assert [u for u in GOOD_UNITS if unit_problem(u)] == []
    assert [u for u in BAD_UNITS if not unit_problem(u)] == []


def test_a_line_has_no_character_that_moves_a_cursor():
    assert not line_problem('Pump "A" <b>, 50 % & $x$ é 🙂')
    assert all(line_problem(f"a{c}b") for c in "\n\r\0\x1b\x85\u2028\u202e\ud800")


def test_every_escaping_function_leaves_nothing_of_its_language():
    for text in BAD_NAMES:
        assert not set("<>*_`|[]#\\\n&") & set(markdown(text.replace("_", "")).replace("&#", ""))
        shown = printable(text)
        assert not set("\0\x1b\r\u202e\ud800") & set(shown)
    assert csv_cell("=1+1") == "'=1+1"
    assert [csv_cell(t) for t in ("-", "-1.5", "+2e3", "m/s")] == ["-", "-1.5", "+2e3", "m/s"]
    assert Table(("a",), (("@SUM(A1)",), (-1.5,))).csv() == "a\n'@SUM(A1)\n-1.5\n"


X, U = ca.SX.sym("x", 2), ca.SX.sym("u")
PLANE = ca.Function("plane", [X, U], [X[0] + U])
SPEC = DataSpec("t", ("u",), ("y",), 0.1, 0.3, 1.0, 1.0)
CONTROL = OCP(10, (1.0, 0.1), (1.0,), (1.0,), (-1.0,), (1.0,))
Y = Signal("y", "m")
RECORDS = (
    Signal("y", "m", 0.0, 1.0),
    Parameter("k", 1.0, "N", 0.0, 2.0, "stiffness"),
    Window(0.0, 1.0, "train"),
    SPEC,
    BenchmarkBudget(4, 1, 5, 5, 10),
    BenchmarkSpec({}, units={"y": ("mm", 1e3)}, length=1.0),
    Task("hold", "Hold", 1.0, (0.0, 0.0), lambda t: np.zeros((len(t), 2))),
    Budget(4, 1, 5, 5, seeds=1),
    Scenario("mine", "Mine", "text", lambda values=None: None, SPEC, control=CONTROL, sensor_sigma=(1e-3,)),
    Fault(0.0, 1.0, "input_gain", 0.5, "u", 0.1),
    Balance("energy", 1.0, 1.0),
    OperatingPoint((0.0,), (0.0,)),
    Disturbance("input", "u", 1.0),
    TrainingSettings("pgrnn", 4, 1, 5, 5, 0, 10),
    FaultKind("input_gain", 0.5, 0.9),
    BalanceInfo("energy", "J", "W"),
    ModelInfo(0.1, (Y,), (Y,), (Y,)),
    LoopSettings(),
    CONTROL,
    SoftBound(PLANE, [-1.0], [1.0], [1.0], [1.0]),
    HardBound("x", [-1.0, -1.0], [1.0, 1.0]),
)  # fmt: skip
"""One of each record that a user writes, or a folder holds."""
STRANGE = (
    None,
    True,
    "abc",
    "",
    math.nan,
    1e300,
    -1e300,
    1j,
    object(),
    [True],
    [None],
    ["a"],
    [math.nan],
    {"a": None},
    b"x",
)


def kinds_of(hint):
    """All types that an annotation names, however deep."""
    if hint is typing.Any or not typing.get_args(hint):
        return {hint}
    if typing.get_origin(hint) is typing.Literal:
        return {str}
    if typing.get_origin(hint) is collections.abc.Callable:
        return {collections.abc.Callable}
    return {kind for arm in typing.get_args(hint) for kind in kinds_of(arm)}


def leaves(value):
    """What a value holds, however deep."""
    if isinstance(value, dict):
        return [leaf for v in value.values() for leaf in leaves(v)]
    if isinstance(value, tuple | list | np.ndarray):
        return [leaf for v in np.ravel(value).tolist() for leaf in leaves(v)] if len(value) else []
    return [value]


@pytest.mark.parametrize("record", RECORDS, ids=lambda r: type(r).__name__)
def test_no_field_takes_what_it_is_not(record):
    """Every strange value in every field: refused as InputError, or of a kind that the annotation names."""
    unseen = dict.fromkeys(
        ("Prior", "Plant", "HybridModel", "Figure", "ClosedLoopResult", "OCP", "Term"), typing.Any
    )
    hints = typing.get_type_hints(type(record), localns=unseen, include_extras=True)
    for f in dataclasses.fields(record):
        kinds = kinds_of(hints[f.name])
        if f.name == "covariance" or typing.Any in kinds:  # of what cannot be told apart it has no bound
            continue
        for value in STRANGE:
            try:
                made = dataclasses.replace(record, **{f.name: value})
            except InputError:
                continue
            for leaf in leaves(getattr(made, f.name)):
                fits = (
                    abs(leaf) <= 1e30 or math.isinf(leaf)
                    if isinstance(leaf, float)
                    else isinstance(leaf, tuple(k for k in kinds if isinstance(k, type)))
                )
                assert fits, (f.name, value, leaf)
                assert not isinstance(leaf, bool) or bool in kinds, (f.name, value, leaf)


def test_all_errors_of_a_record_are_told_together():
    with pytest.raises(InputError) as told:
        Signal("", None, True, math.nan, 1, (2, 1))
    for field in ("name", "unit", "lower", "upper", "periodic", "saturation"):
        assert any(f": {field}" in p for p in told.value.problems), field
    with pytest.raises(InputError) as told:
        dataclasses.replace(
            SPEC, dt=True, max_gap=math.inf, inputs=("", "a"), outputs=("a", "a"), fractions=(1, 1, 1)
        )
    assert len(told.value.problems) == 5
    with pytest.raises(InputError) as told:
        OCP(
            True,
            (1.0, math.nan),
            (1.0,),
            (1e300,),
            (1.0,),
            (-1.0,),
            blocks=5,
            soft=None,
            economic="x",
            preview=1,
        )
    assert len(told.value.problems) == 7  # of blocks only a horizon could tell
    with pytest.raises(InputError) as told:
        Scenario(
            "../../x", "a\nb", None, None, SPEC, sensor_sigma=(1e300, True), tasks=(RECORDS[6], RECORDS[6])
        )
    assert len(told.value.problems) == 7


def test_a_control_problem_is_one():
    for record in (RECORDS[6], RECORDS[8]):
        for wrong in ("x", {"horizon": 10}, True):
            with pytest.raises(InputError):
                dataclasses.replace(record, control=wrong)


def test_records_are_what_their_annotations_say():
    assert Signal("y", "m", 0, 1).upper == 1.0
    assert isinstance(Signal("y", "m", 0, 1).upper, float)
    assert dataclasses.replace(SPEC, inputs=["a", "b"]).inputs == ("a", "b")
    assert dataclasses.replace(RECORDS[8], sensor_sigma=np.array([1e-3])).sensor_sigma == (1e-3,)


def test_shipped_machines_keep_the_rules():
    assert {name: hm.load_scenario(name).name for name in registered_scenarios()}


def test_a_study_takes_no_path_for_a_label_and_no_flag_for_a_number():
    for wrong in ({"models": {"../x": "m"}}, {"duration": True}, {"name": "a\nb"}, {"models": {"a*/": "m"}}):
        with pytest.raises(InputError):
            Study(**{"scenario": "golf_robot", "models": "m", **wrong})


def test_no_scenario_of_a_bad_name_passes_the_check(call, tmp_path):
    machine = tmp_path / "machine.py"
    for change in ("name='../../x'", "sensor_sigma=(1e300,)", "data=replace(GOOD.data, dt=True)"):
        machine.write_text(
            "from dataclasses import replace\nfrom tests.check.test_preflight import GOOD\n"
            f"scenario = replace(GOOD, {change})\n"
        )
        assert call("check", machine)[0] == 2


def test_values_of_a_prior_are_numbers():
    prior = hm.load_scenario("pendulum").prior
    name = next(iter(prior().values))
    for wrong in ({name: None}, {name: True}, {name: "1"}, "abc", [1.0]):
        with pytest.raises(InputError):
            prior(wrong)


def test_no_name_of_a_signal_is_a_formula_of_a_spreadsheet(tmp_path):
    """Header cells that the library writes begin with such names; they are read back as they are."""
    names = [name for c in map(chr, range(0x3000)) if not name_problem(name := f"{c}1+")] + [
        name for c in map(chr, range(0x3000)) if not name_problem(name := f"{c}1")
    ]
    assert len(names) > 1000
    assert [name for name in names if csv_cell(name) != name] == []
    columns = {name: np.arange(2.0) for name in ("t", *GOOD_NAMES)}
    first = hm.write_csv(tmp_path / "a.csv", columns).read_text().splitlines()[0]
    assert next(csv.reader([first])) == list(columns)
