"""The world model: §2.2 with the modifications of §4.2; Eqs. (3) and (4).

Encoder, recurrent state-space model (RSSM), decoder, reward and termination heads.

It turns sequences of images into states s = (h, z) (`observe`), continues them without images under
a policy (`imagine`), and says how wrong it is, as named terms (`WorldModel.loss`). It knows no
actor, no setting and no optimiser. In a process group `loss` is of all processes' rows together:
each has to call it.

Time is arrival-indexed. Row t of an episode holds the observation o_t, the action a_{t−1} that led
to it, and the reward and termination received on arriving there; the first row has action 0 and
`is_first`.

    h_t = GRU(dense(z_{t−1}, a_{t−1}), h_{t−1}),   h_0 = 0
    z_t ~ p(z | h_t, o_t) learning and acting;   z_t ~ p(z | h_t) imagining
    r(s_t), d(s_t): reward and end of the episode "for achieving state s_t";   c = 1 − d

Tensor legend of the whole code: B sequences, T steps of a sequence, N starting states, H horizon, K
mixture components, D = deter + stoch, A action dimensions. Batch first in replay (B, T, …), time
first in imagination (H, N, …).
"""

from collections.abc import Callable
from itertools import accumulate, pairwise
from typing import NamedTuple

import torch
import torch.distributed as dist
import torch.nn.functional as F
from torch import Tensor, nn
from torch.distributions import Normal, kl_divergence

SLICE = 256  # images through the convolutions at once: what they leave then fits a CPU's cache


class Observed(NamedTuple):
    """What `observe` makes of B sequences."""

    state: Tensor  # (B, T, D) s = (h, z), z sampled from the posterior
    posterior: Normal  # of (B, T, stoch): p(z_t | h_t, o_t)
    prior: Normal  # of (B, T, stoch): p(z_t | h_t); h_t already holds z_{t−1} and a_{t−1}


class Dream(NamedTuple):
    """What `imagine` makes of N starting states s_0."""

    state: Tensor  # (H + 1, N, D) s_0 … s_H
    action: Tensor  # (H + 1, N, A) a_k = π(s_k); a_H is chosen for V(s_H) = Q(s_H, a_H), not taken
    reward: Tensor  # (H, N) r(s_1) … r(s_H)
    continues: Tensor  # (H, N) c = 1 − d in s_1 … s_H


def in_slices(function: Callable[..., Tensor], *inputs: Tensor) -> Tensor:
    """function(*inputs), computed on a CPU for `SLICE` rows of the inputs at a time."""
    rows = SLICE if inputs[0].is_cpu else len(inputs[0])
    parts = zip(*(x.split(rows) for x in inputs), strict=True)
    return torch.cat([function(*part) for part in parts])


class Encoder(nn.Module):
    """64×64 images to embeddings: four 4×4 convolutions of stride 2 with ReLU, of depth, 2·depth,
    4·depth and 8·depth channels."""

    def __init__(self, depth: int):
        super().__init__()
        channels = [3, depth, 2 * depth, 4 * depth, 8 * depth]
        convolutions = [nn.Conv2d(i, o, 4, stride=2) for i, o in pairwise(channels)]
        self.net = nn.Sequential(*[m for c in convolutions for m in (c, nn.ReLU())], nn.Flatten())
        self.net.to(memory_format=torch.channels_last)
        self.size = 8 * depth * 2 * 2

    def forward(self, image: Tensor) -> Tensor:
        """(M, 64, 64, 3) uint8 -> (M, 32 · depth)."""
        return in_slices(lambda part: self.net(centre(part).permute(0, 3, 1, 2)), image)


class TransposedConvolution(torch.autograd.Function):
    """A transposed convolution of stride 2, each direction in the form that a CPU is fast in.

    Forwards, output pixels of one parity in rows and columns are a plain convolution of half the
    kernel: all four at once, then interleaved. Backwards, its transpose is a plain convolution. The
    decoder's three take 78 ms for 250 images of depth 16 on one thread, in PyTorch's own form 149.
    """

    @staticmethod
    def forward(ctx, x: Tensor, weight: Tensor, bias: Tensor) -> Tensor:
        """(M, I, n, n), (I, O, k, k), (O,) -> (M, O, 2n + k − 2, 2n + k − 2)."""
        ctx.save_for_backward(x, weight)
        size, half = 2 * x.shape[-1] + weight.shape[-1] - 2, (weight.shape[-1] + 1) // 2
        odd = weight.shape[-1] % 2
        # Output pixel 2i + p meets the kernel's taps 2j + p alone, at inputs i − j: hence the flip.
        taps = F.pad(weight, (0, odd, 0, odd)).unflatten(3, (half, 2)).unflatten(2, (half, 2))
        taps = taps.flip(2, 4).permute(3, 5, 1, 0, 2, 4)  # (2, 2, O, I, k/2, k/2)
        taps = taps.flatten(0, 2).contiguous(memory_format=torch.channels_last)
        y = F.conv2d(x, taps, bias.repeat(4), padding=half - 1)
        y = y.permute(0, 2, 3, 1).unflatten(3, (2, 2, -1)).transpose(2, 3)  # (M, n', 2, n', 2, O)
        return y.flatten(3, 4).flatten(1, 2).permute(0, 3, 1, 2)[..., :size, :size]

    @staticmethod
    def backward(ctx, grad: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        x, weight = ctx.saved_tensors
        return (
            F.conv2d(grad, weight, stride=2),
            nn.grad.conv2d_weight(grad, weight.shape, x, stride=2),
            grad.sum((0, 2, 3)),
        )


class TransposedConv2d(nn.ConvTranspose2d):
    """`nn.ConvTranspose2d` of stride 2, on a CPU by the function above in its input's precision."""

    def __init__(self, inputs: int, outputs: int, kernel: int):
        super().__init__(inputs, outputs, kernel, stride=2)

    def forward(self, x: Tensor) -> Tensor:
        if not x.is_cpu:
            return super().forward(x)
        with torch.autocast(x.device.type, enabled=False):
            return TransposedConvolution.apply(x, self.weight.to(x.dtype), self.bias.to(x.dtype))


class Decoder(nn.Module):
    """States to images: a linear layer, then transposed convolutions of kernels 5, 5, 6, 6, stride
    2 and ReLU. The first acts on a 1×1 map, where it is a linear layer, and is written as one."""

    def __init__(self, inputs: int, depth: int):
        super().__init__()
        self.depth = depth
        self.linear = nn.Sequential(
            nn.Linear(inputs, 32 * depth), nn.Linear(32 * depth, 5 * 5 * 4 * depth), nn.ReLU()
        )
        self.net = nn.Sequential(
            TransposedConv2d(4 * depth, 2 * depth, 5),  # 5 -> 13
            nn.ReLU(),
            TransposedConv2d(2 * depth, depth, 6),  # 13 -> 30
            nn.ReLU(),
            TransposedConv2d(depth, 3, 6),  # 30 -> 64
        ).to(memory_format=torch.channels_last)

    def forward(self, x: Tensor) -> Tensor:
        """(M, inputs) -> (M, 64, 64, 3), in the range of `centre`."""
        maps = self.linear(x).unflatten(-1, (5, 5, 4 * self.depth)).permute(0, 3, 1, 2)
        return self.net(maps).permute(0, 2, 3, 1).float()

    def nll(self, x: Tensor, image: Tensor) -> Tensor:
        """½ Σ (o − o')² over pixels, which is −log Normal(o; o', 1) but for a constant:
        (M, inputs), (M, 64, 64, 3) uint8 -> (M,)."""

        def part(x: Tensor, image: Tensor) -> Tensor:
            return 0.5 * F.mse_loss(self(x), centre(image), reduction="none").flatten(1).sum(1)

        return in_slices(part, x, image)


def centre(image: Tensor) -> Tensor:
    """uint8 pixels to [−0.5, 0.5]."""
    assert image.dtype == torch.uint8, image.dtype  # floats would be changed in their own place
    return image.float().div_(255).sub_(0.5)


def normal(statistics: Tensor) -> Normal:
    """(…, 2·stoch) to a diagonal Gaussian of (…, stoch), float32, std softplus + 0.1 (Dreamer)."""
    mean, std = statistics.chunk(2, -1)
    return Normal(mean, F.softplus(std) + 0.1, validate_args=False)


class Float32Linear(nn.Linear):
    """A linear layer that autocast leaves alone: in bfloat16's 8 bits a value of 150.3 is 150."""

    def forward(self, x: Tensor) -> Tensor:
        with torch.autocast(x.device.type, enabled=False):
            return super().forward(x.float())


def mlp(inputs: int, units: int, layers: int, outputs: int, norm=False) -> nn.Sequential:
    """`layers` hidden ELU layers of `units`, then a linear one, as in Dreamer; with `norm` each
    after LayerNorm, so that no output grows with the size of its input."""
    sizes, hidden = [inputs] + [units] * layers, []
    for i, o in pairwise(sizes):
        hidden += [nn.Linear(i, o), *([nn.LayerNorm(o)] if norm else []), nn.ELU(inplace=True)]
    return nn.Sequential(*hidden, Float32Linear(sizes[-1], outputs))


def regression_error(predicted: Tensor, target: Tensor, smooth_l1: bool) -> Tensor:
    """Smooth L1 with its knee at 1 (§4.2, minor 2), or ½(x − y)²: (…), (…) -> (…)."""
    if smooth_l1:
        return F.smooth_l1_loss(predicted, target, reduction="none")
    return 0.5 * F.mse_loss(predicted, target, reduction="none")


class WorldModel(nn.Module):
    """The recurrent state-space model with its encoder, decoder and heads.

    Args:
        actions: A.
        deter, stoch: sizes of h and z.
        hidden: units of the RSSM's dense layers.
        units: units of the reward and termination heads.
        depth: channels of the first convolution.
        termination: learn when episodes end (§4.2); without it c = 1 everywhere.
        fixed_prior: KL to N(0, 1) and Jeffreys to the learnt prior (§4.2), instead of KL to the
            learnt prior.
        smooth_l1: Smooth L1 loss of the reward (§4.2, minor 2), instead of ½(r − r')².
        decode_stoch_only: the decoder sees z alone (§4.2, minor 3), instead of (h, z).
        decode_share: of a batch's images, those that are decoded, drawn at random (ours).
        burn_in: first rows of a sequence that begins within an episode, whose h does not hold what
            came before: they teach no reward and no end (ours; the idea is R2D2's).
        ends_ahead: steps of dreams along recorded actions in which ends are learnt too, since that
            is where actors use them; the gradient passes through the prior into all that came
            before (ours; 0: in what was seen alone).
        observe_first: z_0 is inferred from o_0, so a_0 depends on it (§4.2). Without it s_0 is
            zero and o_0 is never seen.
        free_nats: KL below which there is nothing to gain (Dreamer); with `fixed_prior` unused.

    The paper's values of these, and the weights of the terms of `loss`, are the defaults of
    `train.Settings`.
    """

    def __init__(
        self, actions: int, *, deter: int, stoch: int, hidden: int, units: int, depth: int,
        termination: bool, fixed_prior: bool, smooth_l1: bool, decode_stoch_only: bool,
        decode_share: float, burn_in: int, ends_ahead: int, observe_first: bool, free_nats: float,
    ):  # fmt: skip
        super().__init__()
        self.deter, self.stoch, self.size = deter, stoch, deter + stoch
        self.fixed_prior, self.smooth_l1, self.free_nats = fixed_prior, smooth_l1, free_nats
        self.decode_stoch_only, self.observe_first = decode_stoch_only, observe_first
        self.decode_share, self.burn_in, self.ends_ahead = decode_share, burn_in, ends_ahead
        self.encoder = Encoder(depth)
        # One dense layer on (z, a), in two parts: the action's needs no recurrence.
        self.dense_stoch = nn.Linear(stoch, hidden, bias=False)
        self.dense_action = nn.Linear(actions, hidden)
        self.gru = nn.GRUCell(hidden, deter)
        self.prior_net = mlp(deter, hidden, 1, 2 * stoch)
        # Likewise one dense layer on (h, embedding).
        self.posterior_deter = nn.Linear(deter, hidden, bias=False)
        self.posterior_embed = nn.Linear(self.encoder.size, hidden)
        self.posterior_out = nn.Linear(hidden, 2 * stoch)
        self.decoder = Decoder(stoch if decode_stoch_only else self.size, depth)
        self.reward = mlp(self.size, units, 2, 1)
        self.termination = mlp(self.size, units, 3, 1) if termination else None

    def recur(self, deter: Tensor, stoch: Tensor, action_share: Tensor) -> Tensor:
        """h_t = GRU(dense(z_{t−1}, a_{t−1}), h_{t−1}), given the action's share of the dense."""
        return self.gru(F.elu(self.dense_stoch(stoch) + action_share), deter)

    def observe(
        self, image: Tensor, action: Tensor, is_first: Tensor, previous: Tensor | None = None
    ) -> Observed:
        """States of B sequences, which may cross episodes: the state is reset where one starts.

        Args:
            image: (B, T, 64, 64, 3) uint8.
            action: (B, T, A), the action that led to each row.
            is_first: (B, T) bool.
            previous: (B, D), the state before the first row; zeros if None.
        """
        length = image.shape[1]
        embedding = self.encoder(image.flatten(0, 1)).unflatten(0, image.shape[:2])
        # (B, T, hidden) each: what needs no recurrence is computed for all steps at once
        embed_share = self.posterior_embed(embedding).float()
        action_share = self.dense_action(action).float()
        noise = torch.randn(*image.shape[:2], self.stoch, device=image.device)
        going_on = (~is_first).float().unsqueeze(-1)
        if previous is None:
            previous = torch.zeros(len(image), self.size, device=image.device)
        deter, stoch = previous.split([self.deter, self.stoch], -1)
        deters, stochs, statistics = [], [], []
        # In float32: for so few rows a product costs less than its casts. With its gradient,
        # `observe` takes 68 ms instead of 78 (small preset, one thread).
        with torch.autocast(image.device.type, enabled=False):
            for t in range(length):
                # h_0 = 0: nothing of the episode before passes, nor its z, which comes by h alone
                deter = going_on[:, t] * self.recur(deter, stoch, action_share[:, t])
                out = self.posterior_out(F.elu(self.posterior_deter(deter) + embed_share[:, t]))
                posterior = normal(out)
                stoch = posterior.mean + posterior.stddev * noise[:, t]
                if not self.observe_first:
                    stoch = going_on[:, t] * stoch
                deters.append(deter), stochs.append(stoch), statistics.append(out)
        deter = torch.stack(deters, 1)  # (B, T, deter)
        state = torch.cat([deter, torch.stack(stochs, 1)], -1)
        return Observed(state, normal(torch.stack(statistics, 1)), normal(self.prior_net(deter)))

    def settled(self, is_first: Tensor) -> Tensor:
        """Which rows (B, T) have a state that has seen enough to be learnt from, bool: those whose
        episode began in the sequence, and of others all but the first `burn_in`."""
        known = is_first.cumsum(1) > 0
        known[:, self.burn_in :] = True
        return known

    def step(self, state: Tensor, action: Tensor) -> Tensor:
        """s_{t+1} after s_t and a_t, by the prior: (N, D), (N, A) -> (N, D)."""
        deter, stoch = state.split([self.deter, self.stoch], -1)
        deter = self.recur(deter, stoch, self.dense_action(action))
        return torch.cat([deter, normal(self.prior_net(deter)).rsample()], -1)

    def along(self, start: Tensor, actions: Tensor) -> Tensor:
        """The states of a dream in which these actions are taken, whatever is met: (N, D),
        (H, N, A) -> (H + 1, N, D) s_0 … s_H."""
        return torch.stack([*accumulate(actions, self.step, initial=start)])

    def imagine(self, start: Tensor, policy: Callable[[Tensor], Tensor], horizon: int) -> Dream:
        """H steps from N states through the prior, differentiable in the policy's actions.

        Args:
            start: (N, D).
            policy: states (N, D) to actions (N, A).
            horizon: H.
        """
        states, actions = [start], [policy(start)]
        for _ in range(horizon):
            states.append(self.step(states[-1], actions[-1]))
            actions.append(policy(states[-1]))
        state = torch.stack(states)
        reward, continues = self.predict_reward(state[1:]), self.predict_continues(state[1:])
        return Dream(state, torch.stack(actions), reward, continues)

    def predict_reward(self, state: Tensor) -> Tensor:
        """r(s): (…, D) -> (…), the reward for achieving the state."""
        return self.reward(state).squeeze(-1)

    def predict_continues(self, state: Tensor) -> Tensor:
        """c(s) = 1 − d(s), the probability that the episode goes on: (…, D) -> (…)."""
        if self.termination is None:
            return torch.ones(state.shape[:-1], device=state.device)
        return torch.sigmoid(-self.termination(state)).squeeze(-1)

    def decoder_input(self, state: Tensor) -> Tensor:
        """What the decoder sees of a state: z alone (§4.2, minor 3), or (h, z)."""
        return state[..., self.deter :] if self.decode_stoch_only else state

    def loss(self, batch: dict[str, Tensor]) -> tuple[dict[str, Tensor], Tensor]:
        """The loss as named terms, unweighted, means over batch and time: Eqs. (3), (4) and §4.2.

            image        ½ Σ (o − o')² over pixels; of `decode_share` of the images
            reward       Smooth L1, or ½ (r − r')²; of settled rows; first ones have none
            termination  binary cross-entropy on `terminated`, never on `truncated`; likewise;
                         with `ends_ahead`, plus its mean in dreams along the recorded actions
            kl_standard  KL(posterior ‖ N(0, 1)), which gives the prior no gradient (§4.2)
            jeffreys     KL(posterior ‖ prior) + KL(prior ‖ posterior) (§4.2)
            kl           max(mean KL(posterior ‖ prior), free nats): Dreamer's, in their place

        Departures from print: (4) has the squared errors with the sign of (3)'s log-likelihoods, by
        which they would be maximised; the prior of step t + 1 in (3) lacks the action, which
        h_{t+1} holds.

        Args:
            batch: image (B, T, 64, 64, 3) uint8; action (B, T, A) and reward (B, T) float32;
                is_first and terminated (B, T) bool.

        Returns:
            the terms, and the posterior states (B, T, D), which hold their gradient.
        """
        observed = self.observe(batch["image"], batch["action"], batch["is_first"])
        arrived = (~batch["is_first"]).float()
        seen = torch.ones_like(arrived) if self.observe_first else arrived
        taught = arrived * self.settled(batch["is_first"])
        some = share_of(seen.numel(), self.decode_share, seen.device)
        shown = self.decoder_input(observed.state).flatten(0, 1)[some]
        image = self.decoder.nll(shown, batch["image"].flatten(0, 1)[some])
        terms = {"image": masked_mean(image, seen.flatten()[some])}
        reward = self.predict_reward(observed.state)
        error = regression_error(reward, batch["reward"], self.smooth_l1)
        terms["reward"] = masked_mean(error, taught)
        if self.termination is not None:
            terms["termination"] = self.end_loss(observed.state, batch["terminated"], taught)
            if self.ends_ahead:
                ahead = self.end_loss_ahead(observed.state, batch)
                terms["termination"] = terms["termination"] + ahead
        return terms | self.divergences(observed.posterior, observed.prior, seen), observed.state

    def end_loss(self, state: Tensor, terminated: Tensor, taught: Tensor) -> Tensor:
        """The term termination of `loss` in states (…, D), of rows where `taught` (…) is 1."""
        logit = self.termination(state).squeeze(-1)
        loss = F.binary_cross_entropy_with_logits(logit, terminated.float(), reduction="none")
        return masked_mean(loss, taught)

    def end_loss_ahead(self, state: Tensor, batch: dict[str, Tensor]) -> Tensor:
        """The term termination of `loss` in dreams along the recorded actions.

        They take `ends_ahead` steps each, fewer in a shorter sequence, one after the other, up to
        the last row. One from an unsettled state teaches nothing, nor does any beyond its episode.
        Gradients pass into the states (B, T, D) that they start from. Where rewards were learnt
        there too, HalfCheetah learnt later (one seed; results/trials.md, section N).
        """
        length = state.shape[1]
        steps = min(self.ends_ahead, length - 1)
        skipped = (length - 1) % steps  # rows before the first dream, as the last ends at the last
        starts = slice(skipped, -1, steps)

        def recorded(name: str) -> Tensor:
            """(B, T, …) -> (steps, N, …): what came, in all N dreams."""
            rows = batch[name][:, skipped + 1 :]
            return rows.unflatten(1, (-1, steps)).flatten(0, 1).transpose(0, 1)

        dreamt = self.along(state[:, starts].flatten(0, 1), recorded("action"))[1:]
        taught = self.settled(batch["is_first"])[:, starts].flatten()
        taught = taught * (~recorded("is_first")).cumprod(0)
        return self.end_loss(dreamt, recorded("terminated"), taught)

    def divergences(self, posterior: Normal, prior: Normal, seen: Tensor) -> dict[str, Tensor]:
        """The terms of `loss` that hold the posterior to the prior, in nats, summed over z."""
        to_prior = kl_divergence(posterior, prior).sum(-1)
        if not self.fixed_prior:
            return {"kl": masked_mean(to_prior, seen).clamp(min=self.free_nats)}
        zeros = torch.zeros_like(posterior.mean)
        standard = Normal(zeros, zeros + 1, validate_args=False)  # to check waits for the device
        jeffreys = to_prior + kl_divergence(prior, posterior).sum(-1)
        to_standard = kl_divergence(posterior, standard).sum(-1)
        return {
            "kl_standard": masked_mean(to_standard, seen),
            "jeffreys": masked_mean(jeffreys, seen),
        }


def share_of(count: int, share: float, device: torch.device) -> Tensor | slice:
    """Which of so many to take: a share of them, one at least, drawn at random; or all."""
    if share == 1:
        return slice(None)
    return torch.randperm(count, device=device)[: max(1, round(share * count))]


def masked_mean(x: Tensor, mask: Tensor) -> Tensor:
    """Mean of x where mask is 1, in the whole batch; 0 where it is nowhere."""
    both = torch.stack([(x * mask).sum(), mask.sum()])
    if dist.is_initialized():
        # Both sums' values averaged over the processes that share the batch; of the gradient each
        # has its own rows' part, and `Agent.optimise` averages those.
        total = both.detach().clone()
        dist.all_reduce(total)
        both = both + (total / dist.get_world_size() - both.detach())
    return both[0] / both[1].clamp(min=1e-6)  # not 1: averaged, a count may be ½
