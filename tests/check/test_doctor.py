"""``hybrid-mpc doctor``: what it tells of a computer, and of one that lacks something."""

import importlib.metadata
import os
import resource
import subprocess
import sys
from importlib.metadata import PackageNotFoundError, version

import pytest

from hybrid_mpc.check import doctor
from hybrid_mpc.check.doctor import examine


def by_name():
    return {one.name: one for one in examine()}


def test_it_names_versions_compiler_threads_and_folders(call):
    code, told, _ = call("doctor")
    for words in (
        f"casadi {version('casadi')}",
        f"torch {version('torch')}",
        "C compiler",
        "threads",
        "GPU",
        "cache",
    ):
        assert words in told
    assert code == 0
    assert by_name()["needed"].state == "ok"
    assert "OMP_NUM_THREADS=1" in told  # the command line sets it


def test_what_lacks_is_told_with_its_remedy(monkeypatch, tmp_path):
    there = importlib.metadata.version

    def lacking(name):
        if name in ("dask", "numpy"):
            raise PackageNotFoundError(name)
        return there(name)

    monkeypatch.setattr(doctor, "version", lacking)
    monkeypatch.setenv("CC", "no-such-compiler --fast")
    blocked = tmp_path / "blocked"
    blocked.write_text("a file where a folder should be")
    monkeypatch.setenv("XDG_CACHE_HOME", str(blocked))
    found = by_name()
    assert (found["extra studies"].state, found["extra studies"].remedy) == (
        "absent", "pip install 'hybrid-mpc[studies]'"
    )  # fmt: skip
    assert "dask missing" in found["extra studies"].found
    assert (found["needed"].state, found["needed"].remedy) == ("wrong", "pip install hybrid-mpc")
    assert found["extra report"].state == "ok"
    assert "no-such-compiler" in found["C compiler"].found
    assert found["C compiler"].state == "absent"
    assert found["cache"].state == "wrong"
    assert "XDG_CACHE_HOME" in found["cache"].remedy


def test_a_job_that_could_not_run_has_an_exit_code(call, monkeypatch, tmp_path):
    blocked = tmp_path / "blocked"
    blocked.write_text("")
    monkeypatch.setenv("XDG_CACHE_HOME", str(blocked))
    code, told, _ = call("doctor")
    assert code == 1
    assert "-> set XDG_CACHE_HOME" in told


def test_a_gpu_that_torch_cannot_use_is_told(monkeypatch, tmp_path):
    driver = tmp_path / "nvidia-smi"
    driver.write_text("#!/bin/sh\necho 'GPU 0: Some Card (UUID: GPU-1)'\n")
    driver.chmod(0o755)
    monkeypatch.setenv("PATH", f"{tmp_path}{os.pathsep}{os.environ['PATH']}")
    for installed, state in (("2.13.0+cpu", "absent"), ("2.13.0+cu130", "ok")):
        monkeypatch.setattr(doctor, "version", lambda name, installed=installed: installed)
        found = by_name()["GPU"]
        assert found.state == state
        assert "Some Card" in found.found


@pytest.mark.skipif(not hasattr(resource, "RUSAGE_CHILDREN"), reason="no processor times here")
def test_it_is_quick_and_imports_nothing_heavy():
    """1.5 s of processor time at most, with its interpreter; a third of a second was measured."""
    before = resource.getrusage(resource.RUSAGE_CHILDREN)
    code = (
        "import sys\nsys.argv = ['hybrid-mpc', 'doctor']\nfrom hybrid_mpc.cli.main import main\n"
        "try:\n    main()\nexcept SystemExit:\n    pass\n"
        "print('LOADED', *sorted({name.partition('.')[0] for name in sys.modules}))"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    after = resource.getrusage(resource.RUSAGE_CHILDREN)
    assert (after.ru_utime + after.ru_stime) - (before.ru_utime + before.ru_stime) < 1.5
    loaded = set(done.stdout.partition("LOADED ")[2].split())
    assert not {"torch", "casadi", "scipy", "pandas", "matplotlib"} & loaded
