"""Several objectives as one number."""

import pytest
import torch

from hybrid_mpc.identify.objectives import (
    MOST,
    AugmentedLagrangian,
    VectorPerformanceIndex,
    WeightedSum,
    combine,
)

BOUNDS = torch.tensor([[2.0, 0.5, 4.0], [1.0, 1.0, 1.0]], dtype=torch.float64)
LOSSES = torch.tensor([[1.0, 0.4, 1.0], [0.5, 0.2, 0.9]], dtype=torch.float64)
NAMES = ("smooth_maximum", "hard_maximum", "weighted_sum", "augmented_lagrangian")


def gradient(combination, losses=LOSSES):
    losses = losses.clone().requires_grad_()
    combination.value(losses).sum().backward()
    return losses.grad


def test_only_the_worst_objective_pulls_under_the_hard_maximum():
    hard = VectorPerformanceIndex(BOUNDS, hard=True)
    assert hard.value(LOSSES).tolist() == [0.8, 0.9]
    assert (gradient(hard) > 0).tolist() == [[False, True, False], [False, False, True]]
    lowered = hard.lower(0.5 * LOSSES)
    assert lowered.hard
    assert torch.equal(lowered.bounds, 0.5 * LOSSES)


def test_the_smooth_maximum_goes_to_the_hard_one():
    hard = VectorPerformanceIndex(BOUNDS, hard=True).value(LOSSES)
    excess = [float((VectorPerformanceIndex(BOUNDS, rho).value(LOSSES) - hard).max()) for rho in (10, 1000)]
    assert excess[0] > 1e-3
    assert excess[1] < 1e-12  # exp(-1000 * 0.2) is nothing beside one


def test_a_weighted_sum_trades_one_objective_for_another():
    both = WeightedSum(BOUNDS[1:], (0.5, 0.25, 0.25))
    worse = LOSSES[1:] + torch.tensor([-0.1, 0.1, 0.05], dtype=torch.float64)
    assert float(both.value(worse)) < float(both.value(LOSSES[1:]))
    assert torch.equal(both.updated(worse).bounds, BOUNDS[1:])
    # what the performance index does not do: its bounds stay where one objective got worse than its bound
    index = VectorPerformanceIndex(LOSSES[1:])
    assert torch.equal(index.updated(worse).bounds, LOSSES[1:])


def test_equal_weights_are_the_mean():
    torch.testing.assert_close(WeightedSum(BOUNDS).value(LOSSES), (LOSSES / BOUNDS).mean(1))


def test_multipliers_grow_with_what_is_left_and_stay_bounded():
    now, seen = AugmentedLagrangian(BOUNDS), []
    for _ in range(20):
        now = now.updated(LOSSES)
        seen.append(now.multipliers)
    first = (LOSSES / BOUNDS)[:, 1:]
    torch.testing.assert_close(seen[0], first)  # mu starts at one
    torch.testing.assert_close(seen[1], 2 * first)  # it doubles only after a second look
    torch.testing.assert_close(seen[2], 4 * first)
    assert float(seen[-1].max()) == MOST
    assert (torch.stack(seen).diff(dim=0) >= 0).all()


def test_penalties_rest_while_the_constraint_falls():
    now, losses = AugmentedLagrangian(BOUNDS), LOSSES
    for _ in range(10):
        now, losses = now.updated(losses), 0.8 * losses
    assert torch.equal(now.penalties, torch.ones_like(now.penalties))


def test_losses_that_are_no_number_change_no_multiplier():
    now = AugmentedLagrangian(BOUNDS).updated(LOSSES)
    after = now.updated(torch.full_like(LOSSES, torch.nan))
    for name, value in now.tensors().items():
        assert torch.equal(after.tensors()[name], value), name


@pytest.mark.parametrize("name", NAMES)
def test_networks_are_alone_and_a_combination_is_made_again_from_its_tensors(name):
    now = combine(name, {"bounds": BOUNDS}, (1.0, 2.0, 3.0)).updated(0.9 * LOSSES).updated(0.8 * LOSSES)
    again = combine(name, now.tensors(), (1.0, 2.0, 3.0))
    assert torch.equal(again.value(LOSSES), now.value(LOSSES))
    assert type(again) is type(now)
    other = LOSSES.clone()
    other[0] *= 2.0
    assert float(now.value(other)[1]) == float(now.value(LOSSES)[1])
    assert float(now.value(other)[0]) > float(now.value(LOSSES)[0])


@pytest.mark.parametrize("name", NAMES)
def test_a_single_objective_is_itself(name):
    one = combine(name, {"bounds": BOUNDS[:, :1]})
    torch.testing.assert_close(one.value(LOSSES[:, :1]), (LOSSES / BOUNDS)[:, 0])
