"""What an update costs, for each arm and preset, against what this machine could do.

    pytest tests/benchmark_update.py --benchmark-only

prints pytest-benchmark's table and, above it, the rows of the README's table, one a benchmark:
seconds of an update (median and least) and of its parts, floating-point operations, the machine's
own matrix rates in bfloat16 and float32, the fraction of the first that is reached, and the peak
memory; what an update of `maxent` costs in one and two processes of one and two threads; then
decisions and environment steps a second of collection. With `| grep '^|'` the rows alone. Where a
CUDA device is, it is measured too. Not part of the default tests.
"""

import ctypes
import dataclasses
import re
import time
from collections import defaultdict
from pathlib import Path

import numpy as np
import pytest
import torch
import torch.distributed as dist
import torch.multiprocessing as mp
from torch.utils.flop_counter import FlopCounterMode

from actors import explore
from env import Replay
from train import (
    ARMS,
    PRESETS,
    Agent,
    act,
    default_settings,
    has_bfloat16,
    keep_freed_memory,
    make_env_of,
    update,
)
from world_model import TransposedConv2d

keep_freed_memory()
CPU = torch.device("cpu")
DEVICES = [
    "cpu",
    pytest.param(
        "cuda",
        marks=pytest.mark.skipif(not torch.cuda.is_available(), reason="no CUDA device is here"),
    ),
]
PARTS = {
    "model": "world model", "stochastic_actor": "explorer", "stochastic_critic": "explorer",
    "deterministic_actor": "deterministic", "deterministic_critic": "deterministic", "mdn": "MDN",
}  # fmt: skip


class PeakMemory:
    """GiB that the device, or on a CPU the process, held at most since it was made (Linux;
    elsewhere not a number)."""

    def __init__(self, device: torch.device):
        self.cuda, self.known = device.type == "cuda", Path("/proc/self/clear_refs").exists()
        if self.cuda:
            torch.cuda.reset_peak_memory_stats()
        elif self.known:
            ctypes.CDLL(None).malloc_trim(0)
            Path("/proc/self/clear_refs").write_text("5")  # its high-water mark: back to now

    def __call__(self) -> float:
        if self.cuda:
            return torch.cuda.max_memory_allocated() / 2**30
        if not self.known:
            return float("nan")
        status = Path("/proc/self/status").read_text()
        return int(re.search(r"VmHWM:\s+(\d+)", status)[1]) / 2**20


def clock() -> float:
    """Seconds, once a device has done all that it was given."""
    if torch.cuda.is_available():
        torch.cuda.synchronize()
    return time.perf_counter()


def matrix_rate(dtype: torch.dtype, device: torch.device) -> float:
    """GFLOP/s of a 2048 × 2048 matrix product, the median of ten."""
    a = torch.randn(2048, 2048, dtype=dtype, device=device)
    seconds = []
    for _ in range(12):
        began = clock()
        a @ a
        seconds.append(clock() - began)
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

    def optimise(self, name, loss, metrics, count=1):
        super().optimise(name, loss, metrics, count)
        now = clock()
        self.seconds[PARTS[name]] += now - self.clock
        self.clock = now


@pytest.mark.parametrize("preset", PRESETS)
@pytest.mark.parametrize("arm", ARMS)
@pytest.mark.parametrize("device", DEVICES)
def test_update(device, arm, preset, benchmark, capsys, monkeypatch):
    s, where = default_settings(arm, preset), torch.device(device)
    torch.manual_seed(0)
    agent = TimedAgent(s, 3, where, bfloat16=has_bfloat16(where))
    batch = {name: x.to(where) for name, x in random_batch(s.batch_size, s.length, 3).items()}
    agent.seconds, agent.clock = defaultdict(float), clock()
    update(agent, batch, 0.1)
    # Counted in PyTorch's form of the transposed convolutions: ours pads, and would count more.
    with monkeypatch.context() as patch, FlopCounterMode(display=False) as counter:
        patch.setattr(TransposedConv2d, "forward", torch.nn.ConvTranspose2d.forward)
        update(agent, batch, 0.1)
    agent.seconds.clear()
    peak = PeakMemory(where)

    def timed() -> None:
        agent.clock = clock()
        update(agent, batch, 0.1)

    rounds = 20 if preset == "small" else 3
    benchmark.pedantic(timed, rounds=rounds)
    memory = peak()
    gflop = counter.get_total_flops() / 1e9
    fast, slow = (matrix_rate(dtype, where) for dtype in (torch.bfloat16, torch.float32))
    seconds, least = benchmark.stats.stats.median, benchmark.stats.stats.min
    spent = [agent.seconds.get(part, 0) / rounds for part in dict.fromkeys(PARTS.values())]
    parts = " | ".join(f"{part:.3f}" if part else "–" for part in spent)
    with capsys.disabled():
        print(
            f"\n| {arm}{', CUDA' * (device != 'cpu')} | {preset} | {seconds:.3f} | {least:.3f} "
            f"| {parts} | {gflop:.0f} | {fast:.0f}, {slow:.0f} | {gflop / seconds / fast:.2f} "
            f"| {memory:.1f} |"
        )


def process(rank: int, processes: int, threads: int, preset: str, folder: Path) -> None:
    """One of so many processes that share `maxent`'s batch; the first one writes down the seconds
    of each update but the first two. (pytest-benchmark's own table has the start in it.)"""
    torch.set_num_threads(threads)
    if processes > 1:
        meeting = f"file://{folder / 'meeting'}"
        dist.init_process_group("gloo", init_method=meeting, rank=rank, world_size=processes)
    s = default_settings("maxent", preset)
    agent = Agent(s, 3, CPU, bfloat16=has_bfloat16(CPU))
    batch, seconds = random_batch(s.batch_size // processes, s.length, 3), []
    for _ in range(22 if preset == "small" else 5):
        began = clock()
        update(agent, batch, 0.1)
        seconds.append(clock() - began)
    if rank == 0:
        np.savetxt(folder / "seconds", seconds[2:])
    if processes > 1:
        dist.destroy_process_group()


@pytest.mark.parametrize("preset", PRESETS)
@pytest.mark.parametrize("processes, threads", [(1, 1), (1, 2), (2, 1)])
def test_processes(processes, threads, preset, benchmark, capsys, tmp_path):
    arguments = processes, threads, preset, tmp_path
    benchmark.pedantic(lambda: mp.spawn(process, arguments, nprocs=processes), rounds=1)
    seconds = np.loadtxt(tmp_path / "seconds")
    with capsys.disabled():
        print(
            f"\n| maxent, {processes} × {threads} | {preset} "
            f"| {np.median(seconds):.3f} | {min(seconds):.3f} |"
        )


@pytest.mark.parametrize("preset", PRESETS)
def test_collection(preset, benchmark, capsys):
    """Decisions a second within an episode: state, action, physics, rendering, replay."""
    s = default_settings("maxent", preset)
    env = make_env_of(dataclasses.replace(s, env="HalfCheetahBulletEnv-v0"))
    agent = Agent(s, 6, CPU, bfloat16=has_bfloat16(CPU))
    replay, rng, state = Replay(1000, 6), np.random.default_rng(0), None
    replay.add(env.reset(seed=0)[0], is_first=True)

    def eighty() -> None:  # six times: an episode has 500
        nonlocal state
        for _ in range(80):
            last, policy = replay.last, agent.players["stochastic"]
            action, state = act(agent, policy, last["image"], last["action"], state)
            action = explore(action, s.action_noise, s.random_action, rng)
            image, reward, terminated, _, _ = env.step(action)
            replay.add(image, action, reward, terminated)

    benchmark.pedantic(eighty, rounds=5, warmup_rounds=1)
    env.close()
    rate = 80 / benchmark.stats.stats.median
    with capsys.disabled():
        print(
            f"\n| collection | {preset} | {rate:.0f} decisions, "
            f"{s.action_repeat * rate:.0f} environment steps a second |"
        )
