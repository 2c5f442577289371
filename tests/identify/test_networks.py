import numpy as np
import pytest
import torch

from hybrid_mpc import InputError
from hybrid_mpc.identify.networks import StackedFeedForward, StackedGRU, StackedLSTM, fused_states, make_stack

RNG = np.random.default_rng(0)
CELLS = ("gru", "gru_paper", "lstm", "feed_forward")
S = torch.tensor(RNG.standard_normal((7, 3, 5, 4)))  # periods, networks, batch, features
Z = 6


def hidden(stack):
    """Some hidden state of a stack."""
    return torch.tensor(np.random.default_rng(1).uniform(-1, 1, (3, 5, stack.n_h)))


def weights(stack):
    return dict(stack.named_parameters())


@pytest.fixture(params=CELLS)
def stack(request):
    return make_stack(request.param, 3, 4, Z, 2, seed=1)


def test_a_member_is_its_network_of_the_stack(stack):
    h = hidden(stack)
    out, h_next = stack(S[0], h)
    for i in range(3):
        one, h_one = stack.member(i)(S[0, i], h[i])
        # the same sums in another order: rounding of 10 terms of order one
        torch.testing.assert_close(out[i], one, rtol=0, atol=1e-14)
        torch.testing.assert_close(h_next[i], h_one, rtol=0, atol=1e-14)
        assert stack.member(i).n_h == stack.n_h == h.shape[-1]


@pytest.mark.parametrize(("cell", "layer"), [("gru", torch.nn.GRU), ("lstm", torch.nn.LSTM)])
def test_a_member_is_torchs_own_layer(cell, layer):
    stack = make_stack(cell, 3, 4, Z, 2, seed=1)
    out, _ = stack.sequence(S, stack.initial(5))
    for i in range(3):
        member = stack.member(i)
        torchs = layer(4, Z, dtype=torch.float64)
        torchs.load_state_dict({f"{n}_l0": w for n, w in member.cell.state_dict().items()})
        # rounding through 7 steps
        torch.testing.assert_close(out[:, i], member.head(torchs(S[:, i])[0]), rtol=0, atol=1e-13)


def test_the_paper_form_is_the_paper_with_the_sign_of_z_turned():
    stack = make_stack("gru_paper", 1, 4, Z, 2, seed=1)
    w, r, b = stack.w_ih[0], stack.w_hh[0], stack.b_ih[0, 0]
    (w_r, w_z, w_h), (r_r, r_z, r_h), (b_r, b_z, b_h) = w.split(Z, 1), r.split(Z, 1), b.split(Z)
    s, h = S[0, 0], hidden(make_stack("gru", 3, 4, Z, 2, seed=1))[0]
    z = torch.sigmoid(-(s @ w_z + b_z + h @ r_z))
    reset = torch.sigmoid(s @ w_r + b_r + h @ r_r)
    candidate = torch.tanh(s @ w_h + b_h + reset * (h @ r_h))
    # rounding of sums of 10 terms of order one
    torch.testing.assert_close(stack(s[None], h[None])[1][0], (1 - z) * h + z * candidate, rtol=0, atol=1e-14)
    assert "b_hh" not in weights(stack) | stack.state_dict()  # nothing trains it, nothing saves it
    assert not stack.member(0).cell.bias_hh.any()


def test_the_paper_form_starts_with_the_weights_of_torchs_form():
    paper, torchs = make_stack("gru_paper", 2, 4, Z, 2, seed=1), make_stack("gru", 2, 4, Z, 2, seed=1)
    assert set(weights(torchs)) - set(weights(paper)) == {"b_hh"}
    assert all(torch.equal(w, weights(torchs)[n]) for n, w in weights(paper).items())


def test_sequence_equals_steps(stack):
    outs, h_last = stack.sequence(S, hidden(stack))
    h = hidden(stack)
    for s, out in zip(S, outs, strict=True):
        one, h = stack(s, h)
        torch.testing.assert_close(out, one, rtol=0, atol=1e-13)  # rounding through 7 steps
    torch.testing.assert_close(h_last, h, rtol=0, atol=1e-13)


def test_features_may_be_shared_by_all_networks(stack):
    shared = S[:, :1]
    outs, h_last = stack.sequence(shared, stack.initial(5))
    own, h_own = stack.sequence(shared.expand(-1, 3, -1, -1), stack.initial(5))
    torch.testing.assert_close(outs, own, rtol=0, atol=1e-13)  # rounding through 7 steps
    torch.testing.assert_close(h_last, h_own, rtol=0, atol=1e-13)


def test_a_network_does_not_depend_on_how_many_stand_beside_it(stack):
    kind = {StackedLSTM: "lstm", StackedFeedForward: "feed_forward"}.get(type(stack), "gru")
    alone, other = (make_stack(kind, 1, 4, Z, 2, seed=seed) for seed in (1, 2))
    for name, weight in weights(stack).items():
        assert torch.equal(weights(alone)[name][0], weight[0])
        assert not torch.equal(weight[0], weight[1])
        assert not torch.equal(weight[0], weights(other)[name][0])


def test_networks_of_a_stack_learn_alone(stack):
    """The gradient of one network's output is zero for all the others' weights."""
    outs, _ = stack.sequence(S, stack.initial(5))
    outs[:, 1].square().sum().backward()
    for weight in weights(stack).values():
        assert weight.grad[1].abs().max() > 0
        assert weight.grad[[0, 2]].abs().max() == 0


def by_hand(stack, s, h):
    """The plain sequence of a GRU written out: what the default training has always computed."""
    gates, states = torch.matmul(s, stack.w_ih) + stack.b_ih, []
    for gate in gates:
        inner = torch.baddbmm(stack.b_hh, h, stack.w_hh)
        r, z = torch.sigmoid(gate[..., : 2 * Z] + inner[..., : 2 * Z]).split(Z, -1)
        candidate = torch.tanh(gate[..., 2 * Z :] + r * inner[..., 2 * Z :])
        h = candidate + z * (h - candidate)
        states.append(h)
    return torch.matmul(torch.stack(states), stack.w_out) + stack.b_out, h


def test_the_default_sequence_keeps_its_bits():
    stack = StackedGRU(3, 4, Z, 2, seed=1)
    for got, want in zip(stack.sequence(S, hidden(stack)), by_hand(stack, S, hidden(stack)), strict=True):
        assert torch.equal(got, want)


@pytest.mark.parametrize("one_bias", [False, True])
@pytest.mark.parametrize("shared", [False, True])
def test_the_fused_sequence_is_the_plain_one(one_bias, shared):
    plain, fused = (StackedGRU(3, 4, Z, 2, seed=1, one_bias=one_bias, fused=f) for f in (False, True))
    results = []
    for stack in (plain, fused):
        s, h = (S[:, :1] if shared else S).clone().requires_grad_(), hidden(stack).requires_grad_()
        outs, last = stack.sequence(s, h)
        (outs.square().sum() + (outs[-1] * last.sum()).sum()).backward()
        grads = {name: weight.grad for name, weight in weights(stack).items()}
        results.append(grads | {"outs": outs, "last": last, "s": s.grad, "h": h.grad})
    assert set(results[0]) == set(results[1])
    for name, want in results[0].items():
        # the goal of the exporter holds for this other order of sums, too: 1e-12 of the largest entry
        scale = float(want.detach().abs().max())
        torch.testing.assert_close(results[1][name], want, rtol=0, atol=1e-12 * scale)


def test_the_fused_derivative_is_that_of_its_values():
    rng = np.random.default_rng(2)
    shapes = (
        (4, 2, 3, 2),
        (2, 3, 3),
        (2, 2, 9),
        (2, 3, 9),
        (2, 1, 9),
        (2, 1, 9),
    )  # s, h, w_ih, w_hh, b_ih, b_hh
    arguments = [torch.tensor(rng.uniform(-1, 1, shape)).requires_grad_() for shape in shapes]
    # central differences with steps of 1e-6: rounding of 1e-16 / 1e-6 and more through the steps
    assert torch.autograd.gradcheck(fused_states, arguments, eps=1e-6, atol=1e-8)


def test_a_stack_stays_on_its_device(stack):
    """``meta`` computes nothing, but refuses a tensor made elsewhere."""
    there = stack.to("meta")
    outs, _ = there.sequence(S.to("meta"), there.initial(5))
    assert outs.device.type == "meta"


def test_unknown_cells_and_fused_ones_that_are_not_there_are_refused():
    with pytest.raises(InputError, match="'gru_paper'"):
        make_stack("rnn", 1, 2, 3, 1, seed=0)
    with pytest.raises(InputError, match="no fused form"):
        make_stack("lstm", 1, 2, 3, 1, seed=0, fused=True)
