"""The artifact, a folder with deployed models as data, and the kit, which builds the parts of a loop from it.

:mod:`hybrid_mpc.kit.parts` describes the files of the folder. Loading needs no torch, and executes nothing from the
folder.
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
from hybrid_mpc.estimate.tracking import TrackedParameter, TrackingFilter, tracked_range, with_tracked
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
from hybrid_mpc.model.blend import BLEND_SHARE, blended, with_share
from hybrid_mpc.model.delay import with_input_delay
from hybrid_mpc.model.disturbance import Disturbance
from hybrid_mpc.model.limits import check_flag
from hybrid_mpc.model.model import STEP_INPUTS, STEP_OUTPUTS, Balance, HybridModel, kinematics
from hybrid_mpc.records import known, plain
from hybrid_mpc.scenario import Scenario
from hybrid_mpc.watch.detector import ChannelLimit, WatchLimits
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
ONE_SIDED = 0.5
"""Ratio of the deviations to both sides below which only the larger counts: a bound cuts off the smaller one."""
RELEASED = 0.9
"""Share of a tracked parameter's limit at which its alarm ends."""
OWN = ("step", "xdot")
"""Functions that each single network has of its own; the others are those of the hybrid."""
OUTPUTS = {"step": STEP_OUTPUTS, "xdot": ("xdot",), "output": ("y",), BALANCE: ("residual",)}
JACOBIANS = {"A": ("x", "h"), "B": ("u",)}
WATCHES = ("own", "guard", "energy", "residuals")
"""Kinds of monitor, see :meth:`Kit.monitor`."""

WITHOUT = 'use no alarms: kind="own" only records readings, monitor=None (export c: --no-monitor) removes the monitor'


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
) -> str:
    """Write models, and the settings of loops with them, to ``folder``: ``models/`` and then ``kit.json``.

    Args:
        folder: Folder to write; it is made if missing.
        programs: Program of each function of each model, e.g. ``programs["hybrid"]["step"]``, and of each of its
            balances, ``programs["hybrid"]["balance/energy"]``.
        info: Period and signals, the same for all models.
        limits: Limits of the monitors, by model. Default: none.
        provenance: Origin of the models. Default: unknown.
        loop: Settings of loops: control problems, noise. Default: none.
        recommended: Name of the default model of a loop. Default: the hybrid.
        members: ``step`` and ``xdot`` of each network that the hybrid is the mean of, the best first. Default: none.
        predicting: Settings of predictions of recordings. Default: none, predictions are not possible.

    Returns:
        The hash of the programs.

    Raises:
        InputError: If an expression of a control problem cannot be written as a program.
    """
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
    if loop is not None:
        save_loop(folder, loop)
    if limits is not None:
        set_limits(folder, limits)
    return hashed


def build_model(name: str, programs: Mapping[str, nn_export.Program], info: ModelInfo) -> HybridModel:
    """Build a model from ``programs["<name>/step"]`` and its other functions, with the input's delay.

    Raises:
        KeyError: If a program is missing.
        nn_export.ExportError: If a program cannot be built.
        InputError: If the sizes of the programs do not match the signals.
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
    """Models that are built at their first use; KeyError if one of their programs is missing."""
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
    """Load the kit of an artifact: models, and everything that loops with them need.

    Files that are missing, or that belong to other models or another observer, are left out (docs/kit.md);
    :attr:`Kit.lacks` names them, and methods that need them raise.

    Args:
        folder: The run's folder, or its folder ``model``.

    Raises:
        InputError: If there is no artifact, a file is damaged or of another version, or the models are missing.

    Example:
        ``kit = hm.load("runs/mine")``
    """
    if not isinstance(folder, str | Path):
        raise InputError(f"load: give the path of a folder, got {type(folder).__name__} [HM-KIT-001]")
    folder = artifact_folder(Path(folder))
    parts = read_parts(folder)
    found = parts.description
    if sha256(folder / PROGRAMS) != found.programs_sha256:
        raise InputError(
            f"{folder}: {PROGRAMS} does not belong to {KIT}. The stage export was interrupted, or a file was changed; "
            f"{AGAIN}, or copy the folder from its run [HM-KIT-002]"
        )
    try:
        programs = nn_export.load_programs(folder / MODELS)
        models = _at_use(found.models, programs, found.model, parts.loop.disturbance_model)
        members = member_models(programs, found.model, found.members)
    except KeyError as error:
        raise InputError(
            f"{folder}: {PROGRAMS} lacks {error}, which {KIT} names; {AGAIN}, or copy the folder from its run "
            "[HM-KIT-003]"
        ) from error
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
    if not isinstance(name, str):
        raise InputError(f"{what}: give a name, got {type(name).__name__} [HM-KIT-004]")
    return name


def _disturbed(
    models: Mapping[str, HybridModel], chosen: tuple[Disturbance, ...] | None, name: str
) -> HybridModel:
    """A model with the chosen disturbance model; the same object if it already has it."""
    model = models[name]
    return model if model.disturbance_model == chosen else replace(model, disturbance_model=chosen)


def drift_limits(model: HybridModel, tracked: Sequence[TrackedParameter]) -> tuple[ChannelLimit, ...]:
    """Limits of a model's tracked parameters: their distance from the fitted value at three standard deviations.

    A parameter that drifts as it did between the recordings stays within them; beyond, the machine is another one, or
    has a fault. The nearer side counts for both, except for a parameter near one of its bounds.
    """
    parameters = {p.name: p for p in model.parameters}
    found = []
    for one, low, high in zip(tracked, *tracked_range(model, tracked), strict=True):
        p = parameters[one.name]
        near, far = sorted((high - p.value, p.value - low))
        far = near if near >= ONE_SIDED * far else far
        if far > 0:
            found.append(ChannelLimit(p.name, p.unit, 1, far, RELEASED * far))
    return tuple(found)


@dataclass(frozen=True)
class Kit:
    """A loaded artifact: its models, and methods that build estimator, controller, monitor and guard from them.

    Args:
        models: Deployed models by name (``"hybrid"``, ``"prior"``).
        watch: Limits of the monitors, by model.
        provenance: Origin of the models.
        input_delay: Delay [s] of the inputs in the models. Default: 0.
        loop: Settings of loops: control problems, noise. Default: none.
        recommended: Default model of observer, controller and monitor. Default: the hybrid.
        members: The networks that the hybrid is the mean of, by name, the best first. Default: none.
        predicting: Settings of :func:`hybrid_mpc.predict`. Default: none, predictions are not possible.
        programs_sha256: Hash of the models' programs. Default: unknown.
        promised: The table of promises in the folder (:attr:`promises`). Default: none.
        lacks: Missing content and the stage of the run that writes it, by file. Default: nothing is missing.

    Example: from a folder to a loop::

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
        """The table "What this kit promises" of its run (docs/promises.md).

        If the table is missing, or models, noise or control problems have changed since, a single row says so.

        Example:
            ``[promise.name for promise in kit.promises if promise.verdict != "shown"]``
        """
        if self.promised is None:
            return none_made(
                "this kit contains no table of promises: an older version made it, or its run did not finish the stage "
                "promises"
            )
        if self.promised.of != self.identity:
            return none_made("models, noise or control problems have changed since the table was made")
        return self.promised.rows

    @property
    def identity(self) -> str:
        """Digest of everything that promises depend on: models, recommended model, its observer, control problems,
        tracked parameters.
        """
        own = f"{self.recommended}_observer"
        noise = {name: sigma for name, sigma in self.loop.process_noise.items() if name == own}
        loop = replace(self.loop, causes={}, tasks=(), safe_input=None, process_noise=noise)
        plain_loop = plain(loop)
        if not loop.tracked:
            del plain_loop["tracked"]  # as in kits of older versions
        return digest([self.programs_sha256, self.recommended, self.input_delay, plain_loop])

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
        """Initial standard deviations of the states that no output measures directly; None: from sensors and ranges."""
        return self.loop.first_sigma

    @property
    def causes(self) -> Mapping[str, tuple[str, ...]]:
        """Possible faults by name: the parameters that change together."""
        return self.loop.causes

    @property
    def control(self) -> OCP | None:
        """The common control problem, of all tasks without one of their own; None if missing."""
        return self.loop.control.get("")

    @property
    def safe_input(self) -> tuple[float, ...] | None:
        """Input ``(n_u,)`` with which the machine may be left alone; None if not declared."""
        return self.loop.safe_input

    @property
    def rest_speed(self) -> tuple[float, ...] | None:
        """Speeds ``(n_q,)`` below which friction may stick, learned from recordings; None: unknown."""
        return next((own.rest_speed for own in self.watch.values() if own.rest_speed), None)

    @property
    def known_rest(self) -> tuple[float, ...] | None:
        """:attr:`rest_speed`; if none was learned, a share of the typical speeds of the recordings; None: unknown."""
        held, prior = self.predicting, self.models.get("prior")
        if self.rest_speed is not None or held is None or prior is None:
            return self.rest_speed
        n_q = prior.n_x // 2
        natural = tuple(SHARE * size for size in held.sizes.x[n_q : 2 * n_q])
        of_pairs = n_q > 0 and kinematics(prior) == {i: n_q + i for i in range(n_q)}
        return natural if of_pairs and min(natural) > 0 else None

    def with_noise(self, noise: Mapping[str, ArrayLike]) -> Kit:
        """A kit with other process noise, by estimator (see :meth:`noise`)."""
        if not isinstance(noise, Mapping):
            raise InputError(
                f"noise: give a mapping from estimator to numbers, got {type(noise).__name__} [HM-KIT-005]"
            )
        return replace(self, loop=replace(self.loop, process_noise=tuples(noise)))

    def on(self, scenario: Scenario) -> Kit:
        """A kit with the present control problems, tasks, sensors, disturbances and causes of a scenario.

        Without declared disturbances, the default ones are used
        (:func:`~hybrid_mpc.kit.disturbances.default_disturbances`).
        """
        if not isinstance(scenario, Scenario):
            raise InputError(f"on: give a Scenario, got {type(scenario).__name__} [HM-KIT-006]")
        chosen, problem = scenario.disturbance_model, scenario.control
        if chosen is None and problem is not None and problem.n_y:
            name = "prior" if "prior" in self.models else self.recommended
            chosen = default_disturbances(_disturbed(self.models, None, name), problem)
        loop = replace(loop_settings(scenario, self.loop.process_noise), tracked=self.loop.tracked)
        return replace(self, loop=loop).with_disturbances(chosen)

    def with_disturbances(self, chosen: Sequence[Disturbance] | None) -> Kit:
        """A kit with another disturbance model (see ``Scenario``); None: one disturbance at each input."""
        own = None if chosen is None else tuple(chosen)
        models = ModelsAtUse(tuple(self.models), partial(_disturbed, self.models, own))
        return replace(self, models=models, loop=replace(self.loop, disturbance_model=own))

    def problem(self, task: str = "") -> OCP:
        """The control problem of a task; the common one if the task has none of its own, or no task is given.

        Raises:
            InputError: If the task is unknown, or the control problem is missing.
        """
        if _named(task, "task") and (self.loop.control or TASKS not in self.lacks):
            known(task, sorted({*self.loop.tasks, *self.loop.control} - {""}), "task")
        found = self.loop.control.get(task, self.control)
        if found is None:
            raise InputError(
                f"{self._whose}: no control problem. Define one in the scenario (control=OCP(...)) and run it again"
                f"{self._lack(TASKS)} [HM-KIT-007]"
            )
        return found

    def noise(self, estimator: str) -> NDArray[np.float64]:
        """Process noise ``(n_x,)`` per period [state units] of an estimator.

        Args:
            estimator: Name of the model, followed by ``_observer`` if the estimator estimates an unknown load.

        Raises:
            InputError: If the noise of this estimator is missing, or has another size.
        """
        if _named(estimator, "estimator") not in self.loop.process_noise:
            raise InputError(
                f"{self._whose}: no process noise for {estimator}. Run the scenario again; its stage noise estimates it"
                f"{self._lack(OBSERVER)} [HM-KIT-008]"
            )
        sigma, n_x = np.array(self.loop.process_noise[estimator]), next(iter(self.models.values())).n_x
        if sigma.shape != (n_x,):
            raise InputError(
                f"{self._whose}: the process noise of {estimator} must have {n_x} numbers, got {sigma.size}. Run the "
                "scenario again [HM-KIT-009]"
            )
        return sigma

    def limits(self, model: str = "", kind: str = "") -> WatchLimits:
        """Limits of a monitor.

        Args:
            model: Name of the model that is compared with the machine. Default: the recommended model.
            kind: Kind of readings, ``"energy"`` or ``"residuals"``. Default: the energy if the model allows it.

        Raises:
            InputError: If the limits are missing.
        """
        watched, name = self._model(model), model or self.recommended
        kind = kind or (ENERGY if reads_energy(watched) else RESIDUALS)
        own = self.watch.get(name)
        if own is None or kind not in own.limits:
            lack = self._lack(watch_file(name)) or self._lack(WATCH)
            raise InputError(
                f"{self._whose}: no limits of {kind} for the model {name}. The stage watch of a run learns them: run "
                f"the scenario again with this stage, use learn_limits, or {WITHOUT}{lack} [HM-KIT-010]"
            )
        return own.limits[kind]

    def observer(
        self, model: str = "", *, task: str = "", load: bool = True, kind: str = "switching",
        input_noise: float = 0.0,
    ) -> Filter:  # fmt: skip
        """The estimator of a model's state, hidden state and, with ``load``, unknown disturbances.

        Args:
            model: Name of the model. Default: the recommended model.
            task: Task whose control problem determines the size of a load. Default: the common control problem.
            load: Whether it estimates a load; without this, a constant load causes an offset. Default: True.
            kind: ``"switching"``, ``"ekf"``, ``"ukf"`` or ``"mhe"`` (docs/observers.md). Default: switching.
            input_noise: Noise that the filter assumes at the inputs, as a share of their ranges, with which a loop
                bears larger errors of the model (docs/disturbances.md#the-observer). Default: 0.

        Raises:
            InputError: If model, task or kind are unknown, or control problem or noise are missing.
        """
        check_flag(load, "load")
        model = _named(model, "model") or self.recommended
        found, noise = self._model(model), self.noise(f"{model}_observer" if load else model)
        return make_estimator(
            found, self, noise, self.problem(task), observer=load, kind=kind, input_noise=input_noise
        )

    def tracking_observer(
        self, model: str = "", *, task: str = "", load: bool = True, kind: str = "switching",
        input_noise: float = 0.0,
    ) -> TrackingFilter:  # fmt: skip
        """:meth:`observer` that also tracks the parameters that differ between recordings (docs/tracking.md).

        Its estimates belong to the model whose last measured disturbances are the tracked parameters; a loop needs the
        controller of the same model, ``kit.controller(tracking=True)``.

        Args:
            model: Name of the model. Default: the recommended model.
            task: As for :meth:`observer`.
            load: As for :meth:`observer`.
            kind: As for :meth:`observer`.
            input_noise: As for :meth:`observer`.

        Raises:
            InputError: If the kit names no tracked parameters, or as :meth:`observer`.

        Example:
            ``loop = hm.Loop(kit.tracking_observer(), kit.controller(tracking=True), reference=[0.5])``
        """
        own = self.observer(model, task=task, load=load, kind=kind, input_noise=input_noise)
        return TrackingFilter(own, self._tracked())

    def with_tracked(self, tracked: Sequence[TrackedParameter]) -> Kit:
        """A kit whose :meth:`tracking_observer` tracks these parameters."""
        return replace(self, loop=replace(self.loop, tracked=tuple(tracked)))

    def blended(self, share: float | None = None, std: float = 0.3) -> Kit:
        """A kit whose tracking observer runs prior and hybrid side by side and estimates the share of the correction.

        Its hybrid is ``prior + share (hybrid - prior)`` (:func:`~hybrid_mpc.model.blend.blended`); the share, from 0 to
        2, is one more tracked parameter. Where the machine has changed since the recordings, the correction may no
        longer fit: the loop then uses less of it, or more.

        Args:
            share: Share that the observer starts with. Default: 1, the hybrid, if the hybrid is recommended.
            std: Standard deviation of the share. Default: 0.3, so that prior and hybrid are three deviations apart.

        Raises:
            InputError: If the kit has no hybrid, the share is not inside 0 to 2, or the prior is recommended and no
                share is given.

        Example:
            ``kit = hm.load("runs/mine").blended()``;
            ``loop = hm.Loop(kit.tracking_observer("hybrid"), kit.controller("hybrid", tracking=True))``
        """
        prior, hybrid = self._model("prior"), self._model("hybrid")
        if share is None and self.recommended != "hybrid":
            raise InputError(
                f"{self._whose}: the prior is recommended: no evidence shows that the correction helps, and a blend "
                "may be worse (docs/results/tracking.md). Use kit.observer(), or give share= [HM-KIT-042]"
            )
        share = BLEND_SHARE.value if share is None else share
        if not 0.0 < share < BLEND_SHARE.upper:
            raise InputError(f"share: must be between 0 and {BLEND_SHARE.upper:g}, got {share} [HM-KIT-041]")
        models = {"prior": with_share(prior, share), "hybrid": blended(prior, hybrid, share)}
        tracked = (*self.loop.tracked, TrackedParameter(BLEND_SHARE.name, std))
        return replace(self, models={**self.models, **models}).with_tracked(tracked)

    def _tracked(self) -> tuple[TrackedParameter, ...]:
        if not self.loop.tracked:
            raise InputError(
                f"{self._whose}: no parameter is tracked: tracking does not improve the predictions, or was not "
                "tested. Use kit.observer(), or name parameters: kit.with_tracked([TrackedParameter(...)]) [HM-KIT-040]"
            )
        return self.loop.tracked

    def controller(
        self, model: str = "", *, task: str = "", solver: str = "rti", iterations: int | None = None,
        tracking: bool = False,
    ) -> SafeController:  # fmt: skip
        """The MPC of a model with its safeguards, which use the prior.

        Args:
            model: Name of the model that plans. Default: the recommended model.
            task: Task whose control problem is solved. Default: the common control problem.
            solver: ``"rti"``, ``"native"`` (the same as compiled C), ``"sqp"`` or ``"ipopt"``. Default: rti.
            iterations: Linearizations a period of ``rti``, or largest number of iterations a solve of ``sqp`` and
                ``ipopt``; ``native`` always has one. Default: that of the solver, one for ``rti``.
            tracking: Whether it plans with the parameters of :meth:`tracking_observer`. Default: False.

        Raises:
            InputError: If model, task or solver are unknown, ``iterations`` is not possible, the control problem is
                missing, or ``tracking`` is requested and the kit names no tracked parameters.
        """
        check_flag(tracking, "tracking")
        models = self._model(model), self._model("prior")
        if tracking:
            planning, prior = (with_tracked(one, self._tracked()) for one in models)
            models = planning, planning if models[0] is models[1] else prior
        return make_controller(
            *models, self.problem(task), solver=solver, iterations=iterations, safe_input=self.safe_input
        )

    def monitor(self, model: str = "", *, kind: str = "", task: str = "", tracking: bool = False) -> Monitor:
        """The monitor of a loop or a recording, with the limits learned by the run.

        A mechanical model with measured positions is monitored by its energy, any other model by the residuals of its
        outputs and balances.

        Args:
            model: Name of the model that is compared with the machine. Default: the recommended model.
            kind: ``"guard"``: the suitable readings with their limits; ``"energy"`` or ``"residuals"``: these readings
                with their limits; ``"own"``: the suitable readings without limits, so that it only alarms without a
                valid reading. Default: ``"guard"``.
            task: Task whose control problem gives the inputs' ranges. Default: the common control problem.
            tracking: For a loop with :meth:`tracking_observer`: readings use the tracked parameters, so that their
                drift raises no alarm, and a parameter beyond three standard deviations does, by its name. The kind
                ``"guard"`` then means residuals. Default: False.

        Raises:
            InputError: If model, task or kind are unknown, limits are missing (all kinds but ``"own"``),
                ``"energy"`` is requested for a model without energy balance, or ``tracking`` is requested and the kit
                names no tracked parameters.
        """
        watched = self._model(model)
        kind = known(_named(kind, "kind of monitor") or "guard", WATCHES, "kind of monitor")
        of = kind if kind in (ENERGY, RESIDUALS) else ""
        check_flag(tracking, "tracking")
        of = of or RESIDUALS if tracking else of
        limits = None if kind == "own" else self.limits(model, of)
        if tracking:
            watched = with_tracked(watched, self._tracked())
            if limits is not None and limits.kind == RESIDUALS:
                beyond = drift_limits(self._model(model), self._tracked())
                limits = replace(limits, channels=(*limits.channels, *beyond))
        span = self.problem(task).input_range if self.loop.control or task else None
        rest = self.known_rest if limits is None else None
        return make_monitor(watched, limits, kind=of, rest_speed=rest, input_range=span)

    def diagnoser(self, model: str = "") -> Diagnoser:
        """The diagnoser of a monitor's alarms: changes of the prior's parameters, actuators or sensors.

        Args:
            model: Name of the model. Default: the recommended model.

        Raises:
            InputError: If the model is unknown.
        """
        watched, own = self._model(model), self.watch.get(model or self.recommended)
        limits = None if own is None else own.limits.get(RESIDUALS)
        return Diagnoser(watched, limits, self.causes or None, prior=self.models.get("prior"))

    def guard(self, *, adapt: bool = False, task: str = "") -> Guard:
        """The guard of a loop, which reacts to alarms: with the safe input while a sensor is frozen; other alarms are
        recorded, or cause a switch to an adaptive backup.

        Args:
            adapt: Whether to switch to a backup that estimates the prior's changed parameters after a persistent alarm.
                Default: False.
            task: Task whose control problem the backup solves. Default: the common control problem.

        Raises:
            InputError: If a backup is requested and its model, noise, causes or task are missing.

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
        """Reason why a file is missing, as an addition to a message."""
        why = self.lacks.get(file)
        return f" ({why})" if why else ""

    @property
    def _whose(self) -> str:
        return f"model of scenario {self.name or '(unnamed)'}"

    def _model(self, name: str) -> HybridModel:
        return self.models[known(_named(name, "model") or self.recommended, self.models, "model")]
