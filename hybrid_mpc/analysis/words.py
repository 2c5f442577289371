"""Texts of the analysis page: title, part of the results, tables, figures, paragraphs."""

from __future__ import annotations

from collections.abc import Sequence

SECTIONS: Sequence[tuple[str, str, tuple[str, ...], tuple[str, ...], tuple[str, ...]]] = (
    (
        "Points of rest",
        "equilibria",
        ("equilibria",),
        (),
        (
            "Newton's method from many starts finds states and hidden states that one step leaves where they are,"
            " to 1e-10. A point that was hit only once may have neighbours that were not hit at all.",
        ),
    ),
    (
        "Friction in a linearisation",
        "friction",
        ("friction",),
        ("friction",),
        (
            "A smoothed dry friction tanh(v / v_s) has its steepest slope at rest, where the tangent takes it. No"
            " motion larger than v_s feels that slope. A chord from -v to v, or the describing function of a "
            "sinusoid of that size, says what damping such a motion sees; the tangent in motion says what small "
            "deviations from it see.",
        ),
    ),
    (
        "Linearised models",
        "linear",
        ("modes",),
        ("poles", "bode_rest", "bode_working", "bode_moving", "bode_driven", "steps"),
        (
            "Each model four times: the tangent at rest; at rest with friction of working size; the tangent in "
            "motion; the mean of the tangents along a run driven by a multisine (statistical linearisation). The "
            "tangent in motion holds for deviations over times that are short against the motion. With friction "
            "of working size only the columns by the speeds are chords: what a network made of the other signals "
            "stays its tangent at rest, and that is stiction where the machine sticks.",
        ),
    ),
    (
        "Against the machine",
        "measured",
        (),
        ("measured",),
        (
            "The machine and the models were given the same inputs, and their responses estimated in the same "
            "way. That is the best linear approximation for inputs of this size: of a machine with friction it is"
            " no Jacobian of anything, and the only fair way to compare.",
        ),
    ),
    (
        "Control loops",
        "loops",
        ("margins",),
        ("sensitivity", "nyquist"),
        (
            "The gain of the MPC is the exact derivative of its QP's solution where no bound acts; the filter is "
            "the extended Kalman filter in its steady state, quiet, and as it is for a few periods after a load "
            "came or went. 'prior on hybrid' is the prior's controller and filter around the hybrid as the "
            "machine. A loop that is not stable here has no margins; the real loop is nonlinear, and bounded by "
            "what the linearisation leaves out.",
        ),
    ),
    (
        "Gain schedule",
        "schedule",
        ("gain_schedule",),
        ("schedule",),
        ("LQR of the linearisations over the positions, with the weights of the control problem.",),
    ),
    (
        "Memory of the recurrent part",
        "memory",
        ("memory",),
        (),
        (
            "The certificate is sufficient for the network to forget, for all inputs in the working range. "
            "Trained networks mostly fail it and forget all the same: the exponents of a driven run say so for "
            "that run.",
        ),
    ),
    (
        "Parameters",
        "sensitivity",
        ("sensitivity",),
        ("sensitivity_parameters",),
        ("Exact derivatives of a free run by the prior's parameters, in the prior and within the hybrid.",),
    ),
)
