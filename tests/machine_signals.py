"""The signals of a machine, as recordings are read for it."""

from types import SimpleNamespace

from hybrid_mpc import Signal


def machine(outputs, inputs, states=(), disturbances=()):
    """What names these signals; states that are not told are the outputs and their rates."""
    rates = (Signal(f"{s.name}_dot", f"{s.unit}/s") for s in outputs)
    return SimpleNamespace(
        states=states or (*outputs, *rates), inputs=inputs, outputs=outputs, disturbances=disturbances
    )
