"""Named errors, files that are damaged, and life without torch."""

import copy
import subprocess
import sys
from pathlib import Path

import casadi as ca
import numpy as np
import pytest
import torch
from export_parts import Call
from torch import nn

from nn_export import Program, ProgramError, build, to_casadi, trace
from nn_export.errors import (
    ControlFlowError,
    DtypeError,
    HiddenStateError,
    TrainingModeError,
    UnsupportedOperatorError,
)


@pytest.mark.parametrize(
    ("f", "error", "words"),
    [
        (lambda x: torch.sort(x).values + torch.special.i0(x), UnsupportedOperatorError, r"(?s)sort.*i0"),
        (lambda x: x if x[0] > 0 else -x, ControlFlowError, "torch.where"),
        (lambda x: nn.functional.dropout(x, 0.5), TrainingModeError, "dropout"),
        (lambda x: x.long(), DtypeError, "int64"),
        (lambda x: x.float().sin().double(), DtypeError, "float32"),
        (lambda x: x.add_(1), HiddenStateError, "input"),
    ],
)
def test_named_errors(f, error, words):
    with pytest.raises(error, match=words):
        to_casadi(Call(f), (torch.rand(3),))


def test_the_module_is_not_changed():
    module = nn.Sequential(nn.Linear(2, 3), nn.Dropout(0.5), nn.BatchNorm1d(3)).train()
    before, flags = copy.deepcopy(module.state_dict()), [p.requires_grad for p in module.parameters()]
    to_casadi(module, (torch.zeros(1, 2),))
    assert module.training
    assert flags == [p.requires_grad for p in module.parameters()]
    for key, value in module.state_dict().items():
        assert value.dtype == before[key].dtype
        assert torch.equal(value, before[key])


def test_damaged_files_are_refused(tmp_path):
    trace(nn.GRUCell(2, 3), (torch.zeros(2), torch.zeros(3))).save(tmp_path)
    for name in ("programs.json", "weights.safetensors"):
        good = (tmp_path / name).read_bytes()
        for bad in (b"", good[:-7], good[: len(good) // 2], b"{}", b"[" * 100000, good + b"x"):
            (tmp_path / name).write_bytes(bad)
            with pytest.raises(ProgramError, match=name):
                Program.load(tmp_path)
        (tmp_path / name).write_bytes(good)
    text = (tmp_path / "programs.json").read_text()
    (tmp_path / "programs.json").write_text(text.replace("aten.gru_cell.default", "os.system"))
    with pytest.raises(ProgramError, match=r"os\.system"):
        Program.load(tmp_path)


def test_load_and_build_without_torch(tmp_path):
    program = trace(nn.GRUCell(2, 3), (torch.zeros(2), torch.zeros(3)))
    program.save(tmp_path)
    code = (
        "import sys; sys.modules['torch'] = None\n"
        "import nn_export\n"
        f"f = nn_export.build(nn_export.Program.load({str(tmp_path)!r}))\n"
        "print(repr(f([1, 2], [0, 0, 0]).full().ravel().tolist()))"
    )
    root = str(Path(__file__).parents[2])
    run = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, cwd=root, check=True)
    assert run.stdout.strip() == repr(build(program)([1, 2], [0, 0, 0]).full().ravel().tolist())


def test_a_sum_added_to_its_vector_has_the_right_jacobian():
    function = to_casadi(Call(lambda x: x + x.sum()), (torch.zeros(4),))
    x = ca.MX.sym("x", 4)
    jacobian = ca.Function("jacobian", [x], [ca.jacobian(function(x), x)])(np.ones(4)).full()
    assert np.array_equal(jacobian, np.eye(4) + 1)
