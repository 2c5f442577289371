"""Stage prior of a machine whose input acts later: parameters and delay together."""

from __future__ import annotations

from dataclasses import asdict

from hybrid_mpc.pipeline.context import Context

DELAY_RUNS = 5.0
"""Longest free runs [the machine's seconds] that parameters and delay are fitted to: a swing near the top multiplies
every error."""


def prior_with_delay(context: Context) -> None:
    """Fit the prior's parameters and the input's delay together, to free runs, and smooth the measurements."""
    from hybrid_mpc.pipeline.machine_benchmark.physics import fit_physics, smoothed

    make, spec = context.scenario.prior, context.spec
    train, valid, test = (context.trajectories(role) for role in ("train", "valid", "test"))
    physics = fit_physics(
        make, train, valid, dt=spec.dt, length=DELAY_RUNS * context.time_unit, largest_delay=spec.largest_delay,
        on_progress=lambda done, total, text: context.progress.update("free runs", done, total, text),
    )  # fmt: skip
    every = smoothed(make, physics, [*train, *valid, *test], spec.dt)
    notes = {
        "nominal": make().values,
        "units": {p.name: p.unit for p in make().parameters_spec},
        "smoother": {"sigma": physics.sigma, "walk": physics.walk},
        "delay": physics.delay,
    }
    arrays = {f"{t.name}/{key}": getattr(t, key) for t in every for key in ("x", "xdot")}
    context.save("prior", {**asdict(physics.fit), **notes}, arrays)
    for warning in physics.fit.warnings:
        context.progress.warn(f"fit of the prior: {warning}")
