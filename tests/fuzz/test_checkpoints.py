"""Checkpoints of a run that are damaged: the file is named, and what to delete; nothing is computed on top of them."""

import random
import shutil

import pytest

from hybrid_mpc.pipeline.context import STAGES
from tests.fuzz.forked import command, refused
from tests.pipeline.conftest import arguments, finished, machine

__all__ = ["arguments", "finished", "machine"]  # fixtures
READ_BY = {
    "data": "export", "prior": "training", "training/pgrnn": "training", "training/mopgrnn": "training",
    "evaluation": "export", "control": "estimation", "monitor": "guard", "guard": "report", "estimation": "report",
    "analysis": "report",
}  # fmt: skip
"""Checkpoints, and a stage that reads each of them before it has computed much."""


def damages(content, rng):
    """Ways in which a file comes to harm."""
    at = rng.randrange(len(content))
    yield "cut off", content[:at]
    yield "bytes changed", content[:at] + rng.randbytes(3) + content[at + 3 :]
    yield "zeros", bytes(len(content))
    yield "empty", b""
    yield "another file", b'{"values": {}}'
    yield "a field lost", content.replace(b'"', b"'", 2)


@pytest.mark.full
@pytest.mark.parametrize("name", READ_BY)
def test_damage_is_named(arguments, finished, tmp_path, name):
    out = shutil.copytree(finished, tmp_path / "run")
    folder = out / "checkpoints"
    for stage in STAGES[STAGES.index(READ_BY[name]) :]:
        if stage != name:
            (folder / f"{stage}.json").unlink()
    for ending in ("json", "npz"):
        path = folder / f"{name}.{ending}"
        if not path.is_file():
            continue
        content = path.read_bytes()
        for what, damaged in damages(content, random.Random(name)):
            if damaged == content:
                continue
            path.write_bytes(damaged)
            ended = command(*arguments, "--out", out, "--resume")
            assert path.name in ended.told or path.with_suffix(".json").name in ended.told, (
                f"{name}, {what}:\n{ended.told}"
            )
            assert "delete" in ended.told, f"{name}, {what}:\n{ended.told}"
            assert ended.code == 2, f"{name}, {what}:\n{ended.told}"
            assert "Traceback" not in ended.told, f"{name}, {what}:\n{ended.told}"
        path.write_bytes(content)


@pytest.mark.full
def test_the_note_of_a_run(arguments, finished, tmp_path):
    out = shutil.copytree(finished, tmp_path / "run")
    content = (out / "run.json").read_bytes()
    for what, damaged in damages(content, random.Random(1)):
        (out / "run.json").write_bytes(damaged)
        refused_run = command(*arguments, "--out", out, "--resume")
        assert refused_run.code == 2, f"{what}:\n{refused_run.told}"
        assert "Traceback" not in refused_run.told


@pytest.mark.full
def test_a_training_that_was_interrupted_and_damaged(tmp_path):
    import torch

    from hybrid_mpc.errors import InputError
    from hybrid_mpc.identification.checkpoint import load_checkpoint, save_checkpoint

    path = tmp_path / "pgrnn.safetensors"
    save_checkpoint(path, "key", {"w": torch.arange(12.0).reshape(3, 4)}, {"done": 3})
    content, rng = path.read_bytes(), random.Random(3)
    tensors, numbers = load_checkpoint(path, "key")
    assert (tensors["w"].sum().item(), numbers) == (66.0, {"done": 3})
    for i in range(300):
        at = rng.randrange(len(content))
        damaged = content[:at] + (rng.randbytes(1) if i % 3 else b"") + content[at + 1 :]
        if damaged == content:
            continue
        path.write_bytes(damaged)
        with pytest.raises(InputError, match=r"delete it to train anew|other settings"):
            load_checkpoint(path, "key")


def test_names_of_stages_are_those_of_the_job():
    from hybrid_mpc.pipeline.run import STAGES as WITH_FUNCTIONS

    assert tuple(name for name, _, _ in WITH_FUNCTIONS) == STAGES
    assert refused
