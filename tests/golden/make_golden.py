"""Makes the golden files. README.md says when, and what in them is not the same every time.

make_golden.py freeze MACHINE RUN     the folder MACHINE from the folder of a finished hybrid-mpc run
make_golden.py arrays MACHINE [FILE]  arrays.npz and loops.json: replays, kernels and closed loops
make_golden.py costs MACHINE [FILE]   costs.json: ten seeds of every closed loop
make_golden.py compare FILE FILE      largest differences between two arrays.npz
"""

from __future__ import annotations

import json
import shutil
import subprocess
import sys
import zipfile
from io import BytesIO
from pathlib import Path

import golden_parts as parts
import numpy as np
from golden_parts import HERE, PERIODS, Parts, machine

from hybrid_mpc.records import plain

SEEDS = 10
REPLAYS = {
    "golf_robot": {
        # a heavier club, lost samples, a frozen sensor: all that the estimator and the monitor can meet. The controller
        # is asked until the sensor freezes: then the estimate jumps to speeds far beyond the soft bounds
        "track": {
            "problem": "track", "x0": [0.0, 0.0], "decided": 260,
            "faults": [
                {"target": "plant_mass", "value": 1.5, "start": 2.0, "end": None},
                {"target": "measurement_dropout", "value": 0.0, "start": 1.0, "end": 1.06},
                {"target": "measurement_freeze", "value": 0.0, "start": 5.2, "end": 5.5},
            ],
        },
        "stroke": {"problem": "stroke", "x0": [0.0, 0.0], "decided": PERIODS, "faults": []},
    },
    "unbalanced_disk": {
        "sway": {
            "problem": "sway", "x0": [np.pi, 0.0], "decided": 248,
            "faults": [
                {"target": "input_offset", "value": 0.35, "start": 2.5, "end": 4.0},
                {"target": "measurement_dropout", "value": 0.0, "start": 1.0, "end": 1.075},
                {"target": "measurement_freeze", "value": 0.0, "start": 6.2, "end": None},
            ],
        },
        "swing_up": {"problem": "swing_up", "x0": [0.0, 0.0], "decided": PERIODS, "faults": []},
    },
}  # fmt: skip
LOOPS = {
    "golf_robot": {
        "stroke": {"problem": "stroke", "guard": "adapt", "x0": [0.0, 0.0], "faults": []},
        "track": {"problem": "track", "guard": "adapt", "x0": [0.0, 0.0], "faults": []},
        "heavy": {
            "problem": "track", "guard": "adapt", "x0": [0.0, 0.0], "broken_s": 2.0,
            "faults": [
                {"target": "plant_mass", "value": 1.5, "start": 2.0, "end": 2.6},
                {"target": "plant_mass", "value": 1.5, "start": 4.6, "end": None},
            ],
        },
        "frozen": {
            "problem": "track", "guard": "adapt", "x0": [0.0, 0.0], "broken_s": 3.0,
            "faults": [{"target": "measurement_freeze", "value": 0.0, "start": 3.0, "end": 3.5}],
        },
        "delayed": {
            "problem": "track", "guard": None, "x0": [0.0, 0.0], "faults": [],
            "sensor_delay": 1, "input_delay": 2, "late": [50, 51, 52, 53, 54, 55, 56, 120],
        },
    },
    "unbalanced_disk": {
        # upright, what an encoder's step hides grows threefold in five periods: the loop is held as long as it is one
        "swing_up": {"problem": "swing_up", "guard": "limit", "x0": [0.0, 0.0], "faults": [], "held": 90},
        "weak": {
            "problem": "hang", "guard": "limit", "x0": [0.0, 0.0], "broken_s": 3.0,
            "faults": [
                {"target": "input_offset", "value": 0.7, "start": 3.0, "end": 3.5},
                {"target": "measurement_freeze", "value": 0.0, "start": 5.2, "end": 5.5},
            ],
        },
    },
}  # fmt: skip
PROBLEMS = {
    "golf_robot": {"track": "track_sine", "stroke": "stroke_1.4"},
    "unbalanced_disk": {"swing_up": "swing_up", "sway": "track_up", "hang": "track_down"},
}
SQP = {
    "golf_robot": {
        "track": {"problem": "track", "y0": [0.0], "guess": None},
        "far": {"problem": "track", "y0": [0.4], "guess": None},
        "stroke": {"problem": "stroke", "y0": [0.02], "guess": "first/stroke"},
    },
    "unbalanced_disk": {
        "swing_up": {"problem": "swing_up", "y0": [0.02], "guess": "first/swing_up"},
        "hang": {"problem": "hang", "y0": [0.3], "guess": None},
    },
}
GUARDS = {
    # of the one the quiet time decides when the guard goes back, of the other the shortest time in a mode
    "golf_robot": {
        "groups": {"friction": ["d", "mu"], "mass": ["m", "J"]}, "dwell": 0.5, "quiet": 1.0, "patience": 0.2,
    },
    "unbalanced_disk": {"u_min": [-2.0], "u_max": [2.0], "dwell": 1.5, "quiet": 0.25},
}  # fmt: skip
RUNNERS = {
    "golf_robot": {"problem": "track", "guard": "adapt", "input_delay": 1},
    "unbalanced_disk": {"problem": "hang", "guard": "limit", "input_delay": 0},
}
RUNNER = {
    "periods": 100, "deadline": 0.5, "x0": [0.0, 0.0],
    "lost": [20, 21, 22, 60],
    # in periods: a solve past its deadline, one of several periods, a sample after which no solve can be in time
    "slow_solves": {"30": 0.7, "45": 3.3, "80": 0.6},
    "slow_samples": {"70": 0.9},
}  # fmt: skip


def freeze(name, run):
    """The folder of a machine from a finished run: programs, weights, plain numbers, references."""
    from hybrid_mpc import ModelInfo, load, load_scenario, make_estimator, make_ocp
    from hybrid_mpc.compare.controllers import no_surer_than_prior
    from hybrid_mpc.kit.assembly import first_controller
    from hybrid_mpc.kit.parts import read_description

    folder, run = HERE / name, Path(run)
    folder.mkdir(exist_ok=True)
    scenario, artifact = load_scenario(name), load(run / "model")
    balances = read_description(run / "model").model.balances
    shutil.copy(run / "model" / "models" / "weights.safetensors", folder)
    programs = json.loads((run / "model" / "models" / "programs.json").read_text())
    (folder / "programs.json").write_text(json.dumps(programs, separators=(",", ":")) + "\n")
    noise = json.loads((run / "checkpoints" / "control.json").read_text())["sigma_x"]
    noise = {key: np.asarray(values) for key, values in noise.items()}
    sigma_x = no_surer_than_prior(scenario, noise)["hybrid_observer"]
    hybrid, prior, control = artifact.models["hybrid"], artifact.models["prior"], scenario.control
    observer = make_estimator(hybrid, control, sigma_x)
    deviations = [np.sqrt(f.noise[0]) for f in observer.filters]
    first = np.sqrt(np.diag(observer.filters[0].start(np.zeros(hybrid.n_y)).P))
    n_x, n_u = hybrid.n_x, hybrid.n_u
    tasks = {task.name: task for task in scenario.tasks}
    problems, arrays = {}, {}
    for short, task_name in PROBLEMS[name].items():
        task = tasks[task_name]
        spec = task.control or control
        ocp = make_ocp(prior, spec)
        x_work, u_work = ocp.working_point
        values = {key: plain(getattr(spec, key)) for key in parts.OPTIONAL}
        values |= {
            key: plain(getattr(ocp, key)) for key in ("horizon", "q", "r", "r_delta", "u_min", "u_max")
        }
        values |= {
            "x_work": plain(x_work),
            "u_work": plain(u_work),
            "terminal": plain(ocp.terminal_weight(hybrid)),
        }
        problems[short] = values
        t = hybrid.dt * np.arange(PERIODS + spec.horizon + 1)
        arrays[f"reference/{short}"] = task.reference(t)
        if task.weight is not None:
            arrays[f"weight/{short}"] = task.weight(t)
        solver, rest = first_controller(hybrid, ocp, spec), observer.start(np.array(task.x0)[: hybrid.n_y])
        weight = None if task.weight is None else task.weight(t)
        arrays[f"first/{short}"] = solver.solve(solver.initial(rest), rest, task.reference(t), weight).u
    data = {
        "made": {"commit": commit(), **made_from(run)},
        "model": plain(
            ModelInfo(
                hybrid.dt, hybrid.states, hybrid.inputs, hybrid.outputs, hybrid.parameters, artifact.input_delay,
                hybrid.time_unit, hybrid.disturbances, hybrid.nominal_w, hybrid.covariance, balances,
            )
        ),
        "models": list(artifact.models),
        "limits": plain(artifact.limits("hybrid", "energy")),
        "observer": {
            "sigma_y": plain(control.estimator_sigma), "sigma_x0": plain(first[:n_x]), "sigma_d0": plain(first[-n_u:]),
            "modes": [{"sigma_x": plain(s[:n_x]), "sigma_d": plain(s[-n_u:])} for s in deviations],
            "transition": plain(observer.transition),
        },
        "input_range": plain(control.input_range),
        "problems": problems,
        "replays": REPLAYS[name],
        "loops": LOOPS[name],
        "sqp": SQP[name],
        "guard": GUARDS[name],
        "runner": RUNNER | RUNNERS[name],
    }  # fmt: skip
    (folder / "golden.json").write_text(json.dumps(data, indent=1) + "\n")
    save(folder / "arrays.npz", arrays)


GIVEN = ("reference", "weight", "first")


def make_arrays(name, target=None):
    """Replays recorded, and everything that is held of them and of the closed loops.

    With ``target`` nothing is recorded anew: it says what kernels and loops make of the frozen inputs here.
    """
    m = machine(name)
    if target is None:
        given = {key: value for key, value in m.arrays.items() if key.partition("/")[0] in GIVEN}
        m.arrays.clear()
        m.arrays.update(given)
        record_inputs(m)
    arrays, notes = results(m)
    target = Path(target) if target else m.folder / "arrays.npz"
    save(target, {key: m.arrays[key] for key in m.arrays if key.partition("/")[0] in GIVEN} | arrays)
    (target.with_name("loops.json")).write_text(json.dumps(notes, indent=1) + "\n")


def record_inputs(m):
    """What the kernels are fed with: samples and inputs of recorded loops, estimates, a monitor's numbers."""
    for replay, loop in m.data["replays"].items():
        result = parts.run_loop(Parts(m, loop["problem"], None), loop, seed=0)
        m.arrays[f"{replay}/y"], m.arrays[f"{replay}/u"] = result.y, result.u
        found = parts.estimates(m, replay, "switching")
        m.arrays.update({f"{replay}/switching/{key}": found[key] for key in ("x", "h", "d")})
    found = parts.readings(m)
    m.arrays.update({f"guard/{key}": found[key] for key in ("values", "terms")})


def results(m):
    """All that is held, from the frozen inputs: arrays, and notes that are words and counts."""
    arrays, notes = {}, {"switches": {}}

    def add(prefix, found):
        arrays.update({f"{prefix}/{key}": np.asarray(value) for key, value in found.items()})

    for replay in m.data["replays"]:
        add(replay, {key: m.arrays[f"{replay}/{key}"] for key in ("y", "u")})
        add(f"{replay}/switching", parts.estimates(m, replay, "switching"))
        add(f"{replay}/decide", parts.decisions(m, replay))
    add(f"{m.replay}/single", parts.estimates(m, m.replay, "single"))
    add("guard", parts.readings(m))
    add("detector", parts.detections(m))
    add("model", parts.model_values(m))
    for case in m.data["sqp"]:
        add(f"sqp/{case}", parts.converged(m, case))
    for name, loop in m.data["loops"].items():
        result = parts.run_loop(Parts(m, loop["problem"], loop["guard"]), loop, seed=0)
        add(f"loop/{name}", parts.loop_values(result))
        notes["switches"][name] = parts.switches_of(result)
    found, notes["runner"] = parts.run_real_time(m)
    add("runner", found)
    return arrays, notes


def make_costs(name, target=None):
    """Costs, alarms, detections and switches of ten seeds of every closed loop."""
    m = machine(name)
    found = {loop_name: parts.paired(m, loop_name, range(SEEDS)) for loop_name in m.data["loops"]}
    target = Path(target) if target else m.folder / "costs.json"
    target.write_text(json.dumps(found, indent=1) + "\n")


def compare(first, second):
    """Largest difference of every array, as a share of its largest value."""
    a, b = (np.load(path, allow_pickle=False) for path in (first, second))
    print("only in one:", sorted(set(a.files) ^ set(b.files)))
    for key in a.files:
        if a[key].dtype.kind == "U" or a[key].dtype.kind == "i":
            if not np.array_equal(a[key], b[key]):
                print(f"{key}: {int(np.sum(a[key] != b[key]))} of {a[key].size} differ")
            continue
        off = np.nanmax(np.abs(a[key] - b[key]), initial=0.0)
        if off or not np.array_equal(np.isnan(a[key]), np.isnan(b[key])):
            print(f"{key}: {off / np.nanmax(np.abs(a[key])):.1e} of {np.nanmax(np.abs(a[key])):.3g}")


def save(path, arrays):
    """An ``.npz`` that is the same bytes for the same numbers: no times of day in it."""
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED, compresslevel=9) as archive:
        for name in sorted(arrays):
            content = BytesIO()
            np.save(content, np.asarray(arrays[name]), allow_pickle=False)
            archive.writestr(zipfile.ZipInfo(f"{name}.npy"), content.getvalue(), zipfile.ZIP_DEFLATED, 9)


def made_from(run):
    """What a run was made from; of its recordings the names alone."""
    settings = json.loads((run / "run.json").read_text())["settings"]
    kept = {key: settings[key] for key in ("scenario", "seed", "budget")}
    return kept | {"data": [file["name"] for file in settings["data"]]}


def commit():
    """The repository's commit."""
    found = subprocess.run(["git", "rev-parse", "HEAD"], cwd=HERE, capture_output=True, text=True, check=True)
    return found.stdout.strip()


COMMANDS = {
    "freeze": freeze, "arrays": make_arrays, "costs": make_costs,
    "compare": compare,
}  # fmt: skip

if __name__ == "__main__":
    if len(sys.argv) < 3 or sys.argv[1] not in COMMANDS:
        sys.exit(__doc__)
    COMMANDS[sys.argv[1]](*sys.argv[2:])
