"""CasADi functions in torch: the same numbers, derivatives of any order, batches, torch.func, training."""

import copy
import multiprocessing
import pickle
from concurrent.futures import ThreadPoolExecutor

import casadi as ca
import numpy as np
import pytest
import torch
from torch import nn

from nn_export import ExportError, from_casadi, to_casadi
from nn_export.batched import WALK_FROM, Batched
from nn_export.errors import DerivativeError, DtypeError, SignatureError

torch.set_num_threads(1)
f64 = {"dtype": torch.float64}


def pendulum():
    """A prior with a kink whose other branch has no derivative where it is not taken."""
    x, u, J = ca.SX.sym("x", 2), ca.SX.sym("u"), ca.SX.sym("J")
    loss = ca.if_else(x[1] > 0, ca.sqrt(x[1]), x[1] ** 2)
    xdot = ca.vertcat(x[1], (u - ca.sin(x[0]) - loss) / J)
    return ca.Function("pendulum", [x, u, J], [xdot], ["x", "u", "J"], ["xdot"])


def reference(x, u, J):
    v = x[..., 1]
    loss = torch.where(v > 0, torch.sqrt(torch.where(v > 0, v, 1.0)), v**2)
    return torch.stack([v, (u[..., 0] - torch.sin(x[..., 0]) - loss) / J], -1)


def matrices():
    """MX: matrix inputs and outputs, a product, a sparse output."""
    a, b = ca.MX.sym("a", 2, 3), ca.MX.sym("b", 3)
    return ca.Function(
        "matrices", [a, b], [ca.mtimes(a, ca.sin(b)), a * a, ca.diag(b)], ["a", "b"], ["y", "s", "d"]
    )


def samples(batch, seed=0, grad=False):
    rng = np.random.default_rng(seed)
    x, u = torch.tensor(rng.standard_normal((*batch, 2))), torch.tensor(rng.standard_normal((*batch, 1)))
    return [t.requires_grad_(grad) for t in (x, u, torch.tensor(0.7, **f64))]


@pytest.mark.parametrize("batch", [(), (1,), (5,), (2, 3), (0,), (1030,), (2 * WALK_FROM,)])
def test_values_in_any_batch(batch):
    args = samples(batch)
    given = from_casadi(pendulum())(*args)
    assert given.shape == (*batch, 2)
    assert torch.allclose(given, reference(*args), rtol=1e-14, atol=1e-14)  # a few operations in float64


def test_first_second_and_third_derivatives():
    module, args = from_casadi(pendulum()), samples((4,), grad=True)
    assert torch.autograd.gradcheck(module, args)
    assert torch.autograd.gradgradcheck(module, args)

    def slopes(*a):
        return torch.autograd.grad(torch.sin(module(*a)).sum(), a, create_graph=True)

    assert torch.autograd.gradgradcheck(slopes, args)
    assert torch.autograd.gradcheck(module, args, check_forward_ad=True)


def test_matrices_and_sparse_outputs():
    module = from_casadi(matrices())
    rng = np.random.default_rng(0)
    a, b = torch.tensor(rng.standard_normal((4, 2, 3))), torch.tensor(rng.standard_normal((4, 3)))
    y, s, d = module(a, b)
    assert torch.allclose(y, (a @ torch.sin(b)[..., None])[..., 0], rtol=1e-14)
    assert torch.equal(s, a * a)
    assert torch.equal(d, torch.diag_embed(b))
    assert torch.autograd.gradgradcheck(module, (a.requires_grad_(), b.requires_grad_()))


@pytest.mark.parametrize(
    "transform",
    [
        torch.func.jacrev,
        torch.func.jacfwd,
        torch.func.hessian,
        lambda f, argnums: torch.func.jacrev(torch.func.jacrev(f, argnums), argnums),
        lambda f, argnums: torch.func.jacfwd(torch.func.jacfwd(f, argnums), argnums),
        lambda f, argnums: torch.func.jacrev(torch.func.jacfwd(f, argnums), argnums),
    ],
)
def test_torch_func(transform):
    module, (x, u, J) = from_casadi(pendulum()), samples((3,))
    for argnums in (0, 2):
        given, expected = (
            torch.func.vmap(transform(f, argnums=argnums), in_dims=(0, 0, None))(x, u, J)
            for f in (module, reference)
        )
        assert torch.allclose(given, expected, rtol=1e-13, atol=1e-13)
    nested = torch.func.vmap(
        torch.func.vmap(module, in_dims=(0, None, None)), in_dims=(None, 1, None), out_dims=1
    )
    grid = nested(x, u.reshape(1, 3), J)
    assert torch.allclose(grid[1, 2], reference(x[1], u[2], J), rtol=1e-14)


def test_a_branch_not_taken_does_not_spoil_gradients():
    x = torch.tensor([[0.3, -4.0]], **f64, requires_grad=True)
    for n in (1, WALK_FROM):  # both ways of evaluation
        (slope,) = torch.autograd.grad(
            from_casadi(pendulum())(x.expand(n, 2), torch.zeros(1, **f64), torch.ones((), **f64)).sum(), x
        )
        assert torch.allclose(slope, n * torch.tensor([[-np.cos(0.3), 1 + 8.0]], **f64), rtol=1e-13)


def test_float32_in_gives_the_exact_result_rounded_once():
    module, args = from_casadi(pendulum()), samples((50,))
    narrow = [a.float().requires_grad_() for a in args]
    wide = [a.detach().double().requires_grad_() for a in narrow]
    given, exact = module(*narrow), module(*wide)
    assert given.dtype is torch.float32
    assert torch.equal(given, exact.float())
    given[:, 1].sum().backward()
    exact[:, 1].sum().backward()
    assert torch.equal(narrow[0].grad, wide[0].grad.float())
    assert module(narrow[0], wide[1], narrow[2]).dtype is torch.float64  # the widest input


def test_what_has_no_scalar_form_is_trained_with_too():
    x, p = ca.MX.sym("x"), ca.MX.sym("p")
    root = ca.rootfinder("root", "newton", {"x": x, "p": p, "g": x**3 - p})
    module = from_casadi(ca.Function("cube_root", [p], [root(1.0, p)]))
    p = torch.tensor([[8.0], [27.0]], **f64, requires_grad=True)
    y = module(p)
    assert torch.allclose(y, torch.tensor([[2.0], [3.0]], **f64), rtol=1e-9)  # Newton's tolerance
    (slope,) = torch.autograd.grad(y.sum(), p)
    assert torch.allclose(slope, torch.tensor([[1 / 12], [1 / 27]], **f64), rtol=1e-9)
    with pytest.raises(ExportError, match="NN-001"):
        to_casadi(module, (torch.zeros(1),))


def test_a_large_network_is_not_written_out_in_scalars():
    cell = nn.GRUCell(4, 64).double()
    batched = Batched(to_casadi(cell, (torch.zeros(4), torch.zeros(64))))
    assert batched.steps is None
    x, h = torch.randn(3, 4, **f64), torch.randn(3, 64, **f64)
    assert torch.allclose(batched.evaluate([x, h])[0], cell(x, h), rtol=1e-12, atol=1e-13)


def test_copies_and_pickles_evaluate_alike():
    module, args = from_casadi(pendulum()), samples((5,))
    expected = module(*args)
    for other in (copy.deepcopy(module), pickle.loads(pickle.dumps(module))):
        assert torch.equal(other(*args), expected)


def test_threads_give_the_same_bits():
    module = from_casadi(pendulum())
    cases = [samples((n,), seed=n, grad=True) for n in (1, 3, 17, 100, 300) * 4]

    def slopes(args):
        return torch.autograd.grad(module(*args).square().sum(), args)

    expected = [slopes(args) for args in cases]
    with ThreadPoolExecutor(4) as pool:
        for given, alone in zip(pool.map(slopes, cases), expected, strict=True):
            assert all(torch.equal(a, b) for a, b in zip(given, alone, strict=True))


def _slope_bytes(module):
    x = torch.linspace(0.1, 1, 1000, **f64).reshape(500, 2).requires_grad_()
    module(x, torch.ones(1, **f64), torch.ones(1, **f64)).sum().backward()
    return x.grad.numpy().tobytes()


@pytest.mark.parametrize("context", ["fork", pytest.param("spawn", marks=pytest.mark.full)])
def test_processes_give_the_same_bits(context):
    module = from_casadi(pendulum())
    with multiprocessing.get_context(context).Pool(1) as pool:
        assert pool.apply(_slope_bytes, (module,)) == _slope_bytes(module)


class NoDerivative(ca.Callback):
    def __init__(self):
        super().__init__()
        self.construct("no_derivative", {})

    def eval(self, arguments):
        return [2 * arguments[0]]


def test_named_errors():
    module, (x, u, J) = from_casadi(pendulum()), samples((3,))
    with pytest.raises(SignatureError, match="NN-102"):
        module(x, u)
    with pytest.raises(SignatureError, match=r"\(3, 1\).*NN-105"):
        module(u, u, J)
    with pytest.raises(SignatureError, match="NN-103"):
        module(x, u[:2], J)
    with pytest.raises(DtypeError, match=r"int64.*NN-104"):
        module(x, u, torch.tensor(1))
    with pytest.raises(SignatureError, match="NN-100"):
        from_casadi(lambda x: x)
    callback = NoDerivative()
    y = from_casadi(callback)(torch.ones(1, **f64, requires_grad=True))
    assert y.item() == 2.0
    with pytest.raises(DerivativeError, match=r"no_derivative.*NN-003"):
        y.sum().backward()
