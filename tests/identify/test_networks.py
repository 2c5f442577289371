import numpy as np
import pytest
import torch

from hybrid_mpc.identify.networks import StackedGRU, hidden_states

RNG = np.random.default_rng(0)
S = torch.tensor(RNG.standard_normal((7, 3, 5, 4)))  # periods, networks, batch, features
H = torch.tensor(np.random.default_rng(1).uniform(-1, 1, (3, 5, 6)))
Z = 6


def weights(stack):
    return dict(stack.named_parameters())


@pytest.fixture
def stack():
    return StackedGRU(3, 4, Z, 2, seed=1)


def test_a_member_is_its_network_of_the_stack_and_torchs_own_layer(stack):
    out, h_next = stack(S[0], H)
    outs, _ = stack.sequence(S, stack.initial(5))
    for i in range(3):
        member = stack.member(i)
        one, h_one = member(S[0, i], H[i])
        # the same sums in another order: rounding of 10 terms of order one
        torch.testing.assert_close(out[i], one, rtol=0, atol=1e-14)
        torch.testing.assert_close(h_next[i], h_one, rtol=0, atol=1e-14)
        torchs = torch.nn.GRU(4, Z, dtype=torch.float64)
        torchs.load_state_dict({f"{n}_l0": w for n, w in member.cell.state_dict().items()})
        # rounding through 7 steps
        torch.testing.assert_close(outs[:, i], member.head(torchs(S[:, i])[0]), rtol=0, atol=1e-13)


def test_networks_of_a_stack_learn_alone(stack):
    """The gradient of one network's output is zero for all the others' weights."""
    outs, _ = stack.sequence(S, stack.initial(5))
    outs[:, 1].square().sum().backward()
    for weight in weights(stack).values():
        assert weight.grad[1].abs().max() > 0
        assert weight.grad[[0, 2]].abs().max() == 0


@pytest.mark.parametrize("shared", [False, True])
def test_the_derivative_of_a_sequence_is_that_of_its_steps(shared):
    results = []
    for by_steps in (True, False):
        stack = StackedGRU(3, 4, Z, 2, seed=1)
        s, h = (S[:, :1] if shared else S).clone().requires_grad_(), H.clone().requires_grad_()
        if by_steps:  # torch differentiates every operation
            last, every = h, []
            for now in s.expand(-1, 3, -1, -1):
                out, last = stack(now, last)
                every.append(out)
            outs = torch.stack(every)
        else:
            outs, last = stack.sequence(s, h)
        (outs.square().sum() + (outs[-1] * last.sum()).sum()).backward()
        grads = {name: weight.grad for name, weight in weights(stack).items()}
        results.append(grads | {"outs": outs, "last": last, "s": s.grad, "h": h.grad})
    assert set(results[0]) == set(results[1])
    for name, want in results[0].items():
        # the goal of the exporter holds for this other order of sums, too: 1e-12 of the largest entry
        scale = float(want.detach().abs().max())
        torch.testing.assert_close(results[1][name], want, rtol=0, atol=1e-12 * scale)


def test_the_derivative_written_by_hand_is_that_of_its_values():
    rng = np.random.default_rng(2)
    # s, h, w_ih, w_hh, b_ih, b_hh
    shapes = ((4, 2, 3, 2), (2, 3, 3), (2, 2, 9), (2, 3, 9), (2, 1, 9), (2, 1, 9))
    arguments = [torch.tensor(rng.uniform(-1, 1, shape)).requires_grad_() for shape in shapes]
    # central differences with steps of 1e-6: rounding of 1e-16 / 1e-6 and more through the steps
    assert torch.autograd.gradcheck(hidden_states, arguments, eps=1e-6, atol=1e-8)
