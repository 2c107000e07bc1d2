"""The discounted distribution of future states and its entropy: §3, §4.1, Eqs. (6) to (10).

q(x | s_t) is the discounted occupancy of the states that the policy visits strictly after s_t. A
mixture density network P(x | s_t) learns it from imagined states (`mdn_loss`), bootstrapping from
itself at the last one, and the stochastic actor maximises the entropy of P (`entropy`), estimated
the same way; `particle_entropy` needs no network. This file sees tensors of states s = (h, z); it
knows neither the world model nor the actors. γ here is γ_q, the discount of q, not that of returns.

Departures from print, all but (8)'s shown in tests/test_mdn.py: with termination the printed
weights do not sum to one; (8) and (9) are off by one step; (10) counts s_t itself, an atom of
unbounded likelihood in a continuous space, and misses step n. And "importance sampling" is
bootstrapping, with the ratio q / P taken to be one.
"""

import math
from itertools import accumulate
from typing import NamedTuple

import torch
import torch.nn.functional as F
from torch import Tensor, nn


class Mixture(NamedTuple):
    """A mixture of K diagonal Gaussians over states, for each of N given states; float32.

    Its states are about 0 and of about unit size, as h and z are; scale others, lest the floor
    under σ and rounding in `log_prob` count. Another density needs the same two methods and
    `log_weights`: one that is no mixture has K = 1. The network that makes it, states (N, D) to a
    density, takes the place of `MixtureDensityNetwork` in `train.Agent`.
    """

    log_weights: Tensor  # (N, K) log π, normalised
    mean: Tensor  # (N, K, D)
    std: Tensor  # (N, K, D)

    def log_prob(self, x: Tensor) -> Tensor:
        """log P(x | s), of shape (M, N), for M points x of shape (M, N, D) per conditioning state.

        Σ_d (x_d − μ_d)² / σ_d² is expanded into two batched matrix products, x² · σ⁻² and x · μσ⁻²:
        the broadcast (x − μ)² would hold M·N·K·D numbers.
        """
        assert x.shape[1:] == (self.mean.shape[0], self.mean.shape[2]), (x.shape, self.mean.shape)
        with torch.autocast(x.device.type, enabled=False):
            x = x.float().transpose(0, 1)  # (N, M, D)
            precision = self.std.pow(-2)
            quadratic = x.square() @ precision.mT - x @ (2 * self.mean * precision).mT  # (N, M, K)
            constant = self.mean.square() * precision + 2 * self.std.log() + math.log(2 * math.pi)
            component = -0.5 * (quadratic + constant.sum(-1).unsqueeze(1))
            return torch.logsumexp(self.log_weights.unsqueeze(1) + component, -1).T

    def sample_components(self) -> Tensor:
        """One reparametrised sample of each component: (K, N, D)."""
        return (self.mean + self.std * torch.randn_like(self.std)).transpose(0, 1)


class MixtureDensityNetwork(nn.Module):
    """P(· | s): the mixture density network of §4.1, 8 components, hidden layers of 256 (§5; that
    there are two is ours).

    Args:
        size: D, numbers in a state.
        components: K.
        units: width of the hidden layers.
        min_std: floor under σ. h is a deterministic function of what came before it, so the true
            density is singular and its likelihood unbounded: without a floor −log P has no minimum.
    """

    def __init__(self, size: int, components: int = 8, units: int = 256, min_std: float = 0.1):
        super().__init__()
        self.size, self.components, self.min_std = size, components, min_std
        self.hidden = nn.Sequential(
            nn.Linear(size, units),
            nn.ELU(inplace=True),
            nn.Linear(units, units),
            nn.ELU(inplace=True),
        )
        self.head = nn.Linear(units, components * (1 + 2 * size))

    def forward(self, state: Tensor) -> Mixture:
        """The mixture given each state: (N, D) -> Mixture."""
        hidden = self.hidden(state)
        with torch.autocast(state.device.type, enabled=False):  # π, μ and σ in float32
            out = self.head(hidden.float()).unflatten(-1, (self.components, -1))
        log_weights, mean, std = out.split([1, self.size, self.size], -1)
        return Mixture(log_weights.flatten(1).log_softmax(-1), mean, F.softplus(std) + self.min_std)


def discounted_weights(continues: Tensor, gamma: float) -> tuple[Tensor, Tensor]:
    """Weights of the n imagined states and of the bootstrap in q(· | s_t): Eqs. (8) to (10).

        m_0 = 1,  m_k = Π_{1≤j≤k} γ c_{t+j};   w_k = m_{k−1} − m_k,  w_b = m_n;   Σ_k w_k + w_b = 1

    Without termination w_k = (1 − γ) γ^{k−1} and w_b = γ^n; where the episode ends, the unspent
    mass stays.

    Args:
        continues: (n, N) c of s_{t+1} … s_{t+n}.
        gamma: γ_q.

    Returns:
        w of shape (n, N) and w_b of shape (N,).
    """
    # Step by step: the gradient of `cumprod` would wait for a GPU to see whether there are zeros.
    one = torch.ones_like(continues[0])
    mass = torch.stack([*accumulate(gamma * continues, torch.mul, initial=one)])
    return mass[:-1] - mass[1:], mass[-1]


def cross_entropy(
    density: Mixture, following: Tensor, continues: Tensor, tail: Mixture, gamma: float
) -> Tensor:
    """−E_{x ~ q(· | s_t)} log P(x | s_t): Eq. (10) with L = −log P, one value for each s_t.

        −Σ_k w_k log P(s_{t+k} | s_t) − w_b E_{s̃ ~ P(· | s_{t+n})} log P(s̃ | s_t)

    s̃ is not one draw: its K components are enumerated, each sampled once and weighted by its π, so
    the estimate is unbiased in π's gradient too (drawing a component would lose it).

    Args:
        density: P(· | s_t).
        following: (n, N, D) s_{t+1} … s_{t+n}.
        continues: (n, N) c in those states.
        tail: P(· | s_{t+n}), from which the bootstrap s̃ is drawn.
        gamma: γ_q.

    Returns:
        (N,) in nats.
    """
    weights, tail_weight = discounted_weights(continues, gamma)
    points = torch.cat([following, tail.sample_components()])  # (n + K, N, D)
    weights = torch.cat([weights, tail_weight * tail.log_weights.exp().T])  # their sum is one
    return -(weights * density.log_prob(points)).sum(0)


def mdn_loss(mdn: MixtureDensityNetwork, states: Tensor, continues: Tensor, gamma: float) -> Tensor:
    """Negative log-likelihood that the MDN minimises, Eq. (10): (N,) nats.

    Gradient flows into the online MDN alone.

    Args:
        mdn: the online network.
        states: (n + 1, N, D) s_t … s_{t+n}, of the policy whose future is to be learnt.
        continues: (n, N) c in s_{t+1} … s_{t+n}.
        gamma: γ_q.
    """
    states, continues = states.detach(), continues.detach()  # the data, whatever made them
    density = mdn(states[0])  # first: older autocasts keep casts that were made without gradient
    with torch.no_grad():
        tail = mdn(states[-1])
    return cross_entropy(density, states[1:], continues, tail, gamma)


def entropy(
    target: MixtureDensityNetwork, states: Tensor, continues: Tensor, gamma: float
) -> Tensor:
    """Ĥ of the discounted state distribution, the second term of the objective (7): (N,) nats.

    It is −E_q log P_T = H(q) + KL(q ‖ P_T). Where P_T is q, KL has its minimum and no gradient, and
    what is left is that of H(q) in what the policy does up to s_{t+n}. What it does later is frozen
    in P_T: of a Gaussian chain's gradient 1 − γⁿ is left (tests/test_mdn.py).

    Gradient flows to the policy through the imagined states, their c and s̃ ~ P_T(· | s_{t+n}). It
    could not flow through samples of P_T(· | s_t): those do not depend on what the policy does
    after s_t.

    Args:
        target: P_T, the target network, whose parameters do not require gradient.
        states, continues, gamma: as in `mdn_loss`, not detached.
    """
    density = target(states[0].detach())  # s_t is given, not chosen
    return cross_entropy(density, states[1:], continues, target(states[-1]), gamma)


def particle_entropy(states: Tensor, continues: Tensor, gamma: float, k: int = 3) -> Tensor:
    """Ĥ by distances to neighbours, instead of `entropy` (ours; the paper's conclusion asks
    for other models than a network of mixtures): (N,) nats.

    Kozachenko and Leonenko's estimate from the distance ε_i of s_{t+i} to its k-th neighbour among
    one state drawn from the q of each *other* start, V the volume of the unit ball of d dimensions:

        Σ_i w_i [ψ(N) − ψ(k) + log V + d log ε_i]

    w_b, which has no P to be spent on, goes to s_{t+n}. This is not the entropy of q(· | s_t), as
    in (7), but its cross-entropy to the mean of the other starts' q: be where the others are not.
    One draw a start gives plain samples of that mean, and a fifteenth of the distances (6 ms with
    the backward pass, at n = 15, N = 250, d = 64, on one thread). Neighbours are found by matrix
    products, which know distances to some thousandth of the states' size.

    Args:
        states: (n + 1, N, d) s_t … s_{t+n}, N above k, of the part that distances are taken in: z,
            which KL holds to N(0, 1), while h has no scale. Gradient flows through s_{t+i} to
            where a neighbour is not, never through the neighbour.
        continues, gamma: as in `entropy`.
        k: neighbours (ours: those of env.coverage).
    """
    following, (weights, tail) = states[1:].float(), discounted_weights(continues.float(), gamma)
    weights = torch.cat([weights[:-1], weights[-1:] + tail])
    starts, size = following.shape[1:]
    assert starts > k, (starts, k)  # else a state's own draw would be its neighbour
    with torch.no_grad():
        # (N,) which of each start's futures, by the inverse of its w's cumulative sum, which ends
        # at one but for rounding (`multinomial` would wait for a GPU, and raise at a nan)
        drawn = (weights.cumsum(0) < torch.rand(starts, device=weights.device)).sum(0)
        drawn = drawn.clamp(max=len(weights) - 1)
        others = following[drawn, torch.arange(starts, device=drawn.device)]  # (N, d)
        distance = torch.cdist(following.flatten(0, 1), others).unflatten(0, (-1, starts))
        distance.diagonal(dim1=1, dim2=2).fill_(math.inf)  # (n, N, N): its own is no neighbour
        nearest = distance.topk(k, largest=False).indices[..., -1]
    squared = (following - others[nearest]).square().sum(-1)
    log_ball = size / 2 * math.log(math.pi) - math.lgamma(size / 2 + 1)
    psi_n, psi_k = torch.digamma(torch.tensor([starts, k], dtype=torch.float64)).tolist()
    log_distance = (squared + 1e-6).log() / 2  # a thousandth, squared: equal states have no density
    return (weights * (psi_n - psi_k + log_ball + size * log_distance)).sum(0)


@torch.no_grad()
def soft_update(target: nn.Module, online: nn.Module, rate: float) -> None:
    """θ_T ← (1 − λ) θ_T + λ θ, §4.1 (λ there is this rate, 0.1 in §5; it is not the λ of Eq. 5), of
    parameters; buffers, which none here has, stay."""
    for old, new in zip(target.parameters(), online.parameters(), strict=True):
        old.lerp_(new, rate)
