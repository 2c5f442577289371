"""A small part of the benchmark of unknown machines, with the right values."""

import sys
from pathlib import Path

import numpy as np
import pytest

from hybrid_mpc import fit_prior

sys.path.append(str(Path(__file__).parents[1] / "benchmarks"))
import unknown_machines as own
from unknown.coverage import MACHINES, cramer_rao
from unknown.independent import Runs, cut, fit, free_run_errors
from unknown.motion import MOTION
from unknown.processes import PROCESSES
from unknown.random_priors import drawn

SIMULATED = {machine.name: machine for machine in MACHINES}


@pytest.mark.parametrize("name", ["Swing", "Upright"])
def test_a_stable_and_an_unstable_machine_have_their_true_parameters(name):
    machine = SIMULATED[name]
    runs = [machine.record(40 + i) for i in range(5)]
    parts = tuple(t for t, _ in runs[:3]), (runs[3][0],), (runs[4][0],)
    found = fit_prior(machine.prior, parts[0], parts[1], dt=machine.dt)
    bound = cramer_rao(machine, runs[:3])
    for (key, value), least in zip(machine.truth.items(), bound, strict=True):
        assert abs(found.values[key] - value) < 4 * least, key
        assert 0.7 < found.standard_errors[key] / least < 1.5, key
    sets = [found.values, machine.truth]
    nominal, ours, true = own.judged(machine.prior, parts, machine.dt, machine.length, sets, 4)
    assert ours < 1.05 * true < 0.5 * nominal


def test_the_independent_fit_has_the_true_parameters():
    """What others are compared with must be right itself."""
    machine = SIMULATED["Swing"]
    runs = [machine.record(40 + i)[0] for i in range(4)]
    spread = np.std(np.concatenate([t.y for t in runs]), axis=0)
    model = Runs(machine.prior(), machine.dt, spread)
    found = fit(model, runs[:3], 99, machine.prior().values, 6)
    for key, value in machine.truth.items():
        assert found[key] == pytest.approx(value, rel=0.03), key
    errors = free_run_errors(model, cut(machine.prior(), runs[3:], 99, 4), [found, machine.truth])
    assert errors[0] == pytest.approx(errors[1], rel=0.05)
    assert errors[1] == pytest.approx(machine.noise / spread[0], rel=0.2)


def test_random_priors_are_fitted_or_say_why_not():
    rows = [own.random_row(drawn(seed)) for seed in range(5)]
    assert {row["kind"] for row in rows} <= {"within", "refused", "reason"}
    assert any(row["stable"] for row in rows)
    assert not all(row["stable"] for row in rows)


def test_order_and_units_are_no_matter():
    machine = SIMULATED["Upright"]
    runs = [machine.record(500 + i)[0] for i in range(4)]
    row = own.invariance("Upright", machine.prior, runs[:3], runs[3:], machine.dt)
    assert float(row["order"]) < 1e-6
    assert float(row["units"]) < 1e-6


def test_twelve_machines_half_of_them_processes_a_third_in_closed_loop():
    every = (*PROCESSES, *MOTION)
    assert len(every) == 12
    assert len(PROCESSES) == 6
    assert sum(machine.closed for machine in every) >= 4
    assert sum(not machine.seen for machine in every) == 4
    for machine in every:
        free = {p.name for p in machine.prior.parameters if not p.fixed}
        assert set(machine.truth) <= free
        assert machine.header.split(",")[0] == machine.spec.time
