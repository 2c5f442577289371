"""``hybrid-mpc scenarios``: list the available machines."""

from __future__ import annotations

import re
import textwrap

WIDTH = 80


def scenarios() -> None:
    """List the registered scenarios: name, source of the recordings, machine."""
    from hybrid_mpc.scenario import load_scenario, registered_scenarios

    names = registered_scenarios()
    first = max(map(len, (*names, "name")))
    head = f"{'name':{first}}  recordings   "
    print(f"{head}machine")
    for name in names:
        scenario = load_scenario(name)
        source = "simulated" if scenario.make_data else "--data FILE"
        start = f"{name:{first}}  {source:11}  "
        title = re.sub(r" \((simulated|real recordings?)\)$", "", scenario.title)
        print(textwrap.fill(title, WIDTH, initial_indent=start, subsequent_indent=" " * len(start)))
