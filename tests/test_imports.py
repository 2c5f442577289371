"""Who may import whom, read off the source; and the online half without torch, in a process of its own."""

import ast
import subprocess
import sys
from functools import cache
from pathlib import Path

import pytest
from patience import HANGS

import hybrid_mpc

ROOT = Path(__file__).parents[1]
OWN = ("nn_export", "hybrid_mpc", "scenarios")
ROOMS = {
    "nn_export": "",
    "errors": "",
    "rules": "",
    "engine": "errors rules",
    "records": "nn_export errors rules",
    "files": "nn_export errors records",
    "folder": "errors records files",
    "machine": "nn_export errors rules records",
    "data": "nn_export errors rules records files machine",
    "model": "nn_export errors rules records machine",
    "estimate": "errors rules records machine model",
    "control": "nn_export errors rules records model estimate",
    "loop": "errors rules records machine model estimate control",
    "scenario": "errors rules records machine model control loop",
    "watch": "errors rules machine data model",
    "embedded": "nn_export errors rules files model estimate control loop watch",
    "kit": "nn_export errors rules records files machine data model estimate control embedded loop scenario watch",
    "identify": "nn_export errors rules records files machine data model estimate kit",
    "plots": "errors rules files machine watch",
    "report": "errors rules files plots",
    "analyze": "nn_export errors records files machine data model estimate control loop watch plots report",
    "check": "nn_export errors rules engine records files machine data model control loop scenario kit identify plots "
    "analyze",
    "compare": "nn_export errors rules engine records files folder machine data model estimate control loop scenario "
    "watch kit identify plots report analyze check",
    "workflow": "nn_export errors rules engine records files folder machine data model estimate control loop scenario "
    "watch kit identify plots report analyze check compare",
    "cli": "errors rules engine files machine data scenario kit identify analyze check compare workflow",
    "__main__": "cli",
    "scenarios.paper": "errors rules engine records files folder machine data scenario identify plots workflow cli",
    "scenarios.golf_robot.monitor_study": "errors engine records files folder loop scenario watch kit plots report "
    "compare cli",
    "scenarios": "nn_export",
}
"""What each room may import, besides itself. A room imports only rooms above its own line, so there are no circles.

A machine in ``scenarios`` imports the public names of ``hybrid_mpc`` alone; its parts are no rooms to anyone but it.
"""
# the offline half: the only places where torch may be imported when a module is loaded, or a module that imports it
TORCH = (
    "nn_export/tracing.py",
    "nn_export/convert.py",
    "nn_export/comparison.py",
    "nn_export/batched.py",
    "nn_export/torch_bridge.py",
    "hybrid_mpc/machine/torch_prior.py",
    *(
        f"hybrid_mpc/identify/{name}.py"
        for name in (
            "dataset",
            "evaluate",
            "export",
            "networks",
            "objectives",
            "prior_replay",
            "rollout",
            "step",
            "train",
            "tune",
        )
    ),
    "scenarios/paper/sindy.py",
    "scenarios/paper/step.py",
)
# rooms that run beside a machine and so must not even import torch lazily
ONLINE = ("model", "estimate", "control", "embedded", "loop", "watch", "analyze", "kit", "plots", "report")


@cache
def imports(path, *, at_load):
    """Modules that a file imports; ``at_load`` leaves out functions and TYPE_CHECKING blocks.

    A public name of ``hybrid_mpc`` counts as the room that it is imported from, which is loaded with it.
    """
    return imports_of(path.read_text(), path, at_load=at_load)


def imports_of(source, path, *, at_load):
    names = set()

    def visit(node):
        for child in ast.iter_child_nodes(node):
            if at_load and isinstance(child, ast.FunctionDef | ast.Lambda):
                continue
            if at_load and isinstance(child, ast.If) and "TYPE_CHECKING" in ast.dump(child.test):
                continue
            if isinstance(child, ast.Import):
                names.update(alias.name for alias in child.names)
            elif isinstance(child, ast.ImportFrom):
                assert child.level == 0, f"{path}: relative import"
                names.add(child.module)
                if child.module == "hybrid_mpc":
                    homes = (hybrid_mpc._HOME.get(alias.name) for alias in child.names)
                    names.update(f"hybrid_mpc.{home}" for home in homes if home)
            visit(child)

    visit(ast.parse(source))
    return names


def with_torch(modules):
    """Those that load torch: itself, and the offline half of ``hybrid_mpc``."""
    rooms = [place.removesuffix(".py").removesuffix("/").replace("/", ".") for place in TORCH]
    return {m for m in modules if any(m == r or m.startswith(f"{r}.") for r in ("torch", *rooms))}


FILES = [p for package in OWN for p in sorted((ROOT / package).rglob("*.py"))]
assert len(FILES) > 60


def room_of(module):
    """The room of a module; none for the package itself, whose names are public."""
    for special in ("scenarios.paper", "scenarios.golf_robot.monitor_study"):
        if module == special or module.startswith(f"{special}."):
            return special
    parts = module.split(".")
    return parts[0] if parts[0] != "hybrid_mpc" else parts[1] if len(parts) > 1 else None


def test_a_room_imports_only_rooms_above_it():
    seen = []
    for room, allowed in ROOMS.items():
        assert set(allowed.split()) <= set(seen), room
        seen.append(room)
    there = {
        p.name.removesuffix(".py") for p in (ROOT / "hybrid_mpc").iterdir() if not p.name.startswith("_")
    }
    assert there - {"py.typed"} <= set(ROOMS)


def test_rooms_import_what_the_table_allows():
    wrong = {str(path.relative_to(ROOT)): found for path in FILES if (found := not_allowed(path))}
    assert not wrong


def not_allowed(path):
    """What a file imports and may not."""
    room = room_of(".".join(path.relative_to(ROOT).with_suffix("").parts).removesuffix(".__init__"))
    own = {name for name in imports(path, at_load=False) if name and name.split(".")[0] in OWN}
    if room is None:  # the package: its table of public names
        return set()
    if room == "scenarios":
        own = {name for name in own if name.split(".")[0] != "scenarios"}
        public = {
            "hybrid_mpc",
            "hybrid_mpc.plots",
            *(f"hybrid_mpc.{home}" for home in hybrid_mpc._HOME.values()),
        }
        foreign = {name for name in own if name.startswith("hybrid_mpc")} - public
        return foreign | {
            name for name in own if name.startswith("nn_export") and "nn_export" not in ROOMS[room]
        }
    return {room_of(name) for name in own} - {room, None} - set(ROOMS[room].split())


def test_torch_stays_offline():
    for path in FILES:
        where = str(path.relative_to(ROOT))
        if where.startswith(TORCH) or (where.startswith("scenarios/") and path.name == "prior.py"):
            continue
        assert "torch" not in {name.split(".")[0] for name in imports(path, at_load=True)}, where
        parts = path.relative_to(ROOT).with_suffix("").parts
        if parts[0] == "hybrid_mpc" and parts[1] in ONLINE:
            assert "torch" not in {name.split(".")[0] for name in imports(path, at_load=False)}, where
        if parts[0] == "scenarios":  # public names of the offline half bring torch along
            assert not with_torch(imports(path, at_load=True)), where


def test_a_prior_in_casadi_is_written_and_fitted_without_torch():
    """Every module of the two rooms that the list does not name, loaded in one process; each that it names needs it."""
    files = [p for p in FILES if p.parent.name in ("identify", "machine") and "hybrid_mpc" in p.parts]
    listed = [p for p in files if str(p.relative_to(ROOT)).startswith(TORCH)]
    assert all(with_torch(imports(p, at_load=True)) for p in listed)
    others = [p for p in files if p not in listed]
    assert {"fit", "smooth", "simulation", "delay", "prior_result", "prior", "mechanical", "terms"} <= {
        p.stem for p in others
    }
    names = [".".join(p.relative_to(ROOT).with_suffix("").parts).removesuffix(".__init__") for p in others]
    code = (
        "import sys, hybrid_mpc.identify.linear\nassert not {'control', 'pandas'} & set(sys.modules)\n"
        f"import {', '.join(names)}\nassert 'torch' not in sys.modules"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, cwd=ROOT)
    assert done.returncode == 0, done.stderr


def test_rooms_import_rooms_and_not_the_public_names():
    for path in (ROOT / "hybrid_mpc").rglob("*.py"):
        tree = ast.parse(path.read_text())
        froms = [n for n in ast.walk(tree) if isinstance(n, ast.ImportFrom) and n.module == "hybrid_mpc"]
        assert not {alias.name for node in froms for alias in node.names} & set(hybrid_mpc._HOME), path


def test_only_the_command_line_knows_typer():
    for path in FILES:
        if not {"cli", "cli.py", "__main__.py"} & set(path.parts):
            assert not {"typer", "rich"} & {name.split(".")[0] for name in imports(path, at_load=False)}, path


def test_the_engine_computes_any_work_and_knows_none():
    own = {name for name in imports(ROOT / "hybrid_mpc/engine.py", at_load=False) if name.startswith(OWN)}
    assert own == {"hybrid_mpc.errors", "hybrid_mpc.rules"}


CLOSED_LOOP = """
import sys
class Refuse:
    def find_spec(self, name, *rest):
        if name.split(".")[0] == "torch":
            raise ImportError("torch is refused here")
sys.meta_path.insert(0, Refuse())
import numpy as np
from pathlib import Path
from hybrid_mpc import load
from hybrid_mpc import simulate
from hybrid_mpc import make_controller, make_estimator, make_monitor
from hybrid_mpc import load_scenario
artifact = load(Path(sys.argv[1]))
loaded = set(sys.modules)  # half a second each, and no controller needs them
scenario = load_scenario("golf_robot")
model, prior, task = artifact.models["hybrid"], artifact.models["prior"], scenario.tasks[0]
result = simulate(
    scenario.plant(), make_estimator(model, scenario, np.array([1e-4, 1e-2])),
    make_controller(model, prior, scenario.control), task.reference,
    dt=model.dt, duration=2.0, x0=np.array(task.x0), seed=0, monitor=make_monitor(model))
assert "torch" not in sys.modules
assert not {"scipy.stats", "scipy.signal", "pandas", "matplotlib"} & loaded, loaded
print(result.source.count("MPC"), float(np.abs(result.x[:, 0] - result.reference[:, 0]).max()))
"""


def test_closed_loop_runs_where_torch_cannot_be_imported(tmp_path, golf_artifact):
    done = subprocess.run(
        [sys.executable, "-c", CLOSED_LOOP, str(golf_artifact)], capture_output=True, text=True, timeout=HANGS
    )
    assert done.returncode == 0, done.stderr
    solved, error = done.stdout.split()
    assert int(solved) == 100  # every one of the 2 s / 20 ms steps
    assert float(error) < 0.1  # rad; an untrained network is the prior: it follows, roughly


@pytest.mark.parametrize("option", ["--help", "--version"])
def test_help_and_version_load_nothing_that_computes(option):
    """They answer at once: a command loads what it works with when it is called."""
    script = (
        "import sys; sys.argv = ['hybrid-mpc', sys.argv[1]]\n"
        "from hybrid_mpc.cli.main import main\n"
        "try:\n    main()\nexcept SystemExit as end:\n    assert not end.code\n"
        "print('LOADED', *sorted({name.partition('.')[0] for name in sys.modules}))"
    )
    done = subprocess.run(
        [sys.executable, "-c", script, option], cwd=ROOT, capture_output=True, text=True, check=True
    )
    told, _, loaded = done.stdout.partition("LOADED ")
    assert "hybrid-mpc" in told or "reproduce" in told
    heavy = {
        "numpy",
        "scipy",
        "casadi",
        "torch",
        "pandas",
        "matplotlib",
        "control",
        "dask",
        "joblib",
        "optuna",
        "jinja2",
    }
    assert not heavy & set(loaded.split())


HEAVY = ("torch", "scipy.stats", "scipy.signal", "matplotlib", "pandas", "control", "jinja2", "joblib")


def loaded_by(code, *arguments):
    """Modules that a process of its own has loaded at the end of ``code``."""
    code += "\nimport sys; print('LOADED', *sys.modules)"
    done = subprocess.run(
        [sys.executable, "-c", code, *arguments], cwd=ROOT, capture_output=True, text=True, check=True
    )
    return set(done.stdout.partition("LOADED ")[2].split())


def test_the_list_of_scenarios_needs_nothing_that_computes_on_recordings():
    listed = "from hybrid_mpc.cli.scenarios import scenarios; scenarios()"
    assert not loaded_by(listed).intersection((*HEAVY, "scipy.interpolate", "scipy.io"))


def test_a_kit_loads_no_solver_and_its_loop_nothing_that_plots_or_trains(golf_artifact):
    load = "import sys, hybrid_mpc as hm; kit = hm.load(sys.argv[1])"
    assert not loaded_by(load, str(golf_artifact)).intersection((*HEAVY, "scipy", "hybrid_mpc.control.rti"))
    made = "from hybrid_mpc import load_scenario, make_controller; golf = load_scenario('golf_robot').control"
    made += "; make_controller(kit.models['hybrid'], kit.models['prior'], golf)"
    used = loaded_by(f"{load}; {made}", str(golf_artifact))
    assert "hybrid_mpc.control.rti" in used
    assert not used.intersection((*HEAVY, "hybrid_mpc.embedded.generate", "hybrid_mpc.control.nlp"))
