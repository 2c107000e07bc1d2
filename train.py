"""Trains MaxEnt Dreamer: settings, one update, the one explicit loop, and what a run needs.

    python train.py --env HopperBulletEnv-v0

`update` is the paper's algorithm and `train` its loop; what they call follows in the order in which
they call it. No other file reads settings, holds an optimiser or knows a run's folder.
"""

import contextlib
import csv
import ctypes
import dataclasses
import io
import json
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
import zipfile
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Literal

import filelock
import numpy as np
import torch
import tyro
from annotated_types import Interval
from pydantic import TypeAdapter, ValidationError
from scipy import stats
from torch import Tensor, nn
from torch.utils.tensorboard import SummaryWriter
from tqdm import tqdm

import actors
from actors import Episode, act, actor_loss, critic_loss, explore, imagined_returns, nudge, play
from env import EnvironmentFault, Replay, coverage, make_env
from mdn import MixtureDensityNetwork, entropy, mdn_loss, particle_entropy, soft_update
from world_model import WorldModel

Arm = Literal["dreamer", "dreamer-maxent", "revised", "maxent"]
Preset = Literal["small", "paper"]
Collect = Literal["explorer", "both"]
Size = Annotated[int, Interval(ge=1, le=10_000)]  # of a layer, batch or sequence
Count = Annotated[int, Interval(ge=1, le=10**9)]  # of steps or rows
Whole = Annotated[int, Interval(ge=0, lt=2**63)]
Share = Annotated[float, Interval(ge=0, le=1)]
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
    train_every: Count = 10  # environment steps between two rounds of updates (Dreamer: 1000)
    updates: Size = 1  # gradient updates a round (Dreamer: 100)
    eval_every: Count = 5_000  # environment steps between evaluations, once training began (ours)
    eval_episodes: Size = 10  # episodes an evaluation (§5: 10)
    eval_max_steps: Count = 10_000  # environment steps after which one of them is ended (ours)
    checkpoint_minutes: Amount = 5.0  # between two checkpoints (ours)
    replay_capacity: Count = 500_000  # rows (decisions) of experience kept (ours)
    action_repeat: Size = 2  # environment steps a decision (Dreamer)
    camera_distance: Amount = 1.7  # metres to a PyBullet robot; 3 is the environment's own (ours)
    floor_brightness: Share = 1.0  # factor on a PyBullet floor's texture; 1 is its own (ours)

    termination: bool = True  # §4.2: learn when episodes end, and let returns end there
    observe_first: bool = True  # §4.2: see o_0 before choosing a_0 (Dreamer's code does too)
    fixed_prior: bool = True  # §4.2: KL to N(0, 1) and Jeffreys to the prior, not KL to the prior
    q_critic: bool = True  # §4.2 minor 1: the critic is Q(s, a), not V(s)
    smooth_l1: bool = True  # §4.2 minor 2: Smooth L1 for reward and critic, not squared error
    squared_reward: bool = False  # ½(r − r')² for rewards, whatever smooth_l1 says: a mean (ours)
    decode_stoch_only: bool = True  # §4.2 minor 3: the decoder sees z, not (h, z)
    first_state_only: bool = True  # §4.2: actors maximise the first imagined state's return alone
    entropy: bool = True  # §4.1: the stochastic actor also maximises β × entropy of future states
    deterministic_actor: bool = True  # §4.1: train a deterministic actor too, and evaluate it
    action_noise: Amount = 0.0  # std of noise added to collected actions (Dreamer: 0.3)
    random_action: Share = 0.1  # §4.2 minor 4: probability of a random action (its value ours)
    collect: Collect = "both"  # who collects: the explorer alone, or both actors in turn (ours)

    deter: Size = 200  # size of h (Dreamer: 200)
    stoch: Size = 128  # size of z (§5: 128; Dreamer: 30)
    hidden: Size = 200  # units of the RSSM's dense layers (Dreamer: 200)
    units: Size = 400  # of reward, termination, actor and critic layers (Dreamer: 400)
    depth: Size = 32  # channels of the first convolution (Dreamer: 32)
    batch_size: Size = 50  # sequences a batch (Dreamer: 50)
    length: Annotated[Size, Interval(ge=2)] = 50  # rows a sequence (Dreamer: 50)
    horizon: Size = 15  # imagined steps, and n of Eq. (10) (Dreamer)
    starts: Share = 1.0  # of a batch's live states, those that actors dream on from (Dreamer: all)

    gamma: Share = 0.99  # γ of λ-returns, a decision (Dreamer)
    lam: Share = 0.95  # λ of λ-returns (Dreamer)
    gamma_q: Share = 0.9  # γ of the discounted state distribution (§5)
    beta_start: Amount = 0.2  # entropy coefficient β at the first environment step (§5)
    beta_end: Amount = 0.0001  # and at the last, linear between (§5)
    beta_share: bool = False  # β is the norm of ∇Ĥ's part against ∇R's, not a factor on Ĥ (ours)
    density: Literal["mdn", "knn"] = "mdn"  # whose entropy: §4.1's MDN, or of neighbours' distances
    mdn_components: Size = 8  # components of the mixture density network (§5: heads)
    mdn_units: Size = 256  # its hidden units (§5: 256)
    mdn_min_std: Amount = 0.1  # floor under its σ (ours)
    target_rate: Share = 0.1  # soft update of the target MDN (§5)
    first_action_noise: Amount = 0.1  # on the deterministic actor's first imagined action (ours)
    detach_policy: bool = True  # no gradient through what the policy sees in its dream (Dreamer)
    action_penalty: Amount = 0.0  # on actions squared before their tanh, lest it saturate (ours)
    model_lr: Amount = 6e-4  # Adam's learning rate of the world model (Dreamer)
    actor_lr: Amount = 8e-5  # of each actor (Dreamer)
    critic_lr: Amount = 8e-5  # of each critic (Dreamer)
    mdn_lr: Amount = 2e-4  # of the mixture density network (§5)
    grad_clip: Amount = 100.0  # largest global gradient norm of an optimiser step (Dreamer)
    free_nats: Amount = 3.0  # KL below this costs nothing; of `kl` only (Dreamer)
    image_weight: Amount = 1.0  # weight of the image's loss (Dreamer)
    reward_weight: Amount = 1.0  # of the reward's loss (Dreamer)
    termination_weight: Amount = 10.0  # of the termination's loss (Dreamer)
    kl_weight: Amount = 1.0  # of `kl`, the original Dreamer's divergence (Dreamer)
    kl_standard_weight: Amount = 0.1  # of KL(posterior || N(0, 1)) (§5)
    jeffreys_weight: Amount = 0.1  # of D_J(posterior || prior) (§5)

    def to_json(self) -> str:
        """As a text, for settings.json."""
        return json.dumps(dataclasses.asdict(self), indent=2) + "\n"


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
PRESETS = {
    "small": dict(  # sizes and cadence for two CPU cores, and what results/trials.md found to help
        deter=128, stoch=64, hidden=128, units=128, depth=16, batch_size=20, length=25,
        mdn_units=128, prefill=2000, starts=0.5, floor_brightness=0.4, reward_weight=20.0,
        squared_reward=True, action_penalty=0.01, beta_share=True,
    ),
    "paper": dict(steps=1_000_000, train_every=1000, updates=100),
}
# fmt: on


def default_settings(arm: Arm = "maxent", preset: Preset = "small") -> Settings:
    """The settings of one arm at one size, before any switch of the user's."""
    return Settings(arm=arm, preset=preset, **(PRESETS[preset] | ARMS[arm]))


def update(
    agent: "Agent", batch: dict[str, Tensor], beta: float, s: Settings, look: bool = False
) -> dict[str, float]:
    """One gradient update of the world model, then of each actor with its critic, and of the MDN.

    Args:
        batch: as `WorldModel.loss` takes it.
        beta: entropy coefficient β of Eq. (7).
        look: also `measure_gradients`, which takes two backward passes more.

    Returns:
        named metrics; the world model's are the unweighted terms of its loss.
    """
    weights = {
        "image": s.image_weight, "reward": s.reward_weight, "termination": s.termination_weight,
        "kl": s.kl_weight, "kl_standard": s.kl_standard_weight, "jeffreys": s.jeffreys_weight,
    }  # fmt: skip
    with agent.autocast():
        terms, states = agent.model.loss(batch)
        loss = sum(weights[name] * term for name, term in terms.items())
    metrics = {f"model/{name}": term for name, term in terms.items()}
    metrics["reward_r2"] = reward_r2(agent, states, batch)
    agent.step("model", loss, metrics)
    starts = states[~batch["terminated"]].detach()  # (N, D): where it is over nothing follows
    if s.starts < 1:
        starts = starts[torch.randperm(len(starts))[: max(1, round(s.starts * len(starts)))]]
    for name in agent.actors:
        update_actor(agent, name, starts, beta, s, metrics, look)
    return {name: value.item() for name, value in metrics.items()}


@torch.no_grad()
def reward_r2(agent: "Agent", states: Tensor, batch: dict[str, Tensor]) -> Tensor:
    """The share of the variance of a batch's rewards that its states (B, T, D) predict."""
    arrived = ~batch["is_first"]
    reward = batch["reward"][arrived]
    error = agent.model.predict_reward(states[arrived]) - reward
    return 1 - error.square().mean() / reward.var(correction=0).clamp(min=1e-6)


def update_actor(
    agent: "Agent", name: str, starts: Tensor, beta: float, s: Settings,
    metrics: dict[str, Tensor], look: bool,
) -> None:  # fmt: skip
    """An actor dreams on from starts (N, D), learns from its dream, and so do its critic and the
    MDN: Eq. (7) for the stochastic actor, R_0 alone for the deterministic one."""
    actor, critic = agent.actors[name], agent.critics[name]
    explores = name == "stochastic" and s.entropy
    policy = (lambda state: actor(state.detach())) if s.detach_policy else actor
    with agent.autocast():
        first = actor(starts)
        if name == "deterministic":
            first = nudge(first, s.first_action_noise)
        dream = agent.model.imagine(starts, policy, s.horizon, first)
        returns = imagined_returns(dream, critic, s.gamma, s.lam)
        terms = {"return": actor_loss(returns, dream.continues, s.first_state_only)}
        if explores:
            if s.density == "knn":  # on z alone: h has no scale of its own
                bonus = particle_entropy(dream.state[..., s.deter :], dream.continues, s.gamma_q)
            else:
                bonus = entropy(agent.target_mdn, dream.state, dream.continues, s.gamma_q)
            bonus = bonus.mean()
            metrics["mdn/entropy"] = bonus
            terms["entropy"] = -bonus
        if look and explores:
            measure_gradients(agent, actor, terms, beta, metrics)
        loss = terms["return"] + s.action_penalty * actor.raw(starts).square().sum(-1).mean()
        if explores:
            loss = loss + beta * agent.entropy_scale * terms["entropy"]
    metrics[f"{name}_actor/return"] = returns[0].mean()
    metrics[f"{name}_actor/saturated"] = (dream.action.abs() > 0.99).float().mean()
    metrics[f"{name}_actor/deviation"] = actor.mode(starts).detach().std(0).mean()  # over states
    agent.step(f"{name}_actor", loss, metrics)

    with agent.autocast():
        loss = critic_loss(critic, dream, returns, s.smooth_l1)
    metrics[f"{name}_critic/loss"] = loss
    agent.step(f"{name}_critic", loss, metrics)
    if explores and s.density == "mdn":
        with agent.autocast():
            loss = mdn_loss(agent.mdn, dream.state, dream.continues, s.gamma_q).mean()
        metrics["mdn/nll"] = loss
        agent.step("mdn", loss, metrics)
        soft_update(agent.target_mdn, agent.mdn, s.target_rate)


def measure_gradients(
    agent: "Agent", actor: nn.Module, terms: dict[str, Tensor], beta: float, metrics: dict
) -> None:
    """The norms of the gradients of both terms of Eq. (7) apart, and their averages: `beta_share`
    needs them, since the β of §5 is for one size of state and one robot's rewards."""
    norms = {}
    for name, term in terms.items():
        gradients = torch.autograd.grad(term, list(actor.parameters()), retain_graph=True)
        norms[name] = nn.utils.get_total_norm(gradients)
    average, now = agent.gradient_norms, torch.stack([norms["return"], norms["entropy"]])
    average.lerp_(now, 0.1 if average.any() else 1.0)
    metrics["stochastic_actor/return_grad_norm"] = norms["return"]
    metrics["stochastic_actor/entropy_grad_norm"] = beta * agent.entropy_scale * norms["entropy"]


def train(run: "Run", stop: Callable[[], bool]) -> None:
    """The algorithm: learn, evaluate, act, until all steps are made or `stop` says so.

    What is due follows from what was done, so that a run goes on from any checkpoint as if it had
    never stopped.

    Raises:
        FloatingPointError: if a loss or gradient is not finite.
        EnvironmentFault: if the environment fails.
        OSError: if the disk is full.
    """
    s, agent, env, replay = run.s, run.agent, run.env, run.replay
    while not stop():
        if run.updates < updates_due(run.step, s):
            rows = replay.sample(s.batch_size, s.length, run.rng)
            batch, beta = to_tensors(rows, agent.device), beta_at(run.step, s)
            began = time.monotonic()
            metrics = update(agent, batch, beta, s, look=run.updates % 50 == 0)
            metrics |= {"beta": beta, "update_seconds": time.monotonic() - began}
            run.note_update(metrics)
        elif run.evaluation_due():
            run.report(evaluate(agent, run.eval_env, s, run.bar.set_postfix_str))
        elif run.step < s.steps:
            if run.over:
                replay.add(run.begin_episode(), is_first=True)
            if run.step < s.prefill:
                action = run.rng.uniform(-1, 1, env.action_space.shape).astype(np.float32)
            else:
                last, policy = replay.last, agent.collector(run.episode)
                action, run.state = act(agent, policy, last["image"], last["action"], run.state)
                action = explore(action, s.action_noise, s.random_action, run.rng)
            image, reward, terminated, truncated, info = env.step(action)
            replay.add(image, action, reward, terminated)
            run.note_decision(action, terminated or truncated, info)
        else:
            write_whole(run.folder / "weights.pt", agent.state_dict())
            break
        run.save_if_due()
    run.save()


def updates_due(step: int, s: Settings) -> int:
    """Updates that belong before the decision at an environment step: `updates` of them at each
    multiple of `train_every` from `prefill` on."""
    return s.updates * max(0, passed(s.prefill - 1, step, s.train_every))


def passed(before: int, after: int, every: int) -> int:
    """How many multiples of `every` lie in (before, after]."""
    return after // every - before // every


def to_tensors(rows: np.ndarray, device: torch.device) -> dict[str, Tensor]:
    """Records of the replay as one tensor a field."""
    return {name: torch.from_numpy(rows[name]).to(device) for name in rows.dtype.names}


def beta_at(step: int, s: Settings) -> float:
    """Entropy coefficient β of Eq. (7), linear in environment steps over the run (§5)."""
    return s.beta_start + (s.beta_end - s.beta_start) * min(step / s.steps, 1.0)


def evaluate(agent: "Agent", env, s: Settings, show=lambda text: None) -> list[Episode]:
    """What episodes of the evaluated actor's mode earned and how long they were; each has a seed of
    its own, always the same ones. One in which the environment fails is left out."""
    episodes = []
    for k in range(s.eval_episodes):
        show(f"evaluating, episode {k + 1} of {s.eval_episodes}")
        seed = 2**31 - 1 - k  # some environments take none that is larger
        try:
            episode = play(agent, env, agent.evaluated.mode, seed, s.eval_max_steps)
        except EnvironmentFault as error:  # what only measures never stops a run
            say(f"An evaluation's episode is left out: {error}")
            continue
        episodes.append(episode._replace(images=None, actions=None, rewards=None, states=None))
    return episodes


def interval95(returns: np.ndarray) -> float:
    """Half the width of the mean's 95% t-interval (§5); nan for a single return."""
    if len(returns) < 2:
        return float("nan")
    return float(stats.t.ppf(0.975, len(returns) - 1) * stats.sem(returns))


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
            termination=s.termination, fixed_prior=s.fixed_prior,
            smooth_l1=s.smooth_l1 and not s.squared_reward,
            decode_stoch_only=s.decode_stoch_only, observe_first=s.observe_first,
            free_nats=s.free_nats,
        )  # fmt: skip
        size = self.model.size
        self.actors = nn.ModuleDict({"stochastic": actors.StochasticActor(size, actions, s.units)})
        if s.deterministic_actor:
            self.actors["deterministic"] = actors.DeterministicActor(size, actions, s.units)
        self.critics = nn.ModuleDict()
        learners = {"model": (self.model, s.model_lr)}
        for name, actor in self.actors.items():
            critic = (
                actors.QCritic(size, actions, s.units)
                if s.q_critic
                else actors.VCritic(size, s.units)
            )
            self.critics[name] = critic
            learners[f"{name}_actor"] = actor, s.actor_lr
            learners[f"{name}_critic"] = critic, s.critic_lr
        if s.entropy and s.density == "mdn":
            sizes = size, s.mdn_components, s.mdn_units, s.mdn_min_std
            self.mdn, self.target_mdn = (MixtureDensityNetwork(*sizes) for _ in range(2))
            self.target_mdn.load_state_dict(self.mdn.state_dict())
            self.target_mdn.requires_grad_(False)
            learners["mdn"] = self.mdn, s.mdn_lr
        if s.entropy:
            self.register_buffer("gradient_norms", torch.zeros(2))  # of ∇R and ∇Ĥ, averaged
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

    @property
    def entropy_scale(self) -> Tensor | float:
        """The factor on Ĥ beside β: 1 (§4.1), or what gives ∇Ĥ the norm of ∇R (`beta_share`)."""
        of_return, of_entropy = self.gradient_norms
        return of_return / of_entropy.clamp(min=1e-9) if self.s.beta_share else 1.0

    @property
    def precision(self) -> str:
        """Of forward passes."""
        return "bfloat16" if self.bfloat16 else "float32"

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


class Run:
    """All that a run is: environments, agent, replay, random states, counters, and its folder.

    The folder holds settings.json; metrics.csv, a row an evaluation; TensorBoard's events; best.pt
    and, at the end, weights.pt, the networks alone; replay.bin; and the last two checkpoints:
    networks, optimisers, random states, what KEPT names, and the checksums of the replay's rows.
    """

    KEPT = (
        "step", "updates", "episode", "length", "over", "state", "actions", "visited", "averages",
        "evaluated_at", "best", "seconds", "saved_rows", "metrics_bytes", "machine",
    )  # fmt: skip

    def __init__(self, s: Settings, folder: Path, device: str = "auto", precision: str = "auto"):
        self.s, self.folder = s, folder
        self.env, self.eval_env = (
            make_env(s.env, s.action_repeat, s.camera_distance, s.floor_brightness)
            for _ in range(2)
        )
        torch.manual_seed(s.seed)
        self.rng = np.random.default_rng(s.seed)
        self.agent = make_agent(s, self.env, device, precision)
        self.step = self.updates = self.episode = 0  # made; made; begun
        self.over, self.length = True, 0  # whether the last episode ended; its environment steps
        self.state: Tensor | None = None  # (1, D), the agent's; None: it has not looked yet
        self.actions: list[list[float]] = []  # of the episode under way
        self.visited: list[list[float]] = []  # the environment's own, since the last evaluation
        self.averages: dict[str, list[float]] = {}  # name: [sum, count] since then
        self.evaluated_at, self.best = 0, -float("inf")  # step of the last one; best mean return
        self.saved_rows = self.metrics_bytes = 0  # of replay.bin and metrics.csv, when last saved
        self.seconds, self.clock = 0.0, time.monotonic()  # taken until then; then
        self.machine = f"{self.agent.device}, {self.agent.precision}, "
        self.machine += f"{torch.get_num_threads()} threads, torch {torch.__version__}"
        self.bar = self.writer = None  # open while `train` runs

    def open(self) -> None:
        """Take the folder for this process alone, and its replay.

        Raises:
            ValueError: in one sentence, if another process has it.
        """
        self.lock, owner = filelock.FileLock(self.folder / "run.lock"), self.folder / "run.owner"
        try:
            self.lock.acquire(blocking=False)
        except filelock.Timeout:
            who = f"process {owner.read_text()}" if owner.exists() else "another process"
            raise ValueError(f"{self.folder} is in use by {who}: stop it or wait for it.") from None
        # A checkpoint needs its window of the ring whole until two more are written.
        capacity, self.unsaved = self.s.replay_capacity, min(500, self.s.replay_capacity)
        actions, file = self.env.action_space.shape[0], self.folder / "replay.bin"
        self.replay = Replay(capacity, actions, file, reserve=3 * self.unsaved)

    def describe(self) -> str:
        """What runs where, for the terminal."""
        s, row = self.s, self.replay.rows.itemsize
        millions = sum(p.numel() for p in self.agent.parameters() if p.requires_grad) / 1e6
        rows = min(s.replay_capacity, s.steps // s.action_repeat)
        return (
            f"{s.env}, arm {s.arm}, preset {s.preset}, seed {s.seed}, from step {self.step:,}: "
            f"{self.folder}\n"
            f"{millions:.1f} M parameters; {self.machine}; the replay will take "
            f"{rows * row / 1e9:.1f} GB of disk"
        )

    def sign(self) -> None:
        """Say in the folder what its experiment is, and which process goes on with it."""
        write_whole(self.folder / "run.owner", f"{os.getpid()} on {socket.gethostname()}".encode())
        write_whole(self.folder / "settings.json", self.s.to_json().encode())

    def begin_episode(self) -> np.ndarray:
        """Reset to the next episode, with a seed of its own: its first image."""
        seed = np.random.SeedSequence((self.s.seed, self.episode)).generate_state(1)[0] % 2**31
        self.episode, self.over, self.length = self.episode + 1, False, 0
        self.state, self.actions = None, []
        return self.env.reset(seed=int(seed))[0]

    def note_decision(self, action: np.ndarray, over: bool, info: dict) -> None:
        """Count a decision that was taken."""
        before, self.length = self.length, int(self.env.get_wrapper_attr("episode_lengths"))
        self.step, self.over = self.step + self.length - before, over
        self.actions.append(action.tolist())  # of numbers: 50,000 tensors take seconds to save
        self.visited.append(info["state"].tolist())
        if over:
            whole = info["episode"]
            self.average({"train_return": whole["r"], "train_length": whole["l"]})
        self.bar.update(self.step - self.bar.n)

    def note_update(self, metrics: dict[str, float]) -> None:
        """Count an update that was made; every fiftieth goes to TensorBoard as it is."""
        self.updates += 1
        self.average(metrics)
        if self.updates % 50 == 1:
            for name, value in metrics.items():
                self.writer.add_scalar(f"update/{name}", value, self.step)

    def average(self, metrics: dict[str, float]) -> None:
        """Take metrics into the averages of the next row of metrics.csv."""
        for name, value in metrics.items():
            total, count = self.averages.get(name, (0.0, 0))
            self.averages[name] = [total + float(value), count + 1]

    def evaluation_due(self) -> bool:
        """Whether a multiple of `eval_every`, or the end, was passed since the last evaluation."""
        since = max(self.evaluated_at, self.s.prefill - 1)
        at_end = self.step >= self.s.steps and self.step > self.evaluated_at
        return self.updates > 0 and (at_end or passed(since, self.step, self.s.eval_every) > 0)

    def report(self, episodes: list[Episode]) -> None:
        """A row of metrics.csv and TensorBoard, a line, and best.pt if none was better."""
        self.evaluated_at = self.step
        if not episodes:
            return
        returns, lengths = np.array([(e.total, e.length) for e in episodes]).T
        row = {
            "env_steps": self.step,
            "wall_seconds": self.elapsed(),
            "eval_return": returns.mean(),
            "eval_interval95": interval95(returns),
            "eval_length": lengths.mean(),
            "eval_length_min": lengths.min(),
            "eval_length_max": lengths.max(),
            "coverage": coverage(np.array(self.visited)),
            "train_return": float("nan"),  # unless an episode ended
            "train_length": float("nan"),
        } | {name: total / count for name, (total, count) in self.averages.items()}
        self.averages, self.visited = {}, []
        with open(self.folder / "metrics.csv", "a+", newline="", errors="replace") as file:
            file.seek(0)
            header = file.readline().strip().split(",")  # a resumed run keeps its columns
            known = "env_steps" in header
            table = csv.DictWriter(file, header if known else row, "nan", "ignore")
            file.seek(0, os.SEEK_END)
            if not known:
                table.writeheader()
            table.writerow({k: v if isinstance(v, int) else f"{v:.6g}" for k, v in row.items()})
            self.metrics_bytes = file.tell()
        for name, value in row.items():
            self.writer.add_scalar(name, value, self.step)
        self.writer.flush()
        spread = f" ± {interval95(returns):.1f}" if len(returns) > 1 else ""
        self.bar.set_postfix_str(f"return {returns.mean():.1f}{spread}")
        self.bar.write(
            f"{self.step:9,} environment steps, {self.elapsed() / 60:5.1f} min: "
            f"return {returns.mean():.1f}{spread}, {lengths.mean():.0f} steps an episode"
        )
        if returns.mean() >= self.best:
            self.best = float(returns.mean())
            write_whole(self.folder / "best.pt", self.agent.state_dict())

    def elapsed(self) -> float:
        """Seconds that the run has taken, whenever it ran."""
        return self.seconds + time.monotonic() - self.clock

    def save_if_due(self) -> None:
        """Write a checkpoint every `checkpoint_minutes`, and before the ring's reserve is full."""
        waited = time.monotonic() - self.clock >= 60 * self.s.checkpoint_minutes
        if waited or self.replay.added - self.saved_rows >= self.unsaved:
            self.save()

    def save(self) -> None:
        """Write a checkpoint, whole or not at all; the one before it is kept.

        Raises:
            OSError: if it cannot be written, as on a full disk; the last one is then as it was.
        """
        self.seconds, self.clock = self.elapsed(), time.monotonic()
        self.saved_rows = self.replay.added
        newest, previous = (self.folder / name for name in CHECKPOINTS)
        content = {
            "agent": self.agent.state_dict(),
            "optimisers": {name: o.state_dict() for name, o in self.agent.optimisers.items()},
            "settings": self.s.to_json(),
            "kept": {name: getattr(self, name) for name in self.KEPT},
            "checksums": torch.from_numpy(self.replay.flush()),
            "torch_random": torch.get_rng_state(),
            "cuda_random": torch.cuda.get_rng_state_all(),
            "numpy_random": json.dumps(self.rng.bit_generator.state),
        }
        write_whole(newest, content, keep=previous)

    def load(self) -> dict:
        """Go back to the newest whole checkpoint. Returns the settings with which it was made.

        Raises:
            ValueError: in one sentence, if there is none, or the replay is not its own.
        """
        path, saved = read_checkpoint(self.folder)
        made, now = json.loads(saved["settings"]), dataclasses.asdict(self.s)
        if edited := [k for k in now if k not in CHANGEABLE and now[k] != made.get(k)]:
            raise ValueError(
                f"{self.folder} was made with other settings than its settings.json says: "
                f"{', '.join(f'{k} {made.get(k)}' for k in edited)}; put them back."
            )
        machine = self.machine
        for name in self.KEPT:
            setattr(self, name, saved["kept"][name])
        self.replay.restore(self.saved_rows, saved["checksums"].numpy())
        load_networks(self.agent, saved["agent"])
        for name, optimiser in self.agent.optimisers.items():
            rate = optimiser.param_groups[0]["lr"]
            optimiser.load_state_dict(saved["optimisers"][name])
            optimiser.param_groups[0]["lr"] = rate  # the settings', which may have changed since
        self.state = self.state if self.state is None else self.state.to(self.agent.device)
        self.rng.bit_generator.state = json.loads(saved["numpy_random"])
        if machine != self.machine:
            say(f"Begun on {self.machine}, it goes on on {machine}: otherwise than it would have.")
            self.machine = machine
        damaged = self.folder / CHECKPOINTS[0]
        if path != damaged and damaged.exists():  # it must not take the place of this
            damaged.replace(damaged.with_suffix(".damaged"))
        with open(self.folder / "metrics.csv", "a+b") as file:
            file.seek(0)
            whole = file.read(self.metrics_bytes)  # without rows that are younger
            if len(whole) < self.metrics_bytes:
                say(f"{file.name} has lost rows since the checkpoint: it goes on without them.")
            self.metrics_bytes = whole.rfind(b"\n") + 1
            file.truncate(self.metrics_bytes)
        self.retrace()
        torch.set_rng_state(saved["torch_random"])
        if self.agent.device.type == "cuda" and saved["cuda_random"]:
            torch.cuda.set_rng_state_all(saved["cuda_random"])
        return made

    def retrace(self) -> None:
        """Take the actions of the episode under way again: its environment is then where it was."""
        if self.over:
            return
        actions, state, length = self.actions, self.state, self.length
        self.episode -= 1
        try:
            image = self.begin_episode()
            for action in actions:
                image = self.env.step(np.float32(action))[0]
        except EnvironmentFault:
            image = None
        self.actions, self.state, self.length = actions, state, length
        self.over = not np.array_equal(image, self.replay.last["image"])
        if self.over:
            say(
                f"{self.s.env} does not repeat itself: the episode under way ends here, and the "
                "run goes on otherwise than it would have."
            )


CHECKPOINTS = ("checkpoint.pt", "checkpoint.previous.pt")


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
    """The newest whole checkpoint and its path. Nothing in it is executed.

    Raises:
        ValueError: in one sentence, if none is whole.
    """
    for path in (folder / name for name in CHECKPOINTS):
        if path.exists():
            with contextlib.suppress(Exception), zipfile.ZipFile(path) as file:  # damage has many
                if file.testzip() is None:  # each part has the checksum that was written with it
                    saved = torch.load(path, map_location="cpu", weights_only=True)
                    if "settings" in saved and saved["kept"].keys() == set(Run.KEPT):
                        return path, saved
            say(f"{path} is damaged: looking for the one before it.")
    raise ValueError(f"{folder} holds no whole checkpoint: start a new run in another folder.")


def make_agent(s: Settings, env, device: str = "auto", precision: str = "auto") -> Agent:
    """An untrained agent on this machine.

    Raises:
        ValueError: in one sentence, if the device is not there or no memory holds the networks.
    """
    if device == "auto":
        device = "cuda" if torch.cuda.is_available() else "cpu"
    elif device == "cuda" and not torch.cuda.is_available():
        raise ValueError("--device cuda: no CUDA device is here; leave it out to use the CPU.")
    device = torch.device(device)
    bfloat16 = has_bfloat16(device) if precision == "auto" else precision == "bfloat16"
    try:
        return Agent(s, env.action_space.shape[0], device, bfloat16)
    except RuntimeError as error:  # sizes that no memory holds
        raise ValueError(f"The networks cannot be made: {str(error).splitlines()[0]}") from None


def load_networks(agent: Agent, weights: dict[str, Tensor]) -> None:
    """Put saved weights into an agent. A ValueError, in one sentence, if they are of another."""
    try:
        agent.load_state_dict(weights)
    except RuntimeError as error:
        raise ValueError(f"Other networks were saved: {' '.join(str(error).split())}") from None


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
    run_dir: str = ""  # folder to create; empty: runs/ENV-ARM-PRESET-seedSEED-TIME
    resume: str | None = None  # folder of a run to go on with; steps, rates and the like may change
    device: Literal["auto", "cpu", "cuda"] = "auto"  # where to compute; auto: cuda if there
    precision: Literal["auto", "bfloat16", "float32"] = "auto"  # auto: bfloat16 if in hardware


def parse(arguments: list[str]) -> Command:
    """The command line. The arm and preset, or the run to go on with, set the defaults that the
    other options change.

    Raises:
        ValueError: in one sentence, what cannot be understood.
    """

    def parsed(settings: Settings, arguments: list[str]) -> Command:
        try:
            with contextlib.redirect_stderr(io.StringIO()) as said:
                return tyro.cli(Command, prog="train.py", args=arguments, default=Command(settings))
        except SystemExit as error:
            if not error.code:  # --help
                raise
            lines = said.getvalue().splitlines()[1:]  # of a box, below its title
            raise ValueError(
                " ".join(re.sub("[─│╭╮╰╯]|-{3,}", " ", " ".join(lines)).split())
            ) from None

    first = parsed(Settings(), [a for a in arguments if a not in ("-h", "--help")])
    if first.resume is not None:
        return parsed(read_settings(folder_named(first.resume)), arguments)
    return parsed(default_settings(first.settings.arm, first.settings.preset), arguments)


def check(text: str, where: str = "") -> Settings:
    """The settings that a JSON text holds.

    Raises:
        ValueError: in one sentence, which of them cannot be, and why.
    """
    try:
        s = TypeAdapter(Settings).validate_json(text, strict=True)
    except ValidationError as error:
        wrong = error.errors()[0]
        option = "".join(f"--{name}" for name in wrong["loc"]).replace("_", "-")
        what = f"{option} is {wrong['input']}: {wrong['msg']}" if option else wrong["msg"]
        raise ValueError(f"{where}{what}.") from None
    rows, least = s.prefill // s.action_repeat, s.prefill + s.train_every
    for impossible, sentence in (
        (s.length > rows, f"--length {s.length} is longer than the {rows} rows that --prefill "
         f"{s.prefill} collects: lower the one or raise the other."),
        (s.length > s.replay_capacity, f"--replay-capacity {s.replay_capacity} holds no --length "
         f"{s.length}: raise the one or lower the other."),
        (s.steps < least, f"--steps {s.steps} leaves nothing to train after --prefill {s.prefill}: "
         f"raise it to {least} or more."),
        (s.density == "knn" and s.starts * s.batch_size * (s.length // 2) < 4,
         "--density knn needs four states to dream from: raise --batch-size or --length."),
        (s.eval_every < s.train_every, f"--eval-every {s.eval_every} is less than --train-every "
         f"{s.train_every}: raise it to that."),
    ):  # fmt: skip
        if impossible:
            raise ValueError(f"{where}{sentence}")
    return s


def read_settings(folder: Path) -> Settings:
    """The settings of a run folder.

    Raises:
        ValueError: in one sentence, if it holds none, or those of another version of this program.
    """
    path = folder / "settings.json"
    if not path.is_file():
        raise ValueError(f"{folder} holds no run: there is no settings.json in it.")
    text = path.read_text("utf-8-sig", "replace")
    try:
        saved = dict(json.loads(text))
    except (ValueError, TypeError, RecursionError) as error:
        raise ValueError(f"{path} cannot be read: {error}.") from None
    if differing := saved.keys() ^ {field.name for field in dataclasses.fields(Settings)}:
        names = ", ".join(sorted(differing))
        raise ValueError(f"{folder} was made by a version with other settings: {names}.")
    return check(text, f"{path}: ")


def folder_named(text: str) -> Path:
    """The folder that a user names, wherever the environment goes.

    Raises:
        ValueError: in one sentence, if its name is not UTF-8, as TensorBoard's files want it.
    """
    path = os.path.abspath(os.path.expanduser(text))
    if path != path.encode(errors="ignore").decode():
        raise ValueError(f"{path!a} is not UTF-8: name another folder.")
    return Path(path)


def new_run(command: Command) -> Run:
    """A new run in a folder of its own, made once all else is known to work.

    Raises:
        ValueError: in one sentence, what is wrong with the command.
    """
    s = check(command.settings.to_json())
    name = f"{s.env}-{s.arm}-{s.preset}-seed{s.seed}-{time.strftime('%Y%m%d-%H%M%S')}"
    folder = folder_named(command.run_dir or "runs/" + re.sub(r"[^\w.-]", "-", name))
    taken = f"{folder} is there already: name another --run-dir, or --resume it."
    if command.run_dir and folder.exists() and (not folder.is_dir() or any(folder.iterdir())):
        raise ValueError(taken)
    run = Run(s, folder, command.device, command.precision)
    while True:
        try:
            run.folder.mkdir(parents=True, exist_ok=bool(command.run_dir))
            break
        except FileExistsError:  # begun in the same second
            if command.run_dir:
                raise
            run.folder = run.folder.with_name(run.folder.name + "+")
    try:
        run.open()
        if (run.folder / "settings.json").exists():  # of a process that was faster, and is done
            raise ValueError(taken)
        run.save()
        run.sign()
    except ValueError:  # the folder is another's
        raise
    except BaseException:
        shutil.rmtree(run.folder, ignore_errors=True)
        raise
    return run


def resumed_run(command: Command) -> Run:
    """The run of a folder, from its newest checkpoint, with the settings that changed.

    Raises:
        ValueError: in one sentence, why it cannot go on, or not with these settings.
    """
    folder = folder_named(command.resume)
    before, after = (dataclasses.asdict(x) for x in (read_settings(folder), command.settings))
    fixed = [name for name in after if after[name] != before[name] and name not in CHANGEABLE]
    if command.run_dir or fixed:
        fixed = ", ".join(fixed) or "run_dir"
        raise ValueError(f"--resume keeps the run's own {fixed}; it takes {', '.join(CHANGEABLE)}.")
    run = Run(check(command.settings.to_json()), folder, command.device, command.precision)
    run.open()
    before = run.load()  # settings.json may have been edited
    for name in (name for name in CHANGEABLE if after[name] != before[name]):
        say(f"{name}: {after[name]} in the place of {before[name]} from step {run.step:,} on"
            + ("; β now falls to its end by then." if name == "steps" else "."))  # fmt: skip
    run.sign()
    return run


CHANGEABLE = (
    "steps", "eval_every", "eval_episodes", "eval_max_steps", "checkpoint_minutes", "model_lr",
    "actor_lr", "critic_lr", "mdn_lr", "grad_clip",
)  # fmt: skip


def main(arguments: list[str]) -> int:
    """Runs a command line. Returns the exit code: 0 done, 1 stopped by a fault, 2 bad input."""
    if "--evaluate" in arguments:  # what only looks at a run stands in results/
        player = str(Path(__file__).with_name("results") / "play.py")
        rest = [argument for argument in arguments if argument != "--evaluate"]
        return subprocess.call([sys.executable, player, *rest])
    keep_freed_memory()
    threading.excepthook = leave_out_os_errors
    try:
        command = parse(arguments)
        run = new_run(command) if command.resume is None else resumed_run(command)
    except (ValueError, OSError, MemoryError) as error:
        say(error)
        return 2
    try:
        return train_run(run)
    finally:
        run.lock.release()


def train_run(run: Run) -> int:
    """Trains to the end, to a signal or to a fault, and says what to do next: the exit code."""
    stopped = threading.Event()

    def stop(number: int, _) -> None:
        run.bar.write("Finishing what is under way, then saving; Ctrl-C again to stop at once.")
        stopped.set()
        signal.signal(signal.SIGINT, signal.default_int_handler)

    print(run.describe(), flush=True)
    resume = "Go on with: " + shlex.join([sys.executable, __file__, "--resume", str(run.folder)])
    every = 0.5 if sys.stderr.isatty() else 30  # seconds between two lines of a log file
    try:
        with (
            tqdm(total=run.s.steps, initial=run.step, unit="step", mininterval=every) as run.bar,
            SummaryWriter(run.folder, purge_step=run.step + 1) as run.writer,
        ):
            hangup = getattr(signal, "SIGHUP", signal.SIGINT)  # Windows has none
            for number in (signal.SIGINT, signal.SIGTERM, hangup):
                if number != hangup or signal.getsignal(number) != signal.SIG_IGN:  # nohup
                    signal.signal(number, stop)
            train(run, stopped.is_set)
    except FloatingPointError as error:
        say(f"{error} The last checkpoint is from before: go on from it with a lower --model-lr, "
            f"--actor-lr or --critic-lr, or with --precision float32. {resume}")  # fmt: skip
    except EnvironmentFault as error:
        run.over = True  # whoever goes on begins another episode
        with contextlib.suppress(OSError):
            run.save()
            error = f"{error} What was learnt is saved."
        say(f"{error} {resume}")
    except (MemoryError, RuntimeError) as error:
        if "alloc" not in str(error) and not isinstance(error, MemoryError):
            raise
        size = f"--batch-size {run.s.batch_size} and --length {run.s.length}"
        reason = str(error).partition("\n")[0]  # a MemoryError may have none
        say(f"No memory for an update of {size}: {reason} {resume}")
    except OSError as error:
        say(f"{error}: stopped; what was saved before is whole. {resume}")
    else:
        done = run.step >= run.s.steps and not stopped.is_set()
        print(f"Done: {run.folder / 'metrics.csv'}" if done else f"Stopped. {resume}", flush=True)
        return 0
    return 1


def say(text: object) -> None:
    """One sentence for the user, beside the progress."""
    tqdm.write(" ".join(str(text).splitlines()) or repr(text), file=sys.stderr)


def leave_out_os_errors(thrown: threading.ExceptHookArgs) -> None:
    """No traceback of TensorBoard's thread on a full disk: its error comes back in ours."""
    if not isinstance(thrown.exc_value, OSError):
        threading.__excepthook__(thrown)


def keep_freed_memory() -> None:
    """Let glibc keep the memory that tensors free: the next update asks for as much again, and
    the system would clear each page anew (measured: a fifth of the paper preset's update)."""
    with contextlib.suppress(OSError, AttributeError, TypeError):  # another C library, or none
        trim_threshold, top_pad, mmap_max = -1, -2, -4  # malloc.h
        libc = ctypes.CDLL(None)
        libc.mallopt(mmap_max, 0)
        libc.mallopt(trim_threshold, 2**31 - 1)
        libc.mallopt(top_pad, 64 * 2**20)


class Patient:
    """A stream whose reader may go away, or know few letters: to show a run must not end it."""

    def __init__(self, stream):
        self.stream = stream or open(os.devnull, "w")  # None: it was closed from the start
        with contextlib.suppress(AttributeError):
            stream.reconfigure(errors="replace")

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
        sys.exit("Stopped at once; what the last checkpoint holds can be resumed.")
