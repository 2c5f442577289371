"""Stage track: off without --track; with it the parameters that vary are found and observer.json names the tracked."""

import numpy as np
import pytest

import hybrid_mpc as hm
from hybrid_mpc.workflow.context import Context
from hybrid_mpc.workflow.settings import RunSettings
from hybrid_mpc.workflow.stage import Absent, bring_up_to_date
from hybrid_mpc.workflow.stages.identify import DATA, PRIOR
from hybrid_mpc.workflow.stages.report import _varying_table
from hybrid_mpc.workflow.stages.track import TRACK

DT = 0.1


class Heater(hm.Prior):
    states = (hm.Signal("heat", "K", -20.0, 20.0),)
    inputs = (hm.Signal("power", "W", -5.0, 5.0),)
    outputs = states
    parameters = (hm.Parameter("gain", 2.0, "K/W", 0.2, 10.0), hm.Parameter("tau", 1.0, "s", 0.1, 10.0))
    operating_point = hm.OperatingPoint(x=(0.0,), u=(0.0,))

    def xdot(self, x, u, w, p):
        return ((p.gain * u.power - x.heat) / p.tau,)


scenario = hm.Scenario(
    "heater", "", "", prior=Heater, sensor_sigma=(0.01,),
    control=hm.OCP(20, [0.0], [0.1], [0.1], [-5.0], [5.0], q_y=[1.0]),
    data=hm.DataSpec("t", ("power",), ("heat",), dt=DT, max_gap=DT, smoothing=DT, warm_up=2.0, free_run=4.0),
    budgets={"quick": hm.Budget(4, 1, 0, 10, seeds=1)},
)  # fmt: skip


@pytest.fixture(scope="module")
def files(tmp_path_factory):
    folder, rng, found = tmp_path_factory.mktemp("days"), np.random.default_rng(0), []
    for day, gain in enumerate((1.5, 1.8, 2.1, 2.6)):
        n = 400
        u = np.repeat(rng.uniform(-2.0, 2.0, n // 8), 8)
        x, a = np.zeros(n), np.exp(-DT)
        for k in range(n - 1):
            x[k + 1] = a * x[k] + (1 - a) * gain * u[k]
        y = x + 0.01 * rng.standard_normal(n)
        path = folder / f"day{day}.csv"
        np.savetxt(
            path, np.column_stack([np.arange(n) * DT, u, y]), delimiter=",", header="t,power,heat", comments="",
            fmt="%.6f",
        )  # fmt: skip
        found.append(path)
    return tuple(found)


def context_of(files, out, track):
    context = Context(RunSettings(__file__, files, track=track), scenario, out)
    for stage in (DATA, PRIOR, TRACK):
        bring_up_to_date(context, stage)
    return context


def test_the_stage_finds_what_varies_and_is_then_up_to_date(files, tmp_path):
    context = context_of(files, tmp_path, track=True)
    found = context.read(TRACK)
    assert found.varying.names == ("gain",)
    assert found.varying.pieces == 4
    assert "gain" in [one.name for one in found.tracking.tracked]
    assert found.tracking.ratio["heat"] < 0.97
    assert any("HM-IDENTIFY-082" in one for one in context.prior.fit.warnings)  # said before any tracking
    assert bring_up_to_date(context, TRACK) == "up to date"
    rows = _varying_table(found).rows
    assert [row[0] for row in rows] == ["gain [K/W]", "tau [s]"]
    assert "%, drift" in rows[0][-1]


def test_without_the_option_nothing_is_searched(files, tmp_path):
    context = context_of(files, tmp_path, track=False)
    assert isinstance(context.find(TRACK), Absent)
