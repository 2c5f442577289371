"""Systems of a few linear equations in a module: a mass matrix is written as in any textbook."""

import casadi as ca
import numpy as np
import pytest
import torch

from nn_export import ExportError, to_casadi
from nn_export.operators.value import constant


class Of(torch.nn.Module):
    """A function of tensors as a module."""

    def __init__(self, f):
        super().__init__()
        self.f = f

    def forward(self, a, b):
        return self.f(a, b)


def spd(a):
    return a @ a.mT + torch.eye(a.shape[-1], dtype=a.dtype)


FORMS = {
    "solve": lambda a, b: torch.linalg.solve(a, b),
    "solve a vector": lambda a, b: torch.linalg.solve(a, b[:, 0]),
    "solve from the right": lambda a, b: torch.linalg.solve(a, b.mT, left=False),
    "a stack of one": lambda a, b: torch.linalg.solve(a[None], b[None])[0],
    "inv": lambda a, b: torch.linalg.inv(a) @ b,
    "inverse": lambda a, b: torch.inverse(a) @ b,
    "det": lambda a, b: torch.linalg.det(a) * b,
    "cholesky": lambda a, b: torch.linalg.cholesky(spd(a)) @ b,
    "upper cholesky": lambda a, b: torch.linalg.cholesky(spd(a), upper=True) @ b,
    "cholesky_solve": lambda a, b: torch.cholesky_solve(b, torch.linalg.cholesky(spd(a))),
    "upper cholesky_solve": lambda a, b: torch.cholesky_solve(b, torch.linalg.cholesky(spd(a)).mT, upper=True),
    "cholesky_inverse": lambda a, b: torch.cholesky_inverse(torch.linalg.cholesky(spd(a))) @ b,
    "upper cholesky_inverse": lambda a, b: torch.cholesky_inverse(torch.linalg.cholesky(spd(a)).mT, upper=True) @ b,
    "triangular": lambda a, b: torch.linalg.solve_triangular(spd(a).triu(), b, upper=True),
    "triangular from the right": lambda a, b: torch.linalg.solve_triangular(
        spd(a).tril(), b.mT, upper=False, left=False
    ),
    "unit triangular": lambda a, b: torch.linalg.solve_triangular(a, b, upper=False, unitriangular=True),
    "einsum": lambda a, b: torch.einsum("ij,jk,lj->ilk", a, b, a).sum(1),
}  # fmt: skip


def evaluated(module, a, b):
    """Value of a module as CasADi function, and its derivatives by the first argument, both in torch's order."""
    function = to_casadi(module, (a, b))
    held, order = [constant(t.numpy()) for t in (a, b)], constant(module(a, b).numpy()).positions
    symbols = [ca.MX.sym("x", *v.mx.shape) for v in held]
    out = function(*symbols)
    both = ca.Function("both", symbols, [out, ca.densify(ca.jacobian(ca.vec(out), symbols[0]))])
    value, slopes = (m.full() for m in both.call([ca.evalf(v.mx) for v in held]))
    return value.flatten(order="F")[order], slopes[order.reshape(-1)][:, held[0].positions.reshape(-1)]


@pytest.mark.parametrize(
    ("form", "n"),
    [(form, 3) for form in FORMS]
    + [pytest.param(form, 1, marks=pytest.mark.full) for form in FORMS]
    + [(form, 8) for form in ("solve", "inv", "det", "cholesky_solve")],
)
def test_values_and_derivatives_are_those_of_torch(form, n):
    rng = np.random.default_rng(n)
    a, b = (torch.tensor(rng.normal(size=s)) for s in ((n, n), (n, 2)))
    module = Of(FORMS[form])
    want = module(a, b).numpy()
    exact = torch.autograd.functional.jacobian(lambda x: module(x, b), a).numpy().reshape(want.size, -1)
    value, slopes = evaluated(module, a, b)
    # Elimination loses the condition number of 1e-16, up to some 1e3 here; a derivative does so twice.
    np.testing.assert_allclose(value, want, rtol=0, atol=1e-12 * np.abs(want).max())
    np.testing.assert_allclose(slopes, exact, rtol=0, atol=1e-10 * np.abs(exact).max())


@pytest.mark.parametrize("n", [2, 4, 8])
def test_rows_are_exchanged_where_a_pivot_is_zero(n):
    rng = np.random.default_rng(n)
    a = torch.tensor(np.eye(n)[rng.permutation(n)] * rng.uniform(1, 2, n))
    module = Of(lambda a, b: torch.linalg.solve(a, b) * torch.linalg.det(a))
    b = torch.tensor(rng.normal(size=(n, 2)))
    np.testing.assert_allclose(evaluated(module, a, b)[0], module(a, b).numpy(), rtol=1e-13)


def test_a_singular_matrix_gives_no_number():
    """Torch raises; inside a controller nothing may raise, and what is not finite is noticed there."""
    a, b = torch.eye(2).double(), torch.eye(2).double()
    found = to_casadi(Of(torch.linalg.solve), (a, b))(np.ones((2, 2)), np.eye(2))
    assert not np.isfinite(found.full()).any()


def test_a_large_matrix_is_refused_with_the_limit():
    a = torch.eye(9).double()
    with pytest.raises(ExportError, match="NN-064"):
        to_casadi(Of(torch.linalg.solve), (a, a))
