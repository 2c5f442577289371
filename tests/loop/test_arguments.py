"""What a driver hands to a loop: a wrong kind is refused before anything changes, no value raises."""

import numpy as np
import pytest
from online_models import make_filter, pendulum_model

from hybrid_mpc import OCP, CondensedController, IpoptController, Loop, Runner, SQPController
from hybrid_mpc.errors import InputError
from hybrid_mpc.model.limits import sampled


class Raises:
    def __float__(self):
        raise RuntimeError("no number")

    def __array__(self, dtype=None, copy=None):
        raise RuntimeError("no array")


KINDS = [
    "abc", "1.5", b"1", {}, {"y": 1.0}, set(), object(), Raises(), 1 + 2j, [1 + 2j], [[1.0], [1.0, 2.0]], [None],
    ["1.0"], np.array(["a"]), np.datetime64("2020-01-01"), np.array([1 + 0j]), lambda: 1.0, [Raises()], (),
    [1.0, 2.0, 3.0, 4.0, 5.0], np.zeros((2, 2, 2)),
]  # fmt: skip
VALUES = [
    np.nan, np.inf, -np.inf, 10**400, -(10**400), 1e300, True, np.float32(0.1), np.int8(3), np.ma.masked,
]  # fmt: skip


@pytest.fixture
def loop():
    model = pendulum_model(z=2)
    ocp = OCP(10, [1.0, 0.1], [0.1], [0.01], [-1.0], [1.0])
    made = Loop(make_filter(model), CondensedController(model, ocp))
    made.start([0.1])
    return made


CALLS = {
    "measurement": lambda loop, v: loop.step(v),
    "disturbance": lambda loop, v: loop.step([0.1], v),
    "applied": lambda loop, v: loop.step([0.1], applied=v),
    "reference": lambda loop, v: loop.step([0.1], reference=v),
    "start": lambda loop, v: loop.start(v),
}


@pytest.mark.parametrize("call", CALLS)
def test_a_wrong_kind_is_refused_and_changes_nothing(loop, call):
    for kind in KINDS:
        if call == "disturbance" and isinstance(kind, tuple):  # none, as the model has
            continue
        loop.finish()
        before = loop.state
        with pytest.raises(InputError):
            CALLS[call](loop, kind)
        assert loop.state is before, kind
    assert np.isfinite(loop.step([0.1])).all()


@pytest.mark.parametrize("call", ["measurement", "applied"])
def test_no_value_raises(loop, call):
    for value in VALUES:
        u = CALLS[call](loop, [value])
        assert (np.abs(u) <= 1.0).all()
        assert (np.abs(CALLS[call](loop, value)) <= 1.0).all()  # one output, one input: a number will do


@pytest.mark.parametrize("periods", [2.5, -1, True, "3", None, 1 + 0j, np.nan, [1]])
def test_only_whole_periods_are_skipped(loop, periods):
    with pytest.raises(InputError):
        loop.skip(periods)


@pytest.mark.parametrize("kind", KINDS, ids=lambda kind: type(kind).__name__)
def test_observers_refuse_the_same(kind):
    model = pendulum_model(z=2)
    observer = make_filter(model)
    first = observer.start([0.1])
    for call in (
        observer.start,
        lambda v: observer.update(first, v, [0.0]),
        lambda v: observer.update(first, [0.1], v),
    ):
        with pytest.raises(InputError):
            call(kind)


def test_numbers_of_any_kind_become_floats():
    assert sampled(10**400, (), "y") == np.inf
    assert sampled([-(10**400), 1], (2,), "y").tolist() == [-np.inf, 1.0]
    masked = sampled(np.ma.masked_array([1.0, 2.0], [False, True]), (2,), "y")
    assert masked[0] == 1.0
    assert np.isnan(masked[1])
    given = np.zeros(2)
    assert sampled(given, (2,), "y") is not given


NONE_OF_A_LOOP = [
    np.nan, 3, "abc", b"1", {}, [1.0], object(), Raises(), int, np.zeros(2), lambda: 1.0, 10**400,
]  # fmt: skip
PARTS = ("estimator", "controller", "monitor", "guard")
FUNCTIONS = ("weight", "now", "measure", "actuate", "measure_w", "on_step", "late")
PERIODS = [2.5, -1, True, "3", None, 1 + 0j, np.nan, np.inf, [1], 10**400, np.ma.masked, Raises()]


def parts():
    model = pendulum_model(z=2)
    ocp = OCP(10, [1.0, 0.1], [0.1], [0.01], [-1.0], [1.0])
    return {"estimator": make_filter(model), "controller": CondensedController(model, ocp)}


def loop_of(**given):
    return Loop(**{**parts(), **given})


def runner_of(**given):
    drives = {
        "measure": lambda: [0.1],
        "actuate": lambda u: None,
        "reference": lambda t: np.zeros((len(t), 2)),
    }
    return Runner(**{**parts(), **drives, "safe_input": [0.0], **given})


@pytest.mark.parametrize("part", PARTS)
@pytest.mark.parametrize("make", [loop_of, runner_of])
def test_what_is_no_part_of_a_loop_is_refused_when_it_is_made(make, part):
    for value in NONE_OF_A_LOOP:
        with pytest.raises(InputError):
            make(**{part: value})


@pytest.mark.parametrize(
    ("make", "name"),
    [
        (loop_of, "weight"),
        (loop_of, "now"),
        (runner_of, "weight"),
        *((runner_of, name) for name in FUNCTIONS[2:6]),
        (runner_of, "clock"),
    ],
)
def test_what_cannot_be_called_is_refused_before_the_machine_moves(make, name):
    for value in [np.nan, 3, "abc", {}, [1.0], object(), np.zeros(5), int]:
        with pytest.raises(InputError):
            make(**{name: value})


@pytest.mark.parametrize("make", [loop_of, runner_of])
def test_a_class_is_no_reference(make):
    with pytest.raises(InputError):
        make(reference=int)


@pytest.mark.parametrize("name", ["input_delay", "sensor_delay"])
@pytest.mark.parametrize("make", [loop_of, runner_of])
def test_delays_are_whole_periods(make, name):
    for value in PERIODS:
        with pytest.raises(InputError):
            make(**{name: value})


@pytest.mark.parametrize("name", ["deadline", "keep"])
def test_a_runners_numbers_are_numbers(name):
    for value in ["abc", -1, 0, np.nan, 1 + 0j, [1.0, 2.0], 10**400, Raises(), np.zeros(5)]:
        with pytest.raises(InputError):
            runner_of(**{name: value})


@pytest.mark.parametrize("duration", ["abc", np.nan, np.inf, -1, 1 + 0j, [1.0, 2.0], Raises(), 10**400])
def test_durations_are_numbers(duration):
    with pytest.raises(InputError):
        runner_of().run(duration)


@pytest.mark.parametrize("given", ["abc", None, 1 + 0j, Raises(), [1.0, 2.0]])
def test_what_a_callback_of_a_runner_gives_is_refused_and_the_input_is_safe(given):
    class Clock:
        t, asked = 0.0, 0

        def now(self):
            self.asked += 1
            return self.t if self.asked < 9 or broken != "clock" else given

        def sleep_until(self, t):
            self.t = max(self.t, t)

    for broken in ("clock", "reference"):
        taken = []
        reference = (lambda t: given) if broken == "reference" else (lambda t: np.zeros((len(t), 2)))
        runner = runner_of(
            actuate=lambda u, to=taken: to.append(u[0]), reference=reference, clock=Clock(), safe_input=[0.5]
        )
        with pytest.raises(InputError):
            runner.run(1.0)
        assert taken == [] or taken[-1] == 0.5


def test_a_skip_beyond_all_time_is_refused_and_the_loop_goes_on(loop):
    for n in (10**400, 10**300, np.inf):
        with pytest.raises(InputError):
            loop.skip(n)
    loop.skip(np.int64(3))
    assert np.isfinite(loop.step([0.1])).all()


@pytest.mark.parametrize("iterations", [0, -1, 2.5, "3", np.nan, True, 10**400, np.zeros(2)])
@pytest.mark.parametrize("solver", [CondensedController, SQPController, IpoptController])
def test_iterations_are_a_whole_number(solver, iterations):
    controller = parts()["controller"]
    with pytest.raises(InputError):
        solver(controller.model, controller.ocp, iterations=iterations)
