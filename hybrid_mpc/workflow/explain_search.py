"""The search of ``hybrid-mpc explain`` and of stage explain, saved step by step: fit, missing terms, free runs."""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import closing
from dataclasses import dataclass, field
from functools import lru_cache, partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

from hybrid_mpc.data.scales import time_unit
from hybrid_mpc.data.trajectories import Dataset, Trajectory
from hybrid_mpc.engine import Engine, Lost, make_engine
from hybrid_mpc.errors import InputError
from hybrid_mpc.files import digest, read_document, write_document
from hybrid_mpc.folder import versions
from hybrid_mpc.identify.delay import shifted
from hybrid_mpc.identify.explain import STEPS
from hybrid_mpc.identify.explain import explain as search
from hybrid_mpc.identify.explanation import Explanation
from hybrid_mpc.identify.fit import fit_prior, smoothed
from hybrid_mpc.identify.prior_model import prior_programs
from hybrid_mpc.identify.prior_result import PriorFit
from hybrid_mpc.identify.simulation import Points, required_substeps, visited
from hybrid_mpc.identify.smooth import fit_smoother
from hybrid_mpc.identify.term_fits import Answer, TermFits, Work
from hybrid_mpc.identify.term_library import Candidate, library
from hybrid_mpc.machine.prior import Prior
from hybrid_mpc.machine.terms import EXPLANATIONS, Term, extended
from hybrid_mpc.records import known, plain, record
from hybrid_mpc.scenario import Scenario, load_scenario
from hybrid_mpc.workflow.context import Context
from hybrid_mpc.workflow.explained import ExplainResult, FreeRuns, explained_name
from hybrid_mpc.workflow.stage import sources
from nn_export.program import to_json

if TYPE_CHECKING:
    from hybrid_mpc.identify.evaluate import RunLength


def prior_class(scenario: Scenario) -> type[Prior]:
    """The class of a scenario's prior, which the search extends by terms.

    Raises:
        InputError: If the class needs more than parameter values.
    """
    made = type(scenario.prior())
    try:
        made()
    except TypeError as error:
        raise InputError(
            f"scenario {scenario.name}: {made.__name__}() raised TypeError: {error}. The search needs a prior class "
            "with parameter values as the only argument; turn the other arguments into class attributes "
            "[HM-WORKFLOW-020]"
        ) from error
    return made


@dataclass(frozen=True)
class ChosenTerms:
    """Terms that a search chooses from: laws by name (empty: all), and the scenario's own terms."""

    laws: tuple[str, ...]
    own: tuple[Term, ...]

    def candidates(self, prior: Prior, points: Points, dt: float, length: float) -> tuple[Candidate, ...]:
        """Candidates of the library, without those whose parameter or state names the prior already has.

        Raises:
            InputError: If none of the laws can apply.
        """
        there = {p.name for p in prior.parameters} | {s.name for s in prior.states}
        every = [one for one in library(prior, points, dt, length) if not _names(one) & there]
        found = tuple(one for one in every if not self.laws or _law(one) in self.laws)
        if not found and not self.own:
            apply = ", ".join(dict.fromkeys(_law(one) for one in every)) or "none"
            raise InputError(
                f"terms: {', '.join(self.laws) or 'no law'} cannot apply to {type(prior).__name__}; "
                f"applicable laws: {apply} [HM-WORKFLOW-021]"
            )
        return found


def chosen_terms(scenario: Scenario, names: Sequence[str] = ()) -> ChosenTerms:
    """Laws and own terms that a search chooses from; ``names`` replace the scenario's laws.

    Raises:
        InputError: If a name is not the name of a law.

    Example:
        >>> from hybrid_mpc.scenario import load_scenario
        >>> chosen_terms(load_scenario("emps"), ["coulomb"]).laws
        ('coulomb',)
    """
    own = tuple(term for term in scenario.terms if isinstance(term, Term))
    laws = tuple(names) or tuple(term for term in scenario.terms if not isinstance(term, Term))
    for law in laws:
        known(law, EXPLANATIONS, "law of a term")
    there = {term.name for term in getattr(scenario.prior(), "terms", ())}
    return ChosenTerms(laws, tuple(term for term in own if term.name not in there))


def _law(candidate: Candidate) -> str:
    made = candidate.forms[0].made
    return "" if made is None else made.maker


def _names(candidate: Candidate) -> set[str]:
    names = {name for form in candidate.forms for name in form.names}
    return names | {form.state.name for form in candidate.forms if form.state is not None}


class Search:
    """Fit and search of one machine; each result is saved in the folder."""

    def __init__(
        self,
        context: Context,
        make: type[Prior],
        data: Dataset,
        chosen: ChosenTerms,
        out: Path,
        most: int = STEPS,
    ) -> None:
        self.context, self.make, self.data, self.chosen = context, make, data, chosen
        self.out, self.most = out, most
        self.dt = context.spec.dt
        self.train, self.valid, self.test = (list(data.by_role(role)) for role in ("train", "valid", "test"))
        self.longest = context.spec.free_run or max(
            (len(t.t) - context.warm) * self.dt for t in (*self.valid, *self.test)
        )
        programs = prior_programs(extended(make, *chosen.own)(), self.dt)
        self.key = digest({
            "prior": {name: to_json(program) for name, program in programs.items()},
            "parameters": extended(make, *chosen.own).parameters, "recordings": data.hash, "data": context.spec,
            "chosen": chosen.laws, "versions": versions(), "program": sources("hybrid_mpc.identify.explain"),
        })  # fmt: skip

    def result(self) -> ExplainResult:
        """Fit, search, and errors over the test recordings."""
        progress = self.context.progress
        progress.start("fitting the prior")
        fit = self.fit()
        for warning in fit.warnings:
            progress.warn(f"fit of the prior: {warning}")
        progress.finish("")
        length = self.run_length(fit)
        for warning in length.warnings:
            progress.warn(warning)
        explanation = self.searched(fit, length.seconds or self.longest)
        tests: dict[str, FreeRuns] = {}
        if self.test:
            progress.start("free runs over the test recordings")
            tests = self.tests(fit, explanation, length.seconds)
            progress.finish("")
        name = self.context.scenario.name
        own = fit.smoother(self.make(fit.values), self.dt)
        floor = math.sqrt(
            sum((s / size) ** 2 for s, size in zip(own.sigma, own.sizes.y, strict=True)) / len(own.sigma)
        )
        return ExplainResult(
            name,
            explanation,
            fit.delay,
            floor,
            tests,
            f"{explained_name(name)}.py" if explanation.found else "",
            length.seconds,
        )

    def fit(self) -> PriorFit:
        """The fitted prior."""
        held = self._held("fit")
        if held is not None:
            return record(PriorFit, held, "the fit")
        fit = fit_prior(
            self.make, self.train, self.valid, dt=self.dt, length=self.longest,
            largest_delay=self.context.spec.largest_delay, time_unit=time_unit(self.train, self.dt),
            warm_up=self.context.spec.warm_up,
            on_progress=self._progress("free runs"),
        )  # fmt: skip
        self._keep("fit", fit)
        return fit

    def run_length(self, fit: PriorFit) -> RunLength:
        """Length of the free runs that evaluate models, as in a run."""
        from hybrid_mpc.identify.evaluate import run_length

        every = smoothed(self.make, fit, [*self.train, *self.valid, *self.test], self.dt)
        n = len(self.train)
        return run_length(
            self.make, fit, every[:n], every[n:], dt=self.dt, warm=self.context.warm, longest=self.longest,
            free_run=self.context.spec.free_run,
        )  # fmt: skip

    def searched(self, fit: PriorFit, length: float) -> Explanation:
        """Result of the search by free runs of ``length`` [s]; an interrupted one continues after its last step."""
        known_ = smoothed(self.make, fit, [*self.train, *self.valid], self.dt)
        candidates = self.chosen.candidates(self.make(fit.values), visited(known_), self.dt, length)
        ended = self._held("ended")
        if ended is not None:
            done = record(Explanation, ended["found"], "the search")
            # with fewer terms than allowed it ended for another reason
            if _added(done) < ended["most"] or _added(done) >= self.most:
                return done
        held = self._held("steps")
        begun = None if held is None else record(Explanation, held, "the steps of the search")
        progress, count = self.context.progress, len(candidates) + len(self.chosen.own)
        number = 1 + _added(begun)
        progress.start(f"search, step {number}: {count} candidates")

        def keep(explanation: Explanation) -> None:
            self._keep("steps", explanation)
            last = next(step for step in reversed(explanation.steps) if step.action == "added")
            progress.finish(
                f"{last.name}: ratio to the previous step {last.held_out.ratio:.2f}, {explanation.averaged}"
            )
            if _added(explanation) < self.most:
                progress.start(f"search, step {1 + _added(explanation)}")

        warm_up = self.context.spec.warm_up
        to_fit = _ToFit(self.key, self.context.scenario_path, fit.values, known_, self.dt, length, warm_up)
        with closing(
            make_engine(partial(_answered, to_fit), self.context.workers, self.context.cluster)
        ) as engine:
            found = search(
                self.make, fit.values, known_, dt=self.dt, length=length, warm_up=warm_up, candidates=candidates,
                own=self.chosen.own, begun=begun, most=self.most, on_progress=self._progress("candidates"),
                on_step=keep, answers=partial(_answers, engine),
            )  # fmt: skip
        progress.finish(found.reason)
        self._keep("ended", {"found": found, "most": self.most})
        return found

    def tests(self, fit: PriorFit, explanation: Explanation, length: float | None) -> dict[str, FreeRuns]:
        """Errors over the test recordings, in free runs of ``length`` [s]; None: whole recordings.

        Each model starts from the states of its own smoother.
        """
        from hybrid_mpc.identify.evaluate import evaluation_trajectories, free_runs, score
        from hybrid_mpc.identify.step import PriorStep

        warm = self.context.warm
        fitted, acting = self.make(fit.values), shifted([*self.train, *self.valid], fit.delay)
        own = fit.smoother(fitted, self.dt)
        models = {"fitted": (fitted, own)}
        if explanation.found:
            better = explanation.prior(self.make, self.chosen.own)(explanation.values)
            substeps = required_substeps(better, self.dt)
            unit = time_unit(self.train, self.dt)
            models["explained"] = (
                better,
                fit_smoother(better, acting, self.dt, time_unit=unit, substeps=substeps),
            )
        test, found = shifted(self.test, fit.delay), {}
        steps = {"nominal": (PriorStep(self.make(), self.dt), fitted, own)}
        steps |= {name: (PriorStep(p, self.dt, s.substeps), p, s) for name, (p, s) in models.items()}
        for name, (step, prior, smoother) in steps.items():
            runs = evaluation_trajectories(smoother.smooth(test), smoother, warm, length)
            errors = score(free_runs(step, prior, runs, warm), prior, own.sizes.y)
            found[name] = FreeRuns(errors.error, errors.rmse)
        return found

    def _progress(self, part: str) -> Callable[[int, int, str], None]:
        """A progress function that adds the remaining time of the step."""
        begun, last = time.monotonic(), 0

        def passed(done: int, total: int, text: str) -> None:
            nonlocal begun, last
            now = time.monotonic()
            if done <= 0 or done < last:
                begun = now
            last = done
            left = (now - begun) / done * (total - done) if done > 0 else 0.0
            # remaining time [s] above which the progress text shows it
            more = f", about {left:.0f} s left of this step" if left > 5.0 else ""
            self.context.progress.update(part, done, total, f"{text}{more}")

        return passed

    def _path(self, name: str) -> Path:
        return self.out / "checkpoints" / f"{name}.json"

    def _held(self, name: str) -> Any:
        """Saved result of a part; None if it is missing or belongs to other settings."""
        path = self._path(name)
        if not path.is_file():
            return None
        held = read_document(path, f"delete {path}; then the same command computes it again")
        return held["value"] if held["key"] == self.key else None

    def _keep(self, name: str, value: object) -> None:
        write_document(self._path(name), {"key": self.key, "value": plain(value)})


@dataclass(frozen=True)
class _ToFit:
    """What another process needs to fit terms; ``key``, ``scenario`` and ``length`` determine the rest."""

    key: str
    scenario: str
    values: dict[str, float] = field(compare=False)
    known: list[Trajectory] = field(compare=False)
    dt: float = field(compare=False)
    length: float
    warm_up: float = field(compare=False)


@lru_cache(maxsize=1)
def _fits(to_fit: _ToFit) -> TermFits:
    """Windows and fits of the last search, so that a process cuts and compiles once."""
    scenario = load_scenario(to_fit.scenario)
    return TermFits(
        prior_class(scenario), to_fit.values, to_fit.known, to_fit.dt, to_fit.length, to_fit.warm_up,
        chosen_terms(scenario).own,
    )  # fmt: skip


def _answered(to_fit: _ToFit, batch: tuple[int, Work]) -> Answer:
    return _fits(to_fit).answer(batch[1])


def _answers(engine: Engine[tuple[int, Work], Answer], works: Sequence[Work]) -> Iterator[tuple[int, Answer]]:
    """Index and answer of each candidate, as processes finish them.

    Raises:
        RuntimeError: If a process ends before its answer.
    """
    for batch in enumerate(works):
        engine.submit(batch)
    left = len(works)
    while left:
        # time [s] between checks whether a cluster still has workers
        found = engine.next(timeout=1.0)
        if found is None:
            continue
        (i, _), answer = found
        if isinstance(answer, Lost):
            raise RuntimeError(f"the process of a candidate ended: {answer}")
        left -= 1
        yield i, answer


def _added(explanation: Explanation | None) -> int:
    return 0 if explanation is None else sum(step.action == "added" for step in explanation.steps)
