"""What the report says in general about each section: plain words for a reader new to the method.

Every text is ``Markup`` (our own HTML, trusted). Words about one scenario are supplied by the caller as
plain strings, which the page escapes.
"""

from __future__ import annotations

from collections.abc import Mapping

from markupsafe import Markup

TITLES: Mapping[str, str] = {
    "data": "Data",
    "models": "Prior and models",
    "training": "Training",
    "free_run": "Free runs: how well the models predict",
    "export": "Export",
    "control": "Closed loops",
    "estimation": "Estimation: are the observers as sure as they may be",
    "timing": "Time of a controller step",
    "monitor": "Energy monitor",
    "guard": "Energy guard",
    "analysis": "Linear analysis",
    "glossary": "Names and definitions",
}

_M = Markup

TEXTS: Mapping[str, tuple[Markup, ...]] = {
    "data": (
        _M(
            "The recordings were brought to one uniform time grid, and cut wherever the distance between "
            "two samples was too large to interpolate. Positions were measured; velocities and "
            "accelerations come first from a short polynomial around every sample, to which the prior is "
            "fitted, and then from the prior's own equations, which know where the input jumped and leave a "
            "slowly changing force to be explained."
        ),
        _M(
            "The shading tells what a part is used for: <b>training</b> data fit the parameters, "
            "<b>validation</b> data choose among the trained networks, and <b>test</b> data are seen by "
            "no model before the errors on this page are computed. The phase portrait shows position "
            "against velocity: where test data leave the region that training has covered, a model "
            "must extrapolate."
        ),
    ),
    "models": (
        _M(
            "The <b>prior</b> is the equation of motion that an engineer would write down, with a few "
            "physical parameters. Its published (nominal) parameters seldom fit the machine on the bench, "
            "so they are first fitted to the training data. The <b>fitted prior is the honest "
            "baseline</b>: every percentage on this page refers to it."
        ),
        _M(
            "The networks are small recurrent ones (GRU). Their memory, the hidden state <i>h</i>, can "
            "take up what the prior leaves out, such as friction that depends on the past. The hybrid "
            "keeps the prior and lets the network correct its acceleration only: that a velocity is the "
            "derivative of a position needs no learning."
        ),
    ),
    "training": (
        _M(
            "Two objectives fall together: the error of the predicted motion, and the error of the energy "
            "balance. The dashed lines are the bounds <i>c</i><sub>j</sub>. At each stage the larger of the "
            "two ratios loss / bound is lowered, and the bounds never rise; so neither "
            "objective is bought at the expense of the other."
        ),
        _M(
            "Training starts with measured states at the model's input (teacher forcing). At the dotted line "
            "it turns to free runs, in which the model is fed its own predictions, as a controller will use "
            "it. The lowest row is the error on validation data; the network that is best there is kept."
        ),
    ),
    "free_run": (
        _M(
            "In a free run a model gets the measured input and an initial state, and nothing else: from "
            "then on it lives on its own predictions. Errors accumulate, which makes this a much harder "
            "test than predicting one step. The initial state comes from a short measured past, the "
            "same for every model; that past also warms the networks' memory up, and is not scored."
        ),
        _M(
            "Read from top to bottom: the states, the input, the energy balances of the measurement and of "
            "the hybrid, and their distance, the violation. A good model stays on the black line, and its "
            "violation stays near zero. Bars compare the errors of all models on test data; the dashed "
            "line is the fitted prior, and shorter bars are better."
        ),
    ),
    "export": (
        _M(
            "The trained model leaves the training framework (PyTorch) as plain text and numbers, and is "
            "built again as a symbolic function (CasADi) that the controller can differentiate. Both are "
            "then evaluated at the same points in double precision."
        ),
        _M(
            "The table gives the largest difference at random points of the data's magnitude, at zero, and far "
            "outside (a thousand times). Differences around 10<sup>−16</sup> are the rounding of double "
            "precision itself."
        ),
    ),
    "control": (
        _M(
            "A model predictive controller computes, in every period, the input that is best over the next "
            "second or more according to its model, applies the first part, and starts again with the next "
            "measurement. The same controller with the same weights runs here with different models: the "
            "fitted prior, the hybrid, and an <b>oracle</b> that knows the equations of the simulated "
            "machine."
        ),
        _M(
            "The dashed black line is the reference. The cost is computed on the machine's true state. The "
            "oracle marks what better modelling could gain at most; the <i>gap closed</i> is the share of "
            "the distance between prior and oracle that the hybrid covers:"
            '<span class="formula">gap closed = (<i>J</i><sub>prior</sub> − <i>J</i><sub>hybrid</sub>) / '
            "(<i>J</i><sub>prior</sub> − <i>J</i><sub>oracle</sub>)</span>"
            "It is summed over the tasks in which prior and oracle differ by more than twice the standard error."
        ),
    ),
    "estimation": (
        _M(
            "An observer predicts every measurement before it comes, and says how far off it may be. The "
            "<b>NIS</b> (normalised innovation squared) is the square of how far off it was, over the square "
            "it had allowed for: an observer that knows how wrong it can be has an average of one (for each "
            "measured output), above that it is too sure of itself, below too cautious."
        ),
        _M(
            "The lower picture asks whether one error tells of the next. Bars outside the green band mean "
            "that it does: there is something in the measurement, such as friction that the model lacks or "
            "an encoder's steps, that the observer does not use. On recordings of a real machine few observers "
            "pass these tests to the letter; how far they are off tells which noise to look at."
        ),
    ),
    "timing": (
        _M(
            "A controller step is everything between measurement and input: estimation, prediction, "
            "optimisation and monitoring. It must end within the control period, the black line. "
            "Both axes of time are logarithmic."
        ),
        _M(
            "For real time the slow steps count, not the typical one. The right panel shows which share of "
            "the steps took longer than a given time; where a curve crosses the dotted 1 % line lies its "
            "99th percentile (p99). These numbers belong to the computer that ran this job, and are the "
            "only ones on this page that change when the same job runs again."
        ),
    ),
    "monitor": (
        _M(
            "The prior's energy balance says how much power enters, leaves and is stored. As long as "
            "nothing unknown acts on the machine, the balance of the measurement and that of the model "
            "agree. A push by hand, a collision or a jammed bearing moves energy that the model knows "
            "nothing about, and the violation rises. At rest no power flows, whatever pushes: there the "
            "residual force is judged, less what sticking friction may hold."
        ),
        _M(
            "Grey is the violation at each sample, red-orange the averaged level that is compared with the "
            "threshold (dashed). Pink shading marks alarms. The green bar at the bottom marks "
            "stretches known to be undisturbed: an alarm that starts there is a false one. Both thresholds "
            "were calibrated on undisturbed data."
        ),
    ),
    "guard": (
        _M(
            "The guard looks at the same violation sooner and closer: residual forces in units of their own "
            "scatter, summed up for as long as they last; the energy by which the model, running on its own "
            "for half a second, departs from the machine; and whether the sensor repeats itself while motion "
            "is predicted. What is ordinary was learned where nothing was wrong, for a wanted rate of "
            "false alarms, and lies in the model's folder: <code>hybrid-mpc monitor</code> and "
            "<code>hybrid-mpc control --guard</code> use it."
        ),
        _M(
            "From top to bottom: violation, residual force, energy of the free run, what is compared with the "
            "thresholds (1 is an alarm), and the measured position. Pink shading marks alarms, lines what "
            "breaks and what the guard does. What explains an alarm is a change of the prior's "
            "parameters; where the prior's form is not the machine's, its size is off by that."
        ),
    ),
    "analysis": (
        _M(
            "Around a point of rest the models can be replaced by linear ones. The poles tell how the "
            "machine moves when left alone: inside the unit circle a motion dies out, outside it grows, "
            "and the closer to the circle the longer it lasts. The hybrid has more poles than the prior, "
            "since its memory has a motion of its own; those near the origin die out within a few samples."
        ),
        _M(
            "The Bode plot shows how strongly, and how late, the machine answers to a sinusoidal input of "
            "each frequency. Where both curves agree the network left the prior alone. The linear picture "
            "is valid near that point of rest only, and friction at very low speed is not linear at all."
        ),
    ),
    "glossary": (
        _M(
            "<b>Models</b><dl>"
            "<dt>prior, nominal</dt><dd>The equation of motion with published or data-sheet parameters.</dd>"
            "<dt>prior, fitted</dt><dd>The same equation, its parameters fitted to the training data. The "
            "baseline of every percentage.</dd>"
            "<dt>RNN</dt><dd>A recurrent network without any physics.</dd>"
            "<dt>PGRNN</dt><dd>Physics-guided recurrent network: fitted prior and network together, trained "
            "on the error of motion.</dd>"
            "<dt>MOPGRNN (hybrid)</dt><dd>Multi-objective PGRNN: the same, trained on the error of motion "
            "and the energy balance. It is the model that is exported and used for control.</dd>"
            "<dt>oracle</dt><dd>The equations of the simulated machine itself. Only a simulation "
            "has one.</dd>"
            "</dl>"
        ),
        _M(
            "<b>Simulation error.</b> The mean absolute deviation of the state's derivative along free runs, "
            "over <i>N</i> runs of duration <i>T</i><sub>l</sub>; with λ &gt; 0 late deviations count less:"
            '<span class="formula"><i>E</i><sub>sim</sub> = 1/<i>N</i> Σ<sub>l</sub> '
            "1/<i>T</i><sub>l</sub> ∫<sub>0</sub><sup><i>T</i><sub>l</sub></sup> "
            "‖<i>ẋ</i>(<i>t</i>) − <i>x̂̇</i>(<i>t</i>)‖<sub>1</sub> / (1 + λ<i>t</i>) d<i>t</i></span>"
            "The source of the method prints it in seconds, and so does this page."
        ),
        _M(
            "<b>Energy balance.</b> The equation of motion times the velocity: stored power plus losses "
            "minus the power put in. For a pendulum of inertia <i>J</i>, mass <i>m</i>, distance <i>l</i> "
            "of the centre of mass and damping <i>d</i>:"
            '<span class="formula">Δ<i>E</i> = <i>J</i> <i>φ̈</i> <i>φ̇</i> + <i>m g l</i> <i>φ̇</i> '
            "sin <i>φ</i> + <i>d</i> <i>φ̇</i><sup>2</sup> − <i>u</i> <i>φ̇</i>&nbsp;&nbsp;[W]</span>"
            "It is zero along the prior's own motion. Δ<i>E</i><sub>S</sub> puts the measured motion "
            "in, Δ<i>E</i><sub>M</sub> the model's. It is a power, although the source calls it an energy."
        ),
        _M(
            "<b>Violation.</b> The distance of the two balances:"
            '<span class="formula">Δ = |Δ<i>E</i><sub>M</sub> − Δ<i>E</i><sub>S</sub>|&nbsp;&nbsp;[W]</span>'
            "What both leave out cancels; what only one of them shows remains."
        ),
    ),
}


def paragraphs(section: str) -> tuple[Markup, ...]:
    """General text of a section.

    Args:
        section: ``"data"``, ``"models"``, ``"training"``, ``"free_run"``, ``"export"``, ``"control"``,
            ``"estimation"``, ``"timing"``, ``"monitor"``, ``"guard"``, ``"analysis"`` or ``"glossary"``.

    Returns:
        Its paragraphs, as HTML.

    Example:
        >>> len(paragraphs("training"))
        2
    """
    return TEXTS[section]
