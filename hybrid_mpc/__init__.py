"""hybrid-mpc: measurements and an ODE in, a guarded real-time nonlinear MPC out.

``import hybrid_mpc as hm``: everything that a machine is written with (``hm.Prior``, ``hm.Scenario``, ``hm.OCP`` ...),
the job (``hm.run``), what its result is used with (``hm.load``, ``hm.Loop``, ``hm.simulate``, ``hm.Runner`` ...), and
the parts of a loop, a study or an analysis of one's own. Figures are in ``hm.plots``. A module in which something is
defined may change; these names stay.

Each name is imported when it is used: torch by who trains or writes a prior in it, casadi by who writes a prior, states
a problem or runs a loop.
"""

import importlib
from importlib.metadata import PackageNotFoundError, version
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from hybrid_mpc import plots
    from hybrid_mpc.analyze.equilibria import equilibria, holding_input
    from hybrid_mpc.analyze.linearize import (
        friction_slopes,
        jacobians,
        linearize,
        linearize_along,
        linearize_at_speed,
        linearize_secant,
    )
    from hybrid_mpc.analyze.margins import gain_schedule, mpc_gain, mpc_loop, steady_filter
    from hybrid_mpc.analyze.measured import multisine_response, run_model, run_plant
    from hybrid_mpc.analyze.memory import contraction, feature_box, gru_weights, lyapunov_exponent
    from hybrid_mpc.analyze.properties import (
        balanced_truncation,
        frequency_response,
        physical_states,
        steady_gain,
        system_structure,
    )
    from hybrid_mpc.analyze.sensitivity import parameter_sensitivities
    from hybrid_mpc.control.best_of import BestOf
    from hybrid_mpc.control.move import Move, shortest_move
    from hybrid_mpc.control.nlp import IpoptController
    from hybrid_mpc.control.ocp import OCP, Limits
    from hybrid_mpc.control.problem import Status
    from hybrid_mpc.control.rti import CondensedController
    from hybrid_mpc.control.safeguard import SafeController
    from hybrid_mpc.control.soft import HardBound, SoftBound
    from hybrid_mpc.control.sqp import SQPController
    from hybrid_mpc.control.targets import Steady, Targets
    from hybrid_mpc.data.differentiate import (
        CausalPolynomial,
        LocalPolynomial,
        SmoothingSpline,
        ZeroPhaseFilter,
        differentiate,
    )
    from hybrid_mpc.data.excitation import (
        check_excitation,
        chirp,
        excitation_of,
        multisine,
        prbs,
        random_steps,
        sinusoid,
    )
    from hybrid_mpc.data.files import write_csv
    from hybrid_mpc.data.trajectories import Dataset, Trajectory, load_trajectories
    from hybrid_mpc.errors import InputError, SafeInputError
    from hybrid_mpc.estimate.delay import DelayCompensation
    from hybrid_mpc.estimate.kalman import Estimate, ExtendedKalmanFilter, TrueState
    from hybrid_mpc.estimate.offset_free import OffsetFree, offset_free
    from hybrid_mpc.estimate.parameters import (
        parameter_factors,
        parameter_filter,
        parameter_states,
        with_parameter_states,
    )
    from hybrid_mpc.estimate.switching import SwitchingFilter
    from hybrid_mpc.estimate.tuning import process_noise
    from hybrid_mpc.files import write_arrays
    from hybrid_mpc.identify.evaluate import evaluation_trajectories, free_runs, score
    from hybrid_mpc.identify.export import check_parity, trace_model
    from hybrid_mpc.identify.fit import FirstStates, fit_prior
    from hybrid_mpc.identify.linear import LinearModel, fit_arx, fit_subspace
    from hybrid_mpc.identify.networks import GRUNetwork
    from hybrid_mpc.identify.predict import Prediction, predict
    from hybrid_mpc.identify.prior_model import model_info
    from hybrid_mpc.identify.settings import TrainingSettings
    from hybrid_mpc.identify.smooth import fit_smoother
    from hybrid_mpc.identify.step import HybridStep, PriorStep, Scaling, n_features
    from hybrid_mpc.identify.train import train
    from hybrid_mpc.identify.tune import SearchSpace, tune
    from hybrid_mpc.job.check import check_scenario
    from hybrid_mpc.job.controllers import find_noise
    from hybrid_mpc.job.loops import Bench, LoopRow, LoopSpec, varied
    from hybrid_mpc.job.run import run
    from hybrid_mpc.job.settings import RunSettings
    from hybrid_mpc.job.study import FaultKind, RandomFaults, Study
    from hybrid_mpc.job.study_results import StudyResults, write_study_report
    from hybrid_mpc.job.study_run import dry_run, run_study
    from hybrid_mpc.kit.artifact import (
        Kit,
        LoopSettings,
        ModelInfo,
        Provenance,
        load,
        save_artifact,
        set_calibration,
        set_process_noise,
    )
    from hybrid_mpc.kit.assembly import (
        make_adaptive_guard,
        make_controller,
        make_estimator,
        make_monitor,
        make_ocp,
        make_resting_guard,
    )
    from hybrid_mpc.kit.export_c import generate_controller
    from hybrid_mpc.loop.faults import Fault, check_plant_faults, corrupt_input, corrupt_measurement
    from hybrid_mpc.loop.guard import Guard, Mode
    from hybrid_mpc.loop.loop import Loop
    from hybrid_mpc.loop.realtime import Runner, SafeEnd
    from hybrid_mpc.loop.simulate import ClosedLoopResult, simulate
    from hybrid_mpc.machine.friction import Coulomb, LoadDependent, Stribeck, Viscous, with_friction
    from hybrid_mpc.machine.mechanical import MechanicalPrior
    from hybrid_mpc.machine.prior import Balance, OperatingPoint, Prior
    from hybrid_mpc.machine.signals import Parameter, Signal
    from hybrid_mpc.machine.specification import BenchmarkBudget, BenchmarkSpec, DataSpec, Role, Window
    from hybrid_mpc.machine.torch_prior import TorchPrior
    from hybrid_mpc.model.buffered import BufferedFunction
    from hybrid_mpc.model.delay import with_input_delay
    from hybrid_mpc.model.disturbance import Disturbance
    from hybrid_mpc.model.model import HybridModel, kinematics, longer_period
    from hybrid_mpc.model.riccati import dare, lqr
    from hybrid_mpc.monitor.calibrate import Calibration, count_alarms
    from hybrid_mpc.monitor.detector import Detector
    from hybrid_mpc.monitor.diagnose import Diagnoser
    from hybrid_mpc.monitor.energy import EnergyMonitor
    from hybrid_mpc.monitor.explain import ResidualDiagnoser
    from hybrid_mpc.monitor.learn import guard_monitor, learn_from
    from hybrid_mpc.monitor.lengths import rest_speeds
    from hybrid_mpc.monitor.replay import replay
    from hybrid_mpc.monitor.residuals import (
        ResidualLimits,
        ResidualMonitor,
        learn_residuals,
        replay_residuals,
    )
    from hybrid_mpc.scenario import DEFAULT_BUDGETS, Budget, Scenario, Task, load_scenario

try:
    __version__ = version("hybrid-mpc")
except PackageNotFoundError:  # a source tree that was never installed
    __version__ = "0+unknown"

__all__ = [
    "Balance",
    "Bench",
    "BenchmarkBudget",
    "BenchmarkSpec",
    "BestOf",
    "Budget",
    "BufferedFunction",
    "Calibration",
    "CausalPolynomial",
    "ClosedLoopResult",
    "CondensedController",
    "Coulomb",
    "DEFAULT_BUDGETS",
    "DataSpec",
    "Dataset",
    "DelayCompensation",
    "Detector",
    "Diagnoser",
    "Disturbance",
    "EnergyMonitor",
    "Estimate",
    "ExtendedKalmanFilter",
    "Fault",
    "FaultKind",
    "FirstStates",
    "GRUNetwork",
    "Guard",
    "HardBound",
    "HybridModel",
    "HybridStep",
    "InputError",
    "IpoptController",
    "Kit",
    "Limits",
    "LinearModel",
    "LoadDependent",
    "LocalPolynomial",
    "Loop",
    "LoopRow",
    "LoopSettings",
    "LoopSpec",
    "MechanicalPrior",
    "Mode",
    "ModelInfo",
    "Move",
    "OCP",
    "OffsetFree",
    "OperatingPoint",
    "Parameter",
    "Prediction",
    "Prior",
    "PriorStep",
    "Provenance",
    "RandomFaults",
    "ResidualDiagnoser",
    "ResidualLimits",
    "ResidualMonitor",
    "Role",
    "RunSettings",
    "Runner",
    "SQPController",
    "SafeController",
    "SafeEnd",
    "SafeInputError",
    "Scaling",
    "Scenario",
    "SearchSpace",
    "Signal",
    "SmoothingSpline",
    "SoftBound",
    "Status",
    "Steady",
    "Stribeck",
    "Study",
    "StudyResults",
    "SwitchingFilter",
    "Targets",
    "Task",
    "TorchPrior",
    "TrainingSettings",
    "Trajectory",
    "TrueState",
    "Viscous",
    "Window",
    "ZeroPhaseFilter",
    "__version__",
    "balanced_truncation",
    "check_excitation",
    "check_parity",
    "check_plant_faults",
    "check_scenario",
    "chirp",
    "contraction",
    "corrupt_input",
    "corrupt_measurement",
    "count_alarms",
    "dare",
    "differentiate",
    "dry_run",
    "equilibria",
    "evaluation_trajectories",
    "excitation_of",
    "feature_box",
    "find_noise",
    "fit_arx",
    "fit_prior",
    "fit_smoother",
    "fit_subspace",
    "free_runs",
    "frequency_response",
    "friction_slopes",
    "gain_schedule",
    "generate_controller",
    "gru_weights",
    "guard_monitor",
    "holding_input",
    "jacobians",
    "kinematics",
    "learn_from",
    "learn_residuals",
    "linearize",
    "linearize_along",
    "linearize_at_speed",
    "linearize_secant",
    "load",
    "load_scenario",
    "load_trajectories",
    "longer_period",
    "lqr",
    "lyapunov_exponent",
    "make_adaptive_guard",
    "make_controller",
    "make_estimator",
    "make_monitor",
    "make_ocp",
    "make_resting_guard",
    "model_info",
    "mpc_gain",
    "mpc_loop",
    "multisine",
    "multisine_response",
    "n_features",
    "offset_free",
    "parameter_factors",
    "parameter_filter",
    "parameter_sensitivities",
    "parameter_states",
    "physical_states",
    "plots",
    "prbs",
    "predict",
    "process_noise",
    "random_steps",
    "replay",
    "replay_residuals",
    "rest_speeds",
    "run",
    "run_model",
    "run_plant",
    "run_study",
    "save_artifact",
    "score",
    "set_calibration",
    "set_process_noise",
    "shortest_move",
    "simulate",
    "sinusoid",
    "steady_filter",
    "steady_gain",
    "system_structure",
    "trace_model",
    "train",
    "tune",
    "varied",
    "with_friction",
    "with_input_delay",
    "with_parameter_states",
    "write_arrays",
    "write_csv",
    "write_study_report",
]
_ROOMS = {
    "analyze.equilibria": ("equilibria", "holding_input"),
    "analyze.linearize": (
        "friction_slopes", "jacobians", "linearize", "linearize_along", "linearize_at_speed", "linearize_secant",
    ),
    "analyze.margins": ("gain_schedule", "mpc_gain", "mpc_loop", "steady_filter"),
    "analyze.measured": ("multisine_response", "run_model", "run_plant"),
    "analyze.memory": ("contraction", "feature_box", "gru_weights", "lyapunov_exponent"),
    "analyze.properties": (
        "balanced_truncation", "frequency_response", "physical_states", "steady_gain", "system_structure",
    ),
    "analyze.sensitivity": ("parameter_sensitivities",),
    "control.best_of": ("BestOf",),
    "control.move": ("Move", "shortest_move"),
    "control.nlp": ("IpoptController",),
    "control.ocp": ("Limits", "OCP"),
    "control.problem": ("Status",),
    "control.rti": ("CondensedController",),
    "control.safeguard": ("SafeController",),
    "control.soft": ("HardBound", "SoftBound"),
    "control.sqp": ("SQPController",),
    "control.targets": ("Steady", "Targets"),
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
    "estimate.offset_free": ("OffsetFree", "offset_free"),
    "estimate.parameters": (
        "parameter_factors", "parameter_filter", "parameter_states", "with_parameter_states",
    ),
    "estimate.switching": ("SwitchingFilter",),
    "estimate.tuning": ("process_noise",),
    "files": ("write_arrays",),
    "identify.evaluate": ("evaluation_trajectories", "free_runs", "score"),
    "identify.export": ("check_parity", "trace_model"),
    "identify.fit": ("FirstStates", "fit_prior"),
    "identify.linear": ("LinearModel", "fit_arx", "fit_subspace"),
    "identify.networks": ("GRUNetwork",),
    "identify.predict": ("Prediction", "predict"),
    "identify.prior_model": ("model_info",),
    "identify.settings": ("TrainingSettings",),
    "identify.smooth": ("fit_smoother",),
    "identify.step": ("HybridStep", "PriorStep", "Scaling", "n_features"),
    "identify.train": ("train",),
    "identify.tune": ("SearchSpace", "tune"),
    "job.check": ("check_scenario",),
    "job.controllers": ("find_noise",),
    "job.loops": ("Bench", "LoopRow", "LoopSpec", "varied"),
    "job.run": ("run",),
    "job.settings": ("RunSettings",),
    "job.study": ("FaultKind", "RandomFaults", "Study"),
    "job.study_results": ("StudyResults", "write_study_report"),
    "job.study_run": ("dry_run", "run_study"),
    "kit.artifact": (
        "Kit", "LoopSettings", "ModelInfo", "Provenance", "load", "save_artifact", "set_calibration",
        "set_process_noise",
    ),
    "kit.assembly": (
        "make_adaptive_guard", "make_controller", "make_estimator", "make_monitor", "make_ocp",
        "make_resting_guard",
    ),
    "kit.export_c": ("generate_controller",),
    "loop.faults": ("Fault", "check_plant_faults", "corrupt_input", "corrupt_measurement"),
    "loop.guard": ("Guard", "Mode"),
    "loop.loop": ("Loop",),
    "loop.realtime": ("Runner", "SafeEnd"),
    "loop.simulate": ("ClosedLoopResult", "simulate"),
    "machine.friction": ("Coulomb", "LoadDependent", "Stribeck", "Viscous", "with_friction"),
    "machine.mechanical": ("MechanicalPrior",),
    "machine.prior": ("Balance", "OperatingPoint", "Prior"),
    "machine.signals": ("Parameter", "Signal"),
    "machine.specification": ("BenchmarkBudget", "BenchmarkSpec", "DataSpec", "Role", "Window"),
    "machine.torch_prior": ("TorchPrior",),
    "model.buffered": ("BufferedFunction",),
    "model.delay": ("with_input_delay",),
    "model.disturbance": ("Disturbance",),
    "model.model": ("HybridModel", "kinematics", "longer_period"),
    "model.riccati": ("dare", "lqr"),
    "monitor.calibrate": ("Calibration", "count_alarms"),
    "monitor.detector": ("Detector",),
    "monitor.diagnose": ("Diagnoser",),
    "monitor.energy": ("EnergyMonitor",),
    "monitor.explain": ("ResidualDiagnoser",),
    "monitor.learn": ("guard_monitor", "learn_from"),
    "monitor.lengths": ("rest_speeds",),
    "monitor.replay": ("replay",),
    "monitor.residuals": ("ResidualLimits", "ResidualMonitor", "learn_residuals", "replay_residuals"),
    "scenario": ("Budget", "DEFAULT_BUDGETS", "Scenario", "Task", "load_scenario"),
}  # fmt: skip
"""Public names by the module that defines them."""
_HOME = {name: room for room, names in _ROOMS.items() for name in names}


def __getattr__(name: str) -> Any:
    if name == "plots":
        return importlib.import_module("hybrid_mpc.plots")
    if name not in _HOME:
        raise AttributeError(f"module 'hybrid_mpc' has no attribute {name!r}")
    return getattr(importlib.import_module(f"hybrid_mpc.{_HOME[name]}"), name)


def __dir__() -> list[str]:
    return sorted({*globals(), *__all__})
