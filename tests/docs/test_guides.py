"""The code that the guides show runs, from top to bottom, and gives what the text beside it says."""

import importlib.util
import os
import re
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import casadi as ca
import numpy as np
import pytest

from hybrid_mpc import (
    OCP,
    DataSpec,
    InputError,
    Parameter,
    Scenario,
    Trajectory,
    extended,
    fit_prior,
    load_scenario,
    random_steps,
    terms,
)
from hybrid_mpc.check.preflight import check_scenario

ROOT = Path(__file__).parents[2]


def blocks(page):
    """The Python examples of a page."""
    return re.findall(r"^```python\n(.*?)^```", (ROOT / page).read_text(), re.DOTALL | re.MULTILINE)


def executed(page, sources):
    """What is defined after some examples of a page have run in one namespace."""
    namespace = {"__name__": "example"}
    for source in sources:
        exec(compile(source, page, "exec"), namespace)
    return namespace


@pytest.fixture(scope="module")
def machines():
    """What the pages on priors and plants define."""
    pages = ("docs/writing-a-prior.md", "docs/mechanical-priors.md", "docs/plant.md")
    return {name: value for page in pages for name, value in executed(page, blocks(page)).items()}


@pytest.fixture(scope="module")
def tanks(machines):
    """The two tanks of the guide with a plant of their own, whose upper level nothing measures."""
    return Scenario(
        "tanks", "Two tanks", "", prior=machines["TwoTanks"], plant=machines["TankPlant"], tasks=(machines["fill"],),
        data=DataSpec("time_s", ("pump",), ("lower_m",), dt=2.0, max_gap=5.0, smoothing=20.0, warm_up=60.0),
        control=OCP(30, q=(0.0, 0.0), r=(1e5,), r_delta=(1e6,), u_min=(0.0,), u_max=(3e-4,), q_y=(10.0,)),
        sensor_sigma=(1e-3,), first_sigma=(0.05,), safe_input=(0.0,),
    )  # fmt: skip


def test_the_tanks_are_found_though_one_is_not_measured(machines):
    """Half an hour of the prior itself with other outlets and 1 mm of noise."""
    prior = machines["TwoTanks"]
    plant, dt = prior({"k_upper": 2.4e-4, "k_lower": 1.7e-4}), 2.0
    x, u = ca.SX.sym("x", 2), ca.SX.sym("u")
    rates = ca.Function("rates", [x, u], [plant.equations.xdot(x, u, ca.SX(0, 1), plant.p)])
    step = ca.simpleRK(rates, 1, 4)

    def recorded(role, seed):
        rng, t = np.random.default_rng(seed), dt * np.arange(900)
        pump = random_steps(t, 5e-5, 1.5e-4, hold=(60.0, 300.0), rng=rng)[:, None]
        levels = [np.array([0.2, 0.3])]
        for k in range(len(t) - 1):
            levels.append(step(levels[-1], pump[k], dt).full().ravel())
        y = np.array(levels)[:, 1:] + 1e-3 * rng.standard_normal((len(t), 1))
        unknown = np.zeros((len(t), 2))  # states and their rates: the fit finds them
        return Trajectory(f"{role}{seed}", role, dt, t, pump, y, unknown, unknown)

    fit = fit_prior(prior, [recorded("train", 0)], [recorded("valid", 1)], dt=dt)
    for name in ("k_upper", "k_lower"):
        # half an hour at 1 mm of noise: standard errors are a thousandth of the values
        assert abs(fit.values[name] - plant.values[name]) < 5 * fit.standard_errors[name]
        assert fit.standard_errors[name] < 0.005 * plant.values[name]
    assert fit.identifiability == ()


def test_the_tanks_in_torch_are_the_same(machines):
    one, other = machines["TwoTanks"](), machines["TorchTanks"]()
    x, u = np.random.default_rng(0).uniform(0.0, 1.0, (2, 20)), np.full((1, 20), 1e-4)
    rates = [prior.equations.xdot(x, u, [], prior.p).full() for prior in (one, other)]
    np.testing.assert_allclose(rates[0], rates[1], rtol=1e-12)  # the same operations, rounded alike


@pytest.mark.parametrize(
    "name", ["TwoTanks", "TorchTanks", "Sensed", "Arm", "RubbingArm", "Pendulum", "Loaded"]
)
def test_every_prior_of_the_guide_passes_the_preflight(machines, tanks, name):
    prior, scenario = machines[name], tanks
    if name != "TwoTanks":  # other columns, and no control problem
        columns = {key: tuple(s.name for s in getattr(prior, key)) for key in ("inputs", "outputs")}
        process = {"TorchTanks", "Sensed"}
        data = replace(scenario.data, **columns, **({} if name in process else {"dt": 0.01, "warm_up": 1.0}))
        scenario = replace(
            scenario,
            prior=prior,
            data=data,
            plant=None,
            tasks=(),
            control=None,
            sensor_sigma=(),
            first_sigma=None,
        )
    check_scenario(scenario)


def test_a_root_without_a_floor_and_a_wrong_sign_of_a_supply_are_refused(machines, tanks):
    good, balance = machines["TwoTanks"], machines["Balance"]

    class Root(good):
        def flows(self, x, p):
            return p.k_upper * ca.sqrt(x.upper), p.k_lower * ca.sqrt(x.lower)

    class Sign(good):
        def balances(self, x, u, w, p):
            volume = p.area * (x.upper + x.lower)
            return (balance("volume", volume, -u.pump, self.flows(x, p)[1], "m^3", "m^3/s"),)

    with pytest.raises(InputError, match="HM-CHECK-051"):
        check_scenario(replace(tanks, prior=Root, plant=None, tasks=()))
    with pytest.raises(InputError, match="HM-CHECK-057"):
        check_scenario(replace(tanks, prior=Sign, plant=None, tasks=()))


@pytest.mark.full
def test_the_guide_to_the_fit():
    found = executed("docs/prior-fit.md", blocks("docs/prior-fit.md"))
    assert found["fit"].identifiability == ()
    prior, dry = found["PendulumPrior"], Parameter("F_c", 0.01, "N m", 0.0, 0.1)
    again = fit_prior(
        extended(prior, terms.coulomb("phi_dot", dry, width=0.05)), found["train"], found["valid"], dt=0.01
    )
    assert any("F_c" in line and "bound" in line for line in again.identifiability)
    assert any("F_c may be zero" in line for line in again.identifiability)


@pytest.fixture(scope="module")
def what_fits():
    spec = importlib.util.spec_from_file_location("what_fits", ROOT / "benchmarks" / "what_fits.py")
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def test_the_tank_of_the_guide_is_the_one_in_its_file():
    """The page shows parts of docs/examples/tank.py; the whole of it passes."""
    page = [source for source in blocks("docs/own-machine.md") if "runs/tank" not in source]
    shown = executed("docs/own-machine.md", page)
    whole = load_scenario(str(ROOT / "docs/examples/tank.py"))
    assert (shown["scenario"].data, shown["scenario"].control) == (whole.data, whole.control)
    one, other = shown["Tank"](), whole.prior()
    point = [0.3], [5.0], []
    assert float(one.equations.xdot(*point, one.p)) == float(other.equations.xdot(*point, other.p))
    assert one.parameters == other.parameters
    check_scenario(whole)


def test_the_way_from_a_recording_to_a_fit(tmp_path):
    """The first commands of docs/own-machine.md, in their order."""
    python = {"cwd": tmp_path, "capture_output": True, "text": True, "check": True}
    subprocess.run([sys.executable, ROOT / "docs/examples/tank_record.py"], **python)
    page, head = (ROOT / "docs/own-machine.md").read_text(), (tmp_path / "monday.csv").read_text()[:40]
    assert "\n".join(head.splitlines()[:3]) in page
    for command in (
        "data monday.csv",
        "new my_tank.py --data monday.csv",
        "check my_tank.py --data monday.csv",
    ):
        assert command.startswith("check") or f"hybrid-mpc {command}" in page
        subprocess.run([sys.executable, "-m", "hybrid_mpc", *command.split()], **python)
    fitted = "check docs/examples/tank.py --data monday.csv --data tuesday.csv --fit"
    assert f"hybrid-mpc {fitted}" in page
    command = fitted.replace("docs/examples", str(ROOT / "docs/examples")).split()
    done = subprocess.run(
        [sys.executable, "-m", "hybrid_mpc", *command], env={**os.environ, "COLUMNS": "110"}, **python
    )
    (line,) = (" ".join(line.split()) for line in done.stdout.splitlines() if re.match(r"k .* 5 to 40", line))
    assert line in " ".join(page.split())


@pytest.mark.full
def test_what_does_not_fit_is_refused_as_the_page_says(what_fits):
    """The cases of benchmarks/what_fits.py, whose words the page sums up."""
    for prior in what_fits.REFUSED.values():
        with pytest.raises(InputError):
            check_scenario(what_fits.machine(prior))
    check_scenario(what_fits.machine(what_fits.Base))  # it is what each case adds that is refused
    check_scenario(what_fits.machine(what_fits.rod(5), 2.0))
    with pytest.raises(InputError, match="HM-IDENTIFY-019"):
        check_scenario(what_fits.machine(what_fits.rod(20), 2.0))


def test_the_comparison_of_the_page_on_seeds():
    found = executed("docs/seeds.md", blocks("docs/seeds.md"))["found"]
    assert f"({found.words!r}, {found.finding!r})" in (ROOT / "docs/seeds.md").read_text()


def test_the_machines_of_the_readme():
    sources = [source for source in blocks("README.md") if re.search(r"^class ", source, re.MULTILINE)]
    assert len(sources) == 1  # a tank
    check_scenario(executed("README.md", sources)["scenario"])
    assert len(sources[0].splitlines()) <= 25
    check_scenario(load_scenario(str(ROOT / "docs/examples/my_machine.py")))
