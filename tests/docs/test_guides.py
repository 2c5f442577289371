"""The code that the guides show runs, from top to bottom, and gives what the text beside it says."""

import importlib.util
import re
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from hybrid_mpc import InputError, load_scenario
from hybrid_mpc.check.preflight import check_scenario
from hybrid_mpc.errors import CODE

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
    return executed("docs/machines.md", blocks("docs/machines.md"))


def test_the_tanks_are_found_though_one_is_not_measured(machines):
    fit, plant = machines["fit"], machines["plant"]
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


@pytest.mark.parametrize("name", ["TwoTanks", "TorchTanks", "Arm", "RubbingArm", "Pendulum", "Loaded"])
def test_every_prior_of_the_guide_passes_the_preflight(machines, name):
    prior, scenario = machines[name], machines["scenario"]
    if name != "TwoTanks":  # other columns, and no control problem
        columns = {key: tuple(s.name for s in getattr(prior, key)) for key in ("inputs", "outputs")}
        data = replace(scenario.data, **columns, **({} if "Tanks" in name else {"dt": 0.01, "warm_up": 1.0}))
        scenario = replace(scenario, prior=prior, data=data, control=None, sensor_sigma=(), first_sigma=None)
    check_scenario(scenario)


def test_what_is_refused_is_refused_in_the_words_of_the_guide(machines):
    tanks, ca, balance = machines["TwoTanks"], machines["ca"], machines["Balance"]

    class Root(tanks):
        def flows(self, x, p):
            return p.k_upper * ca.sqrt(x.upper), p.k_lower * ca.sqrt(x.lower)

    class Sign(tanks):
        def balances(self, x, u, w, p):
            volume = p.area * (x.upper + x.lower)
            return (balance("volume", volume, -u.pump, self.flows(x, p)[1], "m^3", "m^3/s"),)

    page = " ".join((ROOT / "docs/machines.md").read_text().split())
    for wrong in (Root, Sign):
        with pytest.raises(InputError) as told:
            check_scenario(replace(machines["scenario"], prior=wrong))
        assert CODE.sub("", str(told.value)).strip() in page


@pytest.mark.full
def test_the_guide_to_the_fit():
    found = executed("docs/prior-fit.md", blocks("docs/prior-fit.md"))
    assert found["fit"].identifiability == ()
    assert any("F_c" in line and "bound" in line for line in found["again"].identifiability)
    assert any("F_c may be zero" in line for line in found["again"].identifiability)


@pytest.fixture(scope="module")
def what_fits():
    spec = importlib.util.spec_from_file_location("what_fits", ROOT / "benchmarks" / "what_fits.py")
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


@pytest.fixture(scope="module")
def own():
    return executed("docs/own-machine.md", blocks("docs/own-machine.md"))


def test_every_prior_of_ones_own_machine_passes_the_preflight(own):
    kinds = {
        name: kind for name, kind in own.items() if isinstance(kind, type) and issubclass(kind, own["Prior"])
    }
    del kinds["Prior"], kinds["MechanicalPrior"], kinds["TorchPrior"], kinds["Wrong"]
    assert len(kinds) == 7
    for prior in kinds.values():
        columns = {
            key: tuple(s.name for s in getattr(prior, key)) for key in ("inputs", "outputs", "disturbances")
        }
        dt = 0.02 if prior is own["Crane"] else 5.0
        data = replace(own["data"], **columns, dt=dt, warm_up=12 * dt)
        check_scenario(replace(own["tank"], prior=prior, data=data))
    with pytest.raises(InputError, match="HM-CHECK-015"):
        check_scenario(replace(own["tank"], prior=own["Wrong"]))
    leaking = replace(own["scenario"], disturbance_model=own["leak"], data=own["delayed"])
    check_scenario(leaking)
    tank, other = own["Tank"](), own["TorchTank"]()
    point = [0.3], [5.0], []
    assert float(tank.equations.xdot(*point, tank.p)) == pytest.approx(
        float(other.equations.xdot(*point, other.p)), rel=1e-12
    )


@pytest.mark.full
def test_what_does_not_fit_is_refused_as_the_page_says(what_fits):
    """The cases of benchmarks/what_fits.py, whose words the page sums up."""
    for prior in what_fits.REFUSED.values():
        with pytest.raises(InputError):
            check_scenario(what_fits.machine(prior))
    check_scenario(what_fits.machine(what_fits.Base))  # it is what each case adds that is refused
    check_scenario(what_fits.machine(what_fits.rod(5), 2.0))
    with pytest.raises(InputError, match="no output tells of"):
        check_scenario(what_fits.machine(what_fits.rod(20), 2.0))


def test_the_machines_of_the_readme():
    sources = [source for source in blocks("README.md") if re.search(r"^class ", source, re.MULTILINE)]
    assert len(sources) == 1  # a tank
    check_scenario(executed("README.md", sources)["scenario"])
    assert len(sources[0].splitlines()) <= 25
    check_scenario(load_scenario(str(ROOT / "docs/examples/my_machine.py")))
