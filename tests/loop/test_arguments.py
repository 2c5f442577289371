"""What a driver hands to a loop: a wrong kind is refused before anything changes, no value raises."""

import numpy as np
import pytest
from online_models import make_filter, pendulum_model

from hybrid_mpc import OCP, CondensedController, Loop
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
    np.nan,
    np.inf,
    -np.inf,
    10**400,
    -(10**400),
    1e300,
    True,
    np.float32(0.1),
    np.int8(3),
    np.ma.masked,
]


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
