"""hybrid-mpc: measurements and an ODE in, a guarded real-time nonlinear MPC out.

``import hybrid_mpc as hm``: everything that a machine is written with (``hm.Prior``, ``hm.Scenario``, ``hm.OCP`` ...),
the job (``hm.run``), what its result is used with (``hm.load``, ``hm.Loop``, ``hm.simulate``, ``hm.Runner`` ...), and
the parts of a loop, a study or an analysis of one's own. Figures are in ``hm.plots``. A module in which something is
defined may change; these names stay.

Each name is imported when it is used: torch by who writes a prior or trains, casadi by who states a problem or runs a
loop.
"""

import importlib
from importlib.metadata import PackageNotFoundError, version
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from hybrid_mpc import plots
    from hybrid_mpc.analysis import (
        balanced_truncation,
        contraction,
        equilibria,
        feature_box,
        frequency_response,
        friction_slopes,
        gain_schedule,
        gru_weights,
        holding_input,
        jacobians,
        linearize,
        linearize_along,
        linearize_at_speed,
        linearize_secant,
        lyapunov_exponent,
        mpc_gain,
        mpc_loop,
        multisine_response,
        parameter_sensitivities,
        physical_states,
        run_model,
        run_plant,
        steady_filter,
        system_structure,
    )
    from hybrid_mpc.artifact import (
        Kit,
        LoopSettings,
        ModelInfo,
        Provenance,
        load,
        save_artifact,
        set_calibration,
        set_process_noise,
    )
    from hybrid_mpc.assembly import (
        make_adaptive_guard,
        make_controller,
        make_estimator,
        make_monitor,
        make_ocp,
        make_resting_guard,
    )
    from hybrid_mpc.benchmark_spec import BenchmarkBudget, BenchmarkSpec
    from hybrid_mpc.buffered import BufferedFunction
    from hybrid_mpc.closed_loop import ClosedLoopResult, Fault, Guard, Loop, Mode, Runner, SafeEnd, simulate
    from hybrid_mpc.closed_loop.faults import check_plant_faults, corrupt_input, corrupt_measurement
    from hybrid_mpc.data import (
        CausalPolynomial,
        Dataset,
        LocalPolynomial,
        SmoothingSpline,
        Trajectory,
        ZeroPhaseFilter,
        check_excitation,
        chirp,
        differentiate,
        excitation_of,
        load_trajectories,
        multisine,
        prbs,
        random_steps,
        sinusoid,
        write_csv,
    )
    from hybrid_mpc.data_spec import DataSpec, Role, Window
    from hybrid_mpc.delayed import with_input_delay
    from hybrid_mpc.errors import InputError, SafeInputError
    from hybrid_mpc.estimation import (
        DelayCompensation,
        Estimate,
        ExtendedKalmanFilter,
        SwitchingFilter,
        TrueState,
        parameter_factors,
        parameter_filter,
        parameter_states,
        process_noise,
        with_parameter_states,
    )
    from hybrid_mpc.files import write_arrays
    from hybrid_mpc.identification.evaluation import free_runs, judged, score
    from hybrid_mpc.identification.export import check_parity, model_info, trace_model
    from hybrid_mpc.identification.friction import (
        Coulomb,
        LoadDependent,
        PendulumLoad,
        Stribeck,
        Viscous,
        with_friction,
    )
    from hybrid_mpc.identification.lags import with_input_lag
    from hybrid_mpc.identification.networks import GRUNetwork
    from hybrid_mpc.identification.output_network import train_output, with_output
    from hybrid_mpc.identification.prior_fit import fit_prior
    from hybrid_mpc.identification.search import search
    from hybrid_mpc.identification.search_space import SearchSpace
    from hybrid_mpc.identification.settings import TrainingSettings
    from hybrid_mpc.identification.sindy import fit_sindy
    from hybrid_mpc.identification.smoothing import fit_smoother
    from hybrid_mpc.identification.step import HybridStep, PriorStep, Scaling, n_features
    from hybrid_mpc.identification.training import train
    from hybrid_mpc.job.contenders import find_noise
    from hybrid_mpc.job.loops import Bench, LoopRow, LoopSpec, varied
    from hybrid_mpc.model import HybridModel, longer_period
    from hybrid_mpc.monitor import (
        Calibration,
        Detector,
        Diagnoser,
        EnergyMonitor,
        Plausibility,
        count_alarms,
        excess_bound,
        guard_monitor,
        learn_from,
        learn_plausibility,
        region_bound,
        replay,
        rest_speeds,
    )
    from hybrid_mpc.mpc import (
        OCP,
        BestOf,
        CondensedController,
        IpoptController,
        Limits,
        SafeController,
        SoftBound,
        SQPController,
        Status,
        output_cost,
    )
    from hybrid_mpc.physics import Prior
    from hybrid_mpc.pipeline.run import run
    from hybrid_mpc.pipeline.settings import RunSettings
    from hybrid_mpc.reproduction import Claim, Effort, Experiment
    from hybrid_mpc.riccati import dare, lqr
    from hybrid_mpc.scenario import DEFAULT_BUDGETS, Budget, Scenario, Task, load_scenario
    from hybrid_mpc.signals import Parameter, Signal
    from hybrid_mpc.studies import (
        FaultKind,
        RandomFaults,
        Study,
        StudyResults,
        run_study,
        write_study_report,
    )
    from hybrid_mpc.studies.dry_run import dry_run

try:
    __version__ = version("hybrid-mpc")
except PackageNotFoundError:  # a source tree that was never installed
    __version__ = "0+unknown"

__all__ = [
    "__version__", "plots",
    "balanced_truncation", "contraction", "equilibria", "feature_box", "frequency_response", "friction_slopes",
    "gain_schedule", "gru_weights", "holding_input", "jacobians", "linearize", "linearize_along",
    "linearize_at_speed", "linearize_secant", "lyapunov_exponent", "mpc_gain", "mpc_loop", "multisine_response",
    "parameter_sensitivities", "physical_states", "run_model", "run_plant", "steady_filter", "system_structure",
    "Kit", "LoopSettings", "ModelInfo", "Provenance", "load", "save_artifact", "set_calibration",
    "set_process_noise",
    "make_adaptive_guard", "make_controller", "make_estimator", "make_monitor", "make_ocp", "make_resting_guard",
    "BenchmarkBudget", "BenchmarkSpec",
    "BufferedFunction",
    "ClosedLoopResult", "Fault", "Guard", "Loop", "Mode", "Runner", "SafeEnd", "simulate",
    "check_plant_faults", "corrupt_input", "corrupt_measurement",
    "CausalPolynomial", "Dataset", "LocalPolynomial", "SmoothingSpline", "Trajectory", "ZeroPhaseFilter",
    "check_excitation", "chirp", "differentiate", "excitation_of", "load_trajectories", "multisine", "prbs",
    "random_steps", "sinusoid", "write_csv",
    "DataSpec", "Role", "Window",
    "with_input_delay",
    "InputError", "SafeInputError",
    "DelayCompensation", "Estimate", "ExtendedKalmanFilter", "SwitchingFilter", "TrueState", "parameter_factors",
    "parameter_filter", "parameter_states", "process_noise", "with_parameter_states",
    "write_arrays",
    "free_runs", "judged", "score",
    "check_parity", "model_info", "trace_model",
    "Coulomb", "LoadDependent", "PendulumLoad", "Stribeck", "Viscous", "with_friction",
    "with_input_lag",
    "GRUNetwork",
    "train_output", "with_output",
    "fit_prior",
    "search",
    "SearchSpace",
    "TrainingSettings",
    "fit_sindy",
    "fit_smoother",
    "HybridStep", "PriorStep", "Scaling", "n_features",
    "train",
    "find_noise",
    "Bench", "LoopRow", "LoopSpec", "varied",
    "HybridModel", "longer_period",
    "Calibration", "Detector", "Diagnoser", "EnergyMonitor", "Plausibility", "count_alarms", "excess_bound",
    "guard_monitor", "learn_from", "learn_plausibility", "region_bound", "replay", "rest_speeds",
    "OCP", "BestOf", "CondensedController", "IpoptController", "Limits", "SQPController", "SafeController",
    "SoftBound", "Status", "output_cost",
    "Prior",
    "run",
    "RunSettings",
    "Claim", "Effort", "Experiment",
    "dare", "lqr",
    "DEFAULT_BUDGETS", "Budget", "Scenario", "Task", "load_scenario",
    "Parameter", "Signal",
    "FaultKind", "RandomFaults", "Study", "StudyResults", "run_study", "write_study_report",
    "dry_run",
]  # fmt: skip
_ROOMS = {
    "analysis": (
        "balanced_truncation", "contraction", "equilibria", "feature_box", "frequency_response",
        "friction_slopes", "gain_schedule", "gru_weights", "holding_input", "jacobians", "linearize",
        "linearize_along", "linearize_at_speed", "linearize_secant", "lyapunov_exponent", "mpc_gain",
        "mpc_loop", "multisine_response", "parameter_sensitivities", "physical_states", "run_model",
        "run_plant", "steady_filter", "system_structure",
    ),
    "artifact": (
        "Kit", "LoopSettings", "ModelInfo", "Provenance", "load", "save_artifact", "set_calibration",
        "set_process_noise",
    ),
    "assembly": (
        "make_adaptive_guard", "make_controller", "make_estimator", "make_monitor", "make_ocp",
        "make_resting_guard",
    ),
    "benchmark_spec": ("BenchmarkBudget", "BenchmarkSpec"),
    "buffered": ("BufferedFunction",),
    "closed_loop": ("ClosedLoopResult", "Fault", "Guard", "Loop", "Mode", "Runner", "SafeEnd", "simulate"),
    "closed_loop.faults": ("check_plant_faults", "corrupt_input", "corrupt_measurement"),
    "data": (
        "CausalPolynomial", "Dataset", "LocalPolynomial", "SmoothingSpline", "Trajectory", "ZeroPhaseFilter",
        "check_excitation", "chirp", "differentiate", "excitation_of", "load_trajectories", "multisine",
        "prbs", "random_steps", "sinusoid", "write_csv",
    ),
    "data_spec": ("DataSpec", "Role", "Window"),
    "delayed": ("with_input_delay",),
    "errors": ("InputError", "SafeInputError"),
    "estimation": (
        "DelayCompensation", "Estimate", "ExtendedKalmanFilter", "SwitchingFilter", "TrueState",
        "parameter_factors", "parameter_filter", "parameter_states", "process_noise", "with_parameter_states",
    ),
    "files": ("write_arrays",),
    "identification.evaluation": ("free_runs", "judged", "score"),
    "identification.export": ("check_parity", "model_info", "trace_model"),
    "identification.friction": (
        "Coulomb", "LoadDependent", "PendulumLoad", "Stribeck", "Viscous", "with_friction",
    ),
    "identification.lags": ("with_input_lag",),
    "identification.networks": ("GRUNetwork",),
    "identification.output_network": ("train_output", "with_output"),
    "identification.prior_fit": ("fit_prior",),
    "identification.search": ("search",),
    "identification.search_space": ("SearchSpace",),
    "identification.settings": ("TrainingSettings",),
    "identification.sindy": ("fit_sindy",),
    "identification.smoothing": ("fit_smoother",),
    "identification.step": ("HybridStep", "PriorStep", "Scaling", "n_features"),
    "identification.training": ("train",),
    "job.contenders": ("find_noise",),
    "job.loops": ("Bench", "LoopRow", "LoopSpec", "varied"),
    "model": ("HybridModel", "longer_period"),
    "monitor": (
        "Calibration", "Detector", "Diagnoser", "EnergyMonitor", "Plausibility", "count_alarms",
        "excess_bound", "guard_monitor", "learn_from", "learn_plausibility", "region_bound", "replay",
        "rest_speeds",
    ),
    "mpc": (
        "OCP", "BestOf", "CondensedController", "IpoptController", "Limits", "SQPController",
        "SafeController", "SoftBound", "Status", "output_cost",
    ),
    "physics": ("Prior",),
    "pipeline.run": ("run",),
    "pipeline.settings": ("RunSettings",),
    "reproduction": ("Claim", "Effort", "Experiment"),
    "riccati": ("dare", "lqr"),
    "scenario": ("DEFAULT_BUDGETS", "Budget", "Scenario", "Task", "load_scenario"),
    "signals": ("Parameter", "Signal"),
    "studies": (
        "FaultKind", "RandomFaults", "Study", "StudyResults", "run_study", "write_study_report",
    ),
    "studies.dry_run": ("dry_run",),
}  # fmt: skip
"""Names by the room that they are imported from."""
_HOME = {name: room for room, names in _ROOMS.items() for name in names}


def __getattr__(name: str) -> Any:
    if name == "plots":
        return importlib.import_module("hybrid_mpc.plots")
    if name not in _HOME:
        raise AttributeError(f"module 'hybrid_mpc' has no attribute {name!r}")
    return getattr(importlib.import_module(f"hybrid_mpc.{_HOME[name]}"), name)


def __dir__() -> list[str]:
    return sorted({*globals(), *__all__})
