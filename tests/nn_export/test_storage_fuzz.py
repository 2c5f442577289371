"""Files that are damaged, truncated, foreign, too large or too costly: the named error, or the identical program."""

import contextlib
import json
import os
import random
import subprocess
import sys
import tempfile
from functools import cache
from pathlib import Path

import numpy as np
import pytest
import torch
from foreign_files import crafted, mutated, places, signed, write
from hypothesis import given, settings
from hypothesis import strategies as st
from torch import nn

from nn_export import ExportError, Limits, Program, ProgramError, build, save_programs, trace
from nn_export.program import to_json

FILES = ("programs.json", "weights.safetensors")


class Model(nn.Module):
    """Operators with lists, numbers, infinities and several results."""

    def __init__(self):
        super().__init__()
        torch.manual_seed(0)
        self.gru, self.head = nn.GRU(2, 3), nn.Linear(3, 2)

    def forward(self, x):
        y, _ = self.gru(x.reshape(3, 2))
        return torch.cat([self.head(y[-1]).clamp(min=-1.5, max=float("inf")), x[::2] * 0.1])


@cache
def saved():
    program = trace(Model(), (torch.zeros(6),))
    with tempfile.TemporaryDirectory() as folder:
        program.save(folder)
        return program, {name: (Path(folder) / name).read_bytes() for name in FILES}


def load(files):
    with tempfile.TemporaryDirectory() as folder:
        for name, data in files.items():
            (Path(folder) / name).write_bytes(data)
        return Program.load(folder)


def identical(a, b):
    same = to_json(a) == to_json(b) and set(a.weights) == set(b.weights)
    return same and all(np.array_equal(a.weights[k], b.weights[k]) for k in a.weights)


def error_or_identical(files):
    try:
        loaded = load(files)
    except ProgramError:
        return
    assert identical(loaded, saved()[0])


def test_the_files_as_they_are_give_the_identical_program():
    assert identical(load(saved()[1]), saved()[0])


@settings(max_examples=40, deadline=None, derandomize=True)
@given(
    name=st.sampled_from(FILES),
    flips=st.lists(st.tuples(st.floats(0, 1, exclude_max=True), st.integers(1, 255)), min_size=1, max_size=4),
)
def test_flipped_bytes(name, flips):
    files = dict(saved()[1])
    data = bytearray(files[name])
    for where, mask in flips:
        data[int(where * len(data))] ^= mask
    error_or_identical({**files, name: bytes(data)})


@settings(max_examples=20, deadline=None, derandomize=True)
@given(name=st.sampled_from(FILES), a=st.floats(0, 1), b=st.floats(0, 1), insert=st.binary(max_size=40))
def test_cut_and_inserted_bytes(name, a, b, insert):
    files = dict(saved()[1])
    data = files[name]
    first, second = sorted((int(a * len(data)), int(b * len(data))))
    error_or_identical({**files, name: data[:first] + insert + data[second:]})
    error_or_identical({**files, name: data[:first]})


VALUES = st.recursive(
    st.none() | st.booleans() | st.integers(-3, 40) | st.floats(-2, 2) | st.text(max_size=4),
    lambda inner: (
        st.lists(inner, max_size=3)
        | st.dictionaries(st.sampled_from(["node", "input", "weight", "float", "x"]), inner, max_size=2)
    ),
    max_leaves=5,
)


@pytest.mark.full
@settings(max_examples=150, deadline=None, derandomize=True)
@given(where=st.floats(0, 1, exclude_max=True), value=VALUES)
def test_foreign_content_is_refused_by_name_or_builds(where, value):
    files = saved()[1]
    document = json.loads(files["programs.json"])
    found = places(document)
    holder, key = found[int(where * len(found))]
    holder[key] = value
    with contextlib.suppress(ExportError):  # any other exception fails
        build(load({**files, "programs.json": signed(document)}))


@pytest.mark.parametrize("name", FILES)
def test_oversized_files_are_not_read(tmp_path, name):
    for file, data in saved()[1].items():
        (tmp_path / file).write_bytes(data)
    with (tmp_path / name).open("rb+") as file:
        file.truncate(2**40)  # sparse: takes no space on the disk
    with pytest.raises(ProgramError, match=f"cannot read .*{name}: has 1.02e\\+03 GiB, at most"):
        Program.load(tmp_path)
    (tmp_path / name).write_bytes(saved()[1][name])
    limits = Limits(json_bytes=100)
    with pytest.raises(ProgramError, match=r"programs\.json.*NN-099"):
        Program.load(tmp_path, limits)


def test_another_schema_and_another_pair_are_named(tmp_path):
    files = saved()[1]
    document = json.loads(files["programs.json"])
    document["schema"] = 99
    with pytest.raises(ProgramError, match=r"99.*NN-089"):
        load({**files, "programs.json": signed(document)})
    trace(nn.Linear(2, 1), (torch.zeros(2),)).save(tmp_path)
    with pytest.raises(ProgramError, match="NN-094"):
        load({**files, "weights.safetensors": (tmp_path / "weights.safetensors").read_bytes()})


def test_a_number_changed_by_hand_is_noticed():
    files = saved()[1]
    assert b"-1.5" in files["programs.json"]
    with pytest.raises(ProgramError, match="NN-086"):
        load({**files, "programs.json": files["programs.json"].replace(b"-1.5", b"-2.5")})


def test_load_and_build_without_torch(tmp_path):
    program = saved()[0]
    program.save(tmp_path)
    code = (
        "import sys; sys.modules['torch'] = None\n"
        "import nn_export\n"
        f"f = nn_export.build(nn_export.Program.load({str(tmp_path)!r}))\n"
        "print(repr(f(range(6)).full().ravel().tolist()))"
    )
    root = str(Path(__file__).parents[2])
    run = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, cwd=root, check=True)
    assert run.stdout.strip() == repr(build(program)(range(6)).full().ravel().tolist())


def judged(tmp_path, cases, *steps):
    """What comes of loading (and building) each case in a process with 1.5 GiB, by name."""
    names = write(tmp_path, cases)
    worker = Path(__file__).with_name("foreign_files.py")
    environment = {**os.environ, "OMP_NUM_THREADS": "1", "OPENBLAS_NUM_THREADS": "1"}
    environment["PYTHONPATH"] = str(Path(__file__).parents[2])
    command = [sys.executable, str(worker), str(tmp_path), *steps]
    done = subprocess.run(command, capture_output=True, text=True, env=environment, timeout=3600)
    assert done.returncode == 0, done.stderr[-2000:]
    outcomes = dict(zip(names, map(json.loads, done.stdout.splitlines()), strict=True))
    assert not [(name, o["error"]) for name, o in outcomes.items() if "error" in o]
    return outcomes


CHEAP = {
    "large product", "constants once more", "positions of positions", "products of constants",
    "an expression for many cells", "parts of a large input",
}  # fmt: skip
"""Crafted files that are within the limits, and soon built."""


@pytest.mark.full
@pytest.mark.skipif(sys.platform != "linux", reason="limits of a process are Linux's here")
def test_small_files_that_ask_for_gigabytes_or_minutes_are_refused_at_once(tmp_path):
    outcomes = judged(tmp_path, crafted(), "load", "build")
    assert {name for name, o in outcomes.items() if not o["refused"]} == CHEAP
    # A second on a machine of today, five times that where others work too. 230 MB are casadi and numpy.
    assert {name: o["seconds"] for name, o in outcomes.items() if sum(o["seconds"].values()) > 5.0} == {}
    assert max(o["peak"] for o in outcomes.values()) < 500e6
    # Every other audited event (exec, compile, import, dlopen, subprocess, unpickling) would be listed too.
    assert {event for o in outcomes.values() for event in o["events"]} <= {"open", "object.__getattr__"}


def material():
    """Programs to be changed: every operator of the table, a recurrent network, the model of above."""
    from test_operators import NAMES, Setup

    programs = {name: Setup(name, inputs).program for name in NAMES for inputs in (True, False)}
    return {**programs, "model": saved()[0]}


def changed(folder, count, seed):
    """Programs with numbers, references and operators changed at random."""
    rng, cases, documents = random.Random(seed), {}, {}
    for name, program in material().items():
        save_programs(folder / "material", {name: program})
        documents[name] = {file: (folder / "material" / file).read_bytes() for file in FILES}
    for k in range(count):
        name = rng.choice(sorted(documents))
        document = mutated(json.loads(documents[name]["programs.json"]), rng)
        cases[f"{k} {name}"] = {**documents[name], "programs.json": document}
    return cases


@pytest.mark.skipif(sys.platform != "linux", reason="limits of a process are Linux's here")
@pytest.mark.full
@pytest.mark.parametrize(("count", "seed"), [(2000, 1), (2000, 2)])
def test_changed_programs_are_refused_by_name_or_build_soon(tmp_path_factory, tmp_path, count, seed):
    cases = changed(tmp_path_factory.mktemp("saved"), count, seed)
    outcomes = judged(tmp_path, cases, "load", "build", "with_jacobian", "side_by_side")
    assert sum(bool(o["refused"]) for o in outcomes.values()) > count // 4  # the others do something else
    # to refuse all would prove nothing
    assert sum(not o["refused"] for o in outcomes.values()) > count // 100
    # Refused before anything is built: within a second. What is within the limits may take some ten seconds.
    assert {name: o for name, o in outcomes.items() if o["seconds"]["load"] > 1.0} == {}
    assert {name: o for name, o in outcomes.items() if sum(o["seconds"].values()) > 30.0} == {}
    assert max(o["peak"] for o in outcomes.values()) < 1.5e9
