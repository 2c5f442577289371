"""Forty faults that an engineer could make, four a room, and whether the tests catch each of them.

Tests are moved, merged and deleted. Line coverage does not tell whether they still find a fault: this tool does. Run
it before and after a change of the tests. What they caught before, they must catch after.

It copies the repository into a temporary folder, puts one fault into the copy, and runs the tests of that fault there.
A fault is *caught* where a test fails, *MISSED* where all pass. It is *broken* where the tool cannot say: the text to
be replaced is not there exactly once, no test is selected, the tests fail without any fault, or a module with the fault
cannot be imported. A fault that is missed or broken makes the exit code 1.

    python tests/seeded_faults.py                      all of them, about a quarter of an hour
    python tests/seeded_faults.py --room control       those of one room
    python tests/seeded_faults.py --only 7             one of them, by its number in the table
    python tests/seeded_faults.py --report faults.json the table as data too

How to add one: take a line of code whose fault would matter to a user, and which is unlikely to be worded anew. ``old``
is a piece of it that occurs once in all of ``hybrid_mpc/``; no file is named, so the fault goes with its line when the
line moves. ``new`` is what it becomes: code that runs, and computes something else. ``tests`` are arguments of pytest,
a folder and mostly ``-k``: words of the subject, which also match the names of files. Where the tests of a room move,
change :data:`FOLDERS` or the words. Where a line is written anew, make the same fault in the new line.
"""

import argparse
import json
import os
import shutil
import subprocess
import sys
import tempfile
import time
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
LEFT_OUT = (".git", ".venv", "__pycache__", ".*_cache", "*.egg-info", "runs", "site", "shared")
LONGEST_S = 900.0
"""A run of tests that takes longer has failed: no test here needs a tenth of it."""
FAILED, PASSED = 1, 0  # exit codes of pytest; every other one says that it could not test


@dataclass(frozen=True)
class SeededFault:
    """A fault, and the tests that are to catch it.

    Args:
        room: The room whose code it is.
        what: What is wrong with it.
        old: A text that occurs once in ``hybrid_mpc/``.
        new: What it becomes.
        tests: Arguments of pytest.
    """

    room: str
    what: str
    old: str
    new: str
    tests: tuple[str, ...]


@dataclass(frozen=True)
class Verdict:
    """What became of a fault: ``caught``, ``MISSED`` or ``broken``, why, where it was put, and how long it took."""

    number: int
    room: str
    what: str
    result: str
    why: str
    file: str
    seconds: float


FOLDERS = {
    "machine": "tests/machine",
    "data": "tests/data",
    "identify": "tests/identify",
    "model": "tests",
    "estimate": "tests/estimate",
    "control": "tests/control",
    "loop": "tests/loop",
    "watch": "tests/watch",
    "analyze": "tests/analyze",
    "check": "tests/check",
    "compare": "tests/compare",
    "workflow": "tests/workflow",
    "fuzz": "tests/fuzz",
    "golden": "tests/golden",
}
"""Where the tests of a room are."""


def fault(room: str, what: str, old: str, new: str, words: str = "", folder: str = "") -> SeededFault:
    """A fault whose tests are those of its room's folder, or of another, that have these words in their names."""
    tests = (FOLDERS[folder or room], *(("-k", words) if words else ()))
    return SeededFault(room, what, old, new, tests)


FAULTS = (
    fault(
        "machine", "the energy balance loses friction's force, not its power",
        "ca.dot(force, v), ca.dot(friction, v)", "ca.dot(force, v), ca.sum(friction)",
        "friction",
    ),
    fault(
        "machine", "a diagonal mass matrix accelerates by the force, not by force over mass",
        "rate = driving / ca.diag(mass) if diagonal", "rate = driving if diagonal",
        "friction",
    ),
    fault(
        "machine", "a Stribeck curve falls with the squared speed over the Stribeck speed, not over its square",
        "ca.exp(-((at.own / speed) ** 2))", "ca.exp(-(at.own**2) / speed)",
        "terms",
    ),
    fault(
        "machine", "the shares of the two inputs that act within one period are swapped",
        "u=(1 - share) * younger + share * older", "u=share * younger + (1 - share) * older",
        "delay", "identify",
    ),
    fault(
        "data", "the input of a period is the mean over the period before",
        "(np.interp(grid + dt, t, z) - np.interp(grid, t, z)) / dt",
        "(np.interp(grid, t, z) - np.interp(grid - dt, t, z)) / dt",
        "trajectories",
    ),
    fault(
        "data", "pieces of different roles share the samples that smoothing mixes",
        "distance = spec.smoothing if windows else 0.0", "distance = 0.0",
        "trajectories",
    ),
    fault(
        "data", "a time stamp that repeats is accepted",
        "wrong = np.diff(t) <= 0", "wrong = np.diff(t) < 0",
        "read",
    ),
    fault(
        "data", "a sensor's noise is estimated too large: the factor of first differences on third ones",
        "return robust_spread(third) / math.sqrt(20.0)",
        "return robust_spread(third) / math.sqrt(2.0)",
        "scales",
    ),
    fault(
        "identify", "the smoother takes a standard deviation for a variance",
        "np.square(walk)], axis=1)", "np.abs(walk)], axis=1)",
        "smoothing",
    ),
    fault(
        "identify", "standard errors of parameters ignore that initial states were fitted too",
        "axis=-1) - a @ follow[self.windows.group]", "axis=-1)",
        "prior_fit",
    ),
    fault(
        "identify", "a bound on the objectives is lowered where one of them is met, not all",
        "keeps = (losses <= self.bounds).all(dim=-1, keepdim=True)",
        "keeps = (losses <= self.bounds).any(dim=-1, keepdim=True)",
        "objectives or bound",
    ),
    fault(
        "identify", "a free run starts a period before the end of its warm-up",
        "step.free_run(x_all[..., warm, :]", "step.free_run(x_all[..., warm - 1, :]",
        "evaluation",
    ),
    fault(
        "model", "a longer period's input Jacobian forgets what earlier periods pass on",
        "a, b = a_k @ a, a_k @ b + b_k", "a, b = a_k @ a, b + b_k",
        "period and jacobian", "control",
    ),
    fault(
        "model", "a delay's older input acts with the share of the younger one",
        "share[:, n_u : 2 * n_u] = (1.0 - rest) * np.eye(n_u)", "share[:, n_u : 2 * n_u] = rest * np.eye(n_u)",
        "test_delayed",
    ),
    fault(
        "model", "programs that do not belong to the description are accepted",
        "if sha256(folder / PROGRAMS) != found.programs_sha256:", "if not (folder / PROGRAMS).is_file():",
        "two_models", "fuzz",
    ),
    fault(
        "model", "a file that was changed by hand is accepted",
        "if document.pop(HASH, None) != digest(document):", "if document.pop(HASH, None) is None:",
        "test_files and document",
    ),
    fault(
        "estimate", "the covariance forgets the noise of the measurement that it took",
        "p = i_kc @ p @ i_kc.T + noise[i] * np.outer(gain, gain)", "p = i_kc @ p @ i_kc.T",
        "kalman",
    ),
    fault(
        "estimate", "a late measurement is matched with the newest input, not the one of its time",
        "self.estimator.update(base, y, inputs[0], ", "self.estimator.update(base, y, inputs[-1], ",
        "delays",
    ),
    fault(
        "estimate", "probabilities of the modes are carried on by the transposed transition",
        "joint = before.probability[:, None] * self.transition",
        "joint = before.probability[:, None] * self.transition.T",
        "switching",
    ),
    fault(
        "estimate", "a band of 95 % leaves out 5 % on either side",
        "tail = (1.0 - LEVEL) / 2", "tail = 1.0 - LEVEL",
        "consistency",
    ),
    fault(
        "control", "the gradient's price of the first change lacks the period",
        "2 * model.dt * ocp.r, 2 * model.dt * ocp.r_delta", "2 * model.dt * ocp.r, 2 * ocp.r_delta",
        "lq",
    ),
    fault(
        "control", "a bound on states is held a period too early",
        "np.repeat(np.arange(n) + (b == 0), count)", "np.repeat(np.arange(n), count)",
        "soft",
    ),
    fault(
        "control", "a plan that is used on does not grow old",
        "return Decision(u, source, plan, solution.status, previous.age + 1)",
        "return Decision(u, source, plan, solution.status, previous.age)",
        "safeguard",
    ),
    fault(
        "control", "limits given for a while may be wider than the machine's own",
        "(np.clip(v, self.u_min, self.u_max) for v in (limits.u_min, limits.u_max))",
        "(v for v in (limits.u_min, limits.u_max))",
        "limits",
    ),
    fault(
        "loop", "what is prepared for the next period sees the reference of this one",
        "previews = self._previews((state.k + 1 + self._delay) * self.model.dt)",
        "previews = self._previews((state.k + self._delay) * self.model.dt)",
        "order or control",
    ),
    fault(
        "loop", "the monitor is told the command, not the input that was applied",
        "inputs = (*inputs[:-1], previous.u)", "inputs = (*inputs[:-1], state.decision.u)",
        "order",
    ),
    fault(
        "loop", "a guard returns to normal as soon as a frozen sensor moves once",
        "if frozen == t or t - frozen < guard.quiet - TINY:", "if frozen == t:",
        "guard",
    ),
    fault(
        "loop", "the simulated machine has no input delay",
        "before, self._acting = self._acting, self._commands.pop(0)",
        "before, self._acting = self._acting, self._commands.pop()",
        "simulate",
    ),
    fault(
        "watch", "a force that pulls the other way is not detected",
        "up, down = sums[2 * k] + z - drift, sums[2 * k + 1] - z - drift",
        "up, down = sums[2 * k] + z - drift, sums[2 * k + 1] + z - drift",
        "detector", "golden",
    ),
    fault(
        "watch", "a rate of alarms an hour is taken for one a minute",
        "rate = false_alarms_per_hour * block_s / 3600.0", "rate = false_alarms_per_hour * block_s / 60.0",
        "calibrat",
    ),
    fault(
        "watch", "a sensor that freezes while the machine moves backwards is not noticed",
        "if within and abs(moved) > far", "if within and moved > far",
        "frozen",
    ),
    fault(
        "watch", "a diagnosis takes correlated samples for independent ones",
        "independent = max(samples / self.short, 2.0)", "independent = samples",
        "diagnosis",
    ),
    fault(
        "analyze", "where no rest is found, the last guess is told as one",
        "if not error <= RESIDUAL or np.any(x < box[:, 0] - edge)", "if np.any(x < box[:, 0] - edge)",
        "points",
    ),
    fault(
        "analyze", "the delay that a loop bears is a period too long",
        "return periods - 1", "return periods",
        "margins",
    ),
    fault(
        "analyze", "the MPC's gain by the input before lacks the period",
        "before[:n_u] = -2 * model.dt * np.diag(ocp.r_delta)", "before[:n_u] = -2 * np.diag(ocp.r_delta)",
        "loop",
    ),
    fault(
        "analyze", "a measured response has the phase of its inverse",
        "np.conj(mean_u) * mean_y", "mean_u * np.conj(mean_y)",
        "signals",
    ),
    fault(
        "compare", "loops of machines with other parameters are taken for one another",
        'left_out = ("number", "keep", ', 'left_out = ("number", "keep", "parameters", ',
        "configuration",
    ),
    fault(
        "compare", "a study goes on with models that were trained anew since",
        "settings |= models | {", "settings |= {",
        "another or resumed",
    ),
    fault(
        "compare", "an interval of 95 % is one of 90 %",
        "student.ppf(0.5 + level / 2, n - 1)", "student.ppf(level, n - 1)",
        "interval",
    ),
    fault(
        "workflow", "the hybrid is held against the worse of the two controllers on the prior",
        "baseline = min((costs[n] for n in BASELINES if n in costs)",
        "baseline = max((costs[n] for n in BASELINES if n in costs)",
        "gap or baseline",
    ),
)  # fmt: skip


class Copy:
    """A copy of the repository in a folder, where one fault at a time is put in and its tests are run."""

    def __init__(self, folder: Path) -> None:
        self.root = folder / ROOT.name
        shutil.copytree(ROOT, self.root, ignore=shutil.ignore_patterns(*LEFT_OUT))
        if (ROOT.parent / "shared").exists():  # recordings, which tests look for beside the repository
            (folder / "shared").symlink_to((ROOT.parent / "shared").resolve())
        self._sources = {path: path.read_text() for path in sorted(self.root.glob("hybrid_mpc/**/*.py"))}
        self._whole: dict[tuple[str, ...], int] = {}

    def judge(self, number: int, seeded: SeededFault) -> Verdict:
        """What the tests say of a fault."""
        begin = time.monotonic()
        found = [path for path, text in self._sources.items() for _ in range(text.count(seeded.old))]
        place = str(found[0].relative_to(self.root)) if len(found) == 1 else ""
        if place:
            result, why = self._tried(found[0], seeded)
        else:
            result, why = "broken", f"its old text occurs {len(found)} times, needed is once"
        spent = round(time.monotonic() - begin, 1)
        return Verdict(number, seeded.room, seeded.what, result, why, place, spent)

    def _tried(self, path: Path, seeded: SeededFault) -> tuple[str, str]:
        if seeded.tests not in self._whole:
            self._whole[seeded.tests] = self._run(seeded.tests)[0]
        if self._whole[seeded.tests] != PASSED:
            return "broken", f"pytest ends with {self._whole[seeded.tests]} where there is no fault"
        text = self._sources[path]
        path.write_text(text.replace(seeded.old, seeded.new))
        try:
            code, failed = self._run(seeded.tests)
        finally:
            path.write_text(text)
        if code == PASSED:
            return "MISSED", f"all pass: pytest {' '.join(seeded.tests)}"
        if code != FAILED or "::" not in failed:  # a module that cannot be imported
            return "broken", f"pytest ends with {code} before any test: {failed}"
        return "caught", failed

    def _run(self, tests: Sequence[str]) -> tuple[int, str]:
        """Exit code of pytest, and the test that failed.

        No compiled code is kept: it is told from other code by the second and the size of its file alone.
        """
        environment = {**os.environ, "PYTHONPATH": str(self.root), "PYTHONDONTWRITEBYTECODE": "1"}
        words = [sys.executable, "-m", "pytest", *tests, "-x", "-q", "-p", "no:cacheprovider", "--tb=no"]
        try:
            done = subprocess.run(
                words, cwd=self.root, env=environment, capture_output=True, text=True, timeout=LONGEST_S
            )
        except subprocess.TimeoutExpired:
            return FAILED, f"no end within {LONGEST_S:g} s :: {' '.join(tests)}"
        lines = [line for line in done.stdout.splitlines() if line.startswith(("FAILED ", "ERROR "))]
        return done.returncode, lines[0].split(" ")[1] if lines else ""


def main() -> int:
    """Try the faults asked for, one after another, and print a table; 1 where one is missed or broken."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--room", choices=sorted({seeded.room for seeded in FAULTS}), help="only its faults")
    parser.add_argument("--only", type=int, nargs="+", metavar="N", help="only these, by number from 1 on")
    parser.add_argument("--report", type=Path, metavar="FILE", help="the table as JSON")
    given = parser.parse_args()
    chosen = [
        (number, seeded)
        for number, seeded in enumerate(FAULTS, 1)
        if given.room in (None, seeded.room) and (given.only is None or number in given.only)
    ]
    if not chosen:
        parser.error(f"no such fault; there are 1 to {len(FAULTS)}")
    verdicts = []
    with tempfile.TemporaryDirectory() as folder:
        copy = Copy(Path(folder))
        for number, seeded in chosen:
            verdicts.append(copy.judge(number, seeded))
            print(_line(verdicts[-1]), flush=True)
    left = [verdict for verdict in verdicts if verdict.result != "caught"]
    print(f"{len(verdicts) - len(left)} of {len(verdicts)} caught", *map(_line, left), sep="\n")
    if given.report is not None:
        given.report.write_text(json.dumps([asdict(verdict) for verdict in verdicts], indent=1) + "\n")
    return 1 if left else 0


def _line(v: Verdict) -> str:
    return f"{v.number:3} {v.room:9} {v.result:7} {v.seconds:6.1f} s  {v.what}  [{v.why}]"


if __name__ == "__main__":
    sys.exit(main())
