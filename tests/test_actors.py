"""actors.py held against torch.distributions, scipy and numbers worked by hand."""

import math
from functools import partial
from types import SimpleNamespace

import numpy as np
import pytest
import torch
from scipy import optimize, stats
from torch import nn
from torch.distributions import Normal

from actors import (
    DeterministicActor,
    QCritic,
    StochasticActor,
    VCritic,
    actor_loss,
    critic_loss,
    explore,
    imagined_returns,
)

GAMMA = 0.9


def always(actor, *outputs):
    """The actor with its last layer fixed, whatever the state."""
    nn.init.zeros_(actor.net[-1].weight)
    actor.net[-1].bias.data = torch.tensor(outputs)
    return actor


def dream(state, action, reward=None, continues=None):
    """What the losses see of a dream: state and action (H + 1, N, ·), the rest (H, N)."""
    shape = state[1:].shape[:2]
    reward = torch.zeros(shape) if reward is None else reward
    continues = torch.ones(shape) if continues is None else continues
    return SimpleNamespace(state=state, action=action, reward=reward, continues=continues)


# Actors


def test_untrained_policy_is_five_wide():
    std = StochasticActor(6, 2, 32).distribution(torch.randn(100, 6)).stddev
    assert std.min() > 4.5 and std.max() < 5.5


def test_policy_before_the_tanh_has_a_bounded_mean_and_a_positive_deviation():
    """μ = 5 tanh(x / 5); σ is 5 at x = 0 and never under 1e-4."""
    policy = always(StochasticActor(6, 3, 32), 5.0, -2.5, 1e4, 0.0, -1e4, 1.0)
    got = policy.distribution(torch.randn(6))
    np.testing.assert_allclose(got.mean.detach(), [3.807971, -2.310586, 5], rtol=1e-6)
    np.testing.assert_allclose(got.stddev[:2].detach(), [5.0001, 1e-4], rtol=1e-5)


@pytest.mark.parametrize("actor", [StochasticActor(6, 2, 8), DeterministicActor(6, 2, 8)])
def test_raw_is_what_the_bounds_act_on(actor):
    state = torch.randn(5, 6)
    torch.testing.assert_close(
        actor.greedy(state), torch.tanh(5 * torch.tanh(actor.raw(state) / 5))
    )


def test_actions_are_the_tanh_of_a_normal():
    raw_std = math.log(math.expm1(0.5)) - math.log(math.expm1(5))  # σ = 0.5
    policy = always(StochasticActor(6, 1, 32), 1.0, raw_std)
    action = policy(torch.randn(20_000, 6)).detach().flatten()
    before = Normal(5 * math.tanh(0.2), 0.5001)
    uniform = before.cdf(action.double().atanh())
    assert stats.kstest(uniform.numpy(), "uniform").pvalue > 0.001


@pytest.mark.parametrize("kind", [StochasticActor, DeterministicActor])
def test_actions_and_greedy_ones_stay_within_one(kind):
    actor = kind(6, 2, 32)
    actor.net[-1].weight.data *= 1e4
    state = torch.randn(200, 6)
    for action in (actor(state), actor.greedy(state)):
        assert action.shape == (200, 2) and action.abs().max() <= 1
        assert action.abs().max() > 0.99


def test_greedy_is_the_tanh_of_the_mean_and_the_deterministic_action_is_the_same_function():
    """tanh(5 tanh(x / 5)) at x = 1 and x = −4."""
    stochastic = always(StochasticActor(6, 2, 32), 1.0, -4.0, 0.0, 0.0)
    deterministic = always(DeterministicActor(6, 2, 32), 1.0, -4.0)
    state = torch.randn(6)
    for action in (stochastic.greedy(state), deterministic(state), deterministic.greedy(state)):
        np.testing.assert_allclose(action.detach(), [0.7560273, -0.9973903], rtol=1e-5)


def test_sampled_actions_are_reparametrised():
    policy = StochasticActor(6, 2, 32)
    policy(torch.randn(50, 6)).sum().backward()
    assert all(p.grad.ne(0).any() for p in policy.parameters())


# Critics and returns


def test_value_is_the_mean_of_q_over_actions():
    """V = E_a Q: for Q = −(a − m)² and a ~ N(μ, σ), −(μ − m)² − σ², gradients too."""
    n, m = 200_000, 0.5
    mean, std = torch.tensor(-1.0, requires_grad=True), torch.tensor(0.7, requires_grad=True)
    action = Normal(mean, std).rsample((2, n, 1))

    def q(state, action):
        return -(action - m).square().squeeze(-1)

    value = imagined_returns(dream(torch.zeros(2, n, 1), action), q, 1.0, 0.95).mean()
    gradients = torch.autograd.grad(value, (mean, std))
    assert value.item() == pytest.approx(-(1.5**2) - 0.49, rel=0.01)
    assert [g.item() for g in gradients] == pytest.approx([3.0, -1.4], rel=0.02)


def test_returns_take_q_at_the_state_arrived_in_and_the_action_chosen_there():
    state, action = torch.tensor([1.0, 2.0, 3.0]).view(3, 1, 1), torch.tensor([4.0, 5.0, 6.0])
    reward, continues = torch.tensor([[100.0], [200.0]]), torch.tensor([[1.0], [0.5]])

    def q(state, action):
        return (10 * state + action).squeeze(-1)

    got = imagined_returns(dream(state, action.view(3, 1, 1), reward, continues), q, GAMMA, 0.0)
    np.testing.assert_allclose(got.flatten(), [100 + 0.9 * 25, 200 + 0.9 * 0.5 * 36])


def test_q_sees_state_and_action_and_v_the_state_alone():
    state, action = (
        torch.randn(2, 7, 6, requires_grad=True),
        torch.randn(2, 7, 3, requires_grad=True),
    )
    q, v = QCritic(6, 3, 32)(state, action), VCritic(6, 32)(state, action)
    assert q.shape == v.shape == (2, 7)
    assert all(g.ne(0).all() for g in torch.autograd.grad(q.sum(), (state, action)))
    of_state, of_action = torch.autograd.grad(v.sum(), (state, action), allow_unused=True)
    assert of_state.ne(0).all() and of_action is None


# Losses


def test_first_state_only_is_the_mean_return_of_the_starting_states():
    returns = torch.tensor([[1.0, 3.0], [10.0, 30.0]], requires_grad=True)
    loss = actor_loss(returns, torch.full((2, 2), 0.5), first_state_only=True)
    (gradient,) = torch.autograd.grad(loss, returns)
    assert loss.item() == -2
    assert gradient.tolist() == [[-0.5, -0.5], [0, 0]]


def test_later_actions_receive_gradient_from_the_first_return():
    """With s' = s + a, r = s, Q = 7 a, λ = 1: ∂R_0/∂a_k = Σ_{k≤j<H} γ^j, and 7 γ^H for a_H."""
    action = torch.randn(4, 1, 1, requires_grad=True)
    state = torch.cat([torch.zeros(1, 1, 1), action[:-1].cumsum(0)])
    imagined = dream(state, action, reward=state[1:].squeeze(-1))
    returns = imagined_returns(imagined, lambda state, action: 7 * action.squeeze(-1), GAMMA, 1.0)
    actor_loss(returns, imagined.continues, first_state_only=True).backward()
    expected = [1 + 0.9 + 0.81, 0.9 + 0.81, 0.81, 7 * 0.729]
    np.testing.assert_allclose(-action.grad.flatten(), expected, rtol=1e-6)


def test_all_states_count_by_their_survival():
    """Dreamer's paper's: (1 · 1 + ½ · 10 + ½ · 0 · 100) / 3, with no gradient through survival."""
    continues = torch.tensor([[0.5], [0.0], [1.0]], requires_grad=True)
    returns = torch.tensor([[1.0], [10.0], [100.0]], requires_grad=True)
    loss = actor_loss(returns, continues, first_state_only=False)
    loss.backward()
    assert loss.item() == pytest.approx(-2)
    np.testing.assert_allclose(returns.grad.flatten(), [-1 / 3, -1 / 6, 0], rtol=1e-6)
    assert continues.grad is None


class Table(nn.Module):
    """Q of each of three states and two actions, both one-hot."""

    def __init__(self):
        super().__init__()
        self.q = nn.Parameter(torch.zeros(3, 2).double())

    def forward(self, state, action):
        return torch.einsum("...s,...a,sa->...", state, action, self.q)


@pytest.mark.parametrize("lam", [0.0, 0.95])
def test_a_critic_learns_eq2_of_a_chain_with_ends(lam):
    """Q(s, a) = r(s') + γ c(s') Q(s', π(s')), solved. Dreams of three steps take each first action
    from each state, and then π's."""
    follows = torch.tensor([[1, 2], [2, 0], [0, 1]])  # s' of s and a
    reward, continues = torch.tensor([1.0, -2.0, 3.0]).double(), torch.tensor([1.0, 0.6, 0.0])
    chosen = torch.tensor([0, 1, 1])  # π
    states, actions = [torch.arange(3).repeat_interleave(2)], [torch.tensor([0, 1]).repeat(3)]
    for _ in range(3):
        states.append(follows[states[-1], actions[-1]])
        actions.append(chosen[states[-1]])
    states, actions = torch.stack(states), torch.stack(actions)
    imagined = dream(
        nn.functional.one_hot(states, 3).double(), nn.functional.one_hot(actions, 2).double(),
        reward[states[1:]], continues.double()[states[1:]],
    )  # fmt: skip
    table = Table()
    optimiser = torch.optim.SGD(table.parameters(), 2.0)
    for _ in range(300):
        returns = imagined_returns(imagined, table, GAMMA, lam)
        optimiser.zero_grad()
        critic_loss(table, imagined, returns.detach(), smooth_l1=False).backward()
        optimiser.step()
    under_policy = follows[torch.arange(3), chosen]
    on = continues.double()[under_policy].diag() @ nn.functional.one_hot(under_policy, 3).double()
    matrix = torch.eye(3).double() - GAMMA * on
    value = torch.linalg.solve(matrix, reward[under_policy])
    expected = (reward + GAMMA * continues * value)[follows]
    torch.testing.assert_close(table.q.detach(), expected, rtol=1e-4, atol=1e-4)


class Constant(nn.Module):
    """A critic that says the same of everything."""

    def __init__(self, value):
        super().__init__()
        self.value = nn.Parameter(torch.tensor(float(value)))

    def forward(self, state, action):
        return self.value.expand(state.shape[:-1])


@pytest.mark.parametrize(("smooth_l1", "expected"), [(True, 1 / 9), (False, 1)])
def test_smooth_l1_does_not_estimate_a_mean(smooth_l1, expected):
    """Of returns 0, nine in ten, and 10, one in ten."""
    returns = torch.tensor([[0.0] * 9 + [10.0]]).double()
    imagined = dream(torch.zeros(2, 10, 1), torch.zeros(2, 10, 1))

    def loss(value):
        return critic_loss(Constant(value).double(), imagined, returns, smooth_l1).item()

    assert optimize.minimize_scalar(loss).x == pytest.approx(expected, abs=1e-4)


def test_smooth_l1_is_half_the_square_up_to_an_error_of_one_and_linear_beyond():
    """Errors of ¼ and 1 cost ½ of their squares in both; one of 3 costs 2½, or 4½."""
    imagined = dream(torch.zeros(2, 1, 1), torch.zeros(2, 1, 1))
    for error, smooth, square in [(0.25, 1 / 32, 1 / 32), (1, 1 / 2, 1 / 2), (3, 5 / 2, 9 / 2)]:
        returns = torch.full((1, 1), float(error))
        assert critic_loss(Constant(0), imagined, returns, True).item() == pytest.approx(smooth)
        assert critic_loss(Constant(0), imagined, returns, False).item() == pytest.approx(square)


def test_critic_loss_compares_q_where_the_return_starts_and_weighs_it_by_survival():
    """Q = s + a is 5, 7 and 9 against 4, 5 and 6: (1 · ½ + ½ · 2 + ½ · 0.2 · 4½) / 3."""
    state, action = torch.tensor([1.0, 2.0, 3.0, 99.0]), torch.tensor([4.0, 5.0, 6.0, 99.0])
    continues = torch.tensor([[0.5], [0.2], [0.0]])
    imagined = dream(state.view(4, 1, 1), action.view(4, 1, 1), continues=continues)
    returns = torch.tensor([[4.0], [5.0], [6.0]])

    def q(state, action):
        return (state + action).squeeze(-1)

    assert critic_loss(q, imagined, returns, False).item() == pytest.approx(1.95 / 3)


@pytest.mark.parametrize("smooth_l1", [True, False])
def test_critic_loss_gives_gradient_to_the_critic_alone(smooth_l1):
    critic = QCritic(6, 2, 32)
    leaves = [torch.rand(s, requires_grad=True) for s in [(4, 5, 6), (4, 5, 2), (3, 5), (3, 5)]]
    imagined = dream(*leaves)
    returns = imagined_returns(imagined, critic, GAMMA, 0.95)
    critic_loss(critic, imagined, returns, smooth_l1).backward()
    assert all(p.grad.ne(0).any() for p in critic.parameters())
    assert all(leaf.grad is None for leaf in leaves)


def test_critic_loss_does_not_move_the_value_that_it_bootstraps_from():
    """Q = 0 and R = γ Q = 0.9 · Q(s_1, a_1): ∂ ½ (Q − R)² / ∂Q at Q = 1 is 0.1, not 0.1 · 0.1."""
    critic, imagined = Constant(1), dream(torch.zeros(2, 1, 1), torch.zeros(2, 1, 1))
    returns = imagined_returns(imagined, critic, GAMMA, 0.95)
    critic_loss(critic, imagined, returns, smooth_l1=True).backward()
    assert critic.value.grad.item() == pytest.approx(0.1)


# Exploration


def test_exploration_without_noise_is_the_action():
    action = np.array([0.3, -1.0], np.float32)
    np.testing.assert_array_equal(explore(action, 0.0, 0.0, np.random.default_rng(0)), action)


def test_exploration_noise_is_gaussian_and_clipped():
    rng, action = np.random.default_rng(0), np.full(20_000, 0.5, np.float32)
    got = explore(action, 0.1, 0.0, rng)
    assert got.dtype == np.float32
    assert stats.kstest(got, stats.norm(0.5, 0.1).cdf).pvalue > 0.001
    clipped = explore(action, 1.0, 0.0, rng)  # P(0.5 + ε > 1), P(0.5 + ε < −1)
    assert (clipped == 1).mean() == pytest.approx(stats.norm.sf(0.5), abs=0.01)
    assert (clipped == -1).mean() == pytest.approx(stats.norm.sf(1.5), abs=0.01)
    assert np.all(action == 0.5)


def test_random_actions_are_uniform_and_as_frequent_as_asked():
    """Minor modification 4 of §4.2."""
    rng = np.random.default_rng(0)
    got = explore(np.zeros(20_000), 0.3, 1.0, rng)
    assert got.dtype == np.float32
    assert stats.kstest(got, stats.uniform(-1, 2).cdf).pvalue > 0.001
    count = sum(explore(np.zeros(2), 0.0, 0.3, rng).any() for _ in range(5000))
    assert stats.binomtest(int(count), 5000, 0.3).pvalue > 0.001


@pytest.mark.parametrize("make", [partial(QCritic, 6, 2, 32), partial(VCritic, 6, 32)])
def test_a_normalised_critic_does_not_run_away_with_the_size_of_its_state(make):
    state, action = torch.randn(5, 6), torch.rand(5, 2)
    growth = {}
    for norm in (True, False):
        critic = make(norm=norm)
        growth[norm] = (critic(1e6 * state, action) / critic(1e3 * state, action)).abs()
    torch.testing.assert_close(growth[True], torch.ones(5), rtol=0.1, atol=0)
    assert growth[False].min() > 100


@pytest.mark.parametrize("critic", [QCritic(6, 2, 8), VCritic(6, 8)])
def test_values_keep_their_digits_in_bfloat16(critic):
    """bfloat16 would make 150 of 150.3: the last layer is in float32 whatever the others are."""
    torch.nn.init.zeros_(critic.net[-1].weight)
    torch.nn.init.constant_(critic.net[-1].bias, 150.3)
    with torch.autocast("cpu", torch.bfloat16):
        value = critic(torch.randn(5, 6), torch.randn(5, 2))
    torch.testing.assert_close(value, torch.full((5,), 150.3))
