"""What an update costs, for each arm and preset, against what this machine could do.

    pytest tests/benchmark_update.py --benchmark-only

prints pytest-benchmark's table and, below it, one line a benchmark: seconds of the parts of an
update, floating-point operations, the machine's own matrix rates and the fraction reached.
Not part of the default tests.
"""

import contextlib
import ctypes
import re
import time
from collections import defaultdict
from pathlib import Path

import numpy as np
import pytest
import torch
from torch.utils.flop_counter import FlopCounterMode

from env import make_env
from train import (
    ARMS,
    PRESETS,
    Agent,
    act,
    default_settings,
    has_bfloat16,
    keep_freed_memory,
    update,
)
from world_model import TransposedConv2d

keep_freed_memory()
CPU = torch.device("cpu")
PARTS = {
    "model": "world model", "stochastic_actor": "explorer", "stochastic_critic": "explorer",
    "mdn": "MDN", "deterministic_actor": "deterministic", "deterministic_critic": "deterministic",
}  # fmt: skip


class PeakMemory:
    """GiB that the process held at most since it was made (Linux; elsewhere not a number)."""

    def __init__(self):
        with contextlib.suppress(OSError, AttributeError):
            ctypes.CDLL(None).malloc_trim(0)
            Path("/proc/self/clear_refs").write_text("5")  # its high-water mark: back to now

    def __call__(self) -> float:
        with contextlib.suppress(OSError):
            status = Path("/proc/self/status").read_text()
            return int(re.search(r"VmHWM:\s+(\d+)", status)[1]) / 2**20
        return float("nan")


def matrix_rate(dtype: torch.dtype) -> float:
    """GFLOP/s of a 2048 × 2048 matrix product, the median of ten."""
    a = torch.randn(2048, 2048, dtype=dtype)
    seconds = []
    for _ in range(12):
        began = time.perf_counter()
        a @ a
        seconds.append(time.perf_counter() - began)
    return 2 * 2048**3 / np.median(seconds[2:]) / 1e9


def random_batch(batch: int, length: int, actions: int) -> dict[str, torch.Tensor]:
    """A batch as the replay gives it, of noise."""
    return {
        "image": torch.randint(0, 256, (batch, length, 64, 64, 3), dtype=torch.uint8),
        "action": torch.rand(batch, length, actions) * 2 - 1,
        "reward": torch.randn(batch, length),
        "terminated": torch.rand(batch, length) < 0.02,
        "is_first": torch.rand(batch, length) < 0.02,
    }


class TimedAgent(Agent):
    """An agent that keeps the seconds up to the end of each optimiser step, by part."""

    def step(self, name, loss, metrics):
        super().step(name, loss, metrics)
        now = time.perf_counter()
        self.seconds[PARTS[name]] += now - self.clock
        self.clock = now


@pytest.mark.parametrize("preset", PRESETS)
@pytest.mark.parametrize("arm", ARMS)
def test_update(arm, preset, benchmark, capsys, monkeypatch):
    s, peak = default_settings(arm, preset), PeakMemory()
    torch.manual_seed(0)
    agent = TimedAgent(s, 3, CPU, bfloat16=has_bfloat16(CPU))
    batch = random_batch(s.batch_size, s.length, 3)
    agent.seconds, agent.clock = defaultdict(float), time.perf_counter()
    update(agent, batch, 0.1, s)
    # Counted in PyTorch's form of the transposed convolutions: ours pads, and would count more.
    with monkeypatch.context() as patch, FlopCounterMode(display=False) as counter:
        patch.setattr(TransposedConv2d, "forward", torch.nn.ConvTranspose2d.forward)
        update(agent, batch, 0.1, s)
    agent.seconds.clear()

    def timed() -> None:
        agent.clock = time.perf_counter()
        update(agent, batch, 0.1, s)

    rounds = 10 if preset == "small" else 3
    benchmark.pedantic(timed, rounds=rounds)
    gflop, fast, slow = (
        counter.get_total_flops() / 1e9,
        *map(matrix_rate, (torch.bfloat16, torch.float32)),
    )
    seconds = benchmark.stats.stats.median
    parts = ", ".join(f"{name} {total / rounds:.3f}" for name, total in agent.seconds.items())
    with capsys.disabled():
        print(
            f"\n{arm}, {preset}: {seconds:.3f} s an update ({parts}); {gflop:.0f} GFLOP; "
            f"bfloat16 {fast:.0f} and float32 {slow:.0f} GFLOP/s; "
            f"{gflop / seconds / fast:.2f} of bfloat16; peak memory {peak():.1f} GiB"
        )


@pytest.mark.parametrize("preset", PRESETS)
def test_collection(preset, benchmark, capsys):
    """Decisions a second: state, action, physics, rendering."""
    s = default_settings("maxent", preset)
    env = make_env("HalfCheetahBulletEnv-v0", s.action_repeat, s.camera_distance)
    agent = Agent(s, 6, CPU, bfloat16=has_bfloat16(CPU))

    def hundred() -> None:
        image, _ = env.reset(seed=0)
        action, state = np.zeros(6, np.float32), None
        for _ in range(100):
            action, state = act(agent, agent.actors["stochastic"], image, action, state)
            image = env.step(action)[0]

    benchmark.pedantic(hundred, rounds=5, warmup_rounds=1)
    env.close()
    with capsys.disabled():
        rate = 100 / benchmark.stats.stats.median
        print(
            f"\n{preset}: {rate:.0f} decisions, {s.action_repeat * rate:.0f} environment steps "
            "a second"
        )
