"""What jobs work on: a small machine of a user's own with its recordings, and the folder of a golf robot's run."""

import math
import shutil
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from engine_jobs import jobs_in_this_process
from PIL import Image

PENDULUM = Path(__file__).parents[1] / "docs/examples/my_machine.py"
TINY = """
import dataclasses
from hybrid_mpc import Budget
tiny = {"quick": Budget(hidden=4, networks=2, teacher_steps=50, free_run_steps=25, seeds=1)}
scenario = dataclasses.replace(scenario, budgets=tiny)
"""


def recording(seed: int, seconds: float = 12.0, dt: float = 0.01) -> dict[str, np.ndarray]:
    """A pendulum with dry friction (the prior of docs/examples has none), by semi-implicit Euler at 2.5 ms."""
    rng = np.random.default_rng(seed)
    n, fine = round(seconds / dt), 4
    t = dt * np.arange(n)
    u = 0.4 * np.sin(2 * np.pi * rng.uniform(0.2, 0.4) * t) + 0.3 * np.sign(
        np.sin(2 * np.pi * 0.13 * t + seed)
    )
    phi, v, out = 0.2, 0.0, np.zeros(n)
    for k in range(n):
        out[k] = phi
        for _ in range(fine):
            v += dt / fine * (u[k] - 1.1 * math.sin(phi) - 0.06 * v - 0.08 * math.tanh(v / 0.05)) / 0.1
            phi += dt / fine * v
    return {"time_s": t, "tau_nm": u, "phi_rad": out + 2e-4 * rng.standard_normal(n)}


def write(path: Path, columns: dict[str, np.ndarray]) -> Path:
    table = np.column_stack(list(columns.values()))
    np.savetxt(path, table, delimiter=",", header=",".join(columns), comments="", fmt="%.8g")
    return path


@pytest.fixture(scope="session")
def machine(shared) -> Path:
    """Folder with ``my_machine.py`` (that of docs/examples) and two recordings, one with ten samples that repeat."""
    return shared("machine", write_machine)


def write_machine(folder: Path) -> None:
    (folder / "my_machine.py").write_text(PENDULUM.read_text() + TINY)
    for i, name in enumerate(("monday", "tuesday")):
        columns = recording(i)
        columns["phi_rad"][600 : 600 + 10 * i] = columns["phi_rad"][600]
        write(folder / f"{name}.csv", columns)


@pytest.fixture(scope="session")
def arguments(machine) -> list[str]:
    """Command line of a run without its --out."""
    data = [w for name in ("monday", "tuesday") for w in ("--data", str(machine / f"{name}.csv"))]
    return ["run", str(machine / "my_machine.py"), *data]


@pytest.fixture(scope="module")
def jobs_here():
    """See there: for a module."""
    with jobs_in_this_process():
        yield


@pytest.fixture(scope="session")
def finished(arguments, shared) -> Path:
    """Folder of a finished run, by the command itself but in this process."""
    return shared("finished", lambda folder: finish(folder, arguments)) / "run"


def finish(folder: Path, arguments: list[str], *, drawn: bool = True) -> None:
    """A run into ``run`` of a folder, and what it told, by the command itself but in this process.

    Where nobody looks at its pictures, a point of ink is each of them (``drawn=False``).
    """
    from typer.testing import CliRunner

    from hybrid_mpc.cli.main import app
    from hybrid_mpc.workflow.stages import figures

    with jobs_in_this_process(), pytest.MonkeyPatch.context() as patch:
        if not drawn:
            patch.setattr(figures, "_saved", point)
        done = CliRunner().invoke(app, [*arguments, "--out", str(folder / "run")])
    assert done.exit_code == 0, done.output
    assert "report.html" in done.stdout
    (folder / "told.txt").write_text(done.stdout)


def point(figure: Any, path: Path) -> Path:
    """The smallest picture."""
    path.parent.mkdir(exist_ok=True)
    Image.new("1", (1, 1)).save(path)
    return path


@pytest.fixture(scope="session")
def run_folder(golf_artifact, tmp_path_factory) -> Path:
    """A run's folder as far as loops look at it: an artifact with noise, and limits that alarm at once."""
    from hybrid_mpc import ChannelLimit, WatchLimits, set_limits, set_process_noise

    folder = tmp_path_factory.mktemp("run")
    model = shutil.copytree(golf_artifact, folder / "model")
    names = ("prior", "prior_observer", "hybrid", "hybrid_observer", "oracle")
    set_process_noise(model, dict.fromkeys(names, (1e-4, 2e-2)))
    at_once = ChannelLimit("violation", "W", 1, 1e-9, 1e-10)
    limits = WatchLimits("energy", 0.02, (at_once,), (1.0,), (0,), 1.0, 1.0, "for tests")
    set_limits(model, {"hybrid": [limits]})
    return folder


BARE = """
from dataclasses import replace
from hybrid_mpc import Budget
from scenarios.simulated.two_tanks import scenario as tanks
few = Budget(hidden=4, networks=2, teacher_steps=10, free_run_steps=0, seeds=1)
short = replace(tanks.data, windows={}, warm_up=100.0, free_run=400.0)
scenario = replace(
    tanks, name="bare_tanks", plant=None, tasks=(), make_data=None, data=short, budgets={"quick": few},
    control=tanks.control.changed(horizon=20),
)
"""


@pytest.fixture(scope="session")
def bare_tanks(shared) -> Path:
    """Folder of a scenario without plant and tasks: ``tanks.py``, recordings, a finished ``run``, and what it told."""
    return shared("bare_tanks", write_bare_tanks)


def write_bare_tanks(folder: Path) -> None:
    from scenarios.simulated.two_tanks import EXPERIMENT

    short = replace(EXPERIMENT, seconds=1200.0)
    (folder / "tanks.py").write_text(BARE)
    words = []
    for i, name in enumerate(("monday", "tuesday", "later")):
        table = dict(zip(short.columns, short.table("train", i + 1, 0).T, strict=True))
        path = write(folder / f"{name}.csv", table)
        words += ["--data", str(path)] if name != "later" else []
    skipped = [word for stage in ("estimation", "watch", "analysis") for word in ("--skip", stage)]
    finish(folder, ["run", str(folder / "tanks.py"), *words, *skipped], drawn=False)
