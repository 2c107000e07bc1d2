"""Trains MaxEnt Dreamer: the settings, one explicit loop, evaluation, checkpoints and the command line.

    python train.py --env HopperBulletEnv-v0

The algorithm is `train` (act, store, update, evaluate) and `update` (one gradient step of everything); what they call
stands in world_model.py, actors.py, returns.py, mdn.py and env.py. No other file reads settings, holds an optimiser,
moves a device or writes to disk.
"""

import argparse
import contextlib
import csv
import ctypes
import dataclasses
import difflib
import hashlib
import io
import json
import os
import signal
import sys
import threading
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import gymnasium as gym
import numpy as np
import torch
import tyro
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
)
from env import Replay, make_env
from mdn import MixtureDensityNetwork, entropy, mdn_loss, soft_update
from world_model import WorldModel

Arm = Literal["dreamer", "dreamer-maxent", "revised", "maxent"]
Preset = Literal["small", "paper"]


@dataclass(frozen=True)
class Settings:
    """Everything that a run depends on. §: section of the paper; Dreamer: its authors' code; ours: the paper is silent."""

    env: str = (
        "HopperBulletEnv-v0"  # any Gymnasium id with bounded Box actions and rgb_array rendering
    )
    arm: Arm = "maxent"  # curve of the paper's figure: sets the switches below
    preset: Preset = "small"  # sizes and cadence: two CPU cores, or the paper's
    seed: int = (
        0  # of weights, environment and sampling; equal seeds give equal metrics on one machine
    )
    run_dir: str = ""  # folder to create for the run; empty: runs/ENV-ARM-PRESET-seedSEED-TIME
    device: str = "auto"  # cpu or cuda; auto: cuda if there
    precision: Literal["auto", "bfloat16", "float32"] = (
        "auto"  # auto: bfloat16 if the processor has it in hardware
    )

    steps: int = 100_000  # environment steps of the run, prefill included (ours)
    prefill: int = 5000  # environment steps of uniformly random actions before training (Dreamer)
    train_every: int = (
        10  # environment steps between two rounds of gradient updates (Dreamer: 1000)
    )
    updates: int = 1  # gradient updates a round (Dreamer: 100)
    eval_every: int = 5000  # environment steps between two evaluations (ours)
    eval_episodes: int = 10  # episodes an evaluation (§5: 10)
    checkpoint_minutes: float = 5  # between two checkpoints (ours)
    replay_capacity: int = 500_000  # rows (decisions) of experience kept (ours)
    action_repeat: int = 2  # environment steps a decision (Dreamer)
    camera_distance: float = 1.7  # metres to the PyBullet robot; the environment's own is 3 (ours)

    termination: bool = True  # §4.2: learn when episodes end, and let returns end there
    observe_first: bool = True  # §4.2: see o_0 before choosing a_0 (Dreamer's code does too)
    fixed_prior: bool = True  # §4.2: KL to N(0, 1) and Jeffreys to the prior, for KL to the prior
    q_critic: bool = True  # §4.2 minor 1: the critic is Q(s, a), for V(s)
    smooth_l1: bool = True  # §4.2 minor 2: Smooth L1 for reward and critic, for squared error
    decode_stoch_only: bool = True  # §4.2 minor 3: the decoder sees z, for (h, z)
    first_state_only: bool = (
        True  # §4.2: actors maximise the return of the first imagined state, for all
    )
    entropy: bool = (
        True  # §4.1: the stochastic actor also maximises β times the entropy of future states
    )
    deterministic_actor: bool = True  # §4.1: train a deterministic actor too, and evaluate it
    collect: Literal["explorer", "both"] = (
        "both"  # who collects: the stochastic actor, or both in turn (ours)
    )
    action_noise: float = 0.0  # standard deviation of noise added when collecting (Dreamer: 0.3)
    random_action: float = (
        0.1  # §4.2 minor 4: probability of a random action when collecting (value ours)
    )

    deter: int = 200  # size of h (Dreamer)
    stoch: int = 128  # size of z (§5: 128; Dreamer: 30)
    hidden: int = 200  # units of the RSSM's dense layers (Dreamer)
    units: int = 400  # units of reward, termination, actor and critic layers (Dreamer)
    depth: int = 32  # channels of the first convolution (Dreamer)
    batch_size: int = 50  # sequences a batch (Dreamer)
    length: int = 50  # rows a sequence (Dreamer)
    horizon: int = 15  # imagined steps, and n of Eq. (10) (Dreamer)

    gamma: float = 0.99  # γ of λ-returns, a decision (Dreamer)
    lam: float = 0.95  # λ of λ-returns (Dreamer)
    gamma_q: float = 0.9  # γ of the discounted state distribution (§5)
    beta_start: float = 0.2  # entropy coefficient β at the first environment step (§5)
    beta_end: float = 0.0001  # and at the last, linear between (§5)
    mdn_components: int = 8  # components of the mixture density network (§5: heads)
    mdn_units: int = 256  # its hidden units (§5)
    mdn_min_std: float = 0.1  # floor under its σ (ours)
    target_rate: float = 0.1  # soft update of the target MDN (§5)
    first_action_noise: float = (
        0.1  # on the deterministic actor's first imagined action, for ∂Q/∂a (ours)
    )
    model_lr: float = 6e-4  # Adam's learning rate of the world model (Dreamer)
    actor_lr: float = 8e-5  # of each actor (Dreamer)
    critic_lr: float = 8e-5  # of each critic (Dreamer)
    mdn_lr: float = 2e-4  # of the mixture density network (§5)
    grad_clip: float = 100.0  # largest global gradient norm of an optimiser step (Dreamer)
    free_nats: float = 3.0  # of `kl`, the original Dreamer's only (Dreamer)
    reward_weight: float = 1.0  # weight of `reward` in the world model's loss (Dreamer)
    kl_weight: float = 1.0  # of `kl`, the original Dreamer's divergence (Dreamer)
    kl_standard_weight: float = 0.1  # of KL(posterior || N(0, 1)) (§5)
    jeffreys_weight: float = 0.1  # of D_J(posterior || prior) (§5)


ORIGINAL = dict(
    termination=False, fixed_prior=False, q_critic=False, smooth_l1=False,
    decode_stoch_only=False, first_state_only=False, stoch=30, random_action=0.0,
)  # fmt: skip
ARMS = {  # what each curve of the paper's figure changes in `Settings`, which is the last of them
    "dreamer": ORIGINAL | dict(entropy=False, deterministic_actor=False, action_noise=0.3),
    "dreamer-maxent": ORIGINAL,
    "revised": dict(entropy=False, deterministic_actor=False, action_noise=0.3),
    "maxent": {},
}
PRESETS = {
    "small": dict(
        deter=128, stoch=64, hidden=128, units=128, depth=16, batch_size=10, length=25, mdn_units=128,
        prefill=2000, eval_every=10_000,
    ),
    "paper": dict(steps=1_000_000, train_every=1000, updates=100, eval_every=10_000),
}  # fmt: skip


def default_settings(arm: Arm = "maxent", preset: Preset = "small") -> Settings:
    """The settings of one arm at one size, before any switch of the user's."""
    return Settings(arm=arm, preset=preset, **(PRESETS[preset] | ARMS[arm]))


class Agent(nn.Module):
    """All networks of a run, and one Adam for each that learns."""

    def __init__(self, s: Settings, actions: int, device: torch.device, bfloat16: bool):
        super().__init__()
        self.device, self.bfloat16 = device, bfloat16
        self.model = WorldModel(
            actions, deter=s.deter, stoch=s.stoch, hidden=s.hidden, units=s.units, depth=s.depth,
            termination=s.termination, fixed_prior=s.fixed_prior, smooth_l1=s.smooth_l1,
            decode_stoch_only=s.decode_stoch_only, observe_first=s.observe_first, free_nats=s.free_nats,
        )  # fmt: skip
        size = self.model.size
        self.actors = nn.ModuleDict({"stochastic": StochasticActor(size, actions, s.units)})
        if s.deterministic_actor:
            self.actors["deterministic"] = DeterministicActor(size, actions, s.units)
        self.critics = nn.ModuleDict({
            name: QCritic(size, actions, s.units) if s.q_critic else VCritic(size, s.units)
            for name in self.actors
        })  # fmt: skip
        learners = {"model": (self.model, s.model_lr)}
        learners |= {f"{name}_actor": (actor, s.actor_lr) for name, actor in self.actors.items()}
        learners |= {
            f"{name}_critic": (critic, s.critic_lr) for name, critic in self.critics.items()
        }
        if s.entropy:
            self.mdn, self.target_mdn = (
                MixtureDensityNetwork(size, s.mdn_components, s.mdn_units, s.mdn_min_std)
                for _ in range(2)
            )
            self.target_mdn.load_state_dict(self.mdn.state_dict())
            self.target_mdn.requires_grad_(False)
            learners["mdn"] = (self.mdn, s.mdn_lr)
        self.to(device)
        self.optimisers = {
            name: torch.optim.Adam(net.parameters(), lr, fused=True)
            for name, (net, lr) in learners.items()
        }
        self.grad_clip, self.collect = s.grad_clip, s.collect

    @property
    def evaluated(self) -> nn.Module:
        """The actor that evaluation plays, by its mode: the deterministic one if there is one (§4.1)."""
        return self.actors["deterministic" if "deterministic" in self.actors else "stochastic"]

    def collector(self, episode: int) -> nn.Module:
        """The actor that plays the given episode of training: the explorer, or each in turn."""
        return list(self.actors.values())[
            episode % len(self.actors) if self.collect == "both" else 0
        ]

    def autocast(self) -> torch.autocast:
        """Forward passes in bfloat16 where the module's inputs allow it; one context for each, since it caches weights."""
        return torch.autocast(self.device.type, torch.bfloat16, enabled=self.bfloat16)

    def step(self, name: str, loss: Tensor) -> Tensor:
        """One optimiser step of the network `name` on `loss`, and of no other: returns its gradient norm.

        Raises:
            FloatingPointError: if loss or gradient is not finite, before anything is changed.
        """
        optimiser = self.optimisers[name]
        parameters = optimiser.param_groups[0]["params"]
        optimiser.zero_grad()
        loss.backward(
            inputs=parameters
        )  # gradients that pass through other networks stop at their inputs
        norm = nn.utils.clip_grad_norm_(parameters, self.grad_clip)
        if not torch.isfinite(norm):
            part = "gradient" if torch.isfinite(loss) else "loss"
            raise FloatingPointError(f"The {part} of {name} is not finite.")
        optimiser.step()
        return norm


def update(agent: Agent, batch: dict[str, Tensor], beta: float, s: Settings) -> dict[str, float]:
    """One gradient update of the world model, of each actor and its critic, and of the MDN. Returns named metrics."""
    with agent.autocast():
        terms, states = agent.model.loss(batch)
        weight = {"kl": s.kl_weight, "kl_standard": s.kl_standard_weight, "jeffreys": s.jeffreys_weight,
                  "reward": s.reward_weight}  # fmt: skip
        loss = sum(weight.get(name, 1.0) * term for name, term in terms.items())
    metrics = {f"model/{name}": term for name, term in terms.items()}
    metrics["model/grad_norm"] = agent.step("model", loss)
    starts = states[
        ~batch["terminated"]
    ].detach()  # where the episode is over there is nothing to imagine
    for name, actor in agent.actors.items():
        critic = agent.critics[name]
        with agent.autocast():
            first = actor(starts)
            if (
                name == "deterministic"
            ):  # Q is only ever asked near a = A(s): show it what lies beside
                first = (first + s.first_action_noise * torch.randn_like(first)).clamp(-1, 1)
            dream = agent.model.imagine(starts, actor, s.horizon, first)
            returns = imagined_returns(dream, critic, s.gamma, s.lam)
            loss = actor_loss(returns, dream.continues, s.first_state_only)
            if name == "stochastic" and s.entropy:  # Eq. (7)
                bonus = entropy(agent.target_mdn, dream.state, dream.continues, s.gamma_q).mean()
                loss = loss - beta * bonus
                metrics["mdn/entropy"] = bonus
        metrics[f"{name}/actor_grad_norm"] = agent.step(f"{name}_actor", loss)
        with agent.autocast():
            loss = critic_loss(critic, dream, returns, s.smooth_l1)
        metrics[f"{name}/critic_loss"] = loss
        metrics[f"{name}/critic_grad_norm"] = agent.step(f"{name}_critic", loss)
        metrics[f"{name}/return"] = returns[0].mean()
        metrics[f"{name}/saturated"] = (dream.action.abs() > 0.99).float().mean()
        if name == "stochastic" and s.entropy:
            with agent.autocast():
                loss = mdn_loss(agent.mdn, dream.state, dream.continues, s.gamma_q).mean()
            metrics["mdn/nll"] = loss
            metrics["mdn/grad_norm"] = agent.step("mdn", loss)
            soft_update(agent.target_mdn, agent.mdn, s.target_rate)
    return {name: value.item() for name, value in metrics.items()}


def beta_at(step: int, s: Settings) -> float:
    """Entropy coefficient β, linear in environment steps from `beta_start` to `beta_end` over the run (§5)."""
    return s.beta_start + (s.beta_end - s.beta_start) * min(step / s.steps, 1.0)


@torch.no_grad()
def act(
    agent: Agent, policy, image: np.ndarray, action: np.ndarray, state: Tensor | None
) -> tuple[np.ndarray, Tensor]:
    """One decision from pixels: the new state is the posterior's, given image, last action and last state (None: first).

    Returns:
        the action (A,) and the state (1, D).
    """
    batch = (
        torch.as_tensor(image)[None, None],
        torch.as_tensor(action)[None, None],
        torch.tensor([[state is None]]),
    )
    with agent.autocast():
        state = agent.model.observe(*(x.to(agent.device) for x in batch), previous=state).state[
            :, 0
        ]
        return policy(state)[0].float().cpu().numpy(), state


def evaluate(agent: Agent, env: gym.Env, episodes: int) -> tuple[np.ndarray, np.ndarray]:
    """Returns and lengths (environment steps) of episodes of the evaluated actor, each with a seed of its own.

    The seeds are the same at each evaluation, and the training's random numbers are left as they were.
    """
    results = []
    with torch.random.fork_rng():
        torch.manual_seed(0)
        for episode in range(episodes):
            image, _ = env.reset(seed=2**31 + episode)
            action, state, over = np.zeros(env.action_space.shape, np.float32), None, False
            while not over:
                action, state = act(agent, agent.evaluated.mode, image, action, state)
                image, _, terminated, truncated, info = env.step(action)
                over = terminated or truncated
            results.append((info["episode"]["r"], info["episode"]["l"]))
    return tuple(np.array(results).T)


def interval95(returns: np.ndarray) -> float:
    """Half the width of the mean's 95% t-interval (§5); nan for a single return."""
    return (
        float(stats.t.ppf(0.975, len(returns) - 1) * stats.sem(returns))
        if len(returns) > 1
        else float("nan")
    )


COUNTERS = (
    "step",
    "episode",
    "over",
    "seconds",
    "saved_rows",
    "metrics_bytes",
)  # of a Run, in a checkpoint


class Run:
    """All that a run is, in memory and in its folder: environments, agent, replay, random states, counters.

    The folder holds settings.json; metrics.csv, a row an evaluation; TensorBoard events of the same names; the last
    two checkpoints; and replay.bin, to which each checkpoint appends the rows that are new. A checkpoint knows how
    long both files were; what is longer is cut off when the run is resumed.
    """

    def __init__(self, s: Settings, folder: Path):
        self.s, self.folder = s, folder
        device = torch.device(
            s.device if s.device != "auto" else "cuda" if torch.cuda.is_available() else "cpu"
        )
        bfloat16 = has_bfloat16(device) if s.precision == "auto" else s.precision == "bfloat16"
        self.env, self.eval_env = (
            make_env(s.env, s.action_repeat, s.camera_distance) for _ in range(2)
        )
        actions = self.env.action_space.shape[0]
        torch.manual_seed(s.seed)
        self.rng = np.random.default_rng(s.seed)
        self.agent = Agent(s, actions, device, bfloat16)
        self.replay = Replay(s.replay_capacity, actions)
        self.state = None  # (1, D), the agent's in the episode under way; None: it has seen nothing of it yet
        self.averages: dict[str, list[float]] = {}  # name: [sum, count] since the last evaluation
        self.step, self.episode = 0, 0  # environment steps made, episodes begun
        self.begun_at, self.over = (
            0,
            True,
        )  # step at which the last episode began, and whether it has ended
        self.saved_rows, self.metrics_bytes = 0, 0  # of replay.bin and metrics.csv
        self.seconds = 0.0  # that the run took up to `self.clock`
        self.clock = time.monotonic()
        self.bar = tqdm(total=s.steps, unit=" env steps", dynamic_ncols=True)
        self.writer = SummaryWriter(folder)

    def description(self) -> str:
        """What runs where, for the terminal."""
        s, agent, rows = self.s, self.agent, self.replay.rows
        parameters = sum(p.numel() for p in agent.parameters() if p.requires_grad)
        return (
            f"{s.env}, arm {s.arm}, preset {s.preset}, seed {s.seed}, in {self.folder}\n"
            f"{parameters / 1e6:.1f} M parameters on {agent.device}, {torch.get_num_threads()} threads, "
            f"{'bfloat16' if agent.bfloat16 else 'float32'}; replay of {len(rows):,} rows, up to {rows.nbytes / 2**30:.1f} GiB"
        )

    def reset(self) -> np.ndarray:
        """Begin the next episode, with a seed of its own: its first image."""
        seed = np.random.SeedSequence((self.s.seed, self.episode)).generate_state(1)[0]
        self.episode += 1
        self.begun_at, self.state = self.step, None
        return self.env.reset(seed=int(seed))[0]

    def average(self, metrics: dict[str, float]) -> None:
        """Take metrics into the averages of the next row of metrics.csv."""
        for name, value in metrics.items():
            total = self.averages.setdefault(name, [0.0, 0])
            total[0] += value
            total[1] += 1

    def elapsed(self) -> float:
        """Seconds that the run has taken, in all its processes."""
        return self.seconds + time.monotonic() - self.clock

    def report(self, returns: np.ndarray, lengths: np.ndarray) -> None:
        """Write a row of metrics.csv and the same numbers for TensorBoard, and begin new averages."""
        row = {
            "env_steps": self.step,
            "wall_seconds": self.elapsed(),
            "eval_return": returns.mean(),
            "eval_interval95": interval95(returns),
            "eval_length": lengths.mean(),
            "train_return": float("nan"),  # unless an episode ended
            "train_length": float("nan"),
            "beta": beta_at(self.step, self.s),
        } | {name: total / count for name, (total, count) in self.averages.items()}
        with open(self.folder / "metrics.csv", "a", newline="") as file:
            table = csv.DictWriter(file, row)
            if file.tell() == 0:
                table.writeheader()
            table.writerow({name: f"{value:.6g}" for name, value in row.items()})
            self.metrics_bytes = file.tell()
        for name, value in row.items():
            self.writer.add_scalar(name, value, self.step)
        self.averages.clear()
        result = f"return {returns.mean():.1f} ± {row['eval_interval95']:.1f}, {lengths.mean():.0f} steps an episode"
        self.bar.write(f"{self.step:>9,} steps, {row['wall_seconds'] / 60:.0f} min: {result}")
        self.bar.set_postfix_str(result)

    def save(self) -> None:
        """Write a checkpoint, whole or not at all; the one before it is kept.

        Raises:
            OSError: if the disk is full; the last checkpoint is then as it was.
        """
        rows, added = self.replay.rows, self.replay.added
        self.seconds, self.clock = self.elapsed(), time.monotonic()
        with open(self.folder / "replay.bin", "ab") as file:
            file.truncate(self.saved_rows * rows.itemsize)
            file.write(rows[np.arange(self.saved_rows, added) % len(rows)].tobytes())
            file.flush()
            os.fsync(file.fileno())
        self.saved_rows = added
        content = io.BytesIO()
        torch.save({
            "agent": self.agent.state_dict(),
            "optimisers": {name: optimiser.state_dict() for name, optimiser in self.agent.optimisers.items()},
            "counters": {name: getattr(self, name) for name in COUNTERS},
            "averages": self.averages,
            "state": self.state,
            "torch_random": torch.get_rng_state(),
            "cuda_random": torch.cuda.get_rng_state_all(),
            "numpy_random": json.dumps(self.rng.bit_generator.state),
        }, content)  # fmt: skip
        content = content.getvalue()
        newest, before = (self.folder / name for name in CHECKPOINTS)
        aside = self.folder / "checkpoint.writing"
        with open(aside, "wb") as file:
            file.write(hashlib.sha256(content).digest() + content)
            file.flush()
            os.fsync(file.fileno())
        if newest.exists():
            newest.replace(before)
        aside.replace(newest)

    def load(self) -> None:
        """Go back to the last checkpoint, or to the one before it if that one is damaged.

        Raises:
            ValueError: in one sentence, if there is none to go back to.
        """
        saved = read_checkpoint(self.folder, self.agent.device)
        self.agent.load_state_dict(saved["agent"])
        for name, optimiser in self.agent.optimisers.items():
            optimiser.load_state_dict(saved["optimisers"][name])
        for name in COUNTERS:
            setattr(self, name, saved["counters"][name])
        self.averages = saved["averages"]
        torch.set_rng_state(saved["torch_random"].cpu())
        torch.cuda.set_rng_state_all([state.cpu() for state in saved["cuda_random"]])
        self.rng.bit_generator.state = json.loads(saved["numpy_random"])
        os.truncate(self.folder / "metrics.csv", self.metrics_bytes)
        self.load_replay()
        self.state = saved["state"]

    def load_replay(self) -> None:
        """The replay from its file, and the environment from the replay: by taking the last episode's actions again."""
        rows, added = self.replay.rows, self.saved_rows
        kept = np.arange(max(0, added - len(rows)), added)
        with open(self.folder / "replay.bin", "rb") as file:
            file.seek(kept[0] * rows.itemsize)
            rows[kept % len(rows)] = np.fromfile(file, rows.dtype, len(kept))
        self.replay.added = added
        if self.over:
            return
        first = kept[rows["is_first"][kept % len(rows)]][-1]
        self.episode -= 1
        image = self.reset()
        for row in rows[np.arange(first + 1, added) % len(rows)]:
            image = self.env.step(row["action"])[0]
        self.begun_at = self.step - self.env.get_wrapper_attr("episode_lengths")
        if not np.array_equal(image, self.replay.last["image"]):
            raise ValueError(
                "The episode under way does not come back as it was: this machine differs from the run's."
            )


CHECKPOINTS = ("checkpoint.pt", "checkpoint.previous.pt")


def read_checkpoint(folder: Path, device: torch.device) -> dict:
    """The newest whole checkpoint of a run folder. Nothing in it is executed.

    Raises:
        ValueError: in one sentence, if there is none.
    """
    for path in (folder / name for name in CHECKPOINTS):
        if not path.exists():
            continue
        content = path.read_bytes()
        digest, content = content[:32], content[32:]
        if hashlib.sha256(content).digest() == digest:
            return torch.load(io.BytesIO(content), map_location=device, weights_only=True)
        print(f"{path} is damaged; taking the checkpoint before it.", file=sys.stderr)
    raise ValueError(f"{folder} holds no whole checkpoint: start the run anew.")


def has_bfloat16(device: torch.device) -> bool:
    """Whether bfloat16 matrix products are in the hardware; emulated ones are slower than float32."""
    if device.type == "cuda":
        return torch.cuda.is_bf16_supported(including_emulation=False)
    capabilities = torch.cpu.get_capabilities()
    return any(capabilities.get(name, False) for name in ("avx512_bf16", "amx_bf16", "bf16"))


def train(run: Run, stop: Callable[[], bool]) -> None:
    """The algorithm: act, store, update, evaluate, until the run has made its environment steps, or `stop` says so.

    Raises:
        FloatingPointError: if a loss or gradient is not finite.
        OSError: if the disk is full.
    """
    s, agent, env, replay = run.s, run.agent, run.env, run.replay
    saved_at = time.monotonic()
    while run.step < s.steps and not stop():
        if run.over:
            replay.add(run.reset(), is_first=True)
        if run.step < s.prefill:
            action = run.rng.uniform(-1, 1, env.action_space.shape).astype(np.float32)
        else:
            now = replay.last
            action, run.state = act(
                agent, agent.collector(run.episode), now["image"], now["action"], run.state
            )
            action = explore(action, s.action_noise, s.random_action, run.rng)
        image, reward, terminated, truncated, info = env.step(action)
        replay.add(image, action, reward, terminated)
        before, run.over = run.step, terminated or truncated
        run.step = run.begun_at + env.get_wrapper_attr("episode_lengths")
        if run.over:
            run.average(
                {"train_return": info["episode"]["r"], "train_length": info["episode"]["l"]}
            )
        for _ in range(
            s.updates * (passed(before, run.step, s.train_every) if run.step >= s.prefill else 0)
        ):
            began = time.monotonic()
            batch = to_tensors(replay.sample(s.batch_size, s.length, run.rng), agent.device)
            run.average(update(agent, batch, beta_at(run.step, s), s))
            run.average({"update_seconds": time.monotonic() - began})
        run.bar.update(run.step - run.bar.n)
        if run.step >= s.steps or (run.step > s.prefill and passed(before, run.step, s.eval_every)):
            run.report(*evaluate(agent, run.eval_env, s.eval_episodes))
        unsaved = replay.added - run.saved_rows
        if time.monotonic() - saved_at > 60 * s.checkpoint_minutes or unsaved >= s.replay_capacity:
            run.save()
            saved_at = time.monotonic()
    run.save()


def passed(before: int, after: int, every: int) -> int:
    """How many multiples of `every` lie in (before, after]."""
    return after // every - before // every


def to_tensors(rows: np.ndarray, device: torch.device) -> dict[str, Tensor]:
    """Records of the replay as one tensor a field."""
    return {name: torch.from_numpy(rows[name]).to(device) for name in rows.dtype.names}


def check(s: Settings) -> None:
    """Refuse settings that cannot work.

    Raises:
        ValueError: in one sentence, what is wrong and what to do.
    """
    for field in dataclasses.fields(s):
        value = getattr(s, field.name)
        may_be_zero = field.name in ("seed", "prefill") or isinstance(value, float)
        if type(value) in (int, float) and not (value >= 0 if may_be_zero else value > 0):
            raise ValueError(
                f"--{field.name.replace('_', '-')} is {value}, but must be {'0 or ' * may_be_zero}more."
            )
    rows = s.prefill // s.action_repeat
    if s.length > min(rows, s.replay_capacity):
        raise ValueError(
            f"--length {s.length} is longer than the {rows} rows that --prefill {s.prefill} collects: lower one or raise the other."
        )
    if s.device.startswith("cuda") and not torch.cuda.is_available():
        raise ValueError(
            "--device cuda was asked for, but no CUDA device is there: leave it out, or say --device cpu."
        )


@dataclass(frozen=True)
class Command:
    """MaxEnt Dreamer: learns to act from 64×64 pixels in an imagined world, exploring for the entropy of its states.

    Options shown with their values for the arm and preset on this command line.
    """

    settings: tyro.conf.OmitArgPrefixes[Settings]
    resume: str = (
        ""  # folder of a run to go on with, by its own settings; no other option goes with it
    )


def parse(arguments: list[str]) -> Command:
    """The command line. Arm and preset set the defaults that `--help` shows and that the other options change.

    Raises:
        ValueError: in one sentence, if it cannot be understood.
    """
    first = argparse.ArgumentParser(add_help=False, allow_abbrev=False, exit_on_error=False)
    first.add_argument("--arm", default="maxent")
    first.add_argument("--preset", default="small")
    chosen = first.parse_known_args(arguments)[0]
    for name, value, known in (("arm", chosen.arm, ARMS), ("preset", chosen.preset, PRESETS)):
        if value not in known:
            raise ValueError(f"There is no {name} {value!r}: choose one of {', '.join(known)}.")
    default = Command(default_settings(chosen.arm, chosen.preset))
    complaint = io.StringIO()
    try:
        with contextlib.redirect_stderr(complaint):
            return tyro.cli(Command, args=arguments, default=default)
    except SystemExit as error:
        if not error.code:
            raise
        raise ValueError(complaint.getvalue()) from None


def open_run(command: Command) -> Run:
    """A new run in a folder of its own, or one taken up again.

    Raises:
        ValueError: in one sentence, what is wrong with the command.
    """
    s = command.settings
    if command.resume:
        folder = Path(command.resume)
        run = Run(read_settings(folder), folder)
        run.load()
        return run
    check(s)
    name = f"{s.env}-{s.arm}-{s.preset}-seed{s.seed}-{time.strftime('%Y%m%d-%H%M%S')}"
    folder = Path(s.run_dir or f"runs/{name}")
    if folder.exists() and any(folder.iterdir()):
        raise ValueError(
            f"{folder} already holds a run: name another --run-dir, or go on with --resume {folder}."
        )
    run = Run(s, folder)
    folder.mkdir(parents=True, exist_ok=True)
    (folder / "settings.json").write_text(json.dumps(dataclasses.asdict(s), indent=2) + "\n")
    (folder / "metrics.csv").touch()
    return run


def read_settings(folder: Path) -> Settings:
    """The settings of a run folder.

    Raises:
        ValueError: in one sentence, if it holds none or those of another version of this program.
    """
    path = folder / "settings.json"
    if not path.exists():
        raise ValueError(f"{folder} holds no run: there is no settings.json in it.")
    saved = json.loads(path.read_text())
    differing = set(saved) ^ {field.name for field in dataclasses.fields(Settings)}
    if differing:
        raise ValueError(
            f"{folder} was made by another version, whose settings differ in {', '.join(sorted(differing))}."
        )
    return Settings(**saved)


def keep_freed_memory() -> None:
    """Let glibc keep the memory that tensors free, for the next update asks for as much again: without it the
    operating system clears every page anew, a sixth of the paper preset's update (8.3 s instead of 10.3 s)."""
    with contextlib.suppress(OSError, AttributeError):  # not glibc: nothing to set
        m_trim_threshold, m_top_pad, m_mmap_max = -1, -2, -4
        libc = ctypes.CDLL(None)
        libc.mallopt(m_mmap_max, 0)
        libc.mallopt(m_trim_threshold, 2**31 - 1)
        libc.mallopt(m_top_pad, 512 * 2**20)


def main(arguments: list[str]) -> int:
    """Runs the command line; returns the exit code: 0 done, 1 stopped by a fault, 2 bad input."""
    try:
        run = open_run(parse(arguments))
    except ValueError as error:
        print(error, file=sys.stderr)
        return 2
    keep_freed_memory()
    print(run.description(), flush=True)
    interrupted = threading.Event()
    signal.signal(signal.SIGINT, lambda *_: interrupted.set())
    resume = f"go on with: python train.py --resume {run.folder}"
    try:
        train(run, interrupted.is_set)
    except FloatingPointError as error:
        run.save()
        print(
            f"{error} What was learned is in {run.folder}; try --precision float32 or a lower learning rate.",
            file=sys.stderr,
        )
        return 1
    except OSError as error:
        print(f"{error}: the run stopped; its last checkpoint is whole, {resume}", file=sys.stderr)
        return 1
    print(
        f"Interrupted; {resume}"
        if run.step < run.s.steps
        else f"Done; see {run.folder}/metrics.csv"
    )
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
