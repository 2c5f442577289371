import numpy as np
import pytest
import torch

from hybrid_mpc.identification.networks import StackedGRU

RNG = np.random.default_rng(0)
S = torch.tensor(RNG.standard_normal((7, 3, 5, 4)))  # periods, networks, batch, features
H = torch.tensor(RNG.uniform(-1, 1, (3, 5, 6)))


@pytest.fixture
def stack():
    return StackedGRU(3, 4, 6, 2, seed=1)


def test_stacked_network_equals_its_member_and_torch_gru_cell(stack):
    out, h_next = stack(S[0], H)
    for i in range(3):
        member = stack.member(i)
        one, h_one = member(S[0, i], H[i])
        # the same sums in another order: rounding of 10 terms of order one
        torch.testing.assert_close(out[i], one, rtol=0, atol=1e-14)
        torch.testing.assert_close(h_next[i], h_one, rtol=0, atol=1e-14)
        cell = torch.nn.GRUCell(4, 6, dtype=torch.float64)
        cell.load_state_dict(member.cell.state_dict())
        torch.testing.assert_close(h_next[i], cell(S[0, i], H[i]), rtol=0, atol=1e-14)


def test_sequence_equals_steps(stack):
    outs, h_last = stack.sequence(S, H)
    h = H
    for s, out in zip(S, outs, strict=True):
        one, h = stack(s, h)
        torch.testing.assert_close(out, one, rtol=0, atol=1e-13)  # rounding through 7 steps
    torch.testing.assert_close(h_last, h, rtol=0, atol=1e-13)


def test_a_network_does_not_depend_on_how_many_stand_beside_it(stack):
    alone = StackedGRU(1, 4, 6, 2, seed=1)
    for name, weight in alone.named_parameters():
        assert torch.equal(weight[0], dict(stack.named_parameters())[name][0])
    assert not torch.equal(stack.w_ih[0], stack.w_ih[1])
    assert not torch.equal(stack.w_ih, StackedGRU(3, 4, 6, 2, seed=2).w_ih)
