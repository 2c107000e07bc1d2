"""Returns to be better than: uniformly random actions, none, and the best that never changes.

    python results/reference.py

writes results/reference.csv: mean return of ten episodes with the seeds of every evaluation, half
its 95% interval, mean length in environment steps. The best constant action is a corner of the
action box: of all, the eight that earn most in two episodes (of other seeds), of these, the one
that does in ten. An agent that holds a pose has learnt no more. Rewards do not depend on images,
so none are rendered.
"""

import argparse
import itertools
import sys
from pathlib import Path

import gymnasium as gym
import numpy as np
from gymnasium import wrappers

sys.path.insert(0, str(Path(__file__).parents[1]))
import env  # registers the PyBullet environments
from train import Settings, evaluation_seed, interval95


def episode(world: gym.Env, seed: int, policy) -> tuple[float, int]:
    """Return and length of an episode of actions in [−1, 1] that look at nothing."""
    world.reset(seed=seed)
    over = False
    while not over:
        _, _, terminated, truncated, info = world.step(policy().astype(np.float32))
        over = terminated or truncated
    return info["episode"]["r"], info["episode"]["l"]


def policies(world: gym.Env) -> dict:
    """{name: what gives the next action}."""
    size, rng = world.action_space.shape[0], np.random.default_rng(0)
    corners = [np.array(corner) for corner in itertools.product((-1.0, 1.0), repeat=size)]

    def earned(corner: np.ndarray, episodes: int) -> float:
        return np.mean([episode(world, seed, lambda: corner)[0] for seed in range(episodes)])

    some = sorted(corners, key=lambda corner: earned(corner, 2))[-8:]
    best = max(some, key=lambda corner: earned(corner, 10))
    print(world.spec.id, "constant", best)
    random, zero = (lambda: rng.uniform(-1, 1, size)), (lambda: np.zeros(size))
    return {"random": random, "zero": zero, "constant": lambda: best}


def make(name: str) -> gym.Env:
    """The environment without its images, warmed up as `env.make_env` does it."""
    world = wrappers.RecordEpisodeStatistics(gym.make(f"{name}BulletEnv-v0"))
    world = wrappers.RepeatAction(world, Settings.action_repeat)
    with env.silence():
        world.reset(seed=0)
    return world


if __name__ == "__main__":
    says = "Writes results/reference.csv: what actions earn that look at nothing."
    argparse.ArgumentParser(prog="python results/reference.py", description=says).parse_args()
    lines = ["env,policy,return,interval95,length"]
    for name in ("Hopper", "Walker2D", "HalfCheetah", "Ant"):
        world = make(name)
        for policy, act in policies(world).items():
            played = [episode(world, evaluation_seed(k), act) for k in range(10)]
            returns, lengths = np.array(played).T
            row = f"{returns.mean():.1f},{interval95(returns):.1f},{lengths.mean():.1f}"
            lines.append(f"{name}BulletEnv-v0,{policy},{row}")
            print(lines[-1], flush=True)
    Path(__file__).with_name("reference.csv").write_text("\n".join(lines) + "\n")
