"""mdn.py held against torch.distributions, scipy, and two chains solved in closed form.

The chains carry the proof of Eqs. (6)–(10). On a finite one with termination, the discounted
occupancy is q = (I − γPC)⁻¹ P (I − γC). On x' = a x + b + σ ε, q's mean and variance are known,
and a Gaussian bootstrapped from itself keeps both, so that one component is enough.
"""

import itertools
import math

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy import integrate, stats
from torch import nn
from torch.distributions import Categorical, Independent, MixtureSameFamily, Normal

from mdn import (
    Mixture,
    MixtureDensityNetwork,
    cross_entropy,
    discounted_weights,
    entropy,
    mdn_loss,
    particle_entropy,
    soft_update,
)

GAMMA = 0.9  # γ_q


# The mixture


def random_mixture(n: int, components: int, size: int) -> Mixture:
    log_weights = torch.randn(n, components).log_softmax(-1)
    shape = (n, components, size)
    return Mixture(log_weights, torch.randn(shape), torch.rand(shape) + 0.1)


def reference(mixture: Mixture) -> MixtureSameFamily:
    """The same mixture by torch.distributions, in float64."""
    log_weights, mean, std = (x.double() for x in mixture)
    return MixtureSameFamily(Categorical(logits=log_weights), Independent(Normal(mean, std), 1))


@pytest.mark.parametrize("dtype", [torch.float32, torch.bfloat16])
def test_log_prob_is_that_of_torch_distributions(dtype):
    """At the paper's sizes; bfloat16 states and autocast around it must not cost precision."""
    mixture = random_mixture(5, 8, 328)
    x = torch.randn(23, 5, 328, dtype=dtype)
    with torch.autocast("cpu", torch.bfloat16, enabled=dtype == torch.bfloat16):
        got = mixture.log_prob(x)
    expected = reference(mixture).log_prob(x.double())
    torch.testing.assert_close(got.double(), expected, rtol=1e-6, atol=0)


def test_gradients_of_log_prob_are_those_of_torch_distributions():
    """Each to a ten-thousandth of the largest: float32 knows log-densities of thousands of nats to
    some 5e-4, and so which component a point is of."""
    mixture, x = random_mixture(5, 8, 328), torch.randn(23, 5, 328)
    inputs = [tensor.requires_grad_() for tensor in (x, *mixture)]
    got = torch.autograd.grad(mixture.log_prob(x).sum(), inputs)
    log_prob = reference(mixture).log_prob(x.double())
    expected = torch.autograd.grad(log_prob.sum(), inputs)
    for own, torchs in zip(got[:1] + got[2:], expected[:1] + expected[2:], strict=True):
        assert (own - torchs).abs().max() <= 1e-4 * torchs.abs().max()
    # Categorical normalises the weights, which are already: it takes out their mean direction
    tangent = got[1] - mixture.log_weights.exp() * got[1].sum(1, keepdim=True)
    torch.testing.assert_close(tangent, expected[1], rtol=1e-4, atol=1e-3)


def test_log_prob_and_its_gradient_are_finite_a_thousand_deviations_away():
    mixture = random_mixture(4, 8, 6)
    x = (1000 * mixture.std.amax(1)).unsqueeze(0).requires_grad_()
    got = mixture.log_prob(x)
    expected = reference(mixture).log_prob(x.double())
    torch.testing.assert_close(got.double(), expected, rtol=1e-6, atol=0)
    assert torch.autograd.grad(got.sum(), x)[0].isfinite().all()


def test_log_prob_refuses_points_that_would_broadcast():
    with pytest.raises(AssertionError):
        random_mixture(4, 2, 3).log_prob(torch.zeros(7, 1, 3))


def test_density_integrates_to_one():
    mixture = MixtureDensityNetwork(1, components=8)(10 * torch.randn(1, 1))

    def density(x):
        return mixture.log_prob(torch.full((1, 1, 1), x)).exp().item()

    with torch.no_grad():
        assert integrate.quad(density, -50, 50, points=[-5, 0, 5])[0] == pytest.approx(1, abs=1e-4)


def test_deviation_has_a_floor():
    mdn = MixtureDensityNetwork(3, components=2, min_std=0.25)
    nn.init.constant_(mdn.head.bias, -100)
    assert mdn(torch.randn(4, 3)).std.min().item() == pytest.approx(0.25)


def test_monte_carlo_entropy_of_one_component_is_that_of_a_normal():
    normal = Normal(torch.tensor([3.0, -1.0]), torch.tensor([0.5, 4.0]))
    n = 100_000
    p = Mixture(torch.zeros(n, 1), normal.mean.expand(n, 1, 2), normal.stddev.expand(n, 1, 2))
    got = cross_entropy(p, p.sample_components(), torch.ones(1, n), p, GAMMA).mean()
    assert got.item() == pytest.approx(normal.entropy().sum().item(), abs=0.02)


def test_identical_components_are_one_gaussian():
    mean, std = torch.randn(4, 3), torch.rand(4, 3) + 0.1
    same = [parameter.unsqueeze(1).expand(4, 8, 3) for parameter in (mean, std)]
    mixture, x = Mixture(torch.randn(4, 8).log_softmax(-1), *same), torch.randn(9, 4, 3)
    expected = Normal(mean, std).log_prob(x).sum(-1)
    torch.testing.assert_close(mixture.log_prob(x), expected)


# The weights of Eqs. (8)–(10)


@settings(database=None, deadline=None, derandomize=True)
@given(st.lists(st.floats(0, 1), min_size=1, max_size=20), st.floats(0, 1))
def test_weights_are_a_distribution(continues, gamma):
    weights, tail = discounted_weights(torch.tensor(continues).double().unsqueeze(1), gamma)
    assert weights.min() >= 0 and tail.item() >= 0
    assert (weights.sum(0) + tail).item() == pytest.approx(1)


def test_weights_without_termination_are_geometric():
    """(1 − γ) γ^{k−1} on s_{t+k}, k = 1 … n: Eq. (10) prints k = 0 … n − 1."""
    weights, tail = discounted_weights(torch.ones(15, 1).double(), GAMMA)
    clock = stats.geom(1 - GAMMA)
    np.testing.assert_allclose(weights[:, 0], clock.pmf(np.arange(1, 16)))
    np.testing.assert_allclose(tail, clock.sf(15))


def test_weight_that_is_left_stays_where_the_episode_ends():
    continues = torch.tensor([[0.0, 1.0], [1.0, 0.0], [1.0, 1.0]])
    weights, tail = discounted_weights(continues, GAMMA)
    torch.testing.assert_close(weights, torch.tensor([[1.0, 0.1], [0.0, 0.9], [0.0, 0.0]]))
    assert tail.tolist() == [0, 0]


def test_weights_sum_to_one_where_the_printed_form_with_termination_does_not():
    """The unnumbered equation after (6): with d = ½ in each state its weights sum to 1.275."""
    weights, tail = discounted_weights(torch.full((2, 1), 0.5).double(), GAMMA)
    np.testing.assert_allclose([*weights[:, 0], tail[0]], [0.55, 0.45 * 0.55, 0.45**2])
    ends = [0.0, 1 / 2, 1 / 4]  # p(d_{t+k} | s_t): the episode ends at k, for k = 0, 1, 2
    mass = 1.0
    for before, now in reversed(list(itertools.pairwise(ends))):
        mass = (1 - before) * (1 - GAMMA + GAMMA * mass) + now
    assert mass == pytest.approx(1.275)


# Eqs. (6), (9), (10) on finite chains. A state is a one-hot row, a density a table


class Atoms:
    """A table (N, S) of probabilities in the place of a mixture: component k is state k."""

    def __init__(self, probs):
        self.log_weights = probs.log()

    def sample_components(self):
        n, size = self.log_weights.shape
        return torch.eye(size).double().unsqueeze(1).expand(size, n, size)


class Indicator:
    """−log P is 1 at state j and 0 elsewhere: a cross-entropy with it is the probability of j."""

    def __init__(self, j):
        self.j = j

    def log_prob(self, x):
        return -x[..., self.j]


def fixed_point(transition, continues, n):
    """q (S, S) that the n-step bootstrap leaves as it is, by enumeration of all paths."""
    size = len(transition)
    paths = torch.tensor(list(itertools.product(range(size), repeat=n))).T  # (n, S^n)
    probs = transition[:, paths[0]] * transition[paths[:-1], paths[1:]].prod(0)  # (S, S^n)
    q = torch.full((size, size), 1 / size).double()
    for _ in range(10 + 300 // n):
        tail = Atoms(q[paths[-1]])
        hit = [
            cross_entropy(
                Indicator(j), torch.eye(size).double()[paths], continues[paths], tail, GAMMA
            )
            for j in range(size)
        ]
        q = probs @ torch.stack(hit, 1)
    return q


def occupancy(transition, continues):
    """(I − γPC)⁻¹ P (I − γC)."""
    eye, c = torch.eye(len(transition)).double(), continues.diag()
    return torch.linalg.solve(eye - GAMMA * transition @ c, transition @ (eye - GAMMA * c))


def random_chain(size):
    transition = torch.rand(size, size).double().pow(2)
    return transition / transition.sum(1, keepdim=True), torch.linspace(0, 1, size).double()


@pytest.mark.parametrize(("n", "size"), [(1, 5), (4, 5), (15, 2)])
def test_eq10_fixed_point_is_the_discounted_occupancy(n, size):
    transition, continues = random_chain(size)
    expected = occupancy(transition, continues)
    torch.testing.assert_close(expected.sum(1), torch.ones(size).double())
    torch.testing.assert_close(fixed_point(transition, continues, n), expected)


def test_eq10_fixed_point_is_not_what_eq9_prints():
    """At n = 1 (9) prints q = (1 − γ) p + γ q, which is q = p: nothing of later states."""
    transition, _ = random_chain(4)
    printed = torch.full((4, 4), 0.25).double()
    for _ in range(400):
        printed = (1 - GAMMA) * transition + GAMMA * printed
    torch.testing.assert_close(printed, transition)
    got = fixed_point(transition, torch.ones(4).double(), 1)
    expected = sum(
        (1 - GAMMA) * GAMMA ** (k - 1) * transition.matrix_power(k) for k in range(1, 400)
    )
    torch.testing.assert_close(got, expected)
    assert (got - printed).abs().max() > 0.1


def test_eq10_fixed_point_is_where_simulated_episodes_are_found():
    """Stop a walk by a geometric clock or by the end of its episode, whichever is first."""
    transition, continues = random_chain(4)
    start, walks = 2, 50_000
    state = torch.full((walks,), start)
    clock = torch.as_tensor(stats.geom(1 - GAMMA).rvs(walks, random_state=0))
    walking = torch.ones(walks).bool()
    for k in range(1, int(clock.max()) + 1):
        state = torch.where(walking, torch.multinomial(transition[state], 1)[:, 0], state)
        walking &= (clock > k) & (torch.rand(walks) < continues[state])
    histogram = state.bincount(minlength=4) / walks
    expected = fixed_point(transition, continues, 2)[start]
    torch.testing.assert_close(histogram.double(), expected, atol=0.01, rtol=0)


def test_probability_of_the_end_of_a_two_state_chain():
    """q(end) = e / (1 − γ (1 − e)): 0.1 / 0.19."""
    transition = torch.tensor([[0.9, 0.1], [0.0, 1.0]]).double()
    q = fixed_point(transition, torch.tensor([1.0, 0.0]).double(), 3)
    assert q[0, 1].item() == pytest.approx(10 / 19)


# Eq. (10) learnt, on x' = a x + b + σ ε

A, B, SIGMA = 0.8, 0.5, 0.3
REST = B / (1 - A)  # x*
SLOPE = (1 - GAMMA) * A / (1 - GAMMA * A)  # of the mean of q(· | x)
SPREAD = (1 - GAMMA) * A**2 / (1 - GAMMA * A**2)  # of E_q (x − x*)², in (x_t − x*)²


def walk(start, n, sigma):
    """(n + 1, N, 1) from N starting points (N, 1), reparametrised in σ."""
    states = [start]
    for _ in range(n):
        states.append(A * states[-1] + B + sigma * torch.randn_like(start))
    return torch.stack(states)


def q_moments(x):
    """Mean and variance of q(· | x)."""
    variance = SIGMA**2 / (1 - GAMMA * A**2) + (SPREAD - SLOPE**2) * (x - REST) ** 2
    return REST + SLOPE * (x - REST), variance


def test_eq10_training_finds_the_mean_and_variance_of_a_gaussian_chain():
    """At x = −1.2. Eq. (10) as printed, with s_t in it, would find the mean 1.178571."""
    mdn, n, steps = MixtureDensityNetwork(1, components=1, units=64), 4, 1500
    optimiser = torch.optim.Adam(mdn.parameters(), 3e-3)
    schedule = torch.optim.lr_scheduler.LinearLR(optimiser, 1, 0.01, steps)
    for _ in range(steps):
        states = walk(5.5 * torch.rand(512, 1) - 2, n, SIGMA)
        loss = mdn_loss(mdn, states, torch.ones(n, 512), GAMMA).mean()
        optimiser.zero_grad()
        loss.backward()
        optimiser.step()
        schedule.step()
    learnt = mdn(torch.tensor([[-1.2]]))
    assert q_moments(-1.2) == pytest.approx((1.442857, 1.161128), abs=1e-5)
    assert learnt.mean.item() == pytest.approx(1.442857, abs=0.04)
    assert learnt.std.item() ** 2 == pytest.approx(1.161128, abs=0.06)


class LearntChain(nn.Module):
    """A target network that has learnt q of the chain: one Gaussian with q's mean and variance."""

    def forward(self, state):
        mean, variance = q_moments(state)
        return Mixture(torch.zeros_like(state), mean.unsqueeze(1), variance.sqrt().unsqueeze(1))


@pytest.mark.parametrize("n", [1, 4, 15])
def test_entropy_gradient_of_a_gaussian_chain(n):
    """∂Ĥ/∂σ at x* is (1 − γⁿ) / σ: the true 1 / σ but for the share of the frozen P_T."""
    sigma = torch.tensor(SIGMA, requires_grad=True)
    states = walk(torch.full((100_000, 1), REST), n, sigma)
    estimate = entropy(LearntChain(), states, torch.ones(n, 100_000), GAMMA).mean()
    (gradient,) = torch.autograd.grad(estimate, sigma)
    expected = Normal(REST, q_moments(REST)[1] ** 0.5).entropy().item()
    assert estimate.item() == pytest.approx(expected, abs=0.02)
    assert gradient.item() == pytest.approx((1 - GAMMA**n) / SIGMA, rel=0.03)


def test_entropy_sampled_from_the_target_alone_has_no_gradient():
    """Right in value, but what the policy does after s_t is nowhere in it."""
    sigma = torch.tensor(SIGMA, requires_grad=True)
    states = walk(torch.full((50_000, 1), REST), 1, sigma)
    density = LearntChain()(states[0])
    direct = cross_entropy(
        density, density.sample_components(), torch.ones(1, 50_000), density, GAMMA
    )
    via_states = entropy(LearntChain(), states, torch.ones(1, 50_000), GAMMA)
    assert direct.mean().item() == pytest.approx(via_states.mean().item(), abs=0.02)
    gradients = [
        torch.autograd.grad(estimate.mean(), sigma, retain_graph=True)[0].item()
        for estimate in (direct, via_states)
    ]
    assert gradients == [0, pytest.approx((1 - GAMMA) / SIGMA, rel=0.05)]


@pytest.mark.parametrize("estimate", [mdn_loss, entropy])
def test_of_an_episode_that_ends_at_once_its_last_state_alone_counts(estimate):
    """c_{t+1} = 0: q(· | s_t) is all at s_{t+1}, whatever is dreamt after it."""
    mdn, states = MixtureDensityNetwork(2), torch.randn(4, 5, 2)
    continues = torch.tensor([0.0, 1.0, 1.0]).unsqueeze(1).expand(3, 5)
    expected = -mdn(states[0]).log_prob(states[1:2])[0]
    torch.testing.assert_close(estimate(mdn, states, continues, GAMMA), expected)


# Where gradients go


def imagined(n=3, batch=4, size=2):
    """States (n + 1, N, D) and continues (n, N), leaves that require gradient."""
    states = torch.randn(n + 1, batch, size, requires_grad=True)
    return states, torch.full((n, batch), 0.9).requires_grad_()


def reached(gradient):
    """Which time steps have any gradient."""
    return gradient.flatten(1).ne(0).any(1).tolist()


def test_entropy_gradient_reaches_all_that_follows_and_neither_s_t_nor_the_target():
    target = MixtureDensityNetwork(2).requires_grad_(False)
    states, continues = imagined()
    entropy(target, states, continues, GAMMA).sum().backward()
    assert reached(states.grad) == [False, True, True, True]
    assert reached(continues.grad) == [True, True, True]
    assert all(p.grad is None for p in target.parameters())


def test_entropy_gradient_passes_through_the_bootstrap():
    """With γ = 1 all the weight is on s̃, and only through P_T(· | s_{t+n}) can s_{t+n} matter."""
    target = MixtureDensityNetwork(2).requires_grad_(False)
    states, _ = imagined()
    entropy(target, states, torch.ones(3, 4), 1.0).sum().backward()
    assert reached(states.grad) == [False, False, False, True]


def test_bootstrap_is_unbiased_in_the_mixture_weights():
    """Against N(0, 1): Σ π_k ½ (log 2π + μ_k² + σ_k²), and its derivatives in log π_k."""
    n, pi, mean, std = 50_000, torch.tensor([0.2, 0.8]), torch.tensor([1.0, -3.0]), 0.5
    log_weights = pi.log().requires_grad_()
    tail = Mixture(
        log_weights.expand(n, 2), mean.view(1, 2, 1).expand(n, 2, 1), torch.full((n, 2, 1), std)
    )
    unit = Mixture(torch.zeros(n, 1), torch.zeros(n, 1, 1), torch.ones(n, 1, 1))
    got = cross_entropy(unit, torch.zeros(1, n, 1), torch.ones(1, n), tail, 1.0).mean()
    each = pi * 0.5 * (math.log(2 * math.pi) + mean.square() + std**2)
    torch.testing.assert_close(got, each.sum(), rtol=0.01, atol=0)
    torch.testing.assert_close(torch.autograd.grad(got, log_weights)[0], each, rtol=0.01, atol=0)


def test_mdn_loss_gives_gradient_to_the_online_network_alone():
    mdn = MixtureDensityNetwork(2)
    states, continues = imagined()
    mdn_loss(mdn, states, continues, GAMMA).sum().backward()
    assert all(p.grad.ne(0).any() for p in mdn.parameters())
    assert states.grad is None and continues.grad is None


class OneMeanForEachState(nn.Module):
    """State i is the number i, and has a Gaussian of its own."""

    def __init__(self, size):
        super().__init__()
        self.mean = nn.Parameter(torch.zeros(size))

    def forward(self, state):
        mean = self.mean[state.long()].unsqueeze(1)
        return Mixture(torch.zeros_like(state), mean, torch.ones_like(mean))


def test_mdn_loss_does_not_move_the_prediction_that_it_bootstraps_from():
    """The prediction at s_t goes to its target, never the target, at s_{t+n}, to the prediction."""
    mdn = OneMeanForEachState(3)
    states = torch.arange(3.0).view(3, 1, 1)  # s_t = 0, s_{t+1} = 1, s_{t+2} = 2
    mdn_loss(mdn, states, torch.ones(2, 1), GAMMA).sum().backward()
    assert mdn.mean.grad.ne(0).tolist() == [True, False, False]


# The particle estimate


WIDTHS = torch.tensor([0.3, 2.0, 1.0])  # σ of the three numbers of a state


def crowd(n: int, batch: int, scale: float | torch.Tensor = 1.0) -> torch.Tensor:
    """States (n + 1, N, 3) whose futures are all of one Gaussian."""
    return WIDTHS * scale * torch.randn(n + 1, batch, 3) + torch.tensor([5.0, 0.0, -1.0])


@pytest.mark.parametrize("k", [1, 3, 10])
def test_particle_entropy_of_gaussian_states_is_that_of_a_gaussian(k):
    got = particle_entropy(crowd(8, 2000), torch.ones(8, 2000), GAMMA, k)
    assert got.shape == (2000,) and got.dtype == torch.float32
    assert got.mean().item() == pytest.approx(Normal(0, WIDTHS).entropy().sum().item(), abs=0.05)


def test_particle_entropy_is_of_the_discounted_states():
    """States four times as far apart at the later step: the entropy is that of the mixture of both
    Gaussians with the weights 1 − γ and γ, by quadrature; only the first's where all ends there."""
    gamma, far = 0.4, 4.0
    states = torch.randn(3, 3000, 3) * torch.tensor([1.0, 1.0, far]).view(3, 1, 1)

    def surprise(r):  # −p log p at the distance r from the origin, times the sphere's surface
        near, wide = (
            stats.norm.pdf(r, scale=s) * stats.norm.pdf(0, scale=s) ** 2 for s in (1, far)
        )
        density = (1 - gamma) * near + gamma * wide
        return -4 * np.pi * r**2 * density * np.log(density)

    got = particle_entropy(states, torch.ones(2, 3000), gamma).mean().item()
    assert got == pytest.approx(integrate.quad(surprise, 0, 40, limit=200)[0], abs=0.1)
    ends = torch.tensor([[0.0], [1.0]]).expand(2, 3000)
    got = particle_entropy(states, ends, gamma).mean().item()
    assert got == pytest.approx(3 * stats.norm.entropy(), abs=0.1)


def test_particle_entropy_gradient_is_that_of_the_gaussian():
    """∂H/∂s of states s·x is d / s, a little less since a k-th neighbour has some way to it. One
    crowd's is 2.7 ± 0.2."""
    scale = torch.ones((), requires_grad=True)
    crowds = [crowd(8, 2000, scale) for _ in range(10)]
    got = sum(particle_entropy(each, torch.ones(8, 2000), GAMMA).mean() for each in crowds) / 10
    assert torch.autograd.grad(got, scale)[0].item() == pytest.approx(3, rel=0.12)


def test_particle_entropy_draws_away_from_the_others_and_leaves_them_where_they_are():
    """One start's future stands to the right of all the others': only it moves, to the right."""
    states, continues = imagined(batch=50)
    with torch.no_grad():
        states[:, 7] += torch.tensor([6.0, 0.0])
    particle_entropy(states, continues, GAMMA)[7].backward()
    assert reached(states.grad) == [False, True, True, True]  # s_t is given
    assert reached(states.grad.transpose(0, 1)) == [i == 7 for i in range(50)]
    assert (states.grad[1:, 7, 0] > 0).all()
    assert reached(continues.grad) == [True, True, False]  # c of s_{t+n}: its mass stays there


def test_particle_entropy_takes_no_neighbour_from_its_own_future():
    """Each start stays where it is: its own future, at distance 0, would be without entropy."""
    states = torch.randn(1, 2000, 3).expand(9, 2000, 3)
    got = particle_entropy(states, torch.ones(8, 2000), GAMMA, k=1).mean()
    assert got.item() == pytest.approx(Normal(0, torch.ones(3)).entropy().sum().item(), abs=0.1)


def test_particle_entropy_refuses_as_few_starts_as_neighbours():
    with pytest.raises(AssertionError):
        particle_entropy(torch.randn(6, 3, 8), torch.ones(5, 3), GAMMA)


@pytest.mark.parametrize("dtype", [torch.float32, torch.bfloat16])
def test_particle_entropy_and_its_gradient_are_finite_where_all_states_are_equal(dtype):
    states = torch.ones(3, 6, 4, dtype=dtype, requires_grad=True)
    got = particle_entropy(states, torch.ones(2, 6), GAMMA).mean()
    got.backward()
    assert got < -20 and got.isfinite() and not states.grad.any()


# The target network


def test_soft_update_shrinks_the_difference_geometrically():
    online, target = nn.Linear(5, 7), nn.Linear(5, 7)
    learnt, before = online.weight.clone(), target.weight - online.weight
    for _ in range(5):
        soft_update(target, online, 0.1)
    torch.testing.assert_close(target.weight - online.weight, 0.9**5 * before)
    assert torch.equal(online.weight, learnt)
