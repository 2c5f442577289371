"""hybrid-mpc: measurements and an ODE in, a guarded real-time nonlinear MPC out.

``import hybrid_mpc as hm``: everything that a machine is written with (``hm.Prior``, ``hm.Scenario``, ``hm.OCP`` ...),
the job (``hm.run``), what its result is used with (``hm.load``, ``hm.Loop``, ``hm.simulate``, ``hm.Runner`` ...), and
the parts of a loop, a study or an analysis of one's own. Figures are in ``hm.plots``. A module in which something is
defined may change; these names stay.

Each name is imported when it is used: torch by who trains or writes a prior in it, casadi by who writes a prior, states
a problem or runs a loop.
"""

import importlib
from typing import TYPE_CHECKING, Any

# fmt: off
if TYPE_CHECKING:  # the table below once more, for type checkers; "as" says that a name is public
    from hybrid_mpc import plots as plots
    from hybrid_mpc.analyze.equilibria import equilibria as equilibria
    from hybrid_mpc.analyze.linearize import (
        friction_slopes as friction_slopes, jacobians as jacobians, linearize as linearize,
        linearize_along as linearize_along, linearize_at_speed as linearize_at_speed,
        linearize_secant as linearize_secant,
    )
    from hybrid_mpc.analyze.margins import (
        gain_schedule as gain_schedule, mpc_gain as mpc_gain, mpc_loop as mpc_loop,
        solved_gain as solved_gain, steady_filter as steady_filter,
    )
    from hybrid_mpc.analyze.measured import (
        multisine_response as multisine_response, run_model as run_model, run_plant as run_plant,
    )
    from hybrid_mpc.analyze.memory import (
        contraction as contraction, feature_box as feature_box, gru_weights as gru_weights,
        lyapunov_exponent as lyapunov_exponent,
    )
    from hybrid_mpc.analyze.properties import (
        balanced_truncation as balanced_truncation, frequency_response as frequency_response,
        physical_states as physical_states, steady_gain as steady_gain, system_structure as system_structure,
    )
    from hybrid_mpc.analyze.sensitivity import parameter_sensitivities as parameter_sensitivities
    from hybrid_mpc.control.best_of import BestOf as BestOf
    from hybrid_mpc.control.move import Move as Move, shortest_move as shortest_move
    from hybrid_mpc.control.nlp import IpoptController as IpoptController
    from hybrid_mpc.control.ocp import OCP as OCP, Limits as Limits
    from hybrid_mpc.control.problem import Status as Status
    from hybrid_mpc.control.rti import CondensedController as CondensedController
    from hybrid_mpc.control.safeguard import SafeController as SafeController
    from hybrid_mpc.control.soft import HardBound as HardBound, SoftBound as SoftBound
    from hybrid_mpc.control.sqp import SQPController as SQPController
    from hybrid_mpc.control.targets import Targets as Targets
    from hybrid_mpc.data.differentiate import (
        CausalPolynomial as CausalPolynomial, LocalPolynomial as LocalPolynomial,
        SmoothingSpline as SmoothingSpline, ZeroPhaseFilter as ZeroPhaseFilter,
        differentiate as differentiate,
    )
    from hybrid_mpc.data.excitation import (
        check_excitation as check_excitation, chirp as chirp, excitation_of as excitation_of,
        multisine as multisine, prbs as prbs, random_steps as random_steps, sinusoid as sinusoid,
    )
    from hybrid_mpc.data.files import write_csv as write_csv
    from hybrid_mpc.data.trajectories import (
        Dataset as Dataset, Trajectory as Trajectory, load_trajectories as load_trajectories,
    )
    from hybrid_mpc.errors import InputError as InputError, SafeInputError as SafeInputError
    from hybrid_mpc.estimate.delay import DelayCompensation as DelayCompensation
    from hybrid_mpc.estimate.kalman import (
        Estimate as Estimate, ExtendedKalmanFilter as ExtendedKalmanFilter, TrueState as TrueState,
    )
    from hybrid_mpc.estimate.moving_horizon import MovingHorizonEstimator as MovingHorizonEstimator
    from hybrid_mpc.estimate.offset_free import OffsetFree as OffsetFree, offset_free as offset_free
    from hybrid_mpc.estimate.parameters import (
        parameter_factors as parameter_factors, parameter_filter as parameter_filter,
        parameter_states as parameter_states, with_parameter_states as with_parameter_states,
    )
    from hybrid_mpc.estimate.switching import SwitchingFilter as SwitchingFilter
    from hybrid_mpc.estimate.tracking import (
        TrackedParameter as TrackedParameter, TrackingFilter as TrackingFilter,
    )
    from hybrid_mpc.estimate.tuning import process_noise as process_noise
    from hybrid_mpc.estimate.unscented import UnscentedKalmanFilter as UnscentedKalmanFilter
    from hybrid_mpc.files import write_arrays as write_arrays
    from hybrid_mpc.identify.ahead import errors_ahead as errors_ahead
    from hybrid_mpc.identify.evaluate import (
        evaluation_trajectories as evaluation_trajectories, free_runs as free_runs, score as score,
    )
    from hybrid_mpc.identify.export import check_parity as check_parity, trace_model as trace_model
    from hybrid_mpc.identify.fit import fit_prior as fit_prior
    from hybrid_mpc.identify.linear import (
        LinearModel as LinearModel, fit_arx as fit_arx, fit_subspace as fit_subspace,
    )
    from hybrid_mpc.identify.networks import GRUNetwork as GRUNetwork
    from hybrid_mpc.identify.predict import Prediction as Prediction, predict as predict
    from hybrid_mpc.identify.prior_model import model_info as model_info
    from hybrid_mpc.identify.settings import TrainingSettings as TrainingSettings
    from hybrid_mpc.identify.smooth import fit_smoother as fit_smoother
    from hybrid_mpc.identify.step import (
        HybridStep as HybridStep, PriorStep as PriorStep, Scaling as Scaling, n_features as n_features,
    )
    from hybrid_mpc.identify.train import train as train
    from hybrid_mpc.identify.tune import SearchSpace as SearchSpace, tune as tune
    from hybrid_mpc.identify.varying import find_varying as find_varying
    from hybrid_mpc.identify.windows import FirstStates as FirstStates
    from hybrid_mpc.check.preflight import check_scenario as check_scenario
    from hybrid_mpc.check.with_terms import with_terms as with_terms
    from hybrid_mpc.workflow.check_fit import check_fit as check_fit
    from hybrid_mpc.workflow.explain import explain as explain
    from hybrid_mpc.compare.controllers import find_noise as find_noise
    from hybrid_mpc.compare.loops import Bench as Bench, LoopRow as LoopRow, LoopSpec as LoopSpec, varied as varied
    from hybrid_mpc.workflow.run import run as run
    from hybrid_mpc.compare.sequential import Comparison as Comparison, compare_costs as compare_costs
    from hybrid_mpc.workflow.settings import RunSettings as RunSettings
    from hybrid_mpc.compare.study import FaultKind as FaultKind, RandomFaults as RandomFaults, Study as Study
    from hybrid_mpc.compare.study_results import (
        StudyResults as StudyResults, write_study_report as write_study_report,
    )
    from hybrid_mpc.compare.study_run import dry_run as dry_run, run_study as run_study
    from hybrid_mpc.kit.artifact import Kit as Kit, load as load, save_artifact as save_artifact
    from hybrid_mpc.kit.assembly import (
        make_adaptive_guard as make_adaptive_guard, make_controller as make_controller,
        make_estimator as make_estimator, make_ocp as make_ocp,
        make_resting_guard as make_resting_guard,
    )
    from hybrid_mpc.kit.export_c import generate_controller as generate_controller
    from hybrid_mpc.kit.parts import (
        LoopSettings as LoopSettings, ModelInfo as ModelInfo, Provenance as Provenance,
        set_limits as set_limits, set_process_noise as set_process_noise,
    )
    from hybrid_mpc.kit.promises import Promise as Promise
    from hybrid_mpc.loop.faults import (
        Fault as Fault, check_plant_faults as check_plant_faults, corrupt_input as corrupt_input,
        corrupt_measurement as corrupt_measurement,
    )
    from hybrid_mpc.loop.guard import Guard as Guard, Mode as Mode
    from hybrid_mpc.loop.loop import Loop as Loop
    from hybrid_mpc.loop.realtime import Runner as Runner, SafeEnd as SafeEnd
    from hybrid_mpc.loop.simulate import ClosedLoopResult as ClosedLoopResult, simulate as simulate
    from hybrid_mpc.machine import terms as terms
    from hybrid_mpc.machine.mechanical import MechanicalPrior as MechanicalPrior
    from hybrid_mpc.machine.prior import Balance as Balance, OperatingPoint as OperatingPoint, Prior as Prior
    from hybrid_mpc.machine.signals import Parameter as Parameter, Signal as Signal
    from hybrid_mpc.machine.specification import (
        BenchmarkBudget as BenchmarkBudget, BenchmarkSpec as BenchmarkSpec, ChoiceRule as ChoiceRule,
        DataSpec as DataSpec, Role as Role, Window as Window,
    )
    from hybrid_mpc.machine.terms import Term as Term, extended as extended, with_nominal as with_nominal
    from hybrid_mpc.machine.torch_prior import TorchPrior as TorchPrior
    from hybrid_mpc.model.buffered import BufferedFunction as BufferedFunction
    from hybrid_mpc.model.delay import with_input_delay as with_input_delay
    from hybrid_mpc.model.disturbance import Disturbance as Disturbance
    from hybrid_mpc.model.equilibrium import Steady as Steady, holding_input as holding_input
    from hybrid_mpc.model.model import (
        HybridModel as HybridModel, kinematics as kinematics, longer_period as longer_period,
    )
    from hybrid_mpc.model.riccati import dare as dare, lqr as lqr
    from hybrid_mpc.scenario import (
        DEFAULT_BUDGETS as DEFAULT_BUDGETS, Budget as Budget, Scenario as Scenario, Task as Task,
        load_scenario as load_scenario,
    )
    from hybrid_mpc.watch.detector import ChannelLimit as ChannelLimit, WatchLimits as WatchLimits
    from hybrid_mpc.watch.diagnose import Diagnoser as Diagnoser
    from hybrid_mpc.watch.energy import EnergyReadings as EnergyReadings
    from hybrid_mpc.watch.learn import learn_limits as learn_limits
    from hybrid_mpc.watch.lengths import rest_speeds as rest_speeds
    from hybrid_mpc.watch.monitor import (
        Monitor as Monitor, make_monitor as make_monitor, make_readings as make_readings,
    )
    from hybrid_mpc.watch.replay import Trace as Trace, count_alarms as count_alarms, replay as replay
    from hybrid_mpc.watch.residuals import ResidualReadings as ResidualReadings
# fmt: on

__version__: str

_ROOMS = {
    "analyze.equilibria": ("equilibria",),
    "analyze.linearize": (
        "friction_slopes", "jacobians", "linearize", "linearize_along", "linearize_at_speed", "linearize_secant",
    ),
    "analyze.margins": ("gain_schedule", "mpc_gain", "mpc_loop", "solved_gain", "steady_filter"),
    "analyze.measured": ("multisine_response", "run_model", "run_plant"),
    "analyze.memory": ("contraction", "feature_box", "gru_weights", "lyapunov_exponent"),
    "analyze.properties": (
        "balanced_truncation", "frequency_response", "physical_states", "steady_gain", "system_structure",
    ),
    "analyze.sensitivity": ("parameter_sensitivities",),
    "check.preflight": ("check_scenario",),
    "check.with_terms": ("with_terms",),
    "compare.controllers": ("find_noise",),
    "compare.loops": ("Bench", "LoopRow", "LoopSpec", "varied"),
    "compare.sequential": ("Comparison", "compare_costs"),
    "compare.study": ("FaultKind", "RandomFaults", "Study"),
    "compare.study_results": ("StudyResults", "write_study_report"),
    "compare.study_run": ("dry_run", "run_study"),
    "control.best_of": ("BestOf",),
    "control.move": ("Move", "shortest_move"),
    "control.nlp": ("IpoptController",),
    "control.ocp": ("Limits", "OCP"),
    "control.problem": ("Status",),
    "control.rti": ("CondensedController",),
    "control.safeguard": ("SafeController",),
    "control.soft": ("HardBound", "SoftBound"),
    "control.sqp": ("SQPController",),
    "control.targets": ("Targets",),
    "data.differentiate": (
        "CausalPolynomial", "LocalPolynomial", "SmoothingSpline", "ZeroPhaseFilter", "differentiate",
    ),
    "data.excitation": (
        "check_excitation", "chirp", "excitation_of", "multisine", "prbs", "random_steps", "sinusoid",
    ),
    "data.files": ("write_csv",),
    "data.trajectories": ("Dataset", "Trajectory", "load_trajectories"),
    "errors": ("InputError", "SafeInputError"),
    "estimate.delay": ("DelayCompensation",),
    "estimate.kalman": ("Estimate", "ExtendedKalmanFilter", "TrueState"),
    "estimate.moving_horizon": ("MovingHorizonEstimator",),
    "estimate.offset_free": ("OffsetFree", "offset_free"),
    "estimate.parameters": (
        "parameter_factors", "parameter_filter", "parameter_states", "with_parameter_states",
    ),
    "estimate.switching": ("SwitchingFilter",),
    "estimate.tracking": ("TrackedParameter", "TrackingFilter"),
    "estimate.tuning": ("process_noise",),
    "estimate.unscented": ("UnscentedKalmanFilter",),
    "files": ("write_arrays",),
    "identify.ahead": ("errors_ahead",),
    "identify.evaluate": ("evaluation_trajectories", "free_runs", "score"),
    "identify.export": ("check_parity", "trace_model"),
    "identify.fit": ("fit_prior",),
    "identify.linear": ("LinearModel", "fit_arx", "fit_subspace"),
    "identify.networks": ("GRUNetwork",),
    "identify.predict": ("Prediction", "predict"),
    "identify.prior_model": ("model_info",),
    "identify.settings": ("TrainingSettings",),
    "identify.smooth": ("fit_smoother",),
    "identify.step": ("HybridStep", "PriorStep", "Scaling", "n_features"),
    "identify.train": ("train",),
    "identify.tune": ("SearchSpace", "tune"),
    "identify.varying": ("find_varying",),
    "identify.windows": ("FirstStates",),
    "kit.artifact": ("Kit", "load", "save_artifact"),
    "kit.assembly": (
        "make_adaptive_guard", "make_controller", "make_estimator", "make_ocp",
        "make_resting_guard",
    ),
    "kit.export_c": ("generate_controller",),
    "kit.parts": ("LoopSettings", "ModelInfo", "Provenance", "set_limits", "set_process_noise"),
    "kit.promises": ("Promise",),
    "loop.faults": ("Fault", "check_plant_faults", "corrupt_input", "corrupt_measurement"),
    "loop.guard": ("Guard", "Mode"),
    "loop.loop": ("Loop",),
    "loop.realtime": ("Runner", "SafeEnd"),
    "loop.simulate": ("ClosedLoopResult", "simulate"),
    "machine.mechanical": ("MechanicalPrior",),
    "machine.prior": ("Balance", "OperatingPoint", "Prior"),
    "machine.signals": ("Parameter", "Signal"),
    "machine.specification": ("BenchmarkBudget", "BenchmarkSpec", "ChoiceRule", "DataSpec", "Role", "Window"),
    "machine.terms": ("Term", "extended", "with_nominal"),
    "machine.torch_prior": ("TorchPrior",),
    "model.buffered": ("BufferedFunction",),
    "model.delay": ("with_input_delay",),
    "model.disturbance": ("Disturbance",),
    "model.equilibrium": ("Steady", "holding_input"),
    "model.model": ("HybridModel", "kinematics", "longer_period"),
    "model.riccati": ("dare", "lqr"),
    "scenario": ("Budget", "DEFAULT_BUDGETS", "Scenario", "Task", "load_scenario"),
    "watch.detector": ("ChannelLimit", "WatchLimits"),
    "watch.diagnose": ("Diagnoser",),
    "watch.energy": ("EnergyReadings",),
    "watch.learn": ("learn_limits",),
    "watch.lengths": ("rest_speeds",),
    "watch.monitor": ("Monitor", "make_monitor", "make_readings"),
    "watch.replay": ("Trace", "count_alarms", "replay"),
    "watch.residuals": ("ResidualReadings",),
    "workflow.check_fit": ("check_fit",),
    "workflow.explain": ("explain",),
    "workflow.run": ("run",),
    "workflow.settings": ("RunSettings",),
}  # fmt: skip
"""Public names by the module that defines them."""
_HOME = {name: room for room, names in _ROOMS.items() for name in names}
_MODULES = {"plots": "plots", "terms": "machine.terms"}
"""Public modules by their names."""
__all__ = sorted((*_HOME, *_MODULES, "__version__"))


def _version() -> str:
    from importlib.metadata import PackageNotFoundError, version

    try:
        return version("hybrid-mpc")
    except PackageNotFoundError:  # a source tree that was never installed
        return "0+unknown"


def __getattr__(name: str) -> Any:
    if name == "__version__":
        return _version()
    if name not in _MODULES and name not in _HOME:
        raise AttributeError(f"module 'hybrid_mpc' has no attribute {name!r}")
    from hybrid_mpc.errors import named_extra

    with named_extra(f"hybrid_mpc.{name}"):
        if name in _MODULES:
            return importlib.import_module(f"hybrid_mpc.{_MODULES[name]}")
        return getattr(importlib.import_module(f"hybrid_mpc.{_HOME[name]}"), name)


def __dir__() -> list[str]:
    return sorted({*globals(), *__all__})
