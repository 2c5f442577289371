"""The search of settings: repeatable, resumable, decided by validation alone, and what it refuses."""

import math
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from simulated_pendulum import SMALL, TRUTH, Pendulum

from hybrid_mpc import InputError, SearchSpace, train, tune
from hybrid_mpc.identify import tune as module
from hybrid_mpc.identify.train import TrainingRun
from hybrid_mpc.identify.tune import parsed_space

BASE = replace(SMALL, hidden=16, batch=32, teacher_steps=200, free_run_steps=200, every=20)
SPACE = SearchSpace(batch=(8, 128))
TOTAL = BASE.teacher_steps + BASE.free_run_steps
PRIOR = Pendulum(TRUTH)
TRIALS = 25


def fake(prior, training, validation, settings, *, on_progress):
    """A training in no time: 1 falls to an end that is best at 20 hidden units and a decay of 1000."""
    end = 0.1 + 0.1 * abs(math.log(settings.hidden / 20)) + 0.05 * abs(math.log(settings.decay / 1000))
    total = settings.teacher_steps + settings.free_run_steps
    for done in range(settings.every, total + 1, settings.every):
        error = end + (1.0 - end) * (1.0 - done / total) ** 2
        on_progress(done, total, error)
    return SimpleNamespace(validation=np.array([error + 0.2, error]))


@pytest.fixture
def quick(monkeypatch):
    """The search alone, trainings in no time."""
    monkeypatch.setattr(module, "train", fake)


def run(data, storage, trials=TRIALS, base=BASE, space=SPACE, **options):
    return tune(PRIOR, *data, base, space, trials=trials, storage=storage, **options)


def core(result):
    """Everything of the trials but how long they took."""
    return [(r.number, r.state, r.value, r.steps, dict(r.values)) for r in result.trials]


@pytest.fixture(scope="module")
def whole(data, tmp_path_factory):
    """A search with trainings in no time, and its journal."""
    storage = tmp_path_factory.mktemp("search") / "search.jsonl"
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(module, "train", fake)
        return run(data, storage), storage


@pytest.mark.full
def test_it_finds_settings_that_train_to_the_value_it_names(data, tmp_path):
    space = SearchSpace(hidden=(2, 8), batch=(4, 16))
    result = run(data, tmp_path / "search.jsonl", 4, SMALL, space)
    assert result.trials[0].values == space.values_of(SMALL)  # what one has already comes first
    assert result.base == result.trials[0].value
    assert result.best.value == min(r.value for r in result.trials) <= result.base
    trained = train(PRIOR, *data, result.settings)
    assert trained.validation.min() == result.best.value
    assert trained.validation.mean() == result.best.mean
    other = space.apply(SMALL, result.trials[2].values)
    assert train(PRIOR, *data, other).validation.min() == result.trials[2].value
    assert other.learning_rates[0] != SMALL.learning_rates[0]
    for i in (0, 2):  # the schedule keeps its shape
        ratio = SMALL.learning_rates[i + 1] / SMALL.learning_rates[i]
        assert other.learning_rates[i + 1] == pytest.approx(ratio * other.learning_rates[i], rel=1e-12)


def test_it_comes_nearer_to_the_best_settings_than_as_many_random_ones(whole):
    result, _ = whole
    assert len(result.trials) == TRIALS
    assert all(SPACE.holds(r.values) for r in result.trials)
    assert len({tuple(r.values.values()) for r in result.trials}) == TRIALS
    rng, shots = np.random.default_rng(0), []
    for _ in range(300):
        hidden, decay = (np.exp(rng.uniform(*np.log(SPACE.bounds(n)), TRIALS)) for n in ("hidden", "decay"))
        shots.append(min(0.1 * abs(np.log(hidden / 20)) + 0.05 * abs(np.log(decay / 1000))))
    assert result.best.value - 0.1 < np.median(shots)
    # the value depends on these two alone
    assert set(list(result.importance)[:2]) == {"hidden", "decay"}
    assert sum(result.importance.values()) == pytest.approx(1.0)


def test_bad_settings_are_pruned_and_good_ones_are_not(whole):
    result, _ = whole
    pruned = [r for r in result.trials if r.state == "pruned"]
    assert pruned
    for r in pruned:
        assert module.PATIENCE * TOTAL <= r.steps < TOTAL
        assert r.number >= module.FINISHED
        assert math.isnan(r.mean)
    complete = [r for r in result.trials if r.state == "complete"]
    assert all(r.steps == TOTAL for r in complete)
    assert all(r.mean == pytest.approx(r.value + 0.1) for r in complete)  # the fake's other network


def test_the_same_seed_gives_the_same_trials_and_another_seed_others(quick, whole, data, tmp_path):
    result, _ = whole
    assert core(run(data, tmp_path / "again")) == core(result)
    other = run(data, tmp_path / "other", 3, seed=1)
    assert core(other)[0] == core(result)[0]
    assert core(other)[1] != core(result)[1]


class Killed(BaseException):
    """As Ctrl-C: no part of a search catches it."""


@pytest.mark.parametrize(
    ("trial", "step"),
    [(0, 20), (12, 60), *(pytest.param(*case, marks=pytest.mark.full) for case in ((2, 400), (24, 100)))],
)
def test_a_killed_search_goes_on_as_if_nothing_had_been(quick, whole, data, tmp_path, trial, step):
    def kill(number, done, total, error):
        if (number, done) == (trial, step):
            raise Killed

    storage, seen = tmp_path / "search.jsonl", []
    with pytest.raises(Killed):
        run(data, storage, on_progress=kill)
    with storage.open("ab") as file:
        file.write(b'{"op_code":6,"worker_id"')  # as a kill within a write leaves it
    resumed = run(data, storage, on_progress=lambda n, d, t, e: seen.append(n))
    assert min(seen) == trial  # finished trials are not made again
    assert core(resumed) == core(whole[0])
    assert resumed.settings == whole[0].settings


def test_a_kill_between_drawing_and_training_costs_nothing(quick, whole, data, tmp_path, monkeypatch):
    def killed(*_):
        raise Killed

    storage = tmp_path / "search.jsonl"
    with monkeypatch.context() as patch:
        patch.setattr(module.optuna.Study, "ask", killed)  # the base's trial waits in the queue
        with pytest.raises(Killed):
            run(data, storage)
    assert core(run(data, storage, 3)) == core(whole[0])[:3]


def test_trials_are_counted_in_all_and_a_timeout_ends_after_the_trial(quick, whole, data, tmp_path):
    result, _ = whole
    first = run(data, tmp_path / "search.jsonl", timeout=1e-9)
    assert core(first) == core(result)[:1]
    seen = []
    again = run(data, tmp_path / "search.jsonl", 1, on_progress=lambda *a: seen.append(a))
    assert core(again) == core(first)
    assert not seen
    assert core(run(data, tmp_path / "search.jsonl", 4)) == core(result)[:4]


def test_prior_replay_is_searched_when_asked_for():
    space = parsed_space(["prior_replay=1:100"])
    assert space.names == ("prior_replay",)
    assert space.apply(BASE, {"prior_replay": 7.0}).prior_replay == 7.0


def test_a_journal_of_another_search_is_refused_by_what_differs(whole, data):
    _, storage = whole
    training, validation = data
    other = [training[0], replace(training[1], u=training[1].u + 1.0)]
    for arguments, names in (
        ({"base": replace(BASE, horizon=19)}, r"base settings.*HM-IDENTIFY-065"),
        ({"space": SearchSpace(batch=(8, 129))}, r"space.*HM-IDENTIFY-065"),
        ({"seed": 4}, r"seed.*HM-IDENTIFY-065"),
        ({"data": (other, validation)}, r"data.*HM-IDENTIFY-065"),
        ({"data": (validation, training), "seed": 4}, r"data, seed.*HM-IDENTIFY-065"),
    ):
        before = storage.read_bytes()
        with pytest.raises(InputError, match=names):
            run(**({"data": data} | arguments), storage=storage)
        assert storage.read_bytes() == before
    with pytest.raises(InputError, match=r"prior.*HM-IDENTIFY-065"):
        tune(Pendulum(TRUTH | {"d": 0.06}), *data, BASE, SPACE, trials=2, storage=storage)


@pytest.mark.parametrize("content", ["not json\nat all\n", '{"a": 1}\n', "[1]\n[2]\n"])
def test_what_is_no_journal_is_refused(data, tmp_path, content):
    storage = tmp_path / "search.jsonl"
    storage.write_text(content)
    with pytest.raises(InputError, match="HM-IDENTIFY-064"):
        run(data, storage)


def diverging(monkeypatch, wrong):
    """Trainings whose number is in ``wrong`` have no finite validation error."""
    count = iter(range(100))

    def trained(prior, training, validation, settings, *, on_progress):
        if next(count) in wrong:
            on_progress(TOTAL // 2, TOTAL, math.inf)
            return SimpleNamespace(validation=np.full(2, np.inf))
        return fake(prior, training, validation, settings, on_progress=on_progress)

    monkeypatch.setattr(module, "train", trained)


def test_a_diverged_training_is_recorded_and_the_search_goes_on(whole, data, tmp_path, monkeypatch):
    diverging(monkeypatch, {1})
    result = run(data, tmp_path / "search.jsonl", 3)
    assert [r.state for r in result.trials] == ["complete", "diverged", "complete"]
    assert result.trials[1].value == math.inf
    assert math.isfinite(result.best.value)
    assert core(run(data, tmp_path / "search.jsonl", 3)) == core(result)  # the journal gives infinity back


def test_a_search_in_which_all_diverge_says_so(data, tmp_path, monkeypatch):
    diverging(monkeypatch, {0, 1})
    with pytest.raises(InputError, match="HM-IDENTIFY-063"):
        run(data, tmp_path / "search.jsonl", 2)


def test_trials_with_other_horizons_are_compared_on_the_same_windows(data, tmp_path, monkeypatch):
    used = []

    def trained(prior, training, validation, settings, *, on_progress):
        run = TrainingRun(prior, training, validation, settings)
        used.append((settings.horizon, run.valid.x.shape))
        return fake(prior, training, validation, settings, on_progress=on_progress)

    monkeypatch.setattr(module, "train", trained)
    space = SearchSpace(None, None, None, None, horizon=(5, 40))
    run(data, tmp_path / "search.jsonl", 3, space=space)
    assert len({h for h, _ in used}) == 3
    assert len({shape for _, shape in used}) == 1


def test_a_base_outside_the_space_is_no_trial(quick, data, tmp_path):
    result = run(data, tmp_path / "search.jsonl", 1, space=SearchSpace(hidden=(17, 20)))
    assert result.base is None
    assert result.trials[0].values["hidden"] >= 17
