"""Where packages of extras are not installed, what needs them names the extra, and all else works without them."""

import json
import os
import subprocess
import sys
from pathlib import Path

import pytest
from patience import HANGS

import hybrid_mpc as hm
from hybrid_mpc.errors import EXTRAS, MissingPackage, named_extra

TRAIN = ("torch", "optuna")
REPORT = ("matplotlib", "PIL", "bokeh", "jinja2", "markupsafe")
BLOCKED = """
import contextlib, importlib.metadata, io, json, sys
blocked = set(sys.argv[1].split(","))

class Finder:
    def find_spec(self, name, path=None, target=None):
        if name.partition(".")[0] in blocked:
            raise ModuleNotFoundError(f"No module named {name!r}", name=name)

sys.meta_path.insert(0, Finder())
version = importlib.metadata.version

def without(name):
    if name in blocked:
        raise importlib.metadata.PackageNotFoundError(name)
    return version(name)

importlib.metadata.version = without
"""
NAMES = (
    BLOCKED
    + """
import hybrid_mpc, nn_export
found = {}
for package in (hybrid_mpc, nn_export):
    for name in package.__all__:
        try:
            getattr(package, name)
        except ImportError as error:
            found[f"{package.__name__}.{name}"] = [type(error).__name__, str(error)]
from hybrid_mpc.folder import versions
found["versions"] = sorted(versions())
print(json.dumps(found))
"""
)
COMMANDS = (
    BLOCKED
    + """
from hybrid_mpc.cli.main import main
found = []
for words in json.loads(sys.argv[2]):
    sys.argv = ["hybrid-mpc", *words]
    out, code = io.StringIO(), 0
    with contextlib.redirect_stdout(out), contextlib.redirect_stderr(out):
        try:
            main()
        except SystemExit as stop:
            code = stop.code or 0
    found.append([code, out.getvalue()])
print(json.dumps(found))
"""
)


def python(source, *words):
    """What a script that blocks packages prints last."""
    root = str(Path(hm.__file__).parents[1])
    done = subprocess.run(
        [sys.executable, "-c", source, *words], capture_output=True, text=True, timeout=HANGS,
        env={**os.environ, "PYTHONPATH": root},
    )  # fmt: skip
    assert done.returncode == 0, done.stderr
    return json.loads(done.stdout.splitlines()[-1])


@pytest.mark.parametrize(
    ("packages", "lacking", "extra"),
    [
        (TRAIN, {"hybrid_mpc.train", "hybrid_mpc.TorchPrior", "hybrid_mpc.tune", "nn_export.trace"}, "train"),
        (("control",), set(), "analysis"),
        (REPORT, {"hybrid_mpc.plots", "hybrid_mpc.run", "hybrid_mpc.StudyResults"}, "report"),
        (("dask", "distributed", "pyarrow", "yaml", "filelock"), set(), "studies"),
    ],
)
def test_public_names_are_there_or_name_the_extra(packages, lacking, extra):
    found = python(NAMES, ",".join(packages))
    assert not set(packages) & set(found.pop("versions"))
    assert lacking <= set(found)
    assert not set(found) & {
        f"hybrid_mpc.{name}" for name in ("load", "Loop", "simulate", "Bench", "check_scenario")
    }
    for name, (kind, text) in found.items():
        assert f"hybrid-mpc[{extra}]" in text, name
        assert kind == "MissingPackage" or name.startswith("nn_export."), name
    if not lacking:
        assert not found


@pytest.mark.parametrize(
    ("packages", "needing", "extra"),
    [
        (TRAIN, ("torch", "run", "tune", "benchmark"), "train"),
        (("control",), (), "analysis"),
        (
            ("matplotlib", "PIL", "bokeh", "jinja2", "markupsafe"),
            ("run", "control", "analyze"),
            "report",
        ),
        (("dask", "distributed", "pyarrow", "yaml"), ("study",), "studies"),
    ],
)
def test_commands_work_or_name_the_extra(packages, needing, extra, noisy_artifact, tmp_path):
    study = tmp_path / "s.yaml"
    study.write_text(
        f"scenario: golf_robot\nmodels: {noisy_artifact}\ntasks: [track_sine]\ncontrollers: [prior]\nseeds: 1\n"
    )
    out = str(tmp_path / "out")
    loop = ["--task", "track_sine", "--controller", "prior", "--seeds", "1"]
    recording = tmp_path / "day.csv"
    recording.write_text("t,u\n")
    words = {
        "check": ["check", "two_tanks"],
        "scenarios": ["scenarios"],
        "doctor": ["doctor"],
        "control": [
            "control",
            "golf_robot",
            "--model",
            str(noisy_artifact),
            *loop,
            "--out",
            f"{out}/control",
        ],
        "study": ["study", "run", str(study), "--workers", "1", "--out", f"{out}/study"],
    }
    more = {
        "torch": ["check", "pendulum"],  # whose prior is written in torch
        "run": ["run", "pendulum", "--out", f"{out}/run", "--budget", "quick"],
        "tune": ["tune", "pendulum", "--out", f"{out}/tune"],
        "benchmark": ["benchmark", "unbalanced_disk", "--data", str(recording), "--out", f"{out}/benchmark"],
        "analyze": ["analyze", str(noisy_artifact), "--scenario", "golf_robot", "--out", f"{out}/analyze"],
    }
    words |= {name: more[name] for name in needing if name in more}
    if extra == "report":
        del words["study"]  # which writes one, too
    found = dict(
        zip(words, python(COMMANDS, ",".join(packages), json.dumps(list(words.values()))), strict=True)
    )
    for name, (code, told) in found.items():
        if name in needing:
            assert code == 2, (name, told)
            assert f"hybrid-mpc[{extra}]" in told.replace("\n", ""), (name, told)
            assert "Traceback" not in told
        else:
            assert code == 0, (name, told)


def test_every_package_that_an_extra_brings_is_known():
    """By what the package itself says that it needs."""
    from importlib.metadata import requires

    modules = {
        "pillow": "PIL", "pyyaml": "yaml", "mcap-ros1-support": "mcap_ros1", "mcap-ros2-support": "mcap_ros2",
        "python-can": "can",
    }  # fmt: skip
    for line in requires("hybrid-mpc") or []:
        name, _, marker = line.partition(";")
        extra = next((e for e in set(EXTRAS.values()) if f'extra == "{e}"' in marker.replace("'", '"')), "")
        package = name.strip().split("[")[0].split(">")[0].split("=")[0].strip().lower()
        if extra and package != "hybrid-mpc":
            assert modules.get(package, package) in EXTRAS, line


def test_a_missing_package_is_both_an_input_error_and_an_import_error():
    said = r"a table.*pandas.*tables.*HM-ERRORS-001"
    with pytest.raises(MissingPackage, match=said) as caught, named_extra("a table"):
        raise ModuleNotFoundError("No module named 'pandas.io'", name="pandas.io")
    assert isinstance(caught.value, hm.InputError)
    assert isinstance(caught.value, ImportError)
    with (
        pytest.raises(ModuleNotFoundError, match="mine"),
        named_extra(),
    ):  # what no extra brings is the user's own
        raise ModuleNotFoundError("No module named 'mine'", name="mine")
