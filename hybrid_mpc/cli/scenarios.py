"""``hybrid-mpc scenarios``: the machines that are ready."""

from __future__ import annotations


def scenarios() -> None:
    """List the registered scenarios and what each needs."""
    from hybrid_mpc.scenario import load_scenario, registered_scenarios

    for name in registered_scenarios():
        scenario = load_scenario(name)
        needs = "makes its own data" if scenario.make_data else "needs --data FILE.csv"
        budgets = ", ".join(scenario.budgets)
        print(f"{name:18} {scenario.title} ({needs}; budgets: {budgets})")
