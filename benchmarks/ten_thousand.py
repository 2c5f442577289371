"""10,000 periods of eleven machines: the exported C beside Python's loop with observer, MPC, monitor and guard.

    python benchmarks/ten_thousand.py [--periods 10000] [--only tanks] [--out FILE.json]

Golf robot and disk are those of ``tests/golden`` with their trained networks. The others are priors with nominal
parameters and small networks with random weights of several kinds; the tanks' sensor is bent. One more loop tracks
parameters and the share of its network. Each loop begins alike, tracks the machine's task over and over, and has a
frozen sensor and an input that is off. C gets Python's samples and the inputs that acted there: without these it would
be a controller whose input nobody applies, and one with integral action adds rounding up. "own" is the largest
difference of the input, of its range, of C that goes on from its own plans after the first, "handed" that of C that
goes on from Python's plan in each period; "state" and "reading" are those of the estimate and of the monitor in the
first of the two. The script ends with an error where an alarm, a mode, a source or a status differs in any period.
"""

from __future__ import annotations

import sys
import tempfile
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path

import casadi as ca
import numpy as np
from parts import arguments, report
from replay import of_prior

sys.path.extend(str(Path(__file__).parents[1] / "tests" / name) for name in ("embedded", "golden", "."))

import replay_parts as replays
import torch
from golden_parts import Parts, machine
from replay_parts import Case, Whole, replay
from test_network_layers import Cells, Deep

from hybrid_mpc import (
    OCP,
    CondensedController,
    Fault,
    Monitor,
    ResidualReadings,
    SafeController,
    learn_limits,
    load_scenario,
)
from hybrid_mpc.control.sizes import Sizes
from hybrid_mpc.estimate.tracking import TrackedParameter, TrackingFilter, with_tracked
from hybrid_mpc.kit.assembly import make_estimator, make_ocp, make_resting_guard
from hybrid_mpc.model.blend import BLEND_SHARE, blended, with_share
from nn_export import to_casadi

nn = torch.nn
SHARE = 0.002
"""Of a state's size that a random network corrects in a period, at most."""


@dataclass(frozen=True)
class Machine:
    """What a loop is made of beside the scenario: its network, its task or reference, the input that gives less."""

    name: str
    network: Callable[[], torch.nn.Module]
    task: str = ""
    reference: Callable | None = None
    control: OCP | None = None
    sigma: float = 1e-3
    periods: int = 10_000
    parameters: tuple[tuple[str, float], ...] = ()
    load: float = 0.02
    load_observer: bool = True
    learned: int = 300
    tracked: tuple[TrackedParameter, ...] = ()  # and the share of the network's correction


def sine(*columns):
    """States that move as sines: amplitude, frequency [rad/s]; each with its rate of change."""

    def reference(t):
        return np.column_stack([v for a, f in columns for v in (a * np.sin(f * t), a * f * np.cos(f * t))])

    return reference


def gru(n=8):
    """One cell."""
    return lambda: Cells(nn.GRUCell, n)


def with_network(model, ocp, net, seed=0):
    """A model whose next state a network corrects; what it sees are deviations from the operating point by size."""
    size, span = Sizes(model, ocp).states, ocp.input_scale
    features = model.n_x + model.n_u
    torch.manual_seed(seed)
    inner = net().double().eval()
    enter = torch.nn.Linear(features, 4).double()
    head = torch.nn.Linear(1, model.n_x).double()

    class Whole(nn.Module):
        def __init__(self):
            super().__init__()
            self.enter, self.inner, self.head = enter, inner, head

        def forward(self, s, h):
            y, h = self.inner(torch.tanh(self.enter(s)), h)
            return torch.tanh(self.head(y)), h

    n_h = inner.hidden
    f = to_casadi(Whole(), (torch.zeros(features, dtype=torch.double), torch.zeros(n_h, dtype=torch.double)))
    x, h, u, w, p = (
        ca.MX.sym(k, n)
        for k, n in zip("xhuwp", (model.n_x, n_h, model.n_u, model.n_w, model.n_p), strict=True)
    )
    seen = ca.vertcat((x - model.x0) / size, (u - model.u0) / span)
    extra, h_next = f(seen, h)
    none = ca.MX(0, 1)
    x_next = model.step(x, none, u, w, p)[0] + SHARE * size * extra
    rates = model.xdot(x, none, u, w, p) + SHARE * size / model.dt * extra
    functions = {
        "step": ca.Function("step", [x, h, u, w, p], [x_next, h_next]),
        "xdot": ca.Function("xdot", [x, h, u, w, p], [rates]),
    }
    return replace(model, name="hybrid", with_jacobian=None, side_by_side=None, **functions)


def watched(case, model, weak, learned=300):
    """The case with residuals whose limits are learned in loops without faults, a guard that rests, and faults."""
    nominal = [replays.run(replace(case, seed=50 + i, periods=learned))[1] for i in range(2)]
    readings = ResidualReadings(model)
    limits = learn_limits(readings, case.estimator, nominal)
    t = case.periods * model.dt
    faults = (
        replays.freezes(0.96 * t, 0.965 * t, model.outputs[0].name),
        Fault(0.3 * t, 0.35 * t, "input_offset", weak, model.inputs[0].name),
    )
    guard = make_resting_guard(model) if case.safe.safe_input is not None else None
    return replace(case, monitor=Monitor(readings, limits), guard=guard, faults=faults)


def stored(m: Machine, periods):
    """A machine of the golden tests."""
    g = machine(m.name)
    estimator, safe, _, _ = Parts(g, m.task, None).made
    model, ocp = safe.controller.model, safe.controller.ocp
    case = Case(estimator, safe, None, None, load_scenario(m.name).plant(), m.reference, model.x0, periods)
    return watched(case, model, m.load * ocp.input_range[0])


def made(m: Machine, periods):
    """A prior with a random network, in the loop of its scenario's task."""
    changes = {} if m.control is None else {
        "control": m.control, "sensor_sigma": (m.sigma,),
        "safe_input": tuple(np.clip(0.0, m.control.u_min, m.control.u_max)),
    }  # fmt: skip
    scenario, kit = of_prior(m.name, **changes)
    prior = kit.models["prior"]
    if m.parameters:
        own = dict(m.parameters)
        p = tuple(replace(q, value=own.get(q.name, q.value)) for q in prior.parameters)
        prior = replace(prior, parameters=p)
    ocp = make_ocp(prior, kit.problem(m.task))
    model = with_network(prior, ocp, m.network)
    if m.tracked:
        model, prior = blended(prior, model), with_share(prior)
    estimator = make_estimator(model, kit, kit.noise("prior_observer"), ocp, observer=m.load_observer)
    if m.tracked:
        estimator = TrackingFilter(estimator, (*m.tracked, TrackedParameter(BLEND_SHARE.name, 0.3)))
        model, prior = estimator.model, with_tracked(prior, estimator.tracked)
    safe = SafeController(CondensedController(model, ocp), prior, safe_input=kit.safe_input)
    plant = replays.MachinePlant(prior, sigma=m.sigma) if scenario.plant is None else scenario.plant()
    reference, x0, w = m.reference, model.x0, None
    if reference is None:
        task = next(t for t in scenario.tasks if t.name == m.task)
        reference, x0 = (lambda t: task.reference(np.mod(t, task.duration))), np.array(task.x0)
        w = None if task.w is None else (lambda t: task.w(np.mod(t, task.duration)))
    case = Case(estimator, safe, None, None, plant, reference, x0, min(periods, m.periods), w=w)
    return watched(case, model, m.load * ocp.input_range[0], m.learned)


EMPS = OCP(40, [2.5e3, 25.0], [1e-3], [1e-3], [-150.0], [150.0])
SERVO = OCP(40, [25.0, 0.25], [1.0, 1.0, 1.0], [4.0, 4.0, 4.0], [-1.0, 11.0, 0.9], [1.0, 12.5, 1.0])
MACHINES = (
    Machine("golf_robot", gru(), "track", sine((0.6, 2.0))),
    Machine("unbalanced_disk", gru(), "hang", sine((0.5, 3.0))),
    Machine("cascaded_tanks", gru(), "levels", parameters=(("bend", 0.05),)),
    Machine("temperature_lab", lambda: Cells(nn.LSTMCell, 8), "set_points"),
    Machine("heat_exchanger", lambda: Cells(nn.GRUCell, 8, 6), "saw_tooth_ahead", load_observer=False),
    Machine("cart_pole", gru(), "move"),
    Machine("race_car", lambda: Cells(nn.RNNCell, 8), "slalom", periods=320),
    Machine("coupled_drives", lambda: Deep(8, 12), "speeds"),
    Machine("emps", gru(), reference=sine((0.1, 2.0)), control=EMPS, sigma=1e-5, learned=1500),
    Machine(
        "xl330_pendulum", gru(), reference=sine((0.8, 2.0)), control=SERVO, learned=1500, load_observer=False
    ),
    Machine(
        "temperature_lab",
        gru(16),
        "set_points",
        tracked=(TrackedParameter("P1", 0.15, relative=True), TrackedParameter("tau", 0.2, relative=True)),
    ),
    Machine("torque_pendulum", gru(), reference=sine((0.25, 2.0))),
)


def main() -> None:
    """Run and print."""
    parser = arguments(__doc__)
    parser.add_argument("--periods", type=int, default=10_000)
    parser.add_argument("--only", default="", help="machines whose name holds this")
    given = parser.parse_args()
    rows = []
    for m in MACHINES:
        if given.only not in m.name:
            continue
        case = (stored if m.name in ("golf_robot", "unbalanced_disk") else made)(m, given.periods)
        told = {"own": [], "handed": []}
        with tempfile.TemporaryDirectory() as folder:
            whole = Whole(Path(folder), case, [*replays.SHARED[:1], "-O2", *replays.SHARED[2:]])
            for seed in range(max(1, given.periods // case.periods)):
                loop = replace(case, seed=seed)
                known = replays.run(loop)
                for how, found in told.items():
                    found.append(replay(whole, loop, own=how == "own", known=known))
        own = told["own"]
        rows.append(
            {
                "machine": m.name + (", blended and tracked" if m.tracked else ""),
                "periods": sum(t.periods for t in own), "with alarm": sum(t.alarms for t in own),
                "modes": " ".join(dict.fromkeys(n for t in own for n in t.modes)),
                "sources": " ".join(dict.fromkeys(n for t in own for n in t.sources)),
                "own": max(t.input for t in own), "handed": max(t.input for t in told["handed"]),
                "state": max(t.estimate for t in own), "reading": max(t.reading for t in own),
                "beyond 1e-9 from": max(t.wide for t in own),
            }
        )  # fmt: skip
        print(rows[-1], flush=True)
    report(rows, given.out, periods=sum(row["periods"] for row in rows))


if __name__ == "__main__":
    main()
