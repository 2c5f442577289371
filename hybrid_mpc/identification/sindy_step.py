"""Libraries of candidate terms, and the model that a sparse regression over them gives, as a step (torch)."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from itertools import combinations_with_replacement

import torch
from torch import Tensor, nn

from hybrid_mpc.errors import InputError
from hybrid_mpc.identification.runge_kutta import rk4, substeps_for
from hybrid_mpc.physics import Prior

STEEPNESS = (5.0, 10.0, 20.0, 50.0, 100.0)
"""Slopes gamma [s/rad] of ``tanh(gamma v)`` that :func:`machine_libraries` offers: no regression finds gamma."""
DEGREE = 3
"""Highest degree of the polynomials that :func:`machine_libraries` offers."""
_FUNCTIONS: dict[str, tuple[Callable[[Tensor], Tensor], str]] = {
    "value": (lambda z: z, "{}"),
    "sin": (torch.sin, "sin({})"),
    "cos": (torch.cos, "cos({})"),
    "tanh": (torch.tanh, "tanh({})"),
    "abs": (torch.abs, "|{}|"),
    "abs_cos": (lambda z: torch.abs(torch.cos(z)), "|cos({})|"),
}


@dataclass(frozen=True)
class Factor:
    """``function(scale * signal) ** power``, a factor of a candidate term.

    Args:
        signal: Name of a state or an input.
        function: ``"value"``, ``"sin"``, ``"cos"``, ``"tanh"``, ``"abs"`` or ``"abs_cos"``. Default: the value.
        scale: Default 1.
        power: 1, 2, ... Default 1.

    Raises:
        InputError: If there is no such function, or the power is none.

    Example:
        >>> Factor("phi_dot", "tanh", 20.0).label
        'tanh(20 phi_dot)'
    """

    signal: str
    function: str = "value"
    scale: float = 1.0
    power: int = 1

    def __post_init__(self) -> None:
        if self.function not in _FUNCTIONS:
            raise InputError(f"a term has no function {self.function!r}; there are: {', '.join(_FUNCTIONS)}")
        if not isinstance(self.power, int) or self.power < 1:
            raise InputError(f"a power must be a whole number of at least 1, got {self.power}")

    @property
    def label(self) -> str:
        """As an equation has it."""
        inner = self.signal if self.scale == 1.0 else f"{self.scale:g} {self.signal}"
        text = _FUNCTIONS[self.function][1].format(inner)
        return text if self.power == 1 else f"{text}^{self.power}"

    def __call__(self, signal: Tensor) -> Tensor:
        """Its value, any shape."""
        value = base = _FUNCTIONS[self.function][0](self.scale * signal if self.scale != 1.0 else signal)
        for _ in range(self.power - 1):
            value = value * base
        return value


Term = tuple[Factor, ...]
"""A candidate term: the product of its factors; none of them is the constant 1."""


@dataclass(frozen=True)
class Library:
    """Candidate terms of an acceleration, as plain data.

    Args:
        name: Names it in tables.
        terms: The terms.

    Example:
        >>> Library("mine", ((), (Factor("v"), Factor("v", "abs")))).labels
        ('1', 'v |v|')
    """

    name: str
    terms: tuple[Term, ...]

    @property
    def labels(self) -> tuple[str, ...]:
        """Each term as an equation has it."""
        return tuple(" ".join(factor.label for factor in term) or "1" for term in self.terms)


class SindyStep(nn.Module):
    """An identified equation as a step ``(x, h, u) -> (x_next, h_next)`` with an empty hidden state.

    Kinematics are exact, the acceleration is the sum of terms times coefficients, Runge-Kutta of order 4 integrates
    with the input held: as :class:`~hybrid_mpc.identification.step.PriorStep` does.

    Args:
        prior: Names the states and gives output and energy balance; its equation of motion is not used.
        library: The terms.
        coefficients: ``(n_terms, n_q)`` [SI]. Leading axes are those of a batch, a model for each of its rows.
        dt: Model period [s].
        substeps: Runge-Kutta steps a period; default: what the stiffness at rest asks for.
        candidates: What it was chosen from; default: nothing.

    Raises:
        InputError: If a term names no signal of the prior, shapes do not fit, or the model is too stiff for ``dt``.

    Example:
        >>> from scenarios.pendulum.prior import PendulumPrior
        >>> library = Library("pendulum", ((Factor("u"),), (Factor("phi_dot"),), (Factor("phi", "sin"),)))
        >>> step = SindyStep(PendulumPrior(), library, torch.tensor([[8.0], [-16.0], [-196.2]]).double(), 0.01)
        >>> step.equations()
        ("phi_dot' = 8 u - 16 phi_dot - 196.2 sin(phi)",)
        >>> x, h, u = torch.zeros(2).double(), torch.zeros(0).double(), torch.ones(1).double()
        >>> step.xdot(x, h, u).tolist()
        [0.0, 8.0]
    """

    coefficients: Tensor

    def __init__(
        self,
        prior: Prior,
        library: Library,
        coefficients: Tensor,
        dt: float,
        substeps: int | None = None,
        candidates: tuple[SindyCandidate, ...] = (),
    ) -> None:
        super().__init__()
        self.prior, self.library, self.dt, self.candidates = prior, library, dt, candidates
        self._names = signal_names(prior, library)
        if coefficients.shape[-2:] != (len(library.terms), prior.n_q):
            raise InputError(
                f"library {library.name}: coefficients are {tuple(coefficients.shape)}, its terms and the "
                f"accelerations need {(len(library.terms), prior.n_q)}"
            )
        self.register_buffer("coefficients", coefficients)
        n_x, n_u = len(prior.states), len(prior.inputs)
        name = f"SINDy with the library {library.name}: the model"
        self.substeps = substeps or substeps_for(self._xdot, n_x, n_u, dt, name)

    def forward(self, x: Tensor, h: Tensor, u: Tensor) -> tuple[Tensor, Tensor]:
        """Next state ``(..., n_x)`` and the hidden state as it came."""
        return rk4(lambda z: self._xdot(z, u), x, self.dt, self.substeps), h

    def xdot(self, x: Tensor, h: Tensor, u: Tensor) -> Tensor:
        """Derivative of the state at the instant."""
        return self._xdot(x, u)

    def features(self, x: Tensor, u: Tensor) -> Tensor:
        """The terms ``(..., n_terms)`` at ``x`` ``(..., n_x)`` and ``u`` ``(..., n_u)``, which broadcast."""
        return evaluate(self.library, self._names, x, u)

    def equations(self, digits: int = 4) -> tuple[str, ...]:
        """The identified equations, one an acceleration; terms whose coefficient is zero are left out.

        Args:
            digits: Significant digits of a coefficient. Default 4.
        """
        n_q, made = self.prior.n_q, []
        for i, signal in enumerate(self.prior.states[n_q : 2 * n_q]):
            pairs = zip(self.coefficients[:, i].tolist(), self.library.labels, strict=True)
            parts = [
                f"{'-' if c < 0 else '+'} {abs(c):.{digits}g}{'' if term == '1' else ' ' + term}"
                for c, term in pairs
                if c
            ]
            right = " ".join(parts).removeprefix("+ ") or "0"
            made.append(f"{signal.name}' = {right}")
        return tuple(made)

    def _xdot(self, x: Tensor, u: Tensor) -> Tensor:
        acceleration = (self.features(x, u).unsqueeze(-1) * self.coefficients).sum(-2)
        return torch.cat([x[..., self.prior.n_q :], acceleration], dim=-1)


@dataclass(frozen=True)
class SindyCandidate:
    """One fit that was judged.

    Args:
        library: Name of its library.
        threshold: Its threshold, a share of the acceleration's root mean square.
        terms: Number of terms that it keeps.
        training: Mean absolute error of the training accelerations [rad/s²].
        validation: E_sim on the validation free runs (duration form, λ = 0); infinite if one of them diverges or the
            model is too stiff for the period.
    """

    library: str
    threshold: float
    terms: int
    training: float
    validation: float


def evaluate(library: Library, names: dict[str, int], x: Tensor, u: Tensor) -> Tensor:
    """Terms of a library ``(..., n_terms)``; ``names`` gives the column of each signal in ``[x, u]``."""
    n_x, made = x.shape[-1], {}
    shape = torch.broadcast_shapes(x.shape[:-1], u.shape[:-1])
    columns = []
    for term in library.terms:
        column = x.new_ones(()).expand(shape)
        for i, factor in enumerate(term):
            if factor not in made:  # terms share factors
                at = names[factor.signal]
                made[factor] = factor(x[..., at] if at < n_x else u[..., at - n_x])
            column = made[factor] if i == 0 else column * made[factor]
        columns.append(column.expand(shape))
    return torch.stack(columns, dim=-1)


def signal_names(prior: Prior, library: Library) -> dict[str, int]:
    """Column of each state and input in ``[x, u]``.

    Raises:
        InputError: If a term of the library names none of them, or the library has no term.
    """
    names = {signal.name: i for i, signal in enumerate((*prior.states, *prior.inputs))}
    unknown = {factor.signal for term in library.terms for factor in term} - set(names)
    if unknown or not library.terms:
        what = f"names no signal {', '.join(sorted(unknown))}" if unknown else "has no term"
        raise InputError(f"library {library.name} {what}; {type(prior).__name__} has: {', '.join(names)}")
    return names


def machine_libraries(prior: Prior) -> tuple[Library, ...]:
    """Libraries for machines that turn or slide: polynomials, trigonometric terms, and friction of several slopes.

    With q, v, u of each axis: ``polynomial`` has all monomials of [q, v] up to degree 3 (an angle that turns is left
    out) and u; ``trigonometric`` has 1, sin q, cos q, v, v², v abs(v), u, u cos q; ``friction_20`` has those and
    ``tanh(20 v)`` alone and times cos q, abs(cos q) and v², which is the golf robot's friction where its load keeps
    its sign. Axes meet in the polynomials only: coupled ones need a library of their own.

    Args:
        prior: Names the signals.

    Example:
        >>> from scenarios.pendulum.prior import PendulumPrior
        >>> libraries = machine_libraries(PendulumPrior())
        >>> [library.name for library in libraries][:3]
        ['polynomial', 'trigonometric', 'friction_5']
        >>> libraries[1].labels
        ('1', 'sin(phi)', 'cos(phi)', 'phi_dot', 'phi_dot^2', 'phi_dot |phi_dot|', 'u', 'u cos(phi)')
    """
    n_q = prior.n_q
    q, v = prior.states[:n_q], [s.name for s in prior.states[n_q : 2 * n_q]]
    u = [s.name for s in prior.inputs]
    torque = [(Factor(j),) for j in u]
    variables = [s.name for s in q if not s.periodic] + v
    powers = [
        tuple(Factor(name, power=chosen.count(name)) for name in dict.fromkeys(chosen))
        for degree in range(DEGREE + 1)
        for chosen in combinations_with_replacement(variables, degree)
    ]
    sine: list[Term] = [()]
    for position, speed in zip(q, v, strict=True):
        sine += [(Factor(position.name, "sin"),), (Factor(position.name, "cos"),), (Factor(speed),)]
        sine += [(Factor(speed, power=2),), (Factor(speed), Factor(speed, "abs"))]
    sine += torque + [(Factor(j), Factor(position.name, "cos")) for j in u for position in q]
    libraries = [Library("polynomial", (*powers, *torque)), Library("trigonometric", tuple(sine))]
    for gamma in STEEPNESS:
        rubbing: list[Term] = []
        for position, speed in zip(q, v, strict=True):
            sign = Factor(speed, "tanh", gamma)
            loads = (Factor(position.name, "cos"), Factor(position.name, "abs_cos"), Factor(speed, power=2))
            rubbing += [(sign,), *((sign, load) for load in loads)]
        libraries.append(Library(f"friction_{gamma:g}", (*sine, *rubbing)))
    return tuple(libraries)
