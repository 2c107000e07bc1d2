"""Trains MaxEnt Dreamer: settings, one update, the one explicit loop, and what a run needs.

    python train.py --env HopperBulletEnv-v0

`update` is the paper's algorithm and `train` its loop; what they call follows in the order in which
they call it. The paper ends with `Agent`; from `join_processes` on come processes, devices,
folders, checkpoints and the command line. No other of the six files reads settings, holds an
optimiser or knows a run's folder.
"""

import atexit
import contextlib
import copy
import csv
import ctypes
import dataclasses
import functools
import io
import json
import math
import os
import re
import shlex
import shutil
import signal
import socket
import subprocess
import sys
import threading
import time
import timeit
import zipfile
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, Literal

import filelock
import numpy as np
import torch
import torch.distributed as dist
import tyro
from annotated_types import Interval
from pydantic import TypeAdapter, ValidationError
from scipy.special import stdtrit
from torch import Tensor, nn
from torch.utils.tensorboard import SummaryWriter
from tqdm import tqdm

import actors
from actors import act, actor_loss, add_noise, critic_loss, explore, imagined_returns, play
from env import EnvironmentFault, Replay, coverage, make_env
from mdn import MixtureDensityNetwork, entropy, mdn_loss, particle_entropy, soft_update
from world_model import Dream, WorldModel, share_of

Arm = Literal["dreamer", "dreamer-maxent", "revised", "maxent"]
Preset = Literal["small", "paper"]
Collect = Literal["explorer", "both"]
Size = Annotated[int, Interval(ge=1, le=10_000)]  # of a layer or batch; other small numbers
Count = Annotated[int, Interval(ge=1, le=10**9)]  # of steps or rows
Whole = Annotated[int, Interval(ge=0, lt=2**63)]
Share = Annotated[float, Interval(ge=0, le=1)]
Rate = Annotated[Share, Interval(gt=0)]  # of a moving average: at 0 it would never move
Amount = Annotated[float, Interval(ge=0, lt=float("inf"))]


# fmt: off
@dataclass(frozen=True)
class Settings:
    """All that a run depends on. §: in the paper; Dreamer: its authors' code; ours: in neither."""

    env: str = "HopperBulletEnv-v0"  # Gymnasium id; bounded Box actions, rgb_array rendering
    arm: Arm = "maxent"  # curve of the paper's figure: sets the switches below
    preset: Preset = "small"  # sizes and cadence: for two CPU cores, or the paper's
    seed: Whole = 0  # of weights, environment, sampling; on one machine, equal seeds, equal metrics

    steps: Count = 100_000  # environment steps of the run, prefill included (ours)
    prefill: Whole = 5000  # environment steps of random actions before training (Dreamer: 5000)
    train_every: Count = 1000  # environment steps between two rounds of updates (Dreamer: 1000)
    updates: Size = 100  # gradient updates per round (Dreamer: 100)
    eval_every: Count = 5_000  # environment steps between evaluations, once training began (ours)
    eval_episodes: Size = 10  # episodes per evaluation (§5: 10)
    eval_max_steps: Count = 10_000  # environment steps after which one of them is ended (ours)
    checkpoint_minutes: Amount = 5.0  # between checkpoints; evaluations make one too (ours)
    replay_capacity: Count = 500_000  # rows (decisions) of experience kept (ours)
    action_repeat: Size = 2  # environment steps per decision (Dreamer)
    camera_distance: Amount = 1.7  # metres to a PyBullet robot; its own, 3, suits pendulums (ours)
    floor_brightness: Share = 1.0  # factor on a PyBullet floor's texture; 1 is its own (ours)

    termination: bool = True  # §4.2: learn when episodes end, and let returns end there
    observe_first: bool = True  # §4.2: see o_0 before choosing a_0 (Dreamer's code does too)
    fixed_prior: bool = True  # §4.2: KL to N(0, 1) and Jeffreys to the prior, not Dreamer's `kl`
    q_critic: bool = True  # §4.2 minor 1: the critic is Q(s, a), not V(s)
    smooth_l1: bool = True  # §4.2 minor 2: Smooth L1, not squared error, of critic and reward
    squared_reward: bool = False  # ½(r − r')² of the reward even with smooth_l1: a mean (ours)
    decode_stoch_only: bool = True  # §4.2 minor 3: the decoder sees z, not (h, z)
    first_state_only: bool = True  # §4.2: actors maximise the first imagined state's return alone
    entropy: bool = True  # §4.1: the stochastic actor also maximises β × entropy of future states
    deterministic_actor: bool = True  # §4.1: train a deterministic actor too, and evaluate it
    action_noise: Amount = 0.0  # std of noise on actions the explorer collects (Dreamer: 0.3)
    random_action: Share = 0.1  # §4.2 minor 4: how often the explorer acts at random (value ours)
    collect: Collect = "explorer"  # who collects; both: the evaluated actor too, as much (ours)

    deter: Size = 200  # size of h (Dreamer: 200)
    stoch: Size = 128  # size of z (§5: 128; Dreamer: 30)
    hidden: Size = 200  # units of the RSSM's dense layers (Dreamer: 200)
    units: Size = 400  # of reward, termination, actor and critic layers (Dreamer: 400)
    depth: Size = 32  # channels of the first convolution (Dreamer: 32)
    batch_size: Size = 50  # sequences per batch (Dreamer: 50)
    length: Annotated[Size, Interval(ge=2)] = 50  # rows per sequence (Dreamer: 50)
    burn_in: Whole = 0  # first rows of a window cut mid-episode: no reward, end or dream (ours)
    ends_ahead: Whole = 0  # steps of dreams in which ends are learnt too (ours)
    decode_share: Share = 1.0  # of a batch's images, those that are decoded (Dreamer: all)
    horizon: Size = 15  # imagined steps, and n of Eq. (10) (Dreamer)
    starts: Share = 1.0  # of a batch's live states, those that actors dream on from (Dreamer: all)

    gamma: Share = 0.99  # γ of λ-returns, per decision (Dreamer)
    lam: Share = 0.95  # λ of λ-returns (Dreamer)
    gamma_q: Share = 0.9  # γ of the discounted state distribution (§5)
    beta_start: Amount = 0.2  # entropy coefficient β at the first environment step (§5)
    beta_end: Amount = 0.0001  # and at the last, linear between (§5)
    density: Literal["mdn", "knn"] = "mdn"  # entropy by §4.1's MDN, or by neighbours (ours)
    mdn_components: Size = 8  # components of the mixture density network (§5: heads)
    mdn_units: Size = 256  # its hidden units (§5: 256)
    mdn_min_std: Amount = 0.1  # floor under its σ (ours)
    target_rate: Rate = 0.1  # soft update of the target MDN (§5)
    dream_noise: Amount = 0.0  # std of noise on imagined actions (ours)
    detach_policy: bool = True  # no gradient through what the policy sees in its dream (Dreamer)
    action_penalty: Amount = 0.0  # × Σ x², x an action before its bounds, lest it saturate (ours)
    model_lr: Amount = 6e-4  # Adam's learning rate of the world model (Dreamer)
    actor_lr: Amount = 8e-5  # of each actor (Dreamer)
    critic_lr: Amount = 8e-5  # of each critic (Dreamer)
    critic_norm: bool = False  # LayerNorm in critics, whose values else may run away (ours)
    mdn_lr: Amount = 2e-4  # of the mixture density network (§5)
    play_rate: Rate = 1.0  # of the moving average of an actor, which plays; 1: itself (ours)
    grad_clip: Annotated[Amount, Interval(gt=0)] = 100.0  # largest norm of a gradient (Dreamer)
    free_nats: Amount = 3.0  # a batch's mean KL counts as this at least; of `kl` only (Dreamer)
    image_weight: Amount = 1.0  # weight of the image's loss (Dreamer)
    reward_weight: Amount = 1.0  # of the reward's loss (Dreamer)
    termination_weight: Amount = 10.0  # of the termination's loss (Dreamer)
    kl_weight: Amount = 1.0  # β of (3): of `kl`, the original Dreamer's divergence (Dreamer)
    kl_standard_weight: Amount = 0.1  # of KL(posterior || N(0, 1)) (§5)
    jeffreys_weight: Amount = 0.1  # of D_J(posterior || prior) (§5)

    def to_json(self) -> str:
        """As a text, for settings.json."""
        return json.dumps(dataclasses.asdict(self), indent=2) + "\n"


ORIGINAL = dict(
    termination=False, fixed_prior=False, q_critic=False, smooth_l1=False,
    decode_stoch_only=False, first_state_only=False, stoch=30, random_action=0.0,
)
ARMS = {  # what each curve of the paper's figure changes in a preset, whose own are `maxent`'s
    "dreamer": ORIGINAL | dict(entropy=False, deterministic_actor=False, action_noise=0.3),
    "dreamer-maxent": ORIGINAL,
    "revised": dict(entropy=False, deterministic_actor=False, action_noise=0.3),
    "maxent": {},
}
PRESETS = {
    "small": dict(  # sizes and cadence for two CPU cores, and what results/trials.md found to help
        deter=128, stoch=64, hidden=128, units=128, depth=16, batch_size=20, length=25,
        mdn_units=128, prefill=2000, train_every=10, updates=1, starts=0.25, floor_brightness=0.4,
        reward_weight=20.0, squared_reward=True, smooth_l1=False, ends_ahead=5, burn_in=2,
        action_penalty=0.01, critic_lr=5e-4, critic_norm=True, actor_lr=2e-4, horizon=5,
        play_rate=0.01, decode_share=0.25, dream_noise=0.3, collect="both", action_noise=0.3,
        random_action=0.01,
    ),
    "paper": dict(steps=1_000_000),
}
# fmt: on


def default_settings(arm: Arm = "maxent", preset: Preset = "small") -> Settings:
    """The settings of one arm at one size, before any switch of the user's."""
    return Settings(arm=arm, preset=preset, **(PRESETS[preset] | ARMS[arm]))


def update(
    agent: "Agent", batch: dict[str, Tensor], beta: float, look: bool = False
) -> dict[str, float]:
    """One gradient update of the world model, then of each actor with its critic, and of the MDN.

    Args:
        batch: as `WorldModel.loss` takes it.
        beta: entropy coefficient β of Eq. (7).
        look: also `measure_gradients`, which takes two backward passes more.

    Returns:
        named metrics; the world model's are the unweighted terms of its loss. A FloatingPointError
        names those that are not finite; from the first such gradient on, nothing was changed.
    """
    s = agent.s
    # First, while a GPU is idle: `nonzero` waits for all that it has under way.
    live = live_rows(agent, batch)
    weights = {
        "image": s.image_weight, "reward": s.reward_weight, "termination": s.termination_weight,
        "kl": s.kl_weight, "kl_standard": s.kl_standard_weight, "jeffreys": s.jeffreys_weight,
    }  # fmt: skip
    with agent.autocast():
        terms, states = agent.model.loss(batch)
        loss = sum(weights[name] * term for name, term in terms.items())
    metrics = {f"model/{name}": term for name, term in terms.items()}
    metrics["reward_r2"] = reward_r2(agent, states, batch)
    agent.optimise("model", loss, metrics)
    starts = dream_starts(states, live, s.starts)
    for name in agent.actors:
        update_actor(agent, name, starts, beta, metrics, look)
    numbers = as_numbers(metrics)
    agent.follow()
    return numbers


def live_rows(agent: "Agent", batch: dict[str, Tensor]) -> Tensor:
    """Numbers (L,), of a batch's B · T rows, of those that dreams may start from: settled ones that
    are no ends."""
    live = agent.model.settled(batch["is_first"]) & ~batch["terminated"]
    return live.flatten().nonzero().squeeze(1)


@torch.no_grad()
def reward_r2(agent: "Agent", states: Tensor, batch: dict[str, Tensor]) -> Tensor:
    """The share of the variance of a batch's rewards that its states (B, T, D) predict; 0 where
    they hardly vary."""
    first, reward = batch["is_first"], batch["reward"]
    weight = (agent.model.settled(first) & ~first).float()
    weight /= weight.sum().clamp(min=1)
    error = (weight * (agent.model.predict_reward(states) - reward).square()).sum()
    variance = (weight * (reward - (weight * reward).sum()).square()).sum()
    return torch.where(variance > 1e-6, 1 - error / variance, 0.0)


def dream_starts(states: Tensor, live: Tensor, share: float) -> Tensor:
    """(N, D): a share of a batch's states (B, T, D) in its rows `live` (L,)."""
    starts = states.flatten(0, 1)[live].detach()
    return starts[share_of(len(starts), share, starts.device)]


def update_actor(
    agent: "Agent", name: str, starts: Tensor, beta: float, metrics: dict[str, Tensor], look: bool
) -> None:
    """An actor dreams on from starts (N, D), learns from its dream, and so do its critic and the
    MDN: Eq. (7) for the stochastic actor, its first term alone for the deterministic one."""
    s, actor, critic = agent.s, agent.actors[name], agent.critics[name]
    with_entropy = name == "stochastic" and s.entropy
    with agent.autocast():
        dream = agent.model.imagine(starts, dream_policy(agent, name), s.horizon)
        returns = imagined_returns(dream, critic, s.gamma, s.lam)
        terms = {"return": actor_loss(returns, dream.continues, s.first_state_only)}
        if with_entropy:
            metrics["mdn/entropy"] = future_entropy(agent, dream)
            terms["entropy"] = -beta * metrics["mdn/entropy"]
        penalty = s.action_penalty * actor.raw(starts).square().sum(-1).mean()
        loss = sum(terms.values()) + penalty
    if with_entropy and look:
        measure_gradients(actor, terms, metrics, len(starts))
    metrics |= actor_metrics(actor, starts, dream, returns, name)
    agent.optimise(f"{name}_actor", loss, metrics, len(starts))
    with agent.autocast():
        loss = critic_loss(critic, dream, returns, s.smooth_l1)
    metrics[f"{name}_critic/loss"] = loss
    agent.optimise(f"{name}_critic", loss, metrics, len(starts))
    if with_entropy and s.density == "mdn":
        with agent.autocast():
            loss = mdn_loss(agent.mdn, dream.state, dream.continues, s.gamma_q).mean()
        metrics["mdn/nll"] = loss
        agent.optimise("mdn", loss, metrics, len(starts))


def dream_policy(agent: "Agent", name: str) -> Callable[[Tensor], Tensor]:
    """What an actor does in its dreams, states (N, D) to actions (N, A): its action plus
    `dream_noise`; with `detach_policy` no gradient goes back into the states that it sees: an actor
    then learns how its actions change states, not how those change its later actions (Dreamer)."""
    s, actor = agent.s, agent.actors[name]

    def policy(state: Tensor) -> Tensor:
        action = actor(state.detach() if s.detach_policy else state)
        return add_noise(action, s.dream_noise) if s.dream_noise else action

    return policy


def future_entropy(agent: "Agent", dream: Dream) -> Tensor:
    """Ĥ of Eq. (7), the mean over a dream's starts: by the MDN, or by neighbours (`density`)."""
    s = agent.s
    if s.density == "knn":  # on z alone: h has no scale of its own
        return particle_entropy(dream.state[..., s.deter :], dream.continues, s.gamma_q).mean()
    return entropy(agent.target_mdn, dream.state, dream.continues, s.gamma_q).mean()


def measure_gradients(
    actor: nn.Module, terms: dict[str, Tensor], metrics: dict[str, Tensor], count: int
) -> None:
    """The norms of the gradients of the two terms of Eq. (7), apart: which of them leads."""
    for name, term in terms.items():
        gradients = torch.autograd.grad(term, list(actor.parameters()), retain_graph=True)
        average_over_processes(gradients, count)
        metrics[f"stochastic_actor/{name}_grad_norm"] = nn.utils.get_total_norm(gradients)


@torch.no_grad()
def actor_metrics(
    actor: nn.Module, starts: Tensor, dream: Dream, returns: Tensor, name: str
) -> dict[str, Tensor]:
    """What the log shows of an actor: what it is promised, and whether its actions still vary."""
    found = {
        "return": returns[0].mean(),
        "saturated": (dream.action.abs() > 0.99).float().mean(),
        "deviation": actor.greedy(starts).std(0, correction=0).mean(),
    }
    if name == "stochastic":
        found["sigma"] = actor.distribution(starts).stddev.mean()
    return {f"{name}_actor/{what}": value for what, value in found.items()}


def as_numbers(metrics: dict[str, Tensor]) -> dict[str, float]:
    """Metrics as numbers, by one wait for the device. A FloatingPointError if one is not finite."""
    values = torch.stack([value.detach().float() for value in metrics.values()])
    numbers = dict(zip(metrics, values.tolist(), strict=True))
    if wrong := [name for name, number in numbers.items() if not math.isfinite(number)]:
        raise FloatingPointError(f"Not finite: {', '.join(wrong)}.")
    return numbers


def train(run: "Run", stop: Callable[[], bool]) -> None:
    """The algorithm: learn, evaluate, act, until all steps are made or `stop` says so.

    What is due follows from what was done, so that a run goes on from any checkpoint as if it had
    never stopped. Raises a FloatingPointError if a loss or gradient is not finite, an
    EnvironmentFault if the environment fails, an OSError if the disk is full.
    """
    s, agent, env, replay = run.s, run.agent, run.env, run.replay
    while not any(gathered(stop())):
        # At each multiple of `train_every` from `prefill` on, `updates` of them are due.
        if run.updates < s.updates * passed(s.prefill - 1, run.step, s.train_every):
            rows = replay.sample(s.batch_size // processes(), s.length, run.rng)
            batch, beta = to_tensors(rows, agent.device), beta_at(run.step, s)
            began = time.monotonic()
            look = run.updates % 50 == 0
            metrics = update(agent, batch, beta, look)
            metrics |= {"beta": beta, "update_seconds": time.monotonic() - began}
            run.note_update(metrics, look)
        elif run.evaluation_due():
            run.report(evaluate(agent, run.eval_env, run.bar.set_postfix_str))
        elif run.step < s.steps:
            if run.over:
                replay.add(run.begin_episode(), is_first=True)
            if run.step < s.prefill:
                action = run.rng.uniform(-1, 1, env.action_space.shape).astype(np.float32)
            else:
                last = replay.last
                policy = agent.players["stochastic"] if run.explores else agent.evaluated.greedy
                action, run.state = act(agent, policy, last["image"], last["action"], run.state)
                if run.explores:
                    action = explore(action, s.action_noise, s.random_action, run.rng)
            image, reward, terminated, truncated, info = env.step(action)
            replay.add(image, action, reward, terminated)
            run.note_decision(action, terminated or truncated, info)
        else:
            if rank() == 0:
                write_whole(run.folder / "weights.pt", agent.state_dict())
            break
        run.save_if_due()
    run.save()


def passed(before: int, after: int, every: int) -> int:
    """How many multiples of `every` lie in (before, after]."""
    return after // every - before // every


def to_tensors(rows: np.ndarray, device: torch.device) -> dict[str, Tensor]:
    """Records of the replay as one tensor per field: copied, since the records are read-only."""
    return {name: torch.tensor(rows[name], device=device) for name in rows.dtype.names}


def beta_at(step: int, s: Settings) -> float:
    """Entropy coefficient β of Eq. (7), linear in environment steps over the run (§5)."""
    return s.beta_start + (s.beta_end - s.beta_start) * min(step / s.steps, 1.0)


def evaluate(agent: "Agent", env, show: Callable[[str], None]) -> list[tuple[float, int]]:
    """Return and length of this process's share of the episodes of the evaluated actor's greedy
    actions, each with a seed of its own, always the same. One in which the environment fails is
    left out."""
    s, episodes = agent.s, []
    for k in range(rank(), s.eval_episodes, processes()):
        show(f"evaluating, episode {k + 1} of {s.eval_episodes}")
        seed = evaluation_seed(k)
        try:
            episode = play(agent, env, agent.evaluated.greedy, seed, s.eval_max_steps)
        except EnvironmentFault as error:  # what only measures never stops a run
            say(f"An evaluation's episode is left out: {error}")
            continue
        episodes.append((episode.total, episode.length))
    return episodes


def evaluation_seed(k: int) -> int:
    """The seed of the k-th episode, from 0, of every evaluation, here and in results/."""
    return 2**31 - 1 - k  # some environments take none that is larger


class Agent(nn.Module):
    """All networks of a run with A actions, and one Adam for each that learns."""

    def __init__(self, s: Settings, actions: int, device: torch.device, bfloat16: bool):
        super().__init__()
        self.s, self.device, self.bfloat16 = s, device, bfloat16
        self.model = WorldModel(
            actions, deter=s.deter, stoch=s.stoch, hidden=s.hidden, units=s.units, depth=s.depth,
            termination=s.termination, fixed_prior=s.fixed_prior,
            smooth_l1=s.smooth_l1 and not s.squared_reward,
            decode_stoch_only=s.decode_stoch_only, decode_share=s.decode_share,
            burn_in=s.burn_in, ends_ahead=s.ends_ahead, observe_first=s.observe_first,
            free_nats=s.free_nats,
        )  # fmt: skip
        size = self.model.size
        self.actors = nn.ModuleDict({"stochastic": actors.StochasticActor(size, actions, s.units)})
        if s.deterministic_actor:
            self.actors["deterministic"] = actors.DeterministicActor(size, actions, s.units)
        # What acts in the environment: moving averages of the actors (`play_rate`).
        self.players = copy.deepcopy(self.actors).requires_grad_(False)
        self.critics = nn.ModuleDict()
        learners = {"model": (self.model, s.model_lr)}
        for name, actor in self.actors.items():
            if s.q_critic:
                critic = actors.QCritic(size, actions, s.units, norm=s.critic_norm)
            else:
                critic = actors.VCritic(size, s.units, norm=s.critic_norm)
            self.critics[name] = critic
            learners[f"{name}_actor"] = actor, s.actor_lr
            learners[f"{name}_critic"] = critic, s.critic_lr
        if s.entropy and s.density == "mdn":
            self.mdn = MixtureDensityNetwork(size, s.mdn_components, s.mdn_units, s.mdn_min_std)
            self.target_mdn = copy.deepcopy(self.mdn).requires_grad_(False)
            learners["mdn"] = self.mdn, s.mdn_lr
        self.to(device)
        self.optimisers = {
            name: torch.optim.Adam(network.parameters(), lr, fused=True)
            for name, (network, lr) in learners.items()
        }

    @property
    def evaluated(self) -> nn.Module:
        """The actor that evaluation plays: the deterministic one if there is one (§4.1)."""
        return self.players["deterministic" if self.s.deterministic_actor else "stochastic"]

    def autocast(self) -> torch.autocast:
        """Matrix products and convolutions in bfloat16. A context holds the weights it has cast,
        so each forward pass between two optimiser steps has its own."""
        return torch.autocast(self.device.type, torch.bfloat16, enabled=self.bfloat16)

    def optimise(self, name: str, loss: Tensor, metrics: dict[str, Tensor], count: int = 1) -> None:
        """One step of the named optimiser on `loss`, the mean over this process's `count` things.
        `metrics` get the gradient's norm, which is not finite if, in any process, it or the loss is
        not. Once they hold such a norm, neither this step nor any later one of the update changes
        anything."""
        optimiser = self.optimisers[name]
        parameters = optimiser.param_groups[0]["params"]
        optimiser.zero_grad()
        loss.backward(inputs=parameters)  # through other networks, but into no other's gradients
        loss = loss.detach().clone()  # not finite in one process, it is so in all
        average_over_processes([loss, *(p.grad for p in parameters)], count)
        norm = nn.utils.clip_grad_norm_(parameters, self.s.grad_clip)
        metrics[f"{name}/grad_norm"] = norm + 0 * loss
        # Where it is 1 a fused optimiser does nothing; to ask here would wait for the device.
        norms = torch.stack([value for key, value in metrics.items() if key.endswith("grad_norm")])
        optimiser.found_inf = (~norms.isfinite().all()).float()
        optimiser.step()

    def follow(self) -> None:
        """Move the averages that follow what learns: the players, and the target MDN (§4.1)."""
        soft_update(self.players, self.actors, self.s.play_rate)
        if "mdn" in self.optimisers:
            soft_update(self.target_mdn, self.mdn, self.s.target_rate)


def join_processes() -> None:
    """Meet the processes that torchrun started beside this one, if it did: by gloo on a CPU, by
    NCCL on CUDA, a device each. A ValueError if there are fewer devices."""
    if not dist.is_torchelastic_launched() or dist.is_initialized():
        return
    here = int(os.environ["LOCAL_WORLD_SIZE"])
    devices = torch.cuda.device_count() if torch.cuda.is_available() else 0
    if 0 < devices < here:
        raise ValueError(f"--nproc-per-node {here} is more than the {devices} CUDA devices; "
                         "with CUDA_VISIBLE_DEVICES= before it, CPUs compute.")  # fmt: skip
    if devices:
        torch.cuda.set_device(int(os.environ["LOCAL_RANK"]))
    store, number, size = next(dist.rendezvous("env://"))
    # torchrun's store outlives a restart, and holds the addresses of the dead.
    store = dist.PrefixStore(os.environ["TORCHELASTIC_RESTART_COUNT"], store)
    backend = "cpu:gloo,cuda:nccl" if devices else "gloo"
    dist.init_process_group(backend, store=store, rank=number, world_size=size)
    atexit.register(dist.destroy_process_group)  # its threads, left alone, may abort the exit


def rank() -> int:
    """Which of the run's processes this is; 0, the first, writes what is of all of them."""
    return dist.get_rank() if dist.is_initialized() else 0


def processes() -> int:
    """How many there are."""
    return dist.get_world_size() if dist.is_initialized() else 1


OTHERS_ENDED = "Another process of this run has ended or failed"


def gathered(thing: Any) -> list:
    """One thing of each process, for all of them. A ConnectionError if one of them is gone."""
    things = [thing] * processes()
    if processes() > 1:
        try:
            dist.all_gather_object(things, thing)
        except RuntimeError as error:
            raise ConnectionError(OTHERS_ENDED) from error
    return things


def average_over_processes(tensors: list[Tensor], count: int) -> None:
    """Replace each tensor by its mean over processes, weighted by `count`, in one message. The
    gradient of a mean over each process's `count` things so becomes that of the mean over all."""
    if processes() == 1:
        return
    flat = torch.cat([x.flatten() for x in tensors] + [tensors[0].new_ones(1)]) * count
    dist.all_reduce(flat)
    means = (flat[:-1] / flat[-1]).split([x.numel() for x in tensors])
    for x, mean in zip(tensors, means, strict=True):
        x.copy_(mean.view_as(x))


def make_env_of(s: Settings):
    """The environment as an agent of these settings sees it."""
    return make_env(s.env, s.action_repeat, s.camera_distance, s.floor_brightness)


def make_agent(s: Settings, env, device: str = "auto", precision: str = "auto") -> Agent:
    """An untrained agent; a ValueError if the device is not there or no memory holds it."""
    if device == "cuda" and not torch.cuda.is_available():
        raise ValueError("--device cuda: no CUDA device is here; leave it out to use the CPU.")
    if device == "auto":
        device = "cuda" if torch.cuda.is_available() else "cpu"
    device = torch.device(device)
    bfloat16 = precision == "bfloat16"
    if precision == "auto":
        bfloat16 = all(gathered(has_bfloat16(device)))  # processes share their gradients' digits
    try:
        return Agent(s, env.action_space.shape[0], device, bfloat16)
    except RuntimeError as error:  # sizes that no memory holds
        raise ValueError(f"The networks cannot be made: {str(error).splitlines()[0]}") from None


@functools.cache
def has_bfloat16(device: torch.device) -> bool:
    """Whether bfloat16 products are in the hardware; emulated, they are slow. On some processors
    that have them PyTorch convolves without them, so one convolution is timed in both."""
    if device.type == "cuda":
        return torch.cuda.is_bf16_supported(including_emulation=False)
    capabilities = torch.cpu.get_capabilities()
    if not any(capabilities.get(name, False) for name in ("avx512_bf16", "amx_bf16", "bf16")):
        return False
    slower = convolution_seconds(torch.bfloat16) / convolution_seconds(torch.float32)
    if slower > 3:  # about 1 where they are used, 6 where not
        say(f"Convolutions in bfloat16 are {slower:.0f} times slower here: float32 is used.")
    return slower <= 3


def convolution_seconds(dtype: torch.dtype) -> float:
    """Seconds of one of the encoder's convolutions on this CPU, the least of twenty tries."""
    x, weight = torch.ones(50, 16, 31, 31, dtype=dtype), torch.ones(32, 16, 4, 4, dtype=dtype)
    timer = timeit.Timer(lambda: nn.functional.conv2d(x, weight, stride=2))
    return min(timer.repeat(repeat=20, number=2)) / 2


def interval95(returns: np.ndarray) -> float:
    """Half the width of the mean's 95% t-interval (§5); nan for a single return."""
    if len(returns) < 2:
        return float("nan")
    quantile = stdtrit(len(returns) - 1, 0.975)  # of Student's t
    return float(quantile * np.std(returns, ddof=1) / math.sqrt(len(returns)))


CHECKPOINTS = ("checkpoint.pt", "checkpoint.previous.pt")
CHANGEABLE = (
    "steps", "eval_every", "eval_episodes", "eval_max_steps", "checkpoint_minutes", "model_lr",
    "actor_lr", "critic_lr", "mdn_lr", "grad_clip",
)  # fmt: skip
TURN = 1000  # environment steps, the length of a robot's whole episode


class Run:
    """All that a run is: environments, agent, replay, random states, counters, and its folder.

    The folder holds settings.json; metrics.csv, a row an evaluation; TensorBoard's events; best.pt
    and, at the end, weights.pt, the networks alone; replay.bin; the last two checkpoints: networks,
    optimisers, random states, what KEPT names, and the checksums of the replay's rows; and
    run.lock and run.owner, by which no two processes write to it.
    Of several processes the others have a folder each in it, with their replay and checkpoints.
    """

    KEPT = (
        "step", "updates", "episode", "length", "over", "explores", "lead", "state", "actions",
        "visited", "metrics", "rows", "evaluated_at", "best", "seconds", "saved_rows", "machine",
    )  # fmt: skip

    def __init__(self, s: Settings, folder: Path, device: str, precision: str):
        self.s, self.folder = s, folder
        self.env, self.eval_env = make_env_of(s), make_env_of(s)
        torch.manual_seed(s.seed + 2**40 * rank())
        self.rng = np.random.default_rng(s.seed + 2**40 * rank())
        self.agent = make_agent(s, self.env, device, precision)
        if processes() > 1:  # all begin with the first one's networks
            for value in self.agent.state_dict().values():
                dist.broadcast(value, 0)
        self.step = self.updates = self.episode = 0  # steps and updates made, episodes begun
        self.over, self.length = True, 0  # whether the last episode ended; its environment steps
        self.explores, self.lead = True, 0  # who collects; by how many steps the explorer is ahead
        self.state: Tensor | None = None  # (1, D), the agent's; None: it has not looked yet
        self.actions: list[list[float]] = []  # of the episode under way
        self.visited: list[list[float]] = []  # the environment's own, since the last evaluation
        self.metrics: dict[str, list[float]] = {}  # of updates and whole episodes, since then
        self.rows: list[dict[str, str]] = []  # of metrics.csv
        self.evaluated_at, self.best = 0, -float("inf")  # step of the last one; best mean return
        self.seconds, self.clock = 0.0, time.monotonic()  # up to the last checkpoint; its time
        self.saved_rows = 0  # added to the replay, at the last checkpoint
        precision = "bfloat16" if self.agent.bfloat16 else "float32"
        self.on_cuda = self.agent.device.type == "cuda"
        cpu = torch.backends.cpu.get_cpu_capability()
        chip = torch.cuda.get_device_name() if self.on_cuda else cpu
        self.machine = f"{self.agent.device} ({chip}), {precision}, {torch.get_num_threads()} "
        self.machine += f"threads, torch {torch.__version__}"
        self.machine += f", {processes()} processes" if processes() > 1 else ""
        self.bar = self.writer = None  # open while `train` runs

    @property
    def own(self) -> Path:
        """This process's folder in the run's."""
        return self.folder / f"rank-{rank()}" if rank() else self.folder

    def open(self) -> None:
        """Take the folder, and its replay, for this process alone; a ValueError if another has."""
        self.own.mkdir(exist_ok=True)
        owner = self.folder / "run.owner"
        try:
            self.lock = filelock.FileLock(self.own / "run.lock").acquire(blocking=False)
        except filelock.Timeout:
            who = f"process {owner.read_text()}" if owner.exists() else "another process"
            raise ValueError(f"{self.folder} is in use by {who}: stop it or wait for it.") from None
        actions = self.env.action_space.shape[0]
        self.replay = Replay(self.s.replay_capacity, actions, self.own / "replay.bin")

    def sign(self) -> None:
        """Say in the folder what its experiment is, and which process goes on with it."""
        gathered(None)  # until all have saved
        if rank() == 0:
            owner = f"{os.getpid()} on {socket.gethostname()}"
            write_whole(self.folder / "run.owner", owner.encode())
            write_whole(self.folder / "settings.json", self.s.to_json().encode())

    def begin_episode(self) -> np.ndarray:
        """Go on to the next episode: its first image."""
        self.episode += 1
        self.over, self.length, self.state, self.actions = False, 0, None, []
        return self.reset()

    def reset(self) -> np.ndarray:
        """The first image of the present episode, whose seed is its own."""
        number = (self.episode - 1) * processes() + rank()
        seed = np.random.SeedSequence((self.s.seed, number)).generate_state(1)[0] % 2**31
        return self.env.reset(seed=int(seed))[0]

    def note_decision(self, action: np.ndarray, over: bool, info: dict) -> None:
        """Count a decision. At an episode's end, and every TURN steps of a longer one, whoever has
        collected fewer steps, the explorer or the evaluated actor, collects next."""
        before, self.length = self.length, int(self.env.get_wrapper_attr("episode_lengths"))
        self.step, self.over = self.step + sum(gathered(self.length - before)), over
        self.lead += (self.length - before) * (1 if self.explores else -1)
        if over or passed(before, self.length, TURN):
            self.explores = self.s.collect == "explorer" or self.lead <= 0
        self.actions.append(action.tolist())  # of numbers: 50,000 tensors take seconds to save
        self.visited.append(info["state"].tolist())
        if over:
            whole = info["episode"]
            self.note({"train_return": whole["r"], "train_length": whole["l"]})
        self.bar.update(min(self.step, self.s.steps) - self.bar.n)  # the last may be one too many

    def note_update(self, metrics: dict[str, float], look: bool) -> None:
        """Count an update that was made; one that was looked at goes to TensorBoard as it is."""
        if look:
            for name, value in metrics.items():
                self.writer.add_scalar(f"update/{name}", value, self.step)
        self.updates += 1
        self.note(metrics)

    def note(self, metrics: dict[str, float]) -> None:
        """Keep metrics for the means in the next row of metrics.csv."""
        for name, value in metrics.items():
            self.metrics.setdefault(name, []).append(float(value))

    def evaluation_due(self) -> bool:
        """Whether a multiple of `eval_every`, or the end, was passed since the last evaluation."""
        since = max(self.evaluated_at, self.s.prefill - 1)
        at_end = self.step >= self.s.steps and self.step > self.evaluated_at
        return self.updates > 0 and (at_end or passed(since, self.step, self.s.eval_every) > 0)

    def report(self, episodes: list[tuple[float, int]]) -> None:
        """A row of metrics.csv and TensorBoard, a line, and best.pt if none was better."""
        self.evaluated_at = self.step
        own = episodes, self.visited, self.metrics
        scores, visited, metrics = zip(*gathered(own), strict=True)
        if not any(scores):
            return
        self.metrics, self.visited = {}, []
        if rank():
            return
        returns, lengths = np.concatenate([each for each in scores if each]).T
        names = dict.fromkeys(name for each in metrics for name in each)
        lists = {n: np.concatenate([each[n] for each in metrics if n in each]) for n in names}
        mean, half = float(returns.mean()), interval95(returns)
        row = {
            "env_steps": self.step, "wall_seconds": self.elapsed(),
            "eval_return": mean, "eval_interval95": half,
            "eval_length": lengths.mean(), "eval_length_min": lengths.min(),
            "eval_length_max": lengths.max(), "coverage": coverage(np.concatenate(visited)),
            "train_return": float("nan"), "train_length": float("nan"),  # unless an episode ended
        } | {name: numbers.mean() for name, numbers in lists.items()}  # fmt: skip
        self.rows.append({k: str(v) if k == "env_steps" else f"{v:.6g}" for k, v in row.items()})
        table = io.StringIO()
        writer = csv.DictWriter(table, dict.fromkeys(k for row in self.rows for k in row), "nan")
        writer.writeheader()
        writer.writerows(self.rows)
        write_whole(self.folder / "metrics.csv", table.getvalue().encode())
        for name, value in row.items():
            self.writer.add_scalar(name, value, self.step)
        self.writer.flush()
        said = f"return {mean:.1f}" + (f" ± {half:.1f}" if len(returns) > 1 else "")
        self.bar.set_postfix_str(said)
        self.bar.write(
            f"{self.step:9,} environment steps, {self.elapsed() / 60:5.1f} min: {said}, "
            f"{lengths.mean():.0f} steps an episode"
        )
        if mean >= self.best:
            self.best = mean
            write_whole(self.folder / "best.pt", self.agent.state_dict())

    def elapsed(self) -> float:
        """Seconds that the run has taken, whenever it ran."""
        return self.seconds + time.monotonic() - self.clock

    def save_if_due(self) -> None:
        """Write a checkpoint every `checkpoint_minutes`, before rows of the last one are
        overwritten, and after an evaluation, so that a run which goes on knows of each row and of
        best.pt."""
        waited = time.monotonic() - self.clock >= 60 * self.s.checkpoint_minutes
        full = self.replay.added - self.saved_rows >= self.replay.save_every
        if any(gathered(waited or full or self.evaluated_at == self.step)):
            self.save()

    def save(self) -> None:
        """Write a checkpoint, whole or not at all (an OSError); the one before it is kept."""
        self.seconds, self.clock = self.elapsed(), time.monotonic()
        self.saved_rows = self.replay.added
        newest, previous = (self.own / name for name in CHECKPOINTS)
        content = {
            "agent": self.agent.state_dict(),
            "optimisers": {name: o.state_dict() for name, o in self.agent.optimisers.items()},
            "settings": self.s.to_json(),
            "kept": {name: getattr(self, name) for name in self.KEPT},
            "checksums": torch.from_numpy(self.replay.flush()),
            "torch_random": torch.get_rng_state(),
            "cuda_random": [torch.cuda.get_rng_state()] if self.on_cuda else [],
            "numpy_random": json.dumps(self.rng.bit_generator.state),
        }
        write_whole(newest, content, keep=previous)

    def load(self) -> None:
        """Go back to the newest whole checkpoint, and say what is not as it was. A ValueError if
        there is none, the replay is not its own, what may not change differs, or the networks are
        another version's."""
        path, saved = read_checkpoint(self.own)
        made, now, here = json.loads(saved["settings"]), dataclasses.asdict(self.s), self.machine
        if fixed := fixed_changes(made, now):
            raise ValueError(f"{self.folder} keeps its own {', '.join(fixed)}; --resume takes "
                             f"{', '.join(CHANGEABLE)}.")  # fmt: skip
        vars(self).update(saved["kept"])
        self.replay.restore(self.saved_rows, saved["checksums"].numpy())
        load_weights(self.agent, saved["agent"])
        for name, optimiser in self.agent.optimisers.items():
            now_set = optimiser.state_dict()["param_groups"]  # the rate may have changed since
            optimiser.load_state_dict(saved["optimisers"][name] | {"param_groups": now_set})
        self.state = None if self.state is None else self.state.to(self.agent.device)
        self.rng.bit_generator.state = json.loads(saved["numpy_random"])
        if here != self.machine:
            say(f"Begun on {self.machine}, it goes on on {here}: otherwise than it would have.")
            self.machine = here
        passed_over = self.own / CHECKPOINTS[0]
        gathered(None)  # where one process cannot go on, none changes anything
        if path != passed_over and passed_over.exists():  # it must not take the place of this
            passed_over.replace(passed_over.with_suffix(".damaged"))
        if not self.over:
            self.retrace()
        torch.set_rng_state(saved["torch_random"])
        if self.on_cuda and (states := saved["cuda_random"]):  # none, if it was saved on a CPU
            mine = torch.cuda.current_device()  # once, checkpoints held those of all devices
            torch.cuda.set_rng_state(states[min(mine, len(states) - 1)])
        for name in CHANGEABLE:
            if now[name] != made[name]:
                since = f"{name}: {now[name]} instead of {made[name]} from step {self.step:,} on"
                falls = name == "steps" and self.s.entropy
                say(since + ("; β now falls to its end by then." if falls else "."))

    def retrace(self) -> None:
        """Take the actions of the episode under way again: its environment is then where it was."""
        with contextlib.suppress(EnvironmentFault):
            image, reward, last = self.reset(), 0.0, self.replay.last
            for action in self.actions:
                image, reward, *_ = self.env.step(np.float32(action))
            if np.array_equal(image, last["image"]) and np.float32(reward) == last["reward"]:
                return
        self.over = True
        say(f"{self.s.env} does not repeat itself: the episode under way ends here, and the run "
            "goes on otherwise than it would have.")  # fmt: skip


def fixed_changes(
    made: dict[str, object], now: dict[str, object], free: tuple[str, ...] = CHANGEABLE
) -> list[str]:
    """What is not free to change in a run but has: each such setting, and the value it had."""
    changed = (name for name in now if now[name] != made.get(name))
    return [f"{name} {made.get(name)}" for name in changed if name not in free]


def write_whole(path: Path, content: object, keep: Path | None = None) -> None:
    """Write what torch can save, or bytes, whole or not at all: aside, onto the disk, then in its
    place. What stood there is kept as `keep`, if that is given. An OSError if it cannot be."""
    aside = path.with_suffix(".writing")
    with open(aside, "wb") as file:
        file.write(content) if isinstance(content, bytes) else torch.save(content, file)
        file.flush()
        os.fsync(file.fileno())
    if keep and path.exists():
        path.replace(keep)
    aside.replace(path)


def read_checkpoint(folder: Path) -> tuple[Path, dict]:
    """The newest whole checkpoint, and its path, of a moment that every process has: one that was
    killed while it saved may be one behind. A ValueError if there is none. Nothing in it is
    executed."""
    found = whole_checkpoints(folder)
    moment, path, saved = next(found)
    while len(set(moments := gathered(moment))) > 1:
        if moment == max(moments):
            moment, path, saved = next(found)
    return path, saved


def whole_checkpoints(folder: Path) -> Iterator[tuple[tuple, Path, dict]]:
    """The newest first, each with its moment in the run."""
    for path in (folder / name for name in CHECKPOINTS):
        if path.exists():
            with contextlib.suppress(Exception), zipfile.ZipFile(path) as file:  # damage has many
                if file.testzip() is None:  # each part has the checksum that was written with it
                    saved = torch.load(path, map_location="cpu", weights_only=True)
                    kept = saved["kept"]
                    if "settings" in saved and kept.keys() == set(Run.KEPT):
                        yield (kept["step"], kept["updates"], kept["evaluated_at"]), path, saved
                        continue
            say(f"{path} is damaged: looking for the one before it.")
    raise ValueError(f"{folder} holds no whole checkpoint: start a new run in another folder.")


def has_checkpoint(folder: Path) -> bool:
    """Whether a folder holds a checkpoint, whole or not."""
    return any((folder / name).exists() for name in CHECKPOINTS)


def load_weights(networks: nn.Module, weights: dict[str, Tensor]) -> None:
    """Load what was saved. A ValueError, in one sentence, if it is of other networks."""
    try:
        networks.load_state_dict(weights)
    except RuntimeError as error:
        why = " ".join(str(error).split())
        raise ValueError(f"It is of other settings' or another version's networks: {why}") from None


@dataclass(frozen=True)
class Command:
    """MaxEnt Dreamer learns to act from 64×64 pixels, in a world that it imagines.

    Values shown are those of the arm and preset on this command line. `--evaluate FOLDER` plays a
    run instead (results/play.py).
    """

    settings: tyro.conf.OmitArgPrefixes[Settings]
    run_dir: str = ""  # folder to create; empty: runs/ENV-ARM-PRESET-seedSEED-TIME
    resume: str | None = None  # folder of a run to go on with; steps, rates and the like may change
    device: Literal["auto", "cpu", "cuda"] = "auto"  # where to compute; auto: cuda if there
    precision: Literal["auto", "bfloat16", "float32"] = "auto"  # auto: bfloat16 if in hardware


def parse(arguments: list[str]) -> Command:
    """The command line. The arm and preset, or the run to go on with, set the defaults that the
    other options change. A ValueError says what cannot be understood, or cannot be."""
    words = [a for a in arguments if a not in ("-h", "--help")]
    known = understood(words, default_settings())
    if known.resume is None:
        default = default_settings(known.settings.arm, known.settings.preset)
    else:
        default = read_settings(folder_named(known.resume))
    command = understood(arguments, default)
    return dataclasses.replace(command, settings=check(command.settings.to_json()))


def understood(arguments: list[str], default: Settings) -> Command:
    """The command line over these defaults."""
    try:
        with contextlib.redirect_stderr(io.StringIO()) as said:
            return tyro.cli(Command, prog="train.py", args=arguments, default=Command(default))
    except SystemExit as error:
        if not error.code:  # --help
            raise
        below_title = said.getvalue().partition("\n")[2]
        words = re.sub("[─│╭╮╰╯]|-{3,}", " ", below_title).split()  # without the box around them
        raise ValueError(" ".join(words)) from None


def check(text: str, where: str = "") -> Settings:
    """The settings of a JSON text. A ValueError says which of them cannot be, and why."""
    try:
        s = TypeAdapter(Settings).validate_json(text, strict=True)
    except ValidationError as error:
        wrong = error.errors()[0]
        for name in wrong["loc"]:  # none, if it is no JSON
            where += f"--{name.replace('_', '-')} is {wrong['input']}: "
        raise ValueError(f"{where}{wrong['msg']}.") from None
    n, least = processes(), -(-s.prefill // s.train_every) * s.train_every  # the first that is due
    rows = s.prefill // s.action_repeat // n
    live = s.starts * s.batch_size * ((s.length - s.burn_in) // 2) / n  # that are no ends, at least
    enough = s.density != "knn" or not s.entropy or live >= 4
    # A window has more rows than these; without a burn-in, dreams too long for it are cut short.
    needed = s.burn_in + (s.ends_ahead if s.termination and s.burn_in else 0)
    for possible, sentence in (
        (s.batch_size % n == 0, f"--batch-size {s.batch_size} is no multiple of {n} processes"),
        (s.burn_in <= s.length - 2, f"--burn-in leaves fewer than two rows of --length {s.length}"),
        (s.length <= rows, f"--prefill {s.prefill} makes {rows} rows, no --length {s.length}"),
        (s.length <= s.replay_capacity, f"--replay-capacity is less than --length {s.length}"),
        (s.steps >= least, f"--steps {s.steps} leaves no update after --prefill: give {least}"),
        (s.eval_every >= s.train_every, f"--eval-every is less than --train-every {s.train_every}"),
        (enough, "--density knn needs four states to dream from: raise --batch-size or --length"),
        (needed < s.length,
         f"--burn-in and --ends-ahead {s.ends_ahead} need a --length above {needed}"),
    ):  # fmt: skip
        if not possible:
            raise ValueError(f"{where}{sentence}.")
    return s


def read_settings(folder: Path) -> Settings:
    """The settings of a run's folder. A ValueError if it holds none, or they are another version's
    or cannot be."""
    path = folder / "settings.json"
    try:
        text = path.read_text("utf-8-sig", "replace")
    except (FileNotFoundError, NotADirectoryError):
        raise ValueError(f"{folder} is no run's folder: it holds no settings.json.") from None
    s = check(text, f"{path}: ")
    if differing := json.loads(text).keys() ^ dataclasses.asdict(s).keys():
        names = ", ".join(sorted(differing))
        raise ValueError(f"{folder} was made by a version with other settings: {names}.")
    return s


def folder_named(text: str) -> Path:
    """The folder that a user names, wherever the environment goes."""
    path = os.path.abspath(os.path.expanduser(text))
    if path != path.encode(errors="ignore").decode():  # TensorBoard could not write to it
        raise ValueError(f"{path!a} is not UTF-8: name another folder.")
    return Path(path)


def new_run(command: Command) -> Run:
    """A new run in a folder of its own, made once all else is known to work. A ValueError says
    what is wrong with the command."""
    s = command.settings
    if os.environ.get("TORCHELASTIC_MAX_RESTARTS", "0") != "0" and not command.run_dir:
        raise ValueError("--max-restarts needs --run-dir, by which a run that goes on is found.")
    name = f"{s.env}-{s.arm}-{s.preset}-seed{s.seed}-{time.strftime('%Y%m%d-%H%M%S')}"
    folder = folder_named(command.run_dir or "runs/" + re.sub(r"[^\w.-]", "-", name))
    taken = f"{folder} is there already: name another --run-dir, or --resume it."
    if command.run_dir and folder.exists() and any(folder.iterdir()):
        raise ValueError(taken)
    run = Run(s, folder, command.device, command.precision)
    if rank() == 0:
        while run.folder.exists() and not command.run_dir:  # begun in the same second
            run.folder = run.folder.with_name(run.folder.name + "+")
        run.folder.mkdir(parents=True, exist_ok=True)
    run.folder = gathered(run.folder)[0]
    run.open()
    if (run.folder / "settings.json").exists():  # of a process that was faster, and is done
        raise ValueError(taken)
    try:
        run.save()
        run.sign()
    except BaseException:
        shutil.rmtree(run.folder, ignore_errors=True)
        raise
    return run


def resumed_run(command: Command) -> Run:
    """The run of a folder, from its newest checkpoint, with the settings that changed. A ValueError
    says why it cannot go on, or not with these."""
    if command.run_dir:
        raise ValueError("--resume keeps the run's own run_dir: leave out --run-dir.")
    s, folder = command.settings, folder_named(command.resume)
    run = Run(s, folder, command.device, command.precision)
    if not has_checkpoint(run.own):
        whose = f" of {processes()} processes" if rank() else ""
        raise ValueError(f"{folder} holds no whole checkpoint{whose}: it cannot go on.")
    if (folder / f"rank-{processes()}").exists():
        began = 1 + len(list(folder.glob("rank-*")))
        raise ValueError(f"{folder} was made by {began} processes: go on with as many "
                         f"(torchrun --nproc-per-node {began}).")  # fmt: skip
    run.open()
    run.load()
    run.sign()
    return run


def main(arguments: list[str]) -> int:
    """Runs a command line. Returns the exit code: 0 done, or stopped as asked; 1 stopped by a
    fault; 2 bad input."""
    if "--evaluate" in arguments:  # what only looks at a run stands in results/
        player = str(Path(__file__).with_name("results") / "play.py")
        rest = [argument for argument in arguments if argument != "--evaluate"]
        return subprocess.call([sys.executable, player, *rest])
    keep_freed_memory()
    threading.excepthook = leave_out_os_errors
    try:
        join_processes()
        if rank():
            sys.stdout = open(os.devnull, "w")  # the first speaks for all
        command = parse(arguments)
        restarted = os.environ.get("TORCHELASTIC_RESTART_COUNT", "0") != "0"
        if restarted and command.run_dir:
            if (folder_named(command.run_dir) / "settings.json").exists():
                command = dataclasses.replace(command, resume=command.run_dir, run_dir="")
        run = new_run(command) if command.resume is None else resumed_run(command)
    except (ValueError, OSError, MemoryError) as error:
        say(error)
        return 2
    with run.lock, run.replay.file:
        return train_run(run, command.device, command.precision)


def train_run(run: Run, device: str, precision: str) -> int:
    """Trains to the end, to a signal or to a fault, and says what to do next: the exit code."""
    s, stopped = run.s, threading.Event()

    def stop(number: int, _) -> None:
        run.bar.write("Finishing what is under way, then saving; Ctrl-C again to stop at once.")
        stopped.set()
        signal.signal(signal.SIGINT, signal.default_int_handler)

    size = sum(p.numel() for p in run.agent.parameters() if p.requires_grad) / 1e6
    rows = min(s.replay_capacity * processes(), s.steps // s.action_repeat)
    disk = rows * run.replay.dtype.itemsize / 1e9
    what = f"{s.env}, arm {s.arm}, preset {s.preset}, seed {s.seed}, from step {run.step:,}"
    print(f"{what}: {run.folder}\n{size:.1f} M parameters; {run.machine}; the replay will take "
          f"some {disk:.1f} GB of disk", flush=True)  # fmt: skip
    launcher = ["torchrun", "--nproc-per-node", os.environ.get("LOCAL_WORLD_SIZE", "1")]
    launcher = launcher if dist.is_initialized() else [sys.executable]
    words = [*launcher, __file__, "--resume", str(run.folder)]
    words += ["--device", device] if device != "auto" else []
    words += ["--precision", precision] if precision != "auto" else []
    resume = "Go on with: " + shlex.join(words)
    every = 0.5 if sys.stderr.isatty() else 30  # seconds between two lines of a log file
    try:
        bar = tqdm(total=s.steps, initial=min(run.step, s.steps), unit="step", mininterval=every,
                   disable=rank() > 0)  # fmt: skip
        with bar as run.bar, SummaryWriter(run.own, purge_step=run.step + 1) as run.writer:
            hangup = getattr(signal, "SIGHUP", signal.SIGINT)  # Windows has none
            for number in (signal.SIGINT, signal.SIGTERM, hangup):
                if number != hangup or signal.getsignal(number) != signal.SIG_IGN:  # nohup
                    signal.signal(number, stop)
            train(run, stopped.is_set)
    except (RuntimeError, ArithmeticError, MemoryError, OSError) as error:
        say(f"{explained(error, run)} {resume}")
        return 1
    done = run.step >= s.steps and not stopped.is_set()
    print(f"Done: {run.folder / 'metrics.csv'}" if done else f"Stopped. {resume}", flush=True)
    return 0


def explained(error: Exception, run: Run) -> str:
    """What stopped a run, for its user. What can only be a fault of this program is raised."""
    reason = str(error).partition("\n")[0]  # a MemoryError may have none
    if isinstance(error, FloatingPointError):
        return (f"{error} The last checkpoint is from before: go on with a lower --model-lr, "
                "--actor-lr or --critic-lr, or with --precision float32.")  # fmt: skip
    if isinstance(error, EnvironmentFault):
        run.over = True  # whoever goes on begins another episode
        with contextlib.suppress(OSError):
            if processes() == 1:  # no other could go on from here
                run.save()
                return f"{error} What was learnt is saved."
        return str(error)
    if isinstance(error, OSError):
        return f"{error}: stopped; what was saved before is whole."
    if isinstance(error, MemoryError) or "alloc" in str(error).lower():
        why = f": {reason.rstrip('.')}" if reason else ""
        size = f"--batch-size {run.s.batch_size} and --length {run.s.length}"
        return f"No memory for an update of {size}{why}."
    if dist.is_initialized() and re.search("gloo|NCCL", str(error)):
        return f"{OTHERS_ENDED}: stopped; what was saved before is whole."
    raise error


def say(text: object) -> None:
    """One sentence for the user, beside the progress."""
    who = f"Process {rank()}: " if rank() else ""
    tqdm.write(who + (" ".join(str(text).splitlines()) or repr(text)), file=sys.stderr)


def leave_out_os_errors(thrown: threading.ExceptHookArgs) -> None:
    """No traceback of TensorBoard's thread on a full disk: its error comes back in ours."""
    if not isinstance(thrown.exc_value, OSError):
        threading.__excepthook__(thrown)


def keep_freed_memory() -> None:
    """Let glibc keep the memory that tensors free: the next update asks for as much again, and
    the system would clear each page anew (measured: a fifth of the paper preset's update)."""
    with contextlib.suppress(OSError, AttributeError, TypeError):  # another C library, or none
        trim_threshold, top_pad, mmap_max = -1, -2, -4  # malloc.h
        for option, value in ((mmap_max, 0), (trim_threshold, 2**31 - 1), (top_pad, 64 * 2**20)):
            ctypes.CDLL(None).mallopt(option, value)


class Patient:
    """A stream whose reader may go away, or know few letters: to show a run must not end it."""

    def __init__(self, stream):
        self.stream = stream or open(os.devnull, "w")  # None: it was closed from the start
        self.stream.reconfigure(errors="replace")

    def write(self, text: str) -> int:
        with contextlib.suppress(OSError, ValueError):
            self.stream.write(text)
        return len(text)

    def flush(self) -> None:
        try:
            self.stream.flush()
        except (OSError, ValueError):
            self.stream = open(os.devnull, "w")

    def __getattr__(self, name: str):
        return getattr(self.stream, name)


if __name__ == "__main__":
    sys.stdout, sys.stderr = Patient(sys.stdout), Patient(sys.stderr)
    try:
        sys.exit(main(sys.argv[1:]))
    except KeyboardInterrupt:
        sys.exit("Stopped at once; a run that had begun can be resumed from its last checkpoint.")
