"""Makes the golden files. README.md says when, and what in them is not the same every time.

make_golden.py arrays MACHINE [FILE]  arrays.npz and loops.json: replays, kernels and closed loops
make_golden.py costs MACHINE [FILE]   costs.json: ten seeds of every closed loop
make_golden.py compare FILE FILE      largest differences between two arrays.npz
"""

from __future__ import annotations

import json
import sys
import zipfile
from io import BytesIO
from pathlib import Path

import golden_parts as parts
import numpy as np
from golden_parts import Parts, machine

SEEDS = 10
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


COMMANDS = {"arrays": make_arrays, "costs": make_costs, "compare": compare}

if __name__ == "__main__":
    if len(sys.argv) < 3 or sys.argv[1] not in COMMANDS:
        sys.exit(__doc__)
    COMMANDS[sys.argv[1]](*sys.argv[2:])
