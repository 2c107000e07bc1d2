"""returns.py held against Eq. (5), scipy, a Markov chain solved exactly and hand-worked numbers."""

import itertools

import numpy as np
import pytest
import torch
from scipy import signal

from returns import lambda_return, survival

GAMMA = 0.9
LAMBDAS = pytest.mark.parametrize("lam", [0.0, 0.3, 0.95, 1.0])


def imagined(horizon=6, n=3):
    """Reward, continues and value, (H, N), without termination."""
    torch.manual_seed(0)
    reward, value = torch.randn(2, horizon, n).double()
    return reward, torch.ones_like(reward), value


@LAMBDAS
def test_lambda_return_is_eq5_as_printed_but_for_termination(lam):
    """λ^T γ^T V(s_T) + Σ γ^t λ^t (r_t + γ (1 − λ) V(s_{t+1})), from every step to the end."""
    reward, continues, value = imagined()
    got = lambda_return(reward, continues, value, GAMMA, lam)
    for k in range(6):
        discount = (GAMMA * lam) ** torch.arange(7 - k).double().unsqueeze(1)
        step = reward[k:] + GAMMA * (1 - lam) * value[k:]
        torch.testing.assert_close(got[k], discount[-1] * value[-1] + (discount[:-1] * step).sum(0))


@LAMBDAS
def test_lambda_return_is_a_weighted_mean_where_its_printed_definition_is_not(lam):
    """The weights of the definition above Eq. (5) sum to 1 + λ^T (1 − λ)."""
    zero, one = torch.zeros(3, 1), torch.ones(3, 1)
    assert lambda_return(zero, one, one, 1.0, lam)[0].item() == pytest.approx(1)
    printed = (1 - lam) * sum(lam**t for t in range(4)) + lam**3  # T = 3, all G_t = 1
    assert printed == pytest.approx(1 + lam**3 * (1 - lam))
    assert (printed > 1.01) == (0 < lam < 1)


@LAMBDAS
def test_lambda_return_mixes_the_n_step_returns(lam):
    """(1 − λ) Σ_{t<T−1} λ^t G_t + λ^{T−1} G_{T−1}; as printed, λ = 1 would give G_0."""
    reward, continues, value = imagined()
    discount = GAMMA ** torch.arange(7).double().unsqueeze(1)
    n_step = (discount[:6] * reward).cumsum(0) + discount[1:] * value  # G_0 … G_5
    weights = torch.tensor([(1 - lam) * lam**t for t in range(5)] + [lam**5]).double()
    got = lambda_return(reward, continues, value, GAMMA, lam)[0]
    torch.testing.assert_close(got, weights @ n_step)


def test_lambda_zero_is_the_one_step_target():
    reward, _, value = imagined()
    continues = torch.rand_like(reward)
    got = lambda_return(reward, continues, value, GAMMA, 0.0)
    torch.testing.assert_close(got, reward + GAMMA * continues * value)


def test_lambda_one_is_the_discounted_rewards_and_the_last_value():
    """A one-pole filter run backwards in time, started from V(s_H)."""
    reward, continues, value = imagined()
    backwards = torch.cat([value[-1:], reward.flip(0)]).numpy()
    expected = signal.lfilter([1], [1, -GAMMA], backwards, axis=0)[1:][::-1]
    np.testing.assert_allclose(lambda_return(reward, continues, value, GAMMA, 1.0), expected)


@LAMBDAS
def test_constant_reward_has_a_constant_return(lam):
    """r ≡ 1 and V = 1 / (1 − γ) = 10: γ is applied once a step."""
    one = torch.ones(5, 2).double()
    torch.testing.assert_close(lambda_return(one, one, 10 * one, GAMMA, lam), 10 * one)


@LAMBDAS
def test_values_of_a_markov_chain_with_termination_are_a_fixed_point(lam):
    """V = (I − γPC)⁻¹ P r; the mean of R_0 over all paths of 4 states is V(s_0) again."""
    torch.manual_seed(0)
    transition, reward = torch.rand(3, 3).double().softmax(1), torch.randn(3).double()
    continues = torch.tensor([0.0, 0.6, 1.0]).double()
    matrix = torch.eye(3).double() - GAMMA * transition @ continues.diag()
    value = torch.linalg.solve(matrix, transition @ reward)
    paths = torch.tensor(list(itertools.product(range(3), repeat=4))).T  # (4, 81)
    probs = transition[:, paths[0]] * transition[paths[:-1], paths[1:]].prod(0)  # (3, 81)
    returns = lambda_return(reward[paths], continues[paths], value[paths], GAMMA, lam)
    torch.testing.assert_close(probs @ returns[0], value)


def test_coefficients_of_rewards_and_values():
    """In R_0: (γλ)^t of r(s_{t+1}), (1 − λ) λ^{k−1} γ^k of V(s_k) and λ^{H−1} γ^H of V(s_H)."""
    reward, continues, value = (x[:4, :1].requires_grad_() for x in imagined())
    R = lambda_return(reward, continues, value, GAMMA, 0.5)[0].sum()
    of_reward, of_value = torch.autograd.grad(R, (reward, value))
    np.testing.assert_allclose(of_reward[:, 0], [1, 0.45, 0.45**2, 0.45**3])
    expected = [0.5 * 0.9, 0.25 * 0.9**2, 0.125 * 0.9**3, 0.125 * 0.9**4]
    np.testing.assert_allclose(of_value[:, 0], expected)


def test_an_end_costs_what_would_have_come_after_it():
    """∂R_0/∂c_1 = γ · 4.3, which is ½ V(s_1) + ½ R_1, and ∂R_0/∂c_2 = γ² λ c_1 V(s_2): it is by
    these alone that an actor learns to avoid ends."""
    continues = torch.tensor([[0.5], [1.0]], requires_grad=True)
    reward, value = torch.tensor([[1.0], [2.0]]), torch.tensor([[3.0], [4.0]])
    R = lambda_return(reward, continues, value, GAMMA, 0.5)[0].sum()
    (slope,) = torch.autograd.grad(R, continues)
    assert R.item() == pytest.approx(2.935)
    assert slope.flatten().tolist() == pytest.approx([3.87, 0.81])


@LAMBDAS
def test_reward_for_arriving_is_not_discounted(lam):
    """A reward at s_{t+1} alone: R_t holds it whole, R_{t+1} nothing of it."""
    reward = torch.tensor([0.0, 0.0, 1.0, 0.0]).unsqueeze(1)
    got = lambda_return(reward, torch.ones(4, 1), torch.zeros(4, 1), GAMMA, lam)
    expected = [(GAMMA * lam) ** 2, GAMMA * lam, 1, 0]
    np.testing.assert_allclose(got[:, 0], expected, rtol=1e-6)


@LAMBDAS
def test_nothing_counts_after_the_end_of_an_episode(lam):
    """c = 0 in s_2: its reward is the last, whatever the world model dreams of after it."""
    reward, continues, value = imagined(horizon=4)
    continues[1] = 0
    reward[2:], value[1:] = 1e6, 1e6
    got = lambda_return(reward, continues, value, GAMMA, lam)
    torch.testing.assert_close(got[1], reward[1])
    expected = reward[0] + GAMMA * ((1 - lam) * value[0] + lam * reward[1])
    torch.testing.assert_close(got[0], expected)


def test_lambda_return_refuses_shapes_that_would_broadcast():
    with pytest.raises(AssertionError):
        lambda_return(torch.zeros(4, 3), torch.ones(4, 1), torch.zeros(4, 3), GAMMA, 0.95)


def test_survival_is_the_product_of_the_continues_before():
    """S_k = c_1 … c_k: the c that an action leads to is not in that action's weight."""
    continues = torch.tensor([[0.5, 1.0], [0.4, 0.0], [0.9, 1.0], [0.1, 1.0]], requires_grad=True)
    got = survival(continues)
    expected = torch.tensor([[1.0, 1.0], [0.5, 1.0], [0.2, 0.0], [0.18, 0.0]])
    torch.testing.assert_close(got, expected)
    assert not got.requires_grad
