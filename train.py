"""Trains MaxEnt Dreamer: settings, the one explicit loop, evaluation, checkpoints, command line.

    python train.py --env HopperBulletEnv-v0

The algorithm is `train` (act, store, update, evaluate) and `update` (one gradient step of
everything); what they call stands in world_model.py, actors.py, returns.py, mdn.py and env.py. No
other file reads settings, holds an optimiser, moves a device or writes to disk.
"""

import argparse
import contextlib
import csv
import ctypes
import dataclasses
import hashlib
import io
import itertools
import json
import os
import signal
import sys
import threading
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Literal, NamedTuple

import gymnasium as gym
import numpy as np
import torch
import tyro
from PIL import Image
from scipy import stats
from torch import Tensor, nn
from torch.utils.tensorboard import SummaryWriter
from tqdm import tqdm

from actors import (
    DeterministicActor,
    QCritic,
    StochasticActor,
    VCritic,
    actor_loss,
    critic_loss,
    explore,
    imagined_returns,
    nudge,
)
from env import Replay, coverage, make_env
from mdn import MixtureDensityNetwork, entropy, mdn_loss, soft_update
from world_model import WorldModel

Arm = Literal["dreamer", "dreamer-maxent", "revised", "maxent"]
Preset = Literal["small", "paper"]
Precision = Literal["auto", "bfloat16", "float32"]
Collect = Literal["explorer", "both"]


# fmt: off
@dataclass(frozen=True)
class Settings:
    """All that a run depends on. §: in the paper; Dreamer: its authors' code; ours: in neither."""

    env: str = "HopperBulletEnv-v0"  # Gymnasium id; bounded Box actions, rgb_array rendering
    arm: Arm = "maxent"  # curve of the paper's figure: sets the switches below
    preset: Preset = "small"  # sizes and cadence: for two CPU cores, or the paper's
    seed: int = 0  # of weights, environment, sampling; on one machine, equal seeds, equal metrics
    run_dir: str = ""  # folder to create; empty: runs/ENV-ARM-PRESET-seedSEED-TIME
    device: str = "auto"  # cpu or cuda; auto: cuda if there
    precision: Precision = "auto"  # auto: bfloat16 if the processor has it in hardware

    steps: int = 100_000  # environment steps of the run, prefill included (ours)
    prefill: int = 5000  # environment steps of random actions before training (Dreamer: 5000)
    train_every: int = 10  # environment steps between two rounds of updates (Dreamer: 1000)
    updates: int = 1  # gradient updates a round (Dreamer: 100)
    eval_every: int = 10_000  # environment steps between evaluations, once training began (ours)
    eval_episodes: int = 10  # episodes an evaluation (§5: 10)
    checkpoint_minutes: float = 5.0  # between two checkpoints (ours)
    replay_capacity: int = 500_000  # rows (decisions) of experience kept (ours)
    action_repeat: int = 2  # environment steps a decision (Dreamer)
    camera_distance: float = 1.7  # metres to a PyBullet robot; 3 is the environment's own (ours)

    termination: bool = True  # §4.2: learn when episodes end, and let returns end there
    observe_first: bool = True  # §4.2: see o_0 before choosing a_0 (Dreamer's code does too)
    fixed_prior: bool = True  # §4.2: KL to N(0, 1) and Jeffreys to the prior, not KL to the prior
    q_critic: bool = True  # §4.2 minor 1: the critic is Q(s, a), not V(s)
    smooth_l1: bool = True  # §4.2 minor 2: Smooth L1 for reward and critic, not squared error
    decode_stoch_only: bool = True  # §4.2 minor 3: the decoder sees z, not (h, z)
    first_state_only: bool = True  # §4.2: actors maximise the first imagined state's return alone
    entropy: bool = True  # §4.1: the stochastic actor also maximises β × entropy of future states
    deterministic_actor: bool = True  # §4.1: train a deterministic actor too, and evaluate it
    action_noise: float = 0.0  # std of noise added to collected actions (Dreamer: 0.3)
    random_action: float = 0.1  # §4.2 minor 4: probability of a random action (its value ours)
    collect: Collect = "both"  # who collects: the explorer alone, or both actors in turn (ours)

    deter: int = 200  # size of h (Dreamer: 200)
    stoch: int = 128  # size of z (§5: 128; Dreamer: 30)
    hidden: int = 200  # units of the RSSM's dense layers (Dreamer: 200)
    units: int = 400  # of reward, termination, actor and critic layers (Dreamer: 400)
    depth: int = 32  # channels of the first convolution (Dreamer: 32)
    batch_size: int = 50  # sequences a batch (Dreamer: 50)
    length: int = 50  # rows a sequence (Dreamer: 50)
    horizon: int = 15  # imagined steps, and n of Eq. (10) (Dreamer)

    gamma: float = 0.99  # γ of λ-returns, a decision (Dreamer)
    lam: float = 0.95  # λ of λ-returns (Dreamer)
    gamma_q: float = 0.9  # γ of the discounted state distribution (§5)
    beta_start: float = 0.2  # entropy coefficient β at the first environment step (§5)
    beta_end: float = 0.0001  # and at the last, linear between (§5)
    mdn_components: int = 8  # components of the mixture density network (§5: heads)
    mdn_units: int = 256  # its hidden units (§5: 256)
    mdn_min_std: float = 0.1  # floor under its σ (ours)
    target_rate: float = 0.1  # soft update of the target MDN (§5)
    first_action_noise: float = 0.1  # on the deterministic actor's first imagined action (ours)
    model_lr: float = 6e-4  # Adam's learning rate of the world model (Dreamer)
    actor_lr: float = 8e-5  # of each actor (Dreamer)
    critic_lr: float = 8e-5  # of each critic (Dreamer)
    mdn_lr: float = 2e-4  # of the mixture density network (§5)
    grad_clip: float = 100.0  # largest global gradient norm of an optimiser step (Dreamer)
    free_nats: float = 3.0  # KL below this costs nothing; of `kl` only (Dreamer)
    image_weight: float = 1.0  # weight of the image's loss (Dreamer)
    reward_weight: float = 1.0  # of the reward's loss (Dreamer)
    termination_weight: float = 1.0  # of the termination's loss (ours)
    kl_weight: float = 1.0  # of `kl`, the original Dreamer's divergence (Dreamer)
    kl_standard_weight: float = 0.1  # of KL(posterior || N(0, 1)) (§5)
    jeffreys_weight: float = 0.1  # of D_J(posterior || prior) (§5)


ORIGINAL = dict(
    termination=False, fixed_prior=False, q_critic=False, smooth_l1=False,
    decode_stoch_only=False, first_state_only=False, stoch=30, random_action=0.0,
)
ARMS = {  # what each curve of the paper's figure changes in `Settings`, which is the last of them
    "dreamer": ORIGINAL | dict(entropy=False, deterministic_actor=False, action_noise=0.3),
    "dreamer-maxent": ORIGINAL,
    "revised": dict(entropy=False, deterministic_actor=False, action_noise=0.3),
    "maxent": {},
}
PRESETS = {  # sizes and cadence, nothing else
    "small": dict(
        deter=128, stoch=64, hidden=128, units=128, depth=16, batch_size=10, length=25,
        mdn_units=128, prefill=2000,
    ),
    "paper": dict(steps=1_000_000, train_every=1000, updates=100),
}
# fmt: on


def default_settings(arm: Arm = "maxent", preset: Preset = "small") -> Settings:
    """The settings of one arm at one size, before any switch of the user's."""
    return Settings(arm=arm, preset=preset, **(PRESETS[preset] | ARMS[arm]))


class Agent(nn.Module):
    """All networks of a run, and one Adam for each that learns.

    Args:
        s: the settings.
        actions: A.
        device: where it lives.
        bfloat16: whether `autocast` runs forward passes in bfloat16.
    """

    def __init__(self, s: Settings, actions: int, device: torch.device, bfloat16: bool):
        super().__init__()
        self.s, self.device, self.bfloat16 = s, device, bfloat16
        self.model = WorldModel(
            actions, deter=s.deter, stoch=s.stoch, hidden=s.hidden, units=s.units, depth=s.depth,
            termination=s.termination, fixed_prior=s.fixed_prior, smooth_l1=s.smooth_l1,
            decode_stoch_only=s.decode_stoch_only, observe_first=s.observe_first,
            free_nats=s.free_nats,
        )  # fmt: skip
        size = self.model.size
        self.actors = nn.ModuleDict({"stochastic": StochasticActor(size, actions, s.units)})
        if s.deterministic_actor:
            self.actors["deterministic"] = DeterministicActor(size, actions, s.units)
        self.critics = nn.ModuleDict()
        learners = {"model": (self.model, s.model_lr)}
        for name, actor in self.actors.items():
            critic = QCritic(size, actions, s.units) if s.q_critic else VCritic(size, s.units)
            self.critics[name] = critic
            learners[f"{name}_actor"] = actor, s.actor_lr
            learners[f"{name}_critic"] = critic, s.critic_lr
        if s.entropy:
            sizes = size, s.mdn_components, s.mdn_units, s.mdn_min_std
            self.mdn, self.target_mdn = (MixtureDensityNetwork(*sizes) for _ in range(2))
            self.target_mdn.load_state_dict(self.mdn.state_dict())
            self.target_mdn.requires_grad_(False)
            learners["mdn"] = self.mdn, s.mdn_lr
        self.to(device)
        self.optimisers = {
            name: torch.optim.Adam(network.parameters(), lr, fused=True)
            for name, (network, lr) in learners.items()
        }

    @property
    def evaluated(self) -> nn.Module:
        """The actor that evaluation plays: the deterministic one if there is one (§4.1)."""
        return self.actors["deterministic" if self.s.deterministic_actor else "stochastic"]

    def collector(self, episode: int) -> nn.Module:
        """The actor that plays an episode of training: the explorer, or both in turn."""
        turn = episode % len(self.actors) if self.s.collect == "both" else 0
        return list(self.actors.values())[turn]

    def autocast(self) -> torch.autocast:
        """Matrix products and convolutions in bfloat16. A context holds the weights it has cast,
        so each forward pass between two optimiser steps has its own."""
        return torch.autocast(self.device.type, torch.bfloat16, enabled=self.bfloat16)

    def step(self, name: str, loss: Tensor, metrics: dict[str, Tensor]) -> None:
        """One step of the named optimiser on `loss`; its gradient norm goes into `metrics`.

        Raises:
            FloatingPointError: if loss or gradient is not finite, naming which of `metrics` is
                not; the network is then as it was.
        """
        optimiser = self.optimisers[name]
        parameters = optimiser.param_groups[0]["params"]
        optimiser.zero_grad()
        loss.backward(inputs=parameters)  # through other networks, but into no other's gradients
        norm = nn.utils.clip_grad_norm_(parameters, self.s.grad_clip)
        metrics[f"{name}/grad_norm"] = norm
        if not torch.isfinite(norm + loss):
            named = metrics | {f"{name}/loss": loss}
            wrong = [key for key, value in named.items() if not torch.isfinite(value)]
            raise FloatingPointError(f"Not finite: {', '.join(wrong)}.")
        optimiser.step()


def update(agent: Agent, batch: dict[str, Tensor], beta: float, s: Settings) -> dict[str, float]:
    """One gradient update of the world model, of each actor and its critic, and of the MDN.

    Args:
        batch: as `WorldModel.loss` takes it.
        beta: entropy coefficient β of Eq. (7).

    Returns:
        named metrics; the world model's are the unweighted terms of its loss.
    """
    with agent.autocast():
        terms, states = agent.model.loss(batch)
        loss = sum(getattr(s, f"{name}_weight") * term for name, term in terms.items())
    metrics = {f"model/{name}": term for name, term in terms.items()}
    agent.step("model", loss, metrics)

    starts = states[~batch["terminated"]].detach()  # (N, D): where it is over nothing follows
    for name, actor in agent.actors.items():
        explorer = name == "stochastic" and s.entropy
        with agent.autocast():
            first = actor(starts)
            if name == "deterministic":
                first = nudge(first, s.first_action_noise)
            dream = agent.model.imagine(starts, actor, s.horizon, first)
            returns = imagined_returns(dream, agent.critics[name], s.gamma, s.lam)
            loss = actor_loss(returns, dream.continues, s.first_state_only)
            if explorer:  # Eq. (7)
                bonus = entropy(agent.target_mdn, dream.state, dream.continues, s.gamma_q).mean()
                loss = loss - beta * bonus
                metrics["mdn/entropy"] = bonus
        metrics[f"{name}_actor/return"] = returns[0].mean()
        metrics[f"{name}_actor/saturated"] = (dream.action.abs() > 0.99).float().mean()
        agent.step(f"{name}_actor", loss, metrics)

        with agent.autocast():
            loss = critic_loss(agent.critics[name], dream, returns, s.smooth_l1)
        metrics[f"{name}_critic/loss"] = loss
        agent.step(f"{name}_critic", loss, metrics)

        if explorer:
            with agent.autocast():
                loss = mdn_loss(agent.mdn, dream.state, dream.continues, s.gamma_q).mean()
            metrics["mdn/nll"] = loss
            agent.step("mdn", loss, metrics)
            soft_update(agent.target_mdn, agent.mdn, s.target_rate)
    return {name: value.item() for name, value in metrics.items()}


def train(run: "Run", stop: Callable[[], bool]) -> None:
    """The algorithm: act, store, update, evaluate, until all steps are made or `stop` says so.

    Raises:
        FloatingPointError: if a loss or gradient is not finite.
        OSError: if the disk is full.
    """
    s, agent, env, replay = run.s, run.agent, run.env, run.replay
    while not run.finished and not stop():
        if run.owed == 0:
            if run.over:
                replay.add(run.reset(), is_first=True)
            if run.step < s.prefill:
                action = run.rng.uniform(-1, 1, env.action_space.shape).astype(np.float32)
            else:
                last, policy = replay.last, agent.collector(run.episode)
                action, run.state = act(agent, policy, last["image"], last["action"], run.state)
                action = explore(action, s.action_noise, s.random_action, run.rng)
            image, reward, terminated, truncated, info = env.step(action)
            replay.add(image, action, reward, terminated)
            run.advance(bool(terminated or truncated), info)
        else:
            began, beta = time.monotonic(), beta_at(run.step, s)
            batch = to_tensors(replay.sample(s.batch_size, s.length, run.rng), agent.device)
            run.average(update(agent, batch, beta, s) | {"beta": beta})
            run.average({"update_seconds": time.monotonic() - began})
            run.owed -= 1
        if run.evaluation_due and run.owed == 0:
            run.report(evaluate(agent, run.eval_env, s.eval_episodes))
        run.save_if_due()
    run.save()


def passed(before: int, after: int, every: int) -> int:
    """How many multiples of `every` lie in (before, after]."""
    return after // every - before // every


def to_tensors(rows: np.ndarray, device: torch.device) -> dict[str, Tensor]:
    """Records of the replay as one tensor a field."""
    return {name: torch.from_numpy(rows[name]).to(device) for name in rows.dtype.names}


def beta_at(step: int, s: Settings) -> float:
    """Entropy coefficient β of Eq. (7), linear in environment steps over the run (§5)."""
    return s.beta_start + (s.beta_end - s.beta_start) * min(step / s.steps, 1.0)


@torch.no_grad()
def act(
    agent: Agent,
    policy: Callable[[Tensor], Tensor],
    image: np.ndarray,
    action: np.ndarray,
    state: Tensor | None,
) -> tuple[np.ndarray, Tensor]:
    """One decision from pixels: infer the state from the image and what came before it, then act.

    Args:
        policy: states (1, D) to actions (1, A).
        image: (64, 64, 3) uint8.
        action: (A,), the last one.
        state: (1, D), the last one; None at the first image that is looked at.

    Returns:
        the action (A,) and the state (1, D).
    """
    rows = np.array(image), np.array(action), np.array(state is None)  # B = T = 1
    rows = [torch.from_numpy(x)[None, None].to(agent.device) for x in rows]
    # In float32: to cast all weights costs more than one image's products in bfloat16 save.
    state = agent.model.observe(*rows, previous=state).state[:, 0]
    return policy(state)[0].cpu().numpy(), state


class Episode(NamedTuple):
    """An episode of L decisions, played without learning from it."""

    images: np.ndarray  # (L + 1, 64, 64, 3) uint8 o_0 … o_L
    actions: np.ndarray  # (L, A) a_0 … a_{L−1}
    rewards: np.ndarray  # (L,) r_1 … r_L
    states: Tensor  # (L, D) s_0 … s_{L−1}
    terminated: bool  # or cut off by a time limit
    total: float  # sum of rewards
    length: int  # environment steps


def play(agent: Agent, env: gym.Env, policy: Callable[[Tensor], Tensor], seed: int) -> Episode:
    """One episode of a policy. Training's random numbers stay as they were."""
    image, _ = env.reset(seed=seed)
    images, actions, states = [image], [np.zeros(env.action_space.shape, np.float32)], [None]
    rewards, over = [], False
    with torch.random.fork_rng():
        torch.manual_seed(seed)
        while not over:
            action, state = act(agent, policy, images[-1], actions[-1], states[-1])
            image, reward, terminated, truncated, info = env.step(action)
            over = terminated or truncated
            images.append(image), actions.append(action), states.append(state)
            rewards.append(reward)
    return Episode(
        np.array(images), np.array(actions[1:]), np.array(rewards), torch.cat(states[1:]),
        bool(terminated), info["episode"]["r"], info["episode"]["l"],
    )  # fmt: skip


def evaluate(agent: Agent, env: gym.Env, episodes: int) -> list[Episode]:
    """Episodes of the evaluated actor's mode, each with a seed of its own, always the same ones."""
    return [play(agent, env, agent.evaluated.mode, seed=2**31 + k) for k in range(episodes)]


@torch.no_grad()
def open_loop(agent: Agent, episode: Episode, frames: int, context: int = 5) -> np.ndarray:
    """What the model dreams when it sees `context` images and then only the actions taken.

    Training's random numbers stay as they were.

    Returns:
        (3, F, 64, 64, 3) uint8: truth, prediction (the first `context` are reconstructions), and
        their difference about grey; F is `frames`, or the episode's length if that is less.
    """
    frames = min(frames, len(episode.states))
    context = min(context, frames)
    actions = iter(torch.from_numpy(episode.actions[context - 1 :]).to(agent.device).split(1))
    with agent.autocast(), torch.random.fork_rng():
        torch.manual_seed(0)
        start = episode.states[context - 1 : context]
        dream = agent.model.imagine(start, lambda _: next(actions), frames - context)
        states = torch.cat([episode.states[:context], dream.state[1:, 0]])
        prediction = agent.model.decoder(agent.model.decoded(states))
    prediction = (255 * (prediction + 0.5)).clamp(0, 255).byte().cpu().numpy()
    truth = episode.images[:frames]
    difference = (128 + (prediction.astype(int) - truth) // 2).astype(np.uint8)
    return np.stack([truth, prediction, difference])


def interval95(returns: np.ndarray) -> float:
    """Half the width of the mean's 95% t-interval (§5); nan for a single return."""
    if len(returns) < 2:
        return float("nan")
    return float(stats.t.ppf(0.975, len(returns) - 1) * stats.sem(returns))


class Run:
    """All that a run is: environments, agent, replay, random states, counters, and its folder.

    The folder holds settings.json; metrics.csv, a row an evaluation; TensorBoard events of the same
    names; weights.pt at the end; the last two checkpoints; and replay.bin, to which each checkpoint
    appends the rows that are new. A checkpoint knows how long the two growing files were: what is
    longer is cut off when the run is resumed.
    """

    CHECKPOINTS = ("checkpoint.pt", "checkpoint.previous.pt")
    COUNTERS = (
        "step", "episode", "over", "owed", "evaluation_due", "seconds", "saved_rows",
        "metrics_bytes",
    )  # fmt: skip

    def __init__(self, s: Settings, folder: Path):
        self.s, self.folder = s, folder
        device = s.device
        if device == "auto":
            device = "cuda" if torch.cuda.is_available() else "cpu"
        device = torch.device(device)
        bfloat16 = has_bfloat16(device) if s.precision == "auto" else s.precision == "bfloat16"
        self.env, self.eval_env = (
            make_env(s.env, s.action_repeat, s.camera_distance) for _ in range(2)
        )
        actions = self.env.action_space.shape[0]
        torch.manual_seed(s.seed)
        self.rng = np.random.default_rng(s.seed)
        self.agent = Agent(s, actions, device, bfloat16)
        self.replay = Replay(s.replay_capacity, actions)
        self.state: Tensor | None = None  # (1, D), the agent's; None: it has not looked yet
        self.averages: dict[str, list[float]] = {}  # name: [sum, count] since the last evaluation
        self.visited: list[Tensor] = []  # the environment's own states since then
        self.step = 0  # environment steps made
        self.episode = 0  # episodes begun
        self.over = True  # whether the last of them has ended
        self.begun_at = 0  # step at which it began
        self.owed = 0  # updates still to be made before the next decision
        self.evaluation_due = False  # when they are made
        self.saved_rows = 0  # rows in replay.bin
        self.metrics_bytes = 0  # length of metrics.csv
        self.seconds, self.clock = 0.0, time.monotonic()  # taken until then; then
        self.bar = self.writer = None  # open while `train` runs

    def describe(self) -> str:
        """What runs where, for the terminal."""
        s, agent, rows = self.s, self.agent, self.replay.rows
        millions = sum(p.numel() for p in agent.parameters() if p.requires_grad) / 1e6
        precision = "bfloat16" if agent.bfloat16 else "float32"
        return (
            f"{s.env}, arm {s.arm}, preset {s.preset}, seed {s.seed}: {self.folder}\n"
            f"{millions:.1f} M parameters on {agent.device} in {precision}, "
            f"{torch.get_num_threads()} threads; "
            f"replay of {len(rows):,} rows, {rows.nbytes / 2**30:.2f} GiB when full"
        )

    def reset(self) -> np.ndarray:
        """Begin the next episode, with a seed of its own: its first image."""
        seed = np.random.SeedSequence((self.s.seed, self.episode)).generate_state(1)[0]
        self.episode += 1
        self.begun_at, self.state = self.step, None
        return self.env.reset(seed=int(seed))[0]

    @property
    def finished(self) -> bool:
        """Whether all environment steps are made, and the updates that they call for."""
        return self.step >= self.s.steps and self.owed == 0

    def advance(self, over: bool, info: dict) -> None:
        """Count a decision that was taken, and what it calls for: updates, an evaluation."""
        s, before, self.over = self.s, self.step, over
        self.visited.append(torch.from_numpy(info["state"]))
        self.step = self.begun_at + self.env.get_wrapper_attr("episode_lengths")
        if over:
            whole = info["episode"]
            self.average({"train_return": whole["r"], "train_length": whole["l"]})
        if self.step >= s.prefill:
            self.owed = s.updates * passed(before, self.step, s.train_every)
        last = self.step >= s.steps
        trained = self.owed > 0 or "update_seconds" in self.averages
        self.evaluation_due = trained and (last or passed(before, self.step, s.eval_every) > 0)
        self.bar.update(self.step - self.bar.n)

    def average(self, metrics: dict[str, float]) -> None:
        """Take metrics into the averages of the next row of metrics.csv."""
        for name, value in metrics.items():
            total = self.averages.setdefault(name, [0.0, 0])
            total[0] += float(value)
            total[1] += 1

    def elapsed(self) -> float:
        """Seconds that the run has taken, in all its processes."""
        return self.seconds + time.monotonic() - self.clock

    def report(self, episodes: list[Episode]) -> None:
        """Write a row of metrics.csv, the same and pictures for TensorBoard, and a line."""
        self.evaluation_due = False
        returns, lengths = (
            np.array([getattr(e, k) for e in episodes]) for k in ("total", "length")
        )
        row = {
            "env_steps": self.step,
            "wall_seconds": self.elapsed(),
            "eval_return": returns.mean(),
            "eval_interval95": interval95(returns),
            "eval_length": lengths.mean(),
            "eval_length_min": lengths.min(),
            "eval_length_max": lengths.max(),
            "coverage": coverage(torch.stack(self.visited).numpy()),
            "train_return": float("nan"),  # unless an episode ended
            "train_length": float("nan"),
        } | {name: total / count for name, (total, count) in self.averages.items()}
        self.averages.clear(), self.visited.clear()
        with open(self.folder / "metrics.csv", "a", newline="") as file:
            table = csv.DictWriter(file, row)
            if file.tell() == 0:
                table.writeheader()
            table.writerow({
                name: value if isinstance(value, int) else f"{value:.6g}"
                for name, value in row.items()
            })  # fmt: skip
            self.metrics_bytes = file.tell()
        for name, value in row.items():
            self.writer.add_scalar(name, value, self.step)
        whole = len(episodes[0].states)
        seen = open_loop(self.agent, episodes[0], whole, context=whole)
        dreamt = open_loop(self.agent, episodes[0], frames=25)
        self.add_picture("episode, reconstruction, difference", seen)
        self.add_picture("episode, dream from its first 5 images, difference", dreamt)
        self.writer.flush()
        result = f"return {returns.mean():.1f} ± {row['eval_interval95']:.1f}"
        self.bar.set_postfix_str(result)
        self.bar.write(
            f"{self.step:9,} environment steps, {row['wall_seconds'] / 60:5.1f} min: {result}, "
            f"{lengths.mean():.0f} steps an episode"
        )

    def add_picture(self, name: str, images: np.ndarray) -> None:
        """(R, F, 64, 64, 3) for TensorBoard: R rows of ten of the F images."""
        some = images[:, np.linspace(0, images.shape[1] - 1, 10).astype(int)]
        picture = np.concatenate([np.concatenate(list(row), axis=1) for row in some])
        self.writer.add_image(name, picture, self.step, dataformats="HWC")

    def save_if_due(self) -> None:
        """Write a checkpoint every `checkpoint_minutes`, and before the ring loses new rows."""
        waited = time.monotonic() - self.clock >= 60 * self.s.checkpoint_minutes
        unsaved = self.replay.added - self.saved_rows
        if waited or unsaved >= self.s.replay_capacity - 1:  # a turn of the loop adds up to two
            self.save()

    def save(self) -> None:
        """Write a checkpoint, whole or not at all; the one before it is kept.

        Raises:
            OSError: if it cannot be written, as on a full disk; the last one is then as it was.
        """
        added = self.replay.added
        self.seconds, self.clock = self.elapsed(), time.monotonic()
        with open(self.folder / "replay.bin", "ab") as file:
            file.truncate(self.saved_rows * self.replay.rows.itemsize)
            for part in self.replay.parts(self.saved_rows, added):
                file.write(part.view(np.uint8))
            file.flush()
            os.fsync(file.fileno())
        with open(self.folder / "metrics.csv", "ab") as file:
            os.fsync(file.fileno())
        self.saved_rows = added
        buffer = io.BytesIO()
        torch.save({
            "agent": self.agent.state_dict(),
            "optimisers": {name: o.state_dict() for name, o in self.agent.optimisers.items()},
            "counters": {name: getattr(self, name) for name in self.COUNTERS},
            "averages": self.averages,
            "visited": torch.stack(self.visited) if self.visited else torch.zeros(0),
            "state": self.state,
            "torch_random": torch.get_rng_state(),
            "cuda_random": torch.cuda.get_rng_state_all(),
            "numpy_random": json.dumps(self.rng.bit_generator.state),
        }, buffer)  # fmt: skip
        content = buffer.getvalue()
        newest, previous = (self.folder / name for name in self.CHECKPOINTS)
        write_whole(newest, hashlib.sha256(content).digest() + content, keep=previous)

    def save_weights(self) -> None:
        """Write weights.pt: the networks alone, for whoever wants to use them elsewhere."""
        weights = io.BytesIO()
        torch.save(self.agent.state_dict(), weights)
        write_whole(self.folder / "weights.pt", weights.getvalue())

    def load(self) -> None:
        """Go back to the newest whole checkpoint, or to the start if there was none yet.

        Raises:
            ValueError: in one sentence, if the folder is damaged, or the machine is another.
        """
        self.set_back(self.read_checkpoint(discard=True))
        metrics = self.folder / "metrics.csv"
        metrics.touch()
        if metrics.stat().st_size < self.metrics_bytes:
            raise ValueError(f"{metrics} has lost rows: start the run anew.")
        os.truncate(metrics, self.metrics_bytes)
        self.load_replay()

    def set_back(self, saved: dict | None) -> None:
        """Become what a checkpoint holds; None, from before the first, is what a new run is."""
        if saved is None:
            return
        self.agent.load_state_dict(saved["agent"])
        for name, optimiser in self.agent.optimisers.items():
            optimiser.load_state_dict(saved["optimisers"][name])
        for name in self.COUNTERS:
            setattr(self, name, saved["counters"][name])
        self.averages, self.state = saved["averages"], saved["state"]
        self.visited = list(saved["visited"].cpu())
        torch.set_rng_state(saved["torch_random"].cpu())
        torch.cuda.set_rng_state_all([state.cpu() for state in saved["cuda_random"]])
        self.rng.bit_generator.state = json.loads(saved["numpy_random"])

    def read_checkpoint(self, discard: bool = False) -> dict | None:
        """The newest whole checkpoint, None before the first. Nothing in it is executed.

        Args:
            discard: remove a damaged one that is newer, lest it take the whole one's place.

        Raises:
            ValueError: in one sentence, if none is whole.
        """
        paths = [self.folder / name for name in self.CHECKPOINTS]
        paths = [path for path in paths if path.exists()]
        for k, path in enumerate(paths):
            content = path.read_bytes()
            digest, content = content[:32], content[32:]
            if hashlib.sha256(content).digest() == digest:
                for damaged in paths[:k] if discard else []:
                    damaged.unlink()
                return torch.load(
                    io.BytesIO(content), map_location=self.agent.device, weights_only=True
                )
            print(f"{path} is damaged; looking for the one before it.", file=sys.stderr)
        if paths:
            raise ValueError(f"{self.folder} holds no whole checkpoint: start the run anew.")
        return None

    def load_replay(self) -> None:
        """The replay from its file, and the episode under way by taking its actions again.

        Raises:
            ValueError: in one sentence, if the file is too short.
        """
        replay, added = self.replay, self.saved_rows
        path, itemsize = self.folder / "replay.bin", replay.rows.itemsize
        if added == 0:
            return
        if not path.exists() or path.stat().st_size < added * itemsize:
            raise ValueError(f"{path} is shorter than its checkpoint says: start the run anew.")
        kept = max(0, added - len(replay.rows))
        with open(path, "rb") as file:
            file.seek(kept * itemsize)
            for part in replay.parts(kept, added):
                file.readinto(part.view(np.uint8))
        replay.added = added
        if self.over:
            return
        stored = np.memmap(path, replay.rows.dtype, "r", shape=added)
        first = np.flatnonzero(stored["is_first"])[-1]
        state, self.episode = self.state, self.episode - 1
        image = self.reset()
        for action in np.array(stored["action"][first + 1 :]):
            image = self.env.step(action)[0]
        self.state, self.begun_at = state, self.step - self.env.get_wrapper_attr("episode_lengths")
        if not np.array_equal(image, replay.last["image"]):
            print(
                f"{self.s.env} does not repeat itself: the episode under way ends here, and the "
                "run goes on otherwise than it would have.",
                file=sys.stderr,
            )
            self.over = True


def write_whole(path: Path, content: bytes, keep: Path | None = None) -> None:
    """Write a file whole or not at all: aside, onto the disk, then in its place.

    What stood in its place is kept as `keep`, if that is given.

    Raises:
        OSError: if it cannot be written.
    """
    aside = path.with_suffix(".writing")
    with open(aside, "wb") as file:
        file.write(content)
        file.flush()
        os.fsync(file.fileno())
    if keep and path.exists():
        path.replace(keep)
    aside.replace(path)


def has_bfloat16(device: torch.device) -> bool:
    """Whether bfloat16 matrix products are in the hardware; emulated, they are slow."""
    if device.type == "cuda":
        return torch.cuda.is_bf16_supported(including_emulation=False)
    capabilities = torch.cpu.get_capabilities()
    return any(capabilities.get(name, False) for name in ("avx512_bf16", "amx_bf16", "bf16"))


@dataclass(frozen=True)
class Command:
    """MaxEnt Dreamer learns to act from 64×64 pixels, in a world that it imagines.

    Values shown are those of the arm and preset on this command line.
    """

    settings: tyro.conf.OmitArgPrefixes[Settings]
    resume: str | None = None  # folder of a run to go on with, by its own settings
    evaluate: str | None = None  # folder of a run, whose newest checkpoint to evaluate
    episodes: int = 10  # to evaluate
    video: bool = False  # with --evaluate: an animated GIF of the best episode beside its dream


def parse(arguments: list[str]) -> Command:
    """The command line. Arm and preset set the defaults that the other options change.

    Raises:
        ValueError: in one sentence, if it cannot be understood.
    """
    first = argparse.ArgumentParser(add_help=False, allow_abbrev=False)
    first.add_argument("--arm", nargs="?", default="maxent")
    first.add_argument("--preset", nargs="?", default="small")
    chosen = first.parse_known_args(arguments)[0]
    for name, value, known in (("arm", chosen.arm, ARMS), ("preset", chosen.preset, PRESETS)):
        if value is None:
            raise ValueError(f"--{name} lacks its value: choose one of {', '.join(known)}.")
        if value not in known:
            raise ValueError(f"There is no {name} {value!r}: choose one of {', '.join(known)}.")
    default = Command(default_settings(chosen.arm, chosen.preset))
    complaint = io.StringIO()
    try:
        with contextlib.redirect_stderr(complaint):
            return tyro.cli(Command, args=arguments, default=default)
    except SystemExit as error:
        if not error.code:  # --help
            raise
        # tyro draws a box: what is wrong, a rule, "Perhaps you meant:" with options, more rules
        lines = [line.strip("│ ") for line in complaint.getvalue().splitlines()[1:]]
        wrong = " ".join(itertools.takewhile(lambda line: line.strip("─"), lines))
        meant = [b for a, b in itertools.pairwise(lines) if a.startswith("Perhaps you meant")]
        hint = f"perhaps you meant {meant[0]}?" if meant else "see --help."
        raise ValueError(f"{wrong.rstrip('.')}: {hint}") from None


def check(s: Settings) -> None:
    """Refuse settings that cannot work.

    Raises:
        ValueError: in one sentence, what is wrong and what to do.
    """
    shares = ("gamma", "lam", "gamma_q", "random_action", "target_rate")
    for field in dataclasses.fields(s):
        value, option = getattr(s, field.name), f"--{field.name.replace('_', '-')}"
        least = 0 if field.name in ("seed", "prefill") else 1
        if type(value) is int and not least <= value < 2**63:
            raise ValueError(f"{option} is {value}: give a whole number of {least} or more.")
        if type(value) is float and not 0 <= value < float("inf"):
            raise ValueError(f"{option} is {value}: give a number of 0 or more.")
        if field.name in shares and value > 1:
            raise ValueError(f"{option} is {value}: give a number from 0 to 1.")
    rows = s.prefill // s.action_repeat
    if s.length > rows:
        raise ValueError(
            f"--length {s.length} is longer than the {rows} rows that --prefill {s.prefill} "
            "collects: lower the one or raise the other."
        )
    if s.length > s.replay_capacity or s.replay_capacity < 2:
        raise ValueError(f"--replay-capacity {s.replay_capacity} holds no --length {s.length}.")
    if s.steps < s.prefill + s.train_every:
        raise ValueError(
            f"--steps {s.steps} leaves nothing to train after --prefill {s.prefill}: raise it to "
            f"{s.prefill + s.train_every} or more."
        )
    if s.eval_every < s.train_every:
        raise ValueError(f"--eval-every {s.eval_every} is less than --train-every {s.train_every}.")
    if s.device not in ("auto", "cpu", "cuda"):
        raise ValueError(f"There is no --device {s.device}: choose one of auto, cpu, cuda.")
    if s.device == "cuda" and not torch.cuda.is_available():
        raise ValueError("--device cuda: no CUDA device is there; leave it out to use the CPU.")


def new_run(s: Settings) -> Run:
    """A new run, in a folder of its own.

    Raises:
        ValueError: in one sentence, what is wrong with the settings.
    """
    check(s)
    now = time.strftime("%Y%m%d-%H%M%S")
    folder = Path(s.run_dir or f"runs/{s.env}-{s.arm}-{s.preset}-seed{s.seed}-{now}")
    if folder.exists() and (not folder.is_dir() or any(folder.iterdir())):
        raise ValueError(f"{folder} is there already: name another --run-dir, or --resume it.")
    run = Run(s, folder)
    folder.mkdir(parents=True, exist_ok=True)
    settings = json.dumps(dataclasses.asdict(s), indent=2) + "\n"
    write_whole(folder / "settings.json", settings.encode())
    return run


def read_settings(folder: Path) -> Settings:
    """The settings of a run folder.

    Raises:
        ValueError: in one sentence, if it holds none, or those of another version of this program.
    """
    path = folder / "settings.json"
    if not path.exists():
        raise ValueError(f"{folder} holds no run: there is no settings.json in it.")
    try:
        saved = dict(json.loads(path.read_text()))
    except (ValueError, TypeError) as error:
        raise ValueError(f"{path} cannot be read: {error}.") from error
    differing = saved.keys() ^ {field.name for field in dataclasses.fields(Settings)}
    if differing:
        names = ", ".join(sorted(differing))
        raise ValueError(f"{folder} was made by a version with other settings: {names}.")
    check(settings := Settings(**saved))
    return settings


def keep_freed_memory() -> None:
    """Let glibc keep the memory that tensors free: the next update asks for as much again, and
    the system would clear each page anew (measured: a fifth of the paper preset's update)."""
    with contextlib.suppress(OSError, AttributeError):  # another C library has no mallopt
        trim_threshold, top_pad, mmap_max = -1, -2, -4  # malloc.h
        libc = ctypes.CDLL(None)
        libc.mallopt(mmap_max, 0)
        libc.mallopt(trim_threshold, 2**31 - 1)
        libc.mallopt(top_pad, 64 * 2**20)


def main(arguments: list[str]) -> int:
    """Runs a command line. Returns the exit code: 0 done, 1 stopped by a fault, 2 bad input."""
    keep_freed_memory()
    try:
        command = parse(arguments)
        own = command.resume is not None or command.evaluate is not None
        if own and command.settings != default_settings():
            raise ValueError("--resume and --evaluate go by the run's settings: give no others.")
        if command.resume is not None and command.evaluate is not None:
            raise ValueError("Give --resume or --evaluate, not both.")
        if command.evaluate is not None:
            evaluate_run(Path(command.evaluate), command.episodes, command.video)
            return 0
        if command.video or command.episodes != 10:
            raise ValueError("--video and --episodes go with --evaluate.")
        if command.resume is not None:
            folder = Path(command.resume)
            run = Run(read_settings(folder), folder)
            run.load()
        else:
            run = new_run(command.settings)
    except (ValueError, OSError, MemoryError) as error:
        print(error, file=sys.stderr)
        return 2
    except RuntimeError as error:  # torch's, for sizes that no memory holds or weights that differ
        print(f"The networks cannot be made: {str(error).splitlines()[0]}", file=sys.stderr)
        return 2
    print(run.describe(), flush=True)
    return train_run(run)


def evaluate_run(folder: Path, episodes: int, video: bool) -> None:
    """Plays the newest checkpoint of a run and prints what it earned.

    Raises:
        ValueError: in one sentence, if there is nothing to play.
    """
    if episodes < 1:
        raise ValueError(f"--episodes is {episodes}: give 1 or more.")
    run = Run(read_settings(folder), folder)
    if not (saved := run.read_checkpoint()):
        raise ValueError(f"{folder} holds no checkpoint yet: there is nothing to play.")
    run.set_back(saved)
    played = evaluate(run.agent, run.eval_env, episodes)
    returns, lengths = np.array([e.total for e in played]), np.array([e.length for e in played])
    print(
        f"{run.s.env}, arm {run.s.arm}, after {run.step:,} environment steps: "
        f"return {returns.mean():.1f} ± {interval95(returns):.1f} (95% interval of {episodes} "
        f"episodes), {lengths.min()} to {lengths.max()} steps long, {lengths.mean():.0f} on average"
    )
    if video:
        best = played[returns.argmax()]
        frames = np.concatenate(open_loop(run.agent, best, frames=150), axis=2)  # side by side
        pictures = [Image.fromarray(frame).resize((384, 128)) for frame in frames]
        pictures = [x.quantize(64, dither=Image.Dither.NONE) for x in pictures]  # a third as large
        path = folder / f"episode-{run.step}.gif"
        duration = 1000 * run.s.action_repeat / 60  # milliseconds: PyBullet renders 60 a second
        pictures[0].save(path, save_all=True, append_images=pictures[1:], duration=duration, loop=0)
        print(f"{path}: truth, dream from its first 5 images and the actions taken, difference")


def leave_out_os_errors(thrown: threading.ExceptHookArgs) -> None:
    """No traceback of TensorBoard's thread on a full disk: its error comes back in ours."""
    if not isinstance(thrown.exc_value, OSError):
        threading.__excepthook__(thrown)


def train_run(run: Run) -> int:
    """Trains to the end, to Ctrl-C or to a fault, and says what to do next: the exit code."""
    interrupted = threading.Event()

    def interrupt(*_) -> None:
        run.bar.write("Finishing what is under way, then saving; Ctrl-C again to stop at once.")
        interrupted.set()
        signal.signal(signal.SIGINT, signal.default_int_handler)

    resume = f"Go on with: python train.py --resume {run.folder}"
    every = 0.5 if sys.stderr.isatty() else 30  # seconds between two lines of a log file
    try:
        with (
            tqdm(total=run.s.steps, initial=run.step, unit="step", mininterval=every) as run.bar,
            SummaryWriter(run.folder, purge_step=run.step + 1) as run.writer,
        ):
            signal.signal(signal.SIGINT, interrupt)
            threading.excepthook = leave_out_os_errors
            try:
                train(run, interrupted.is_set)
                if run.finished:
                    run.save_weights()
            except FloatingPointError as error:
                run.save()
                print(
                    f"{error} What was learned before is saved in {run.folder}; "
                    "try a lower --model-lr, --actor-lr or --critic-lr, or --precision float32.",
                    file=sys.stderr,
                )
                return 1
    except OSError as error:
        print(f"{error}: stopped; what was saved before is whole. {resume}", file=sys.stderr)
        return 1
    print(f"Done: {run.folder / 'metrics.csv'}" if run.finished else f"Interrupted. {resume}")
    return 0


if __name__ == "__main__":
    try:
        sys.exit(main(sys.argv[1:]))
    except KeyboardInterrupt:
        sys.exit("Stopped at once; what the last checkpoint holds can be resumed.")
