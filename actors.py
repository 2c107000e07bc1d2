"""Actors, critics, exploration and acting: §2.2, §4.1, minor modifications 1, 2 and 4 of §4.2.

The stochastic actor maximises the λ-return plus β times the entropy of the states it will visit;
the deterministic actor, trained beside it, maximises the λ-return alone. `actor_loss` is the first
term of Eq. (7); `train.update_actor` adds the second, from mdn.py. Each actor has its own critic,
fitted on its own imagined sequences, since V and Q are of the *current policy*. What is imagined
comes from world_model.py, time first: H steps, N sequences, D state, A action.
"""

import contextlib
import math
from collections.abc import Callable, Iterator
from typing import NamedTuple

import numpy as np
import torch
import torch.nn.functional as F
from torch import Tensor, nn
from torch.distributions import Normal

from returns import lambda_return, survival
from world_model import Dream, mlp, regression_error


class StochasticActor(nn.Module):
    """π(a | s) = tanh(Normal(μ, σ)), as in Dreamer.

        μ = 5 tanh(x / 5),   σ = softplus(y + log(e⁵ − 1)) + 1e-4

    σ is near 5 at first: the untrained policy plays all actions, mostly the extreme ones.
    """

    def __init__(self, size: int, actions: int, units: int):
        super().__init__()
        self.net = mlp(size, units, 4, 2 * actions)  # 4 hidden layers, as Dreamer's

    def raw(self, state: Tensor) -> Tensor:
        """x, what the bounds act on: (…, D) -> (…, A)."""
        return self.net(state).chunk(2, -1)[0]

    def distribution(self, state: Tensor) -> Normal:
        """The distribution before the tanh, in float32: (…, D) -> Normal of (…, A)."""
        x, y = self.net(state).chunk(2, -1)
        std = F.softplus(y + math.log(math.exp(5) - 1)) + 1e-4
        return Normal(5 * torch.tanh(x / 5), std, validate_args=False)

    def forward(self, state: Tensor) -> Tensor:
        """A reparametrised sample of π(· | s), in [−1, 1]: (…, D) -> (…, A)."""
        return torch.tanh(self.distribution(state).rsample())

    def greedy(self, state: Tensor) -> Tensor:
        """The action that evaluation takes: tanh(μ), the median of π (Dreamer: the likeliest of 100
        samples): (…, D) -> (…, A)."""
        return torch.tanh(self.distribution(state).mean)


class DeterministicActor(nn.Module):
    """A(s) = tanh(5 tanh(x / 5)), trained beside the stochastic actor and evaluated in its place
    (§4.1)."""

    def __init__(self, size: int, actions: int, units: int):
        super().__init__()
        self.net = mlp(size, units, 4, actions)

    def raw(self, state: Tensor) -> Tensor:
        """x, what the bounds act on: (…, D) -> (…, A)."""
        return self.net(state)

    def forward(self, state: Tensor) -> Tensor:
        """The action, in [−1, 1]: (…, D) -> (…, A)."""
        return torch.tanh(5 * torch.tanh(self.raw(state) / 5))

    greedy = forward


class QCritic(nn.Module):
    """Q(s, a) of the current policy, Eq. (2); minor modification 1 of §4.2."""

    def __init__(self, size: int, actions: int, units: int, norm=False):
        super().__init__()
        self.net = mlp(size + actions, units, 3, 1, norm)  # 3 hidden layers, as Dreamer's

    def forward(self, state: Tensor, action: Tensor) -> Tensor:
        """(…, D), (…, A) -> (…). At a ~ π(s): a one-sample estimate of V(s) = E_a Q(s, a)."""
        return self.net(torch.cat([state, action], -1)).squeeze(-1)


class VCritic(nn.Module):
    """V(s) of the current policy, Eq. (1): the critic of the original Dreamer."""

    def __init__(self, size: int, units: int, norm=False):
        super().__init__()
        self.net = mlp(size, units, 3, 1, norm)

    def forward(self, state: Tensor, action: Tensor) -> Tensor:
        """(…, D), (…, A) -> (…). V ignores the action: either critic can stand in the loop."""
        return self.net(state).squeeze(-1)


def imagined_returns(dream: Dream, critic: nn.Module, gamma: float, lam: float) -> Tensor:
    """R_0 … R_{H−1} of a dream, (H, N), with V(s_k) = Q(s_k, a_k) at its own a_k ~ π(s_k)."""
    value = critic(dream.state[1:], dream.action[1:])
    return lambda_return(dream.reward, dream.continues, value, gamma, lam)


def actor_loss(returns: Tensor, continues: Tensor, first_state_only: bool) -> Tensor:
    """−R, what an actor minimises but for the entropy: a scalar.

    First state only (§4.2): −R_0, averaged over the N starting states. The later actions still
    receive gradient, through the imagined sequence that R_0 sums over. Otherwise, as in Dreamer's
    paper, the mean of S_k R_k over all imagined states, S their survival (its code: γ^k S_k R_k).
    """
    if first_state_only:
        return -returns[0].mean()
    return -(survival(continues) * returns).mean()


def critic_loss(critic: nn.Module, dream: Dream, returns: Tensor, smooth_l1: bool) -> Tensor:
    """Regression of the critic on R_0 … R_{H−1}, weighted by survival: a scalar. "First state only"
    (§4.2) is of the actors alone. Gradient flows into the critic alone.

    Smooth L1 with its knee at 1 (minor modification 2), or ½(Q − R)². Smooth L1 does not estimate a
    mean: of returns that are 0 nine times in ten and 10 once it makes 1/9, where the mean is 1.
    """
    value = critic(dream.state[:-1].detach(), dream.action[:-1].detach())
    error = regression_error(value, returns.detach(), smooth_l1)
    return (survival(dream.continues) * error).mean()


def add_noise(action: Tensor, std: float) -> Tensor:
    """An action plus reparametrised noise, clipped to [−1, 1]. An actor that learns with it earns
    despite small errors, and a deterministic actor's critic sees actions beside A(s), without which
    its slope ∂Q/∂a there is arbitrary."""
    return (action + std * torch.randn_like(action)).clamp(-1, 1)


def explore(
    action: np.ndarray, noise: float, random_probability: float, rng: np.random.Generator
) -> np.ndarray:
    """The action that the explorer takes (§4.2, minor modification 4): the given one with Gaussian
    noise, clipped to [−1, 1], or with a probability a uniform one."""
    if rng.random() < random_probability:
        return rng.uniform(-1, 1, action.shape).astype(np.float32)
    noisy = action + noise * rng.standard_normal(action.shape)
    return noisy.clip(-1, 1).astype(np.float32)


@torch.no_grad()
def act(
    agent, policy: Callable, image: np.ndarray, action: np.ndarray, state: Tensor | None
) -> tuple[np.ndarray, Tensor]:
    """One decision from pixels: infer the state from the image and what came before it, then act.

    Args:
        agent: has the world model, `model`, and the `device` where it is.
        policy: states (1, D) to actions (1, A).
        image: (64, 64, 3) uint8.
        action: (A,) float32, the last one; zeros before the first.
        state: (1, D), the last one; None at the first image that is looked at.

    Returns:
        the action (A,) and the state (1, D). A FloatingPointError if the action is not finite, lest
        the environment be blamed for it.
    """
    rows = image, action, state is None  # B = T = 1
    rows = [torch.tensor(x, device=agent.device)[None, None] for x in rows]
    # No autocast: to cast all weights costs more than bfloat16 saves on one image.
    state = agent.model.observe(*rows, previous=state).state[:, 0]
    action = policy(state)[0].cpu().numpy()
    if not np.isfinite(action).all():
        raise FloatingPointError("Not finite: the actor's action.")
    return action, state


class Episode(NamedTuple):
    """An episode of L decisions, played without learning from it."""

    images: np.ndarray  # (L + 1, 64, 64, 3) uint8 o_0 … o_L
    actions: np.ndarray  # (L, A) a_0 … a_{L−1}
    rewards: np.ndarray  # (L,) r_1 … r_L
    states: Tensor  # (L, D) s_0 … s_{L−1}
    terminated: bool  # False: cut off, by a time limit or after `most` steps
    total: float  # sum of rewards
    length: int  # environment steps


@contextlib.contextmanager
def drawn_by(seed: int, device: torch.device) -> Iterator[None]:
    """Within it torch draws what the seed says; after it, as if nothing had been drawn."""
    with torch.random.fork_rng([device] if device.type == "cuda" else []):
        torch.manual_seed(seed)
        yield


def play(agent, env, policy: Callable, seed: int, most: int) -> Episode:
    """One episode of a policy in what `make_env` made, ended after `most` environment steps if it
    does not end before. Training's random numbers stay as they were."""
    image, _ = env.reset(seed=seed)
    images, actions, states = [image], [np.zeros(env.action_space.shape, np.float32)], [None]
    rewards, over, length = [], False, 0
    with drawn_by(seed, agent.device):
        while not over and length < most:
            action, state = act(agent, policy, images[-1], actions[-1], states[-1])
            image, reward, terminated, truncated, _ = env.step(action)
            over, length = terminated or truncated, int(env.get_wrapper_attr("episode_lengths"))
            images.append(image), actions.append(action), states.append(state)
            rewards.append(reward)
    return Episode(
        np.array(images), np.array(actions[1:]), np.array(rewards), torch.cat(states[1:]),
        bool(terminated), float(sum(rewards)), length,
    )  # fmt: skip
