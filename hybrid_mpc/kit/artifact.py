"""The artifact: a folder of deployed models as data, and the kit of a loop's parts that is made of it.

The folder is composed of files that :mod:`hybrid_mpc.kit.parts` describes. Loading needs no torch and executes nothing
from the folder.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path

import numpy as np
from numpy.typing import ArrayLike, NDArray

import nn_export
from hybrid_mpc.control.ocp import OCP
from hybrid_mpc.control.safeguard import SafeController
from hybrid_mpc.errors import InputError
from hybrid_mpc.estimate.switching import Filter
from hybrid_mpc.files import digest, sha256
from hybrid_mpc.kit.assembly import (
    make_adaptive_guard,
    make_controller,
    make_estimator,
    make_resting_guard,
)
from hybrid_mpc.kit.at_use import ModelsAtUse
from hybrid_mpc.kit.disturbances import default_disturbances
from hybrid_mpc.kit.parts import (
    AGAIN,
    BALANCE,
    HYBRID,
    KIT,
    MODELS,
    OBSERVER,
    PROGRAMS,
    TASKS,
    WATCH,
    Description,
    LoopSettings,
    ModelInfo,
    Provenance,
    WatchFile,
    artifact_folder,
    loop_settings,
    read_parts,
    save_loop,
    set_limits,
    tuples,
    watch_file,
    write_description,
)
from hybrid_mpc.kit.prediction import Predicting
from hybrid_mpc.kit.promises import Promise, PromiseTable, none_made, read_promises
from hybrid_mpc.loop.guard import Guard
from hybrid_mpc.model.delay import with_input_delay
from hybrid_mpc.model.disturbance import Disturbance
from hybrid_mpc.model.limits import check_flag
from hybrid_mpc.model.model import STEP_INPUTS, STEP_OUTPUTS, Balance, HybridModel, kinematics
from hybrid_mpc.records import known
from hybrid_mpc.scenario import Scenario
from hybrid_mpc.watch.detector import WatchLimits
from hybrid_mpc.watch.diagnose import Diagnoser
from hybrid_mpc.watch.lengths import SHARE
from hybrid_mpc.watch.monitor import Monitor, make_monitor, reads_energy
from hybrid_mpc.watch.readings import ENERGY, RESIDUALS

FUNCTIONS = ("step", "xdot", "output")
INPUTS = {
    "step": STEP_INPUTS,
    "xdot": STEP_INPUTS,
    "output": ("x", "u", "w", "p"),
    BALANCE: ("x", "xdot", "u", "w", "p"),
}
OWN = ("step", "xdot")
"""Functions of a single network that are its own; the others are those of the prior that it stands on."""
OUTPUTS = {"step": STEP_OUTPUTS, "xdot": ("xdot",), "output": ("y",), BALANCE: ("residual",)}
JACOBIANS = {"A": ("x", "h"), "B": ("u",)}
WATCHES = ("own", "guard", "energy", "residuals")
"""Kinds of monitor, see :meth:`Kit.monitor`."""

WITHOUT = (
    'go without alarms: kind="own" records readings, monitor=None (export c: --no-monitor) watches nothing'
)


def save_artifact(
    folder: Path,
    programs: Mapping[str, Mapping[str, nn_export.Program]],
    info: ModelInfo,
    *,
    limits: Mapping[str, Sequence[WatchLimits]] | None = None,
    provenance: Provenance | None = None,
    loop: LoopSettings | None = None,
    recommended: str = "",
    members: Sequence[Mapping[str, nn_export.Program]] = (),
    predicting: Predicting | None = None,
) -> None:
    """Write models to ``folder``, and what loops on them need.

    Args:
        folder: Made if missing.
        programs: Program of each function of each model, e.g. ``programs["hybrid"]["step"]``, and of each of its
            balances, ``programs["hybrid"]["balance/energy"]``.
        info: Period and signals, the same for all models.
        limits: By what monitors alarm, by model. Default: none are written.
        provenance: What the models were made from.
        loop: What loops need beside the models. Default: nothing is written.
        recommended: Model that a loop is made of where none is named. Default: the hybrid.
        members: ``step`` and ``xdot`` of each network that the hybrid is the mean of, the best first. Default: none.
        predicting: What predictions of recordings need beside the models. Default: there can be none.

    Raises:
        InputError: If an expression of a control problem cannot be stated as a program.
    """
    save_models(
        folder,
        programs,
        info,
        provenance=provenance,
        recommended=recommended,
        members=members,
        predicting=predicting,
    )
    if loop is not None:
        save_loop(folder, loop)
    if limits is not None:
        set_limits(folder, limits)


def save_models(
    folder: Path,
    programs: Mapping[str, Mapping[str, nn_export.Program]],
    info: ModelInfo,
    *,
    provenance: Provenance | None = None,
    recommended: str = "",
    members: Sequence[Mapping[str, nn_export.Program]] = (),
    predicting: Predicting | None = None,
) -> str:
    """Write ``models/`` and then ``kit.json``, as :func:`save_artifact`; returns the hash of the programs."""
    flat = {f"{model}/{name}": p for model, functions in programs.items() for name, p in functions.items()}
    for name, own in zip(member_names(len(members)), members, strict=True):
        flat |= {f"{name}/{key}": own[key] for key in OWN}
    (folder / MODELS).mkdir(parents=True, exist_ok=True)
    nn_export.save_programs(folder / MODELS, flat)
    hashed = sha256(folder / PROGRAMS)
    write_description(
        folder,
        Description(
            tuple(programs), hashed, info, provenance or Provenance(), recommended, len(members), predicting
        ),
    )
    return hashed


def build_model(name: str, programs: Mapping[str, nn_export.Program], info: ModelInfo) -> HybridModel:
    """The model of ``programs["<name>/step"]`` and its siblings, with the input's delay.

    Raises:
        KeyError: If a program is missing.
        nn_export.ExportError: If a program cannot be built.
        InputError: If it does not fit the signals.
    """
    step, xdot, output = (nn_export.build(programs[f"{name}/{f}"], f) for f in FUNCTIONS)
    balances = tuple(
        Balance(b.name, b.unit, b.rate_unit, nn_export.build(programs[f"{name}/{b.program}"], BALANCE))
        for b in info.balances
    )
    program = programs[f"{name}/step"]
    model = HybridModel(
        name, info.dt, info.states, info.inputs, info.outputs, step, xdot, output,
        with_jacobian=nn_export.with_jacobian(program, JACOBIANS),
        side_by_side=partial(nn_export.SideBySide, program),
        disturbances=info.disturbances, nominal_w=info.nominal_w, parameters=info.parameters,
        covariance=info.covariance, balances=balances, time_unit=info.time_unit, nominal_x=info.nominal_x,
        nominal_u=info.nominal_u, state_spread=info.state_spread, output_spread=info.output_spread,
    )  # fmt: skip
    return with_input_delay(model, info.input_delay) if info.input_delay else model


def member_names(count: int) -> list[str]:
    """Names of the networks that the hybrid is the mean of: ``"hybrid_1"``, ``"hybrid_2"``, ..."""
    return [f"{HYBRID}_{i + 1}" for i in range(count)]


def member_models(
    programs: Mapping[str, nn_export.Program], info: ModelInfo, count: int
) -> Mapping[str, HybridModel]:
    """Models of the networks that the hybrid is the mean of by name, the best first."""
    shared = (*(f for f in FUNCTIONS if f not in OWN), *(b.program for b in info.balances))
    names = member_names(count)
    own = {f"{name}/{key}": programs[f"{name}/{key}"] for name in names for key in OWN}
    own |= {f"{name}/{key}": programs[f"{HYBRID}/{key}"] for name in names for key in shared}
    return _at_use(names, own, info, None)


def _at_use(
    names: Sequence[str], programs: Mapping[str, nn_export.Program], info: ModelInfo,
    chosen: tuple[Disturbance, ...] | None,
) -> ModelsAtUse:  # fmt: skip
    """Models that are built at their first use, of programs that are all there; KeyError for one that is not."""
    needed = (*FUNCTIONS, *(b.program for b in info.balances))
    own = {f"{name}/{key}": programs[f"{name}/{key}"] for name in names for key in needed}
    return ModelsAtUse(names, partial(_built, own, info, chosen))


def _built(
    programs: Mapping[str, nn_export.Program], info: ModelInfo, chosen: tuple[Disturbance, ...] | None, name: str
) -> HybridModel:  # fmt: skip
    try:
        model = build_model(name, programs, info)
    except nn_export.ExportError as error:
        raise InputError(f"model {name}: {error}") from error
    return model if model.disturbance_model == chosen else replace(model, disturbance_model=chosen)


def load(folder: str | Path) -> Kit:
    """The kit of an artifact: models, and all that loops on them need.

    It is composed of the files in the folder (docs/kit.md). What is not there, or was made for other models or another
    observer, is left out; :attr:`Kit.lacks` names it, and what needs it raises.

    Args:
        folder: The run's folder, or its ``model``.

    Raises:
        InputError: If there is none, or a file is damaged or of another version, or the models are not there.

    Example:
        ``kit = hm.load("runs/mine")``
    """
    if not isinstance(folder, str | Path):
        raise InputError(f"load: the path of a folder is needed, got {type(folder).__name__} [HM-KIT-001]")
    folder = artifact_folder(Path(folder))
    parts = read_parts(folder)
    found = parts.description
    if sha256(folder / PROGRAMS) != found.programs_sha256:
        raise InputError(
            f"{folder}: {PROGRAMS} is not the one that {KIT} was saved with: the stage export ended in between, or a "
            f"file was changed; {AGAIN}, or take the folder from its run [HM-KIT-002]"
        )
    try:
        programs = nn_export.load_programs(folder / MODELS)
        models = _at_use(found.models, programs, found.model, parts.loop.disturbance_model)
        members = member_models(programs, found.model, found.members)
    except KeyError as error:
        raise InputError(f"{folder}: {PROGRAMS} lacks {error}, which {KIT} names [HM-KIT-003]") from error
    except nn_export.ExportError as error:
        raise InputError(f"{folder}: {error}") from error
    return Kit(
        models=models,
        watch=parts.watch,
        provenance=found.provenance,
        input_delay=found.model.input_delay,
        loop=parts.loop,
        recommended=found.recommended or (HYBRID if HYBRID in models else found.models[0]),
        members=members,
        predicting=found.predicting,
        programs_sha256=found.programs_sha256,
        promised=read_promises(folder),
        lacks=parts.lacks,
    )


def _named(name: object, what: str) -> str:
    """A name as somebody gives it; InputError if it is no text."""
    if not isinstance(name, str):
        raise InputError(f"{what}: a name is needed, got {type(name).__name__} [HM-KIT-004]")
    return name


def _disturbed(
    models: Mapping[str, HybridModel], chosen: tuple[Disturbance, ...] | None, name: str
) -> HybridModel:
    """A model with a disturbance model; as it is where it has it."""
    model = models[name]
    return model if model.disturbance_model == chosen else replace(model, disturbance_model=chosen)


@dataclass(frozen=True)
class Kit:
    """A loaded artifact: models, and estimator, controller, monitor and guard that are made from them.

    Args:
        models: Deployed models by name (``"hybrid"``, ``"prior"``).
        watch: By what monitors alarm, by model.
        provenance: What the models were made from.
        input_delay: Delay [s] that the models hold. Default: none.
        loop: Control problems, noise and what else loops need. Default: nothing.
        recommended: Model that observer, controller and monitor are made of where none is named. Default: the hybrid.
        members: The networks that the hybrid is the mean of, by name, the best first. Default: none.
        predicting: What :func:`hybrid_mpc.predict` needs beside the models. Default: there can be no predictions.
        programs_sha256: Hash of the models' programs. Default: not known.
        promised: The table that the run left beside the models (:attr:`promises`). Default: there is none.
        lacks: What the folder does not hold, and which stage of the run writes it, by file. Default: nothing is known
            to be missing.

    Example: the whole way from a folder to a loop::

        kit = hm.load("runs/mine")
        loop = hm.Loop(kit.observer(), kit.controller(), monitor=kit.monitor(), reference=[0.5, 0.0])
    """

    models: Mapping[str, HybridModel]
    watch: Mapping[str, WatchFile] = field(repr=False)
    provenance: Provenance
    input_delay: float = 0.0
    loop: LoopSettings = field(default_factory=LoopSettings, repr=False)
    recommended: str = "hybrid"
    members: Mapping[str, HybridModel] = field(default_factory=dict, repr=False)
    predicting: Predicting | None = field(default=None, repr=False)
    programs_sha256: str = field(default="", repr=False)
    promised: PromiseTable | None = field(default=None, repr=False)
    lacks: Mapping[str, str] = field(default_factory=dict, repr=False)

    @property
    def promises(self) -> tuple[Promise, ...]:
        """What this kit promises of its loops, and why or why not: the table that its run has made (docs/promises.md).

        Where there is none, or models, noise or control problems are others since, one row says so.

        Example:
            ``[promise.name for promise in kit.promises if promise.verdict != "shown"]``
        """
        if self.promised is None:
            return none_made(
                "this kit holds no table of promises: an older version made it, or its run did not come to the stage "
                "promises"
            )
        if self.promised.of != self.identity:
            return none_made(
                "models, noise or control problems are others than those that the table was made of"
            )
        return self.promised.rows

    @property
    def identity(self) -> str:
        """Digest of all that promises depend on: models, the recommended one, its observer, and control problems."""
        own = f"{self.recommended}_observer"
        noise = {name: sigma for name, sigma in self.loop.process_noise.items() if name == own}
        loop = replace(self.loop, causes={}, tasks=(), safe_input=None, process_noise=noise)
        return digest([self.programs_sha256, self.recommended, self.input_delay, loop])

    @property
    def name(self) -> str:
        """Name of the machine's scenario."""
        return self.provenance.scenario

    @property
    def fitted(self) -> dict[str, float]:
        """Fitted parameters of the prior by name."""
        return {p.name: p.value for p in self.models["prior"].parameters}

    @property
    def sensor_sigma(self) -> tuple[float, ...]:
        """Standard deviations of the sensors ``(n_y,)`` [output units]."""
        return self.loop.sensor_sigma

    @property
    def first_sigma(self) -> tuple[float, ...] | None:
        """Standard deviations of states that no sensor shows at an estimator's start; None: by sensors and ranges."""
        return self.loop.first_sigma

    @property
    def causes(self) -> Mapping[str, tuple[str, ...]]:
        """What may break, by name: the parameters that change together then."""
        return self.loop.causes

    @property
    def control(self) -> OCP | None:
        """The control problem of all tasks that have none of their own; None: there is none."""
        return self.loop.control.get("")

    @property
    def safe_input(self) -> tuple[float, ...] | None:
        """Input ``(n_u,)`` that the machine may be left with; None: none is declared."""
        return self.loop.safe_input

    @property
    def rest_speed(self) -> tuple[float, ...] | None:
        """Speeds ``(n_q,)`` below which friction may stick, learned from recordings; None: unknown."""
        return next((own.rest_speed for own in self.watch.values() if own.rest_speed), None)

    @property
    def known_rest(self) -> tuple[float, ...] | None:
        """The same; where none was learned, a share of the natural speeds of the recordings; None: unknown."""
        held, prior = self.predicting, self.models.get("prior")
        if self.rest_speed is not None or held is None or prior is None:
            return self.rest_speed
        n_q = prior.n_x // 2
        natural = tuple(SHARE * size for size in held.sizes.x[n_q : 2 * n_q])
        of_pairs = n_q > 0 and kinematics(prior) == {i: n_q + i for i in range(n_q)}
        return natural if of_pairs and min(natural) > 0 else None

    def with_noise(self, noise: Mapping[str, ArrayLike]) -> Kit:
        """The kit with other process noise, by estimator (see :meth:`noise`)."""
        if not isinstance(noise, Mapping):
            raise InputError(
                f"noise: numbers by the name of an estimator are needed, got {type(noise).__name__} [HM-KIT-005]"
            )
        return replace(self, loop=replace(self.loop, process_noise=tuples(noise)))

    def on(self, scenario: Scenario) -> Kit:
        """The kit with the control problems, tasks, sensors, disturbances and causes that a scenario states now; where
        it names no disturbances, the default ones (:func:`~hybrid_mpc.kit.disturbances.default_disturbances`).
        """
        if not isinstance(scenario, Scenario):
            raise InputError(f"on: a Scenario is needed, got {type(scenario).__name__} [HM-KIT-006]")
        chosen, problem = scenario.disturbance_model, scenario.control
        if chosen is None and problem is not None and problem.n_y:
            name = "prior" if "prior" in self.models else self.recommended
            chosen = default_disturbances(_disturbed(self.models, None, name), problem)
        return replace(self, loop=loop_settings(scenario, self.loop.process_noise)).with_disturbances(chosen)

    def with_disturbances(self, chosen: Sequence[Disturbance] | None) -> Kit:
        """The kit with another disturbance model (see ``Scenario``); None: one at each input."""
        own = None if chosen is None else tuple(chosen)
        models = ModelsAtUse(tuple(self.models), partial(_disturbed, self.models, own))
        return replace(self, models=models, loop=replace(self.loop, disturbance_model=own))

    def problem(self, task: str = "") -> OCP:
        """The control problem of a task; of one without a problem of its own, and where no task is named, the common
        one.

        Raises:
            InputError: If there is no such task, or no control problem.
        """
        if _named(task, "task") and (self.loop.control or TASKS not in self.lacks):
            known(task, sorted({*self.loop.tasks, *self.loop.control} - {""}), "task")
        found = self.loop.control.get(task, self.control)
        if found is None:
            raise InputError(
                f"{self._whose} was saved without a control problem: define one in the scenario (control=OCP(...)) "
                f"and run it again{self._lack(TASKS)} [HM-KIT-007]"
            )
        return found

    def noise(self, estimator: str) -> NDArray[np.float64]:
        """Process noise ``(n_x,)`` per period [state units] of an estimator.

        Args:
            estimator: Name of the model, with ``_observer`` behind it where an unknown load is followed.

        Raises:
            InputError: If the folder holds none for it, or it is of another size.
        """
        if _named(estimator, "estimator") not in self.loop.process_noise:
            raise InputError(
                f"{self._whose} was saved without process noise for {estimator}; run the scenario again (its stage "
                f"noise estimates it){self._lack(OBSERVER)} [HM-KIT-008]"
            )
        sigma, n_x = np.array(self.loop.process_noise[estimator]), next(iter(self.models.values())).n_x
        if sigma.shape != (n_x,):
            raise InputError(
                f"the model's process noise of {estimator} must be {n_x} numbers; train it anew [HM-KIT-009]"
            )
        return sigma

    def limits(self, model: str = "", kind: str = "") -> WatchLimits:
        """By what a monitor alarms.

        Args:
            model: Name of the model that is compared with the machine. Default: the recommended one.
            kind: Kind of readings, ``"energy"`` or ``"residuals"``. Default: the energy where it can be read.

        Raises:
            InputError: If the folder holds none.
        """
        watched, name = self._model(model), model or self.recommended
        kind = kind or (ENERGY if reads_energy(watched) else RESIDUALS)
        own = self.watch.get(name)
        if own is None or kind not in own.limits:
            lack = self._lack(watch_file(name)) or self._lack(WATCH)
            raise InputError(
                f"{self._whose} holds no limits of {kind} for the model {name}, which the run's stage watch learns: "
                f"run the main job again with it, take learn_limits, or {WITHOUT}{lack} [HM-KIT-010]"
            )
        return own.limits[kind]

    def observer(self, model: str = "", *, task: str = "", load: bool = True) -> Filter:
        """The estimator of a model's state, hidden state and, with ``load``, an unknown load at its inputs.

        Args:
            model: Name of the model. Default: the recommended one.
            task: Whose control problem says how large a load may be. Default: the common one.
            load: Whether it follows a load: without, a steady one leaves an offset. Default: yes.

        Raises:
            InputError: If there is no such model or task, no control problem, or no noise for this estimator.
        """
        check_flag(load, "load")
        model = _named(model, "model") or self.recommended
        found, noise = self._model(model), self.noise(f"{model}_observer" if load else model)
        return make_estimator(found, self, noise, self.problem(task), observer=load)

    def controller(
        self, model: str = "", *, task: str = "", solver: str = "rti", iterations: int | None = None
    ) -> SafeController:
        """The MPC of a model; its safeguards use the prior.

        Args:
            model: Name of the model that plans. Default: the recommended one.
            task: Whose control problem it solves. Default: the common one.
            solver: ``"rti"``, ``"native"`` (the same as compiled C), ``"sqp"`` or ``"ipopt"``.
            iterations: Linearizations a period of ``rti``, most iterations a solve of ``sqp`` and ``ipopt``; ``native``
                has one. Default: the solver's own, one of ``rti``.

        Raises:
            InputError: If there is no such model, task or solver, none of so many iterations, or no control problem.
        """
        return make_controller(
            self._model(model), self._model("prior"), self.problem(task), solver=solver, iterations=iterations,
            safe_input=self.safe_input,
        )  # fmt: skip

    def monitor(self, model: str = "", *, kind: str = "", task: str = "") -> Monitor:
        """What watches a loop or a recording, with what the run has learned.

        A mechanical model whose positions are measured is watched by its energy, any other by the residuals of its
        outputs and balances.

        Args:
            model: Name of the model that is compared with the machine. Default: the recommended one.
            kind: ``"guard"``: the readings that fit the model, with their limits; ``"energy"`` or ``"residuals"``:
                these readings, with theirs; ``"own"``: the readings that fit, without limits, so that only a monitor
                without a valid reading alarms. Default: ``"guard"``.
            task: Whose control problem gives the inputs' ranges. Default: the common one.

        Raises:
            InputError: If there is no such model, task or kind, nothing was learned by which the monitor could alarm
                (all kinds but ``"own"``), or the energy of a model is asked for that has none.
        """
        watched = self._model(model)
        kind = known(_named(kind, "kind of monitor") or "guard", WATCHES, "kind of monitor")
        of = kind if kind in (ENERGY, RESIDUALS) else ""
        limits = None if kind == "own" else self.limits(model, of)
        span = self.problem(task).input_range if self.loop.control or task else None
        rest = self.known_rest if limits is None else None
        return make_monitor(watched, limits, kind=of, rest_speed=rest, input_range=span)

    def diagnoser(self, model: str = "") -> Diagnoser:
        """What explains the alarms of a monitor with a model: changes of the prior's parameters, actuators or sensors.

        Args:
            model: Name of the model. Default: the recommended one.

        Raises:
            InputError: If there is no such model.
        """
        watched, own = self._model(model), self.watch.get(model or self.recommended)
        limits = None if own is None else own.limits.get(RESIDUALS)
        return Diagnoser(watched, limits, self.causes or None, prior=self.models.get("prior"))

    def guard(self, *, adapt: bool = False, task: str = "") -> Guard:
        """What a loop does on alarms: no input while the sensor is frozen; the rest is recorded, or adapted to.

        Args:
            adapt: Whether a backup that estimates the prior's changed parameters takes over once an alarm has lasted.
                Default: no.
            task: Whose control problem the backup solves. Default: the common one.

        Raises:
            InputError: If a backup is asked for and its model, noise, causes or task are missing.

        Example:
            ``simulate(..., monitor=kit.monitor(), guard=kit.guard())``
        """
        check_flag(adapt, "adapt")
        hybrid = self._model("hybrid")
        if not adapt:
            return make_resting_guard(hybrid)
        noise, problem = self.noise("hybrid_observer"), self.problem(task)
        return make_adaptive_guard(hybrid, self._model("prior"), self, noise, problem)

    def _lack(self, file: str) -> str:
        """What is known of a missing file, to put behind a message."""
        why = self.lacks.get(file)
        return f" ({why})" if why else ""

    @property
    def _whose(self) -> str:
        return f"the model of scenario {self.name or '(unnamed)'}"

    def _model(self, name: str) -> HybridModel:
        return self.models[known(_named(name, "model") or self.recommended, self.models, "model")]
