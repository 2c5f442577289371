"""Model folders that are damaged or made to do harm: each ends with a message, soon, and executes nothing."""

import copy
import json
import os
import random
import shutil

import numpy as np
import pytest

import hybrid_mpc as hm
from hybrid_mpc import ChannelLimit, InputError, WatchLimits, set_limits, set_process_noise
from hybrid_mpc.files import HASH, digest
from hybrid_mpc.kit.parts import KIT, PROGRAMS, WEIGHTS
from tests.fuzz.forked import cheap, command, refused

ODD = [
    None, True, -1, 0, 3, 1.5, 1e308, 10**19, "", "text", "inf", "nan", "../../../etc/passwd", "trap.py", "x" * 10_000,
    [], [[]], [None] * 1000, {}, {"a": {}}, ["prior"] * 3, [1e300] * 4, {"prior": "prior"},
]  # fmt: skip
"""What stands in a field in place of what belongs there."""
RAW = {
    "nothing": b"", "no JSON": b"{", "a list": b"[]", "a number": b"5", "null": b"null", "NaN": b'{"dt_s": NaN}',
    "a long number": b'{"schema_version": ' + b"9" * 5000 + b"}", "a million levels": b"[" * 10**6,
    "a million levels of objects": b'{"a":' * 10**6, "twice": b'{"schema_version": 2, "schema_version": 2}',
    "not UTF-8": b'{"schema_version": "\xff"}', "zeros": bytes(10**6), "half a pair": b'{"a": "\\ud800"}',
    "wide": b"[" + b"0," * 4_000_000 + b"0]", "a long text": b'"' + b"x" * 20_000_000 + b'"',
}  # fmt: skip


def places(value, path=()):
    """Paths to everything within JSON data."""
    yield path
    inner = value.items() if isinstance(value, dict) else enumerate(value) if isinstance(value, list) else ()
    for key, part in inner:
        yield from places(part, (*path, key))


def changed(document, path, new):
    """The document with another value at a path, or without it (``new is ...``)."""
    document = copy.deepcopy(document)
    if not path:
        return new
    at = document
    for key in path[:-1]:
        at = at[key]
    if new is ...:
        del at[path[-1]]
    else:
        at[path[-1]] = new
    return document


@pytest.fixture(scope="module")
def whole(golf_artifact):
    document = json.loads((golf_artifact / KIT).read_text())
    document.pop(HASH)
    return document


@pytest.fixture
def folder(golf_artifact, tmp_path):
    return shutil.copytree(golf_artifact, tmp_path / "model")


def ways(folder, tmp_path):
    return ["analyze", folder, "--scenario", "golf_robot", "--out", tmp_path / "out"]


@pytest.mark.parametrize(
    "name", [n if n in ("no JSON", "NaN", "twice") else pytest.param(n, marks=pytest.mark.full) for n in RAW]
)
def test_what_is_no_description(folder, tmp_path, name):
    (folder / KIT).write_bytes(RAW[name])
    refused(command(*ways(folder, tmp_path)), name)


@pytest.mark.parametrize("file", [KIT, PROGRAMS, WEIGHTS])
def test_what_is_no_file(folder, tmp_path, file):
    for make in (os.mkdir, os.mkfifo, lambda p: os.symlink("/dev/zero", p), lambda p: os.symlink(p, p), None):
        (folder / file).unlink(missing_ok=True) if not (folder / file).is_dir() else (folder / file).rmdir()
        if make is not None:
            make(folder / file)
        refused(command(*ways(folder, tmp_path)), f"{file} {make}")


@pytest.mark.full
@pytest.mark.parametrize("seed", range(4))
def test_fields_that_do_not_fit(folder, whole, tmp_path, seed):
    """With a hash that is right: the file was made so, not damaged. Most are refused; none does anything else."""
    rng, paths = random.Random(seed), list(places(whole))
    count = 0
    for _ in range(50):
        path, new = rng.choice(paths), rng.choice([*ODD, ...])
        if not path and new is ...:
            continue
        document = changed(whole, path, new)
        if document == whole:
            continue
        content = {**document, HASH: digest(document)} if isinstance(document, dict) else document
        (folder / KIT).write_text(json.dumps(content))
        what = f"{path}: {str(new)[:80]}"
        mark = folder / "executed"
        (folder / "trap.py").write_text(f"open({str(mark)!r}, 'w')")
        for words in (
            ["control", "golf_robot", "--model", folder, "--task", "none"],
            ["monitor", folder, "none.csv"],
        ):
            ended = command(*words, "--out", tmp_path / "out")  # no such task, no such recording
            refused(ended, what)
        assert not mark.exists()
        count += 1
    assert count > 40


def limits():
    scale = (1e-4, 1e-4, 0.0, 1e-4)
    force = ChannelLimit("force of phi", "N m", 0, 4.0, 2.0, scale, 0.5)
    power = ChannelLimit("power of the free run", "W", 1, 4.0, 2.0, scale)
    return WatchLimits("energy", 0.02, (force, power), (5e-3,), (0,), rest_speed=(0.2,))


@pytest.fixture
def watched(folder, tmp_path):
    """An artifact with limits of all channels, a recording and a filter's noise."""
    set_limits(folder, {"hybrid": [limits()]})
    t = 0.02 * np.arange(300)
    table = np.column_stack([t, np.sin(2 * t), 0.1 * np.cos(3 * t)])
    np.savetxt(tmp_path / "run.csv", table, delimiter=",", header="time_s,phi_rad,u_nm", comments="")
    set_process_noise(folder, {"hybrid_observer": [1e-3, 1e-2]})

    def words(out):
        return ["monitor", folder, tmp_path / "run.csv", "--scenario", "golf_robot", "--out", tmp_path / out]

    return words


def test_good_limits_are_watched_with(watched):
    ended = command(*watched("out"))
    assert ended.code == 0, ended.told
    assert "channels: force of phi, power of the free run" in ended.told


@pytest.mark.full
@pytest.mark.parametrize("seed", range(2))
def test_limits_that_do_not_fit(watched, folder, seed):
    """Numbers that fit may be watched with, however odd; all else is refused."""
    rng, file = random.Random(seed), "watch/hybrid.json"
    document = json.loads((folder / file).read_text())
    document.pop(HASH)
    paths = [p for p in places(document) if p[:1] in (("limits",), ("rest_speed",))]
    refusals = 0
    for i in range(60):
        path, new = rng.choice(paths), rng.choice([*ODD, ...])
        odd = changed(document, path, new)
        (folder / file).write_text(json.dumps({**odd, HASH: digest(odd)}))
        ended, what = command(*watched(f"out{i}")), f"{path}: {str(new)[:80]}"
        if ended.code == 2:
            refused(ended, what)
            refusals += 1
        assert ended.code is not None, f"{what}:\n{ended.told}"
        assert "Traceback" not in ended.told, f"{what}:\n{ended.told}"
    assert refusals > 30


@pytest.mark.full
@pytest.mark.parametrize("file", [KIT, PROGRAMS, WEIGHTS])
def test_damage_is_refused(folder, tmp_path, file):
    """Bytes that were changed, lost, doubled or moved."""
    content, rng = (folder / file).read_bytes(), random.Random(7)
    for i in range(15):
        at, length = rng.randrange(len(content)), rng.randrange(1, 200)
        damages = (
            content[:at], content[:at] + rng.randbytes(length) + content[at + length :], content[at:],
            content[:at] + content[at + length :], content + content[:length], content[:at] + content,
        )  # fmt: skip
        damaged = damages[i % len(damages)]
        if damaged == content:
            continue
        (folder / file).write_bytes(damaged)
        refused(command(*ways(folder, tmp_path)), f"{file}, damage {i} at {at}")


@pytest.mark.full
def test_files_of_two_models_are_refused(folder, golf_artifact, tmp_path):
    programs = json.loads((folder / PROGRAMS).read_text())
    (folder / PROGRAMS).write_text(json.dumps(programs, indent=4))  # the same programs, another file
    refused(command(*ways(folder, tmp_path)), "programs.json of another saving")


def test_a_good_folder_passes(folder, tmp_path):
    ended = command("control", "golf_robot", "--model", folder, "--task", "none", "--out", tmp_path / "out")
    refused(ended, "an unknown task")
    assert "HM-COMPARE-058" in ended.told
    cheap(ended, "")


@pytest.mark.parametrize("name", ["x" * 5000, "a\0b", "\udcff", ""])
def test_names_that_are_no_folder(name, tmp_path):
    with pytest.raises(InputError):
        hm.load(tmp_path / "x" / name)
    with pytest.raises(InputError):
        hm.load_scenario(f"{name}.py")
