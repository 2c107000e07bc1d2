"""Returns of an imagined sequence: the λ-return with termination (Eq. 5) and survival.

Pure functions of tensors, time first. Everything is arrival-indexed, as the whole code is: row k of
`reward` and of `continues` belongs to the state s_{t+k+1} that the k-th imagined action led to.
"""

import torch
from torch import Tensor


def lambda_return(
    reward: Tensor, continues: Tensor, value: Tensor, gamma: float, lam: float
) -> Tensor:
    """λ-return of every imagined state but the last, Eq. (5) with termination.

        R_H = V(s_H);   R_k = r(s_{k+1}) + γ c_{k+1} [ (1 − λ) V(s_{k+1}) + λ R_{k+1} ]

    Args:
        reward, continues, value: (H, N) r, c = 1 − d and V of s_1 … s_H: the reward for arriving,
            the probability that the episode goes on, the value.
        gamma: discount γ of one decision.
        lam: λ; 0 gives the one-step target, 1 the discounted rewards with V(s_H) at their end.

    Returns:
        (H, N) R_0 … R_{H−1}.

    Departure from print: the weights of the unnumbered definition above Eq. (5) sum to
    1 + λ^T (1 − λ). Eq. (5) is right; this is Eq. (5) as a recursion, with c instead of 1. Its T is
    H here, its G_T^λ is R_0, its r_t is r(s_{t+1}).
    """
    shapes = {x.shape for x in (reward, continues, value)}
    assert len(shapes) == 1, shapes
    one_step = reward + gamma * continues * (1 - lam) * value
    carry = gamma * lam * continues
    returns, following = [], value[-1]
    for k in reversed(range(len(reward))):
        following = one_step[k] + carry[k] * following
        returns.append(following)
    return torch.stack(returns[::-1])


def survival(continues: Tensor) -> Tensor:
    """Probability S_k that a dream gets to s_k and goes on from it, so that a_k is taken, without
    gradient.

    Losses there are weighted by it, which follows from §4.2's termination model. Dreamer's code
    weights by Π γ c where it learns ends, by Π γ where not.

        S_0 = 1;   S_k = c_1 c_2 … c_k

    (H, N) c in s_1 … s_H -> (H, N) S_0 … S_{H−1}, the weights of the states that were acted in.
    """
    continues = continues.detach()  # a policy must not earn by making its own states count less
    return torch.cat([torch.ones_like(continues[:1]), continues[:-1].cumprod(0)])
