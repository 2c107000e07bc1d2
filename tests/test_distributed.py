"""Several processes under torchrun are one run: equal gradients, equal parameters, equal metrics
after a death, and nobody waits for the dead. Two processes on the CPU, by gloo."""

import dataclasses
import math
import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest
import torch
import torch.distributed as dist
import torch.multiprocessing as mp
from test_arms import make_agent, make_batch, tiny
from test_train import metrics, wait_for

import actors
import train
from train import ARMS, Run, Settings, check, default_settings, read_checkpoint, update

ROWS, LENGTH = 3, 6
STILL = dict(model_lr=0.0, actor_lr=0.0, critic_lr=0.0, mdn_lr=0.0, grad_clip=1e9)


# ---- the update ----------------------------------------------------------------------------------


def shard(rank: int) -> dict[str, torch.Tensor]:
    """One process's windows. The first one's hold ends and first rows, the second one's hardly."""
    random = torch.Generator().manual_seed(rank)
    size = ROWS, LENGTH
    batch = {
        "image": torch.randint(256, (*size, 64, 64, 3), generator=random, dtype=torch.uint8),
        "action": 2 * torch.rand(*size, 2, generator=random) - 1,
        "reward": torch.randn(size, generator=random) + 2 * rank,
        "terminated": torch.zeros(size, dtype=torch.bool),
        "is_first": torch.zeros(size, dtype=torch.bool),
    }
    for row, at in ((0, 2), (1, 0), (2, 4)) if rank == 0 else ((1, 5),):
        batch["is_first"][row, at] = True
        batch["terminated"][row, max(0, at - 1)] = rank == 0 and at > 0
    return batch


def whole() -> dict[str, torch.Tensor]:
    shards = [shard(rank) for rank in range(2)]
    return {name: torch.cat([each[name] for each in shards]) for name in shards[0]}


LIVE = [int((~shard(rank)["terminated"]).sum()) for rank in range(2)]


def chosen(n: int, device: torch.device) -> torch.Tensor:
    """In the place of a random order: half of each process's live states, or of its rows, its first
    ones."""
    for one, other in (LIVE, [ROWS * LENGTH] * 2):
        if n == one + other:
            return torch.cat([torch.arange(one // 2), one + torch.arange(other // 2)])
    return torch.arange(n)


def gradients(batch: dict[str, torch.Tensor], s: Settings) -> dict[str, object]:
    """The gradients of one update, by optimiser, and its metrics. Learning rates are 0, and noise
    is 0.3 everywhere, so that a row has the same noise wherever it stands."""
    agent, found = make_agent(s), {}
    step = agent.optimise

    def recorded(name, *rest) -> None:
        step(name, *rest)
        parameters = agent.optimisers[name].param_groups[0]["params"]
        found[name] = torch.cat([p.grad.flatten() for p in parameters])

    agent.optimise = recorded
    noise = {"randn": lambda *size, **_: torch.full(size, 0.3), "randperm": chosen}
    noise["randn_like"] = lambda x: torch.full_like(x, 0.3)
    with pytest.MonkeyPatch.context() as patch:
        for name, function in noise.items():
            patch.setattr(torch, name, function)
        patch.setattr(
            "torch.distributions.normal._standard_normal",
            lambda shape, **_: torch.full(shape, 0.3),
        )
        found["metrics"] = update(agent, batch, 0.1, look=True)
    return found


def free_nats(weight: float) -> float:
    """A threshold between the KL of one process's shard (0: the smaller) and that of all (1)."""
    s = tiny("dreamer", free_nats=0.0, **STILL)
    small = min(gradients(shard(rank), s)["metrics"]["model/kl"] for rank in range(2))
    return small + weight * (gradients(whole(), s)["metrics"]["model/kl"] - small)


CASES = {arm: tiny(arm, **STILL) for arm in ARMS} | {
    **{f"{arm}, half the starts": tiny(arm, starts=0.5, **STILL) for arm in ARMS},
    "blind": tiny("maxent", observe_first=False, **STILL),
    "half the images": tiny("maxent", decode_share=0.5, **STILL),
    "penalty": tiny("maxent", action_penalty=0.01, **STILL),
    "ends ahead": tiny("maxent", ends_ahead=2, burn_in=1, **STILL),
}
MARGINS = {"below all, above one": 0.5, "above all, below one": 1.5}


def keep_gradients(rank: int, folder: Path, cases: dict[str, Settings]) -> None:
    found = {name: gradients(shard(rank), s) for name, s in cases.items()}
    torch.save((cases, found), folder / f"gradients.{rank}")


def keep_weights(rank: int, folder: Path) -> None:
    """Those after twelve updates on different rows, and the random number that comes next."""
    s = dataclasses.replace(tiny("maxent"), starts=0.5, play_rate=0.1)
    agent = make_agent(s)
    torch.manual_seed(rank)
    for number in range(12):
        batch = shard(2 * number + rank)
        batch["terminated"][0, number % LENGTH] = rank == 0
        update(agent, batch, 0.1, look=number % 5 == 0)
    torch.save((agent.state_dict(), torch.rand(1)), folder / f"weights.{rank}")


def meet_infinity(rank: int, folder: Path) -> None:
    """One process's reward is infinite, where Smooth L1 is too and its gradient is 1: what each
    then says, and whether its model is as it was."""
    s = tiny("maxent")
    agent, batch = make_agent(s), shard(rank)
    before = [p.clone() for p in agent.model.parameters()]
    batch["reward"][0, LENGTH // 2] = math.inf if rank == 0 else 0.0
    batch["is_first"][0, LENGTH // 2] = False
    with pytest.raises(FloatingPointError) as stopped:
        update(agent, batch, 0.1)
    loss = sum(p.sum() for p in agent.model.parameters())  # what `masked_mean` does not share
    agent.optimise("model", loss + (math.inf if rank == 0 else 0.0), alone := {})
    same = all(torch.equal(a, b) for a, b in zip(before, agent.model.parameters(), strict=True))
    found = str(stopped.value), alone["model/grad_norm"].item(), same
    torch.save(found, folder / f"infinity.{rank}")


def outlive(rank: int, folder: Path) -> None:
    """The second process dies; the seconds until the first one knows."""
    s = tiny("maxent")
    agent = make_agent(s)
    if rank == 1:
        update(agent, shard(rank), 0.1)
        os._exit(9)
    began = time.monotonic()
    with pytest.raises(RuntimeError) as ended:
        for _ in range(100):
            update(agent, shard(rank), 0.1)
    assert "gloo" in str(ended.value)
    (folder / "seconds").write_text(str(time.monotonic() - began))


def work(rank: int, folder: Path, cases: dict[str, Settings]) -> None:
    torch.set_num_threads(1)
    dist.init_process_group("gloo", f"file://{folder}/meeting", rank=rank, world_size=2)
    keep_gradients(rank, folder, cases)
    keep_weights(rank, folder)
    meet_infinity(rank, folder)
    outlive(rank, folder)
    dist.destroy_process_group()


@pytest.fixture(scope="module")
def apart(tmp_path_factory) -> Path:
    """What two processes that know each other leave in a folder."""
    folder = tmp_path_factory.mktemp("apart")
    margins = {name: tiny("dreamer", free_nats=free_nats(weight), **STILL)
               for name, weight in MARGINS.items()}  # fmt: skip
    new = mp.get_context("spawn").Process
    workers = [new(target=work, args=(rank, folder, CASES | margins)) for rank in range(2)]
    for worker in workers:
        worker.start()
    for worker in workers:
        worker.join(120)
    assert [worker.exitcode for worker in workers] == [0, 9]
    return folder


def test_a_process_that_dies_leaves_no_other_waiting(apart):
    assert float((apart / "seconds").read_text()) < 20


@pytest.mark.parametrize("case", [*CASES, *MARGINS])
def test_gradients_are_those_of_one_process_with_all_shards_as_its_batch(case, apart):
    cases = torch.load(apart / "gradients.0", weights_only=False)[0]
    found = [torch.load(apart / f"gradients.{rank}", weights_only=False)[1] for rank in range(2)]
    one = gradients(whole(), cases[case])
    metrics = one.pop("metrics")
    for each in found:
        assert each[case].keys() - {"metrics"} == one.keys()
        for name, gradient in one.items():
            error = (each[case][name] - gradient).norm() / gradient.norm()
            assert gradient.norm() > 0 and error < 1e-5, (name, error)
        for name in (n for n in metrics if "grad_norm" in n or n.startswith("model/")):
            assert each[case]["metrics"][name] == pytest.approx(metrics[name], rel=1e-5), name
    first, second = (each[case]["metrics"]["reward_r2"] for each in found)
    assert first != second  # each has its own rows


def test_parameters_stay_equal_over_twelve_updates(apart):
    (first, mine), (second, other) = (torch.load(apart / f"weights.{rank}") for rank in range(2))
    before = make_agent(tiny("maxent")).state_dict()
    assert all(torch.equal(first[name], second[name]) for name in first)
    assert not any(torch.equal(first[name], before[name]) for name in first)
    assert mine != other  # of random numbers


def test_an_infinite_loss_in_one_process_stops_both_and_changes_neither(apart):
    for said, norm, same in (torch.load(apart / f"infinity.{rank}") for rank in range(2)):
        assert said.startswith("Not finite: ") and "model/grad_norm" in said
        assert not math.isfinite(norm) and same


@pytest.mark.parametrize("arm", ARMS)
def test_an_update_of_one_process_is_the_same_bit_for_bit_with_and_without_torchrun(arm, tmp_path):
    def after() -> tuple[dict, dict]:
        agent = make_agent(s)
        torch.manual_seed(1)
        return update(agent, make_batch(s), 0.1, look=True), agent.state_dict()

    s = tiny(arm, starts=0.5)
    metrics, weights = after()
    dist.init_process_group("gloo", f"file://{tmp_path}/meeting", rank=0, world_size=1)
    try:
        same_metrics, same_weights = after()
    finally:
        dist.destroy_process_group()
    assert metrics == same_metrics
    assert all(torch.equal(weights[name], same_weights[name]) for name in weights)


# ---- checkpoints ---------------------------------------------------------------------------------


def checkpoint(path: Path, step: int) -> None:
    torch.save({"settings": "", "kept": dict.fromkeys(Run.KEPT, 0) | {"step": step}}, path)


def test_the_newest_checkpoint_that_all_processes_have_is_taken(tmp_path, monkeypatch):
    checkpoint(tmp_path / "checkpoint.pt", 3)
    checkpoint(tmp_path / "checkpoint.previous.pt", 2)
    for others, taken in (([3, 2], 3), ([2, 1], 2), ([2], 2)):
        held = iter(others)
        other = [next(held)]

        def gathered(moment, held=held, other=other):
            found = [moment, (other[0], 0, 0)]
            if found[1] == max(found) != moment:
                other[0] = next(held)
            return found

        monkeypatch.setattr(train, "gathered", gathered)
        assert read_checkpoint(tmp_path)[1]["kept"]["step"] == taken
    monkeypatch.setattr(train, "gathered", lambda moment: [moment, (1, 0, 0)])
    with pytest.raises(ValueError, match="no whole checkpoint"):
        read_checkpoint(tmp_path)


# ---- the command line ----------------------------------------------------------------------------

TINY = (
    "--deter 16 --stoch 8 --hidden 16 --units 16 --depth 2 --mdn-units 16 --horizon 5 --starts 0.5 "
    "--batch-size 4 --length 8 --prefill 60 --eval-episodes 3 --random-action 0.5 "
    "--steps 300 --eval-every 150 --checkpoint-minutes 0.005"
).split()


def torchrun(*arguments, options=()) -> subprocess.Popen:
    """train.py in two processes of one thread each."""
    launcher = [sys.executable, "-m", "torch.distributed.run", "--standalone", *options]
    return subprocess.Popen(
        [*launcher, "--nproc-per-node", "2", train.__file__, *map(str, arguments)],
        env=os.environ | {"OMP_NUM_THREADS": "1"},
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
    )


def worker(launcher: subprocess.Popen, rank: int) -> int:
    """The process number of a rank."""
    children = Path(f"/proc/{launcher.pid}/task/{launcher.pid}/children").read_text()
    for child in children.split():
        if f"RANK={rank}" in Path(f"/proc/{child}/environ").read_text().split("\0"):
            return int(child)
    raise AssertionError(f"no rank {rank}")


@pytest.fixture(scope="module")
def uninterrupted(tmp_path_factory) -> Path:
    folder = tmp_path_factory.mktemp("runs") / "uninterrupted"
    launcher = torchrun("--run-dir", folder, *TINY)
    said, errors = launcher.communicate(timeout=200)
    assert launcher.returncode == 0, errors
    assert said.count("return ") == 2 and said.count("Done") == 1  # the first speaks for all
    return folder


def ends_as(other: Path, folder: Path, launcher: subprocess.Popen) -> str:
    """Wait until a run has ended, with the metrics of the other: what it said on the way."""
    _, errors = launcher.communicate(timeout=200)
    assert launcher.returncode == 0, errors
    assert metrics(folder) == metrics(other)
    return errors


def test_each_process_keeps_its_own_and_the_first_the_rest(uninterrupted):
    names = {path.name for path in uninterrupted.iterdir() if "tfevents" not in path.name}
    own = {"replay.bin", "checkpoint.pt", "checkpoint.previous.pt", "run.lock"}
    rest = {"settings.json", "metrics.csv", "best.pt", "weights.pt", "run.owner"}
    assert names == own | {"rank-1"} | rest
    others = {path.name for path in (uninterrupted / "rank-1").iterdir()}
    assert {name for name in others if "tfevents" not in name} == own
    saved = [torch.load(uninterrupted / folder / "checkpoint.pt") for folder in ("", "rank-1")]
    assert saved[0]["agent"].keys() == saved[1]["agent"].keys()
    assert all(torch.equal(saved[0]["agent"][k], saved[1]["agent"][k]) for k in saved[0]["agent"])
    rows, other = (each["kept"]["saved_rows"] for each in saved)
    assert abs(rows - other) < 30 and 2 * (rows + other) > 300  # steps are those of both
    begun = [train.Replay(500_000, 3, uninterrupted / folder / "replay.bin").read(0)
             for folder in ("", "rank-1")]  # fmt: skip
    assert begun[0] != begun[1]  # each has episodes of its own
    assert int(metrics(uninterrupted)[-1]["env_steps"]) == saved[1]["kept"]["step"]


def test_a_run_killed_in_one_process_and_restarted_equals_one_never_killed(uninterrupted, tmp_path):
    folder = tmp_path / "run"
    launcher = torchrun("--run-dir", folder, *TINY, options=["--max-restarts", "1"])
    wait_for(folder / "rank-1/checkpoint.previous.pt", launcher)
    time.sleep(0.1)
    os.kill(worker(launcher, 1), signal.SIGKILL)
    errors = ends_as(uninterrupted, folder, launcher)
    assert "Another process of this run has ended" in errors and "Traceback" not in errors


@pytest.mark.slow
def test_a_process_one_checkpoint_behind_the_other_is_waited_for(uninterrupted, tmp_path):
    folder = tmp_path / "run"
    launcher = torchrun("--run-dir", folder, *TINY)
    wait_for(folder / "rank-1/checkpoint.previous.pt", launcher)
    os.kill(worker(launcher, 0), signal.SIGKILL)
    launcher.communicate(timeout=60)
    assert launcher.returncode == 1
    newest = torch.load(folder / "rank-1/checkpoint.pt")["kept"]["step"]
    (folder / "rank-1/checkpoint.pt").unlink()
    launcher = torchrun("--resume", folder)
    wait_for(folder / "rank-1/checkpoint.pt", launcher)
    previous = torch.load(folder / "checkpoint.previous.pt")["kept"]["step"]
    assert previous != newest or launcher.poll() is not None  # what was passed over is gone
    ends_as(uninterrupted, folder, launcher)


@pytest.mark.slow
def test_ctrl_c_saves_in_all_processes_and_says_how_to_go_on(uninterrupted, tmp_path):
    folder = tmp_path / "run"
    launcher = torchrun("--run-dir", folder, *TINY)
    wait_for(folder / "rank-1/checkpoint.previous.pt", launcher)
    launcher.send_signal(signal.SIGINT)
    said, _ = launcher.communicate(timeout=60)
    assert f"--resume {folder}" in said and "torchrun --nproc-per-node 2" in said
    kept = [read["kept"]["step"] for read in map(torch.load, folder.rglob("checkpoint.pt"))]
    assert len(kept) == 2 and kept[0] == kept[1]
    launcher = torchrun("--resume", folder)
    ends_as(uninterrupted, folder, launcher)


@pytest.mark.parametrize("usable", [True, False])
def test_devices_that_are_seen_and_cannot_be_used_are_not_counted(usable, monkeypatch):
    monkeypatch.setenv("LOCAL_WORLD_SIZE", "2")
    monkeypatch.setattr("torch.cuda.device_count", lambda: 1)
    monkeypatch.setattr("torch.cuda.is_available", lambda: usable)
    monkeypatch.setattr(dist, "is_torchelastic_launched", lambda: True)
    monkeypatch.setattr(dist, "rendezvous", lambda _: 1 / 0)  # as far as CPUs come here
    with pytest.raises(ValueError if usable else ZeroDivisionError):
        train.join_processes()


def test_processes_share_an_evaluations_episodes_out(monkeypatch):
    def played(agent, env, policy, seed, most):
        seeds.append(seed)
        return actors.Episode(*[None] * 5, total=0.0, length=1)

    seeds, agent = [], make_agent(tiny("revised", eval_episodes=5))
    monkeypatch.setattr(train, "processes", lambda: 2)
    monkeypatch.setattr(train, "play", played)
    for rank in (0, 1):
        monkeypatch.setattr(train, "rank", lambda rank=rank: rank)
        train.evaluate(agent, None, lambda text: None)
    assert sorted(seeds) == sorted(train.evaluation_seed(k) for k in range(5))


@pytest.mark.parametrize(
    "changes, word",
    [(dict(batch_size=3), "--batch-size 3"), (dict(length=20, prefill=60), "15 rows")],
)
def test_what_cannot_be_shared_out_is_refused(changes, word, monkeypatch):
    s = dataclasses.replace(default_settings(), **changes)
    assert check(s.to_json()) == s
    monkeypatch.setattr(train, "processes", lambda: 2)
    with pytest.raises(ValueError, match=word):
        check(s.to_json())
