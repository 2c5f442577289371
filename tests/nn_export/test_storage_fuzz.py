"""Files that are damaged, truncated, foreign or too large: the named error, or the identical program."""

import contextlib
import json
import subprocess
import sys
import tempfile
from functools import cache
from pathlib import Path

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from torch import nn

from nn_export import ExportError, Program, ProgramError, build, storage, trace
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


@settings(max_examples=150, deadline=None, derandomize=True)
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


@settings(max_examples=60, deadline=None, derandomize=True)
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


def places(data):
    """All containers of a JSON document with their keys."""
    items = data.items() if isinstance(data, dict) else enumerate(data) if isinstance(data, list) else ()
    found = []
    for key, value in items:
        found += [(data, key), *places(value)]
    return found


def signed(document):
    """A foreign file may well carry a right hash."""
    document.pop("sha256", None)
    document["sha256"] = storage._content_hash(document)
    return json.dumps(document).encode()


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


@pytest.mark.parametrize("depth", [100, 800, 100_000])
def test_deep_nesting(depth):
    files = saved()[1]
    document = json.loads(files["programs.json"])
    document["programs"]["program"]["program"]["nodes"][0]["args"] = ["DEEP"]
    text = json.dumps(document).replace('"DEEP"', "[" * depth + "]" * depth)
    with pytest.raises(ProgramError, match=r"programs\.json"):
        load({**files, "programs.json": text.encode()})


@pytest.mark.parametrize("name", FILES)
def test_oversized_files_are_not_read(tmp_path, name):
    for file, data in saved()[1].items():
        (tmp_path / file).write_bytes(data)
    limit = {"programs.json": storage.MAX_JSON, "weights.safetensors": storage.MAX_WEIGHTS}[name]
    with (tmp_path / name).open("rb+") as file:
        file.truncate(limit + 1)  # sparse: takes no space on the disk
    with pytest.raises(ProgramError, match=f"{name}: {limit + 1} bytes"):
        Program.load(tmp_path)


def test_another_schema_and_another_pair_are_named(tmp_path):
    files = saved()[1]
    document = json.loads(files["programs.json"])
    document["schema"] = 99
    with pytest.raises(ProgramError, match="schema 99"):
        load({**files, "programs.json": signed(document)})
    trace(nn.Linear(2, 1), (torch.zeros(2),)).save(tmp_path)
    with pytest.raises(ProgramError, match="another model"):
        load({**files, "weights.safetensors": (tmp_path / "weights.safetensors").read_bytes()})


def test_a_number_changed_by_hand_is_noticed():
    files = saved()[1]
    assert b"-1.5" in files["programs.json"]
    with pytest.raises(ProgramError, match="changed by hand"):
        load({**files, "programs.json": files["programs.json"].replace(b"-1.5", b"-2.5")})


AUDIT = """
import sys
from nn_export import Program
Program.load(sys.argv[1])  # now all modules are imported
seen = []
sys.addaudithook(lambda event, args: seen.append(event))
Program.load(sys.argv[1])
print(*sorted(set(seen)))
"""


def test_loading_executes_nothing_and_writes_nothing(tmp_path):
    saved()[0].save(tmp_path)
    root = str(Path(__file__).parents[2])
    done = subprocess.run(
        [sys.executable, "-c", AUDIT, str(tmp_path)], capture_output=True, text=True, cwd=root, check=True
    )
    # Every other audited event (exec, compile, import, dlopen, subprocess, unpickling) would be listed too.
    assert set(done.stdout.split()) <= {"open", "object.__getattr__"}
    assert "open" in done.stdout.split()
