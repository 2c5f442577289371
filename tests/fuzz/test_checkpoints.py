"""Checkpoints of a run that are damaged: the file is named, and what to delete; nothing is computed on top of them."""

import random
import shutil

import pytest

from hybrid_mpc import InputError, RunSettings, load_scenario
from hybrid_mpc.workflow.context import Context
from hybrid_mpc.workflow.run import NAMES, STAGES
from tests.fuzz.forked import command


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
def test_damage_of_any_checkpoint_is_named(finished, tmp_path):
    """Whatever is damaged: the file is named, and what to delete, before anything is computed on top of it."""
    out = shutil.copytree(finished, tmp_path / "run")
    tried, rng, stages = 0, random.Random(0), {stage.name: stage for stage in STAGES}
    for path in sorted((out / "checkpoints").glob("*.*")):

        def read(stage=stages[path.stem]):
            return Context(RunSettings("golf_robot"), load_scenario("golf_robot"), out).stored(stage)

        assert read() is not None
        content = path.read_bytes()
        for what, damaged in damages(content, rng):
            if damaged != content:
                path.write_bytes(damaged)
                with pytest.raises(InputError, match=r"delete .*--resume") as said:
                    read()
                assert path.stem in str(said.value), what
                tried += 1
        path.write_bytes(content)
    assert tried >= 67


@pytest.mark.full
@pytest.mark.parametrize("name", ["prior.npz", "evaluation.json"])
def test_a_run_that_is_resumed_on_damage_says_so(arguments, finished, tmp_path, name):
    out = shutil.copytree(finished, tmp_path / "run")
    for stage in NAMES[NAMES.index("training") :]:
        if not name.startswith(f"{stage}."):
            (out / "checkpoints" / f"{stage}.json").unlink(missing_ok=True)
    path = out / "checkpoints" / name
    path.write_bytes(path.read_bytes()[:-20])
    ended = command(*arguments, "--out", out, "--resume")
    assert ended.code == 2, ended.told
    assert path.name in ended.told or path.stem in ended.told
    assert "delete" in ended.told
    assert "Traceback" not in ended.told


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

    from hybrid_mpc import InputError
    from hybrid_mpc.identify.train import load_checkpoint, save_checkpoint

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
        with pytest.raises(InputError, match=r"delete this file to train again|other settings"):
            load_checkpoint(path, "key")
