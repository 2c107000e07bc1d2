"""Returns to be better than: uniformly random actions, and none.

    python results/reference.py

writes results/reference.csv: ten episodes each, with the seeds of every evaluation; mean return,
half its 95% interval, mean length in environment steps.
"""

import sys
from pathlib import Path

import numpy as np

sys.path.insert(0, str(Path(__file__).parents[1]))
from env import make_env
from train import Settings, interval95

ENVIRONMENTS = ("Hopper", "Walker2D", "HalfCheetah", "Ant")


def episode(env, seed: int, scale: float) -> tuple[float, int]:
    """Return and length of an episode of uniform actions in [−scale, scale]."""
    env.reset(seed=seed)
    rng, over = np.random.default_rng(seed), False
    while not over:
        action = scale * rng.uniform(-1, 1, env.action_space.shape)
        _, _, terminated, truncated, info = env.step(action.astype(np.float32))
        over = terminated or truncated
    return info["episode"]["r"], info["episode"]["l"]


if __name__ == "__main__":
    lines = ["env,policy,return,interval95,length"]
    envs = []  # kept: a PyBullet world that is collected disconnects those opened after it
    for name in ENVIRONMENTS:
        envs.append(
            make_env(f"{name}BulletEnv-v0", Settings.action_repeat, Settings.camera_distance)
        )
        for policy, scale in (("random", 1.0), ("zero", 0.0)):
            played = [episode(envs[-1], 2**31 + i, scale) for i in range(10)]
            returns, lengths = np.array(played).T
            row = f"{returns.mean():.1f},{interval95(returns):.1f},{lengths.mean():.1f}"
            lines.append(f"{name}BulletEnv-v0,{policy},{row}")
    Path(__file__).with_name("reference.csv").write_text("\n".join(lines) + "\n")
