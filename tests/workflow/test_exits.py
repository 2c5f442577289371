"""Code of a user that ends Python is an error with its place, wherever it runs; it never ends a job without a word."""

import os
import subprocess
import sys
from dataclasses import replace

import pytest

import hybrid_mpc as hm
from hybrid_mpc.engine import run_jobs
from hybrid_mpc.errors import no_exit
from hybrid_mpc.workflow.context import Context
from hybrid_mpc.workflow.stage import Absent, Stage, bring_up_to_date

MACHINE = """
import sys
import hybrid_mpc as hm
{top}
class Tank(hm.Prior):
    states = (hm.Signal("level", "m", 0.0, 1.0),)
    inputs = (hm.Signal("pump", "m/s", 0.0, 0.1),)
    outputs = states
    parameters = (hm.Parameter("k", 0.1, "1/s", 0.01, 1.0),)
    operating_point = hm.OperatingPoint(x=(0.2,), u=(0.02,), w=())

    def __init__(self, values=None):
        {made}
        super().__init__(values)

    def xdot(self, x, u, w, p):
        {asked}
        return (u.pump - p.k * x.level,)

scenario = hm.Scenario(name="exits", title="", description="", prior=Tank,
                       data=hm.DataSpec(time="t", inputs=("pump",), outputs=("level",), dt=0.1,
                                        max_gap=0.5, smoothing=3, warm_up=1.0))
"""
NOTHING = {"top": "pass", "made": "pass", "asked": "pass"}


def machine(tmp_path, **lines):
    path = tmp_path / "exits.py"
    path.write_text(MACHINE.format(**NOTHING | lines))
    return path


@pytest.mark.parametrize(
    "code", ["sys.exit(0)", "sys.exit()", "raise SystemExit", "exit()", "raise SystemExit('bye')"]
)
@pytest.mark.parametrize("where", ["top", "made", "asked"])
def test_check_and_run_refuse_it_and_name_the_file(call, tmp_path, where, code):
    path = machine(tmp_path, **{where: code})
    line = 1 + path.read_text().splitlines().index(code if where == "top" else f"        {code}")
    recording = tmp_path / "day.csv"
    recording.write_text("t,pump,level\n" + "".join(f"{0.1 * k:.1f},0.02,0.2\n" for k in range(50)))
    for words in (("check", path), ("run", path, "--data", recording, "--out", tmp_path / "out")):
        status, told, error = call(*words)
        assert status in (1, 2), (told, error)  # the pre-flight ends with 1
        assert f"{path}:{line}" in (told + error).replace("\n", "")
    assert not (tmp_path / "out" / "results.json").exists()


@pytest.mark.parametrize("where", ["top", "made", "asked"])
def test_the_library_raises_it_too(tmp_path, where):
    path = machine(tmp_path, **{where: "sys.exit(0)"})
    with pytest.raises(hm.InputError, match=r"exits\.py:.*HM-ERRORS-002"):
        hm.check_scenario(hm.load_scenario(str(path)))
    if where == "asked":
        prior = hm.load_scenario(str(path)).prior()
        with pytest.raises(hm.InputError, match=r"exits\.py:.*HM-ERRORS-002"):
            _ = prior.equations


def ends(report):
    sys.exit(0)


def test_a_worker_process_hands_it_on():
    with pytest.raises(hm.InputError, match=r"test_exits\.py:.*HM-ERRORS-002"):
        run_jobs({"a": (ends, ())}, lambda *report: None, workers=1)


def test_an_optional_stage_could_not_run(tmp_path):
    context = Context(hm.RunSettings("pendulum"), hm.load_scenario("pendulum"), tmp_path)
    stage = Stage("ends", "ending", Absent, lambda context: sys.exit(0), lambda context: {}, optional=True)
    assert "test_exits.py:" in bring_up_to_date(context, stage)
    assert context.find(stage).failed
    with pytest.raises(SystemExit):  # of one that others need it ends the run, which says so
        bring_up_to_date(context, replace(stage, name="needed", optional=False))


def test_other_ends_pass():
    with pytest.raises(KeyboardInterrupt), no_exit():
        raise KeyboardInterrupt
    with pytest.raises(ZeroDivisionError), no_exit("x"):
        _ = 1 / 0


@pytest.mark.parametrize(
    "code",
    [
        "raise BaseException('b')",
        "raise GeneratorExit",
        "raise hm.Mute",
        r"raise ValueError('\x1b[2J\u202e\udcff')",
    ],
)
@pytest.mark.parametrize("where", ["top", "asked"])
def test_whatever_is_raised_is_told_and_moves_no_cursor(call, tmp_path, where, code):
    code = code.replace("hm.Mute", "type('Mute', (Exception,), {'__str__': lambda self: 1 / 0})")
    status, told, error = call("check", machine(tmp_path, **{where: code}))
    assert status == 2
    said = told + error
    assert "exits.py" in said
    assert "Traceback" not in said
    assert not {"\x1b", "\u202e", "\udcff"} & set(said)


def test_a_terminal_without_a_character_gets_its_number(tmp_path):
    path = machine(tmp_path)
    path.write_text(path.read_text().replace('title=""', 'title="Behälter ≤ 3"'))
    environment = {**os.environ, "PYTHONIOENCODING": "ascii"}
    ended = subprocess.run(
        [sys.executable, "-m", "hybrid_mpc", "check", path], env=environment, capture_output=True, text=True
    )
    assert ended.returncode == 0, ended.stderr
    assert r"Beh\xe4lter \u2264 3" in ended.stdout


@pytest.mark.parametrize(
    ("old", "new"),
    [
        ("prior=Tank", "prior=lambda: Tank()"),  # takes no values
        ("# none", "# \udce4"),  # a comment of another encoding
        ("# none", "# coding: nonsense"),
    ],
)
def test_files_that_python_takes_half_are_told(call, tmp_path, old, new):
    path = machine(tmp_path)
    text = "# none\n" + path.read_text().replace(
        "data=hm.DataSpec",
        "control=hm.OCP(9, [1], [0.1], [0.1], [0], [0.1]), sensor_sigma=(1e-3,), data=hm.DataSpec",
    )
    path.write_bytes(text.replace(old, new, 1).encode("utf-8", "surrogateescape"))
    status, told, error = call("check", path)
    assert status == 2
    assert "exits" in told + error
