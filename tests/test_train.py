"""The whole program, as its user meets it: real PyBullet steps, bad input, kills and faults."""

import csv
import dataclasses
import errno
import json
import os
import random
import re
import resource
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import ClassVar

import gymnasium as gym
import numpy as np
import pytest
import torch
from scipy import stats

import actors
import train
from train import (
    ARMS,
    Agent,
    Settings,
    check,
    default_settings,
    has_bfloat16,
    main,
    read_checkpoint,
)

TRAIN = Path(__file__).parent.parent / "train.py"
TINY = (
    "--deter 16 --stoch 8 --hidden 16 --units 16 --depth 2 --mdn-units 16 --horizon 5 "
    "--batch-size 3 --length 8 --prefill 60 --eval-episodes 2 --random-action 0.5 --free-nats 0"
).split()
TIMES = ("wall_seconds", "update_seconds")


def command(*arguments) -> list[str]:
    return [sys.executable, str(TRAIN), *map(str, arguments)]


def run(*arguments, **options) -> subprocess.CompletedProcess:
    """The command line in a process of its own, with one thread."""
    environment = os.environ | {"OMP_NUM_THREADS": "1"}
    return subprocess.run(
        command(*arguments), env=environment, capture_output=True, text=True, timeout=300, **options
    )


def metrics(folder: Path) -> list[dict[str, str]]:
    """Rows of metrics.csv without what depends on the clock."""
    with open(folder / "metrics.csv", newline="") as file:
        return [{k: v for k, v in row.items() if k not in TIMES} for row in csv.DictReader(file)]


def one_sentence(text: str) -> bool:
    return "Traceback" not in text and len(text.strip().splitlines()) == 1


class NumPyEnv(gym.Env):
    """Its rewards and flags are NumPy's own scalars, as many environments' are."""

    metadata: ClassVar = {"render_modes": ["rgb_array"]}
    action_space = gym.spaces.Box(-1, 1, (2,))
    observation_space = gym.spaces.Box(-1, 1, (1,))
    render_mode = "rgb_array"

    def __init__(self, render_mode=None):
        self.steps = 0

    def reset(self, seed=None, options=None):
        self.steps = 0
        return np.zeros(1, np.float32), {}

    def step(self, action):
        self.steps += 1
        return np.zeros(1, np.float32), np.float64(1), np.bool_(self.steps == 7), np.bool_(0), {}

    def render(self):
        return np.full((64, 64, 3), 30 * self.steps, np.uint8)


@pytest.fixture
def numpy_env(register):
    register(NumPyEnv, "NumPy-v0")


# ---- training ------------------------------------------------------------------------------------


@pytest.mark.parametrize("arm", ARMS)
def test_each_arm_trains_on_pixels_and_moves_every_parameter(arm, tmp_path):
    folder = tmp_path / "run"
    brief = ["--steps", "300", "--eval-every", "150", "--run-dir", str(folder)]
    assert main(["--arm", arm, *brief, *TINY]) == 0
    settings = Settings(**json.loads((folder / "settings.json").read_text()))
    rows = metrics(folder)
    assert [int(row["env_steps"]) // 150 for row in rows] == [1, 2]
    if settings.entropy:
        assert float(rows[0]["stochastic_actor/return_grad_norm"]) > 0  # every fiftieth update's
    torch.manual_seed(settings.seed)
    fresh = Agent(settings, actions=3, device=torch.device("cpu"), bfloat16=False).state_dict()
    saved = torch.load(folder / "weights.pt", weights_only=True)
    assert saved.keys() == fresh.keys()
    assert [name for name in fresh if torch.equal(saved[name], fresh[name])] == []
    assert ("mdn/entropy" in rows[0]) == settings.entropy
    assert ("model/termination" in rows[0]) == settings.termination


@pytest.mark.parametrize(
    "env", ["Walker2DBulletEnv-v0", "HalfCheetahBulletEnv-v0", "AntBulletEnv-v0"]
)
def test_other_robots_train(env, tmp_path):
    small = [*TINY, "--eval-episodes", "1", "--eval-max-steps", "40"]
    assert main(["--env", env, "--steps", "100", "--run-dir", str(tmp_path / "run"), *small]) == 0
    assert len(metrics(tmp_path / "run")) == 1


def test_equal_seeds_give_equal_metrics_and_other_seeds_others(tmp_path, numpy_env):
    for name, seed in (("a", "1"), ("b", "1"), ("c", "2")):
        arguments = ["--env", "NumPy-v0", "--steps", "90", "--run-dir", str(tmp_path / name)]
        assert main([*arguments, "--seed", seed, *TINY]) == 0
    assert metrics(tmp_path / "a") == metrics(tmp_path / "b")
    assert metrics(tmp_path / "a") != metrics(tmp_path / "c")


def test_coverage_is_of_the_rows_since_the_last_evaluation(tmp_path, monkeypatch, numpy_env):
    rows = []
    monkeypatch.setattr("train.coverage", lambda states: rows.append(states.shape) or 0.0)
    folder = str(tmp_path / "run")
    arguments = ["--env", "NumPy-v0", "--steps", "140", "--eval-every", "35", "--run-dir", folder]
    assert main([*arguments, *TINY]) == 0
    # episodes of seven steps are four decisions: 70, 105 and 140 steps are 40, 60 and 80
    assert rows == [(40, 1), (20, 1), (20, 1)]


@pytest.mark.parametrize("arm, collect, turn, turns, noise", [
    ("maxent", "both", 1000, "EE AAAA EEEE AAAA", 0.3),
    ("maxent", "explorer", 1000, "EE EEEE EEEE EEEE", 0.3),
    ("revised", "both", 1000, "EE AAAA EEEE AAAA", 0.3),
    ("revised", "explorer", 1000, "EE EEEE EEEE EEEE", 0.3),
    ("maxent", "both", 4, "AA AAEE EEAA AAEE", 0.3),  # as in episodes longer than a turn
])  # fmt: skip
def test_only_the_explorers_actions_are_disturbed(
    arm, collect, turn, turns, noise, tmp_path, monkeypatch, numpy_env
):
    """What the evaluated actor collects is what it would earn, so the model learns of that. Whoever
    acts remembers the episode, and nothing of the one before."""
    seen = []  # who acts, and whether the action before was a disturbed one
    remembered = [None]

    def acting(agent, policy, image, action, state):
        who = {agent.players["stochastic"]: "E", agent.evaluated.greedy: "A"}[policy]
        assert state is (remembered[-1] if action.any() else None)  # 0 before the first image
        seen.append((who, bool((action == 1).all())))
        action, state = actors.act(agent, policy, image, action, state)
        remembered.append(state)
        return action, state

    def exploring(action, *how):
        assert how[:2] == (noise, 0.5)
        return np.ones_like(action)

    monkeypatch.setattr("train.TURN", turn)
    monkeypatch.setattr("train.act", acting)
    monkeypatch.setattr("train.explore", exploring)
    arguments = ["--env", "NumPy-v0", "--steps", "140", "--run-dir", str(tmp_path / "run")]
    assert main([*arguments, "--arm", arm, "--collect", collect, *TINY]) == 0
    # an episode is four decisions of two steps; half of the first one's are prefill
    expected = []
    for episode in turns.split():
        disturbed = [False, *(who == "E" for who in episode[:-1])]
        expected += zip(episode, disturbed, strict=True)
    assert seen[: len(expected)] == expected


def test_an_explorer_that_falls_at_once_collects_as_much_as_what_is_evaluated(
    tmp_path, monkeypatch, numpy_env
):
    def step(env, action):
        image, reward, over, *rest = unhurt(env, action)
        return image, reward, over or np.bool_(env.explored), *rest

    def exploring(action, *_):
        NumPyEnv.explored = True
        return action

    def acting(*given):
        NumPyEnv.explored = False
        return actors.act(*given)

    unhurt, taken = NumPyEnv.step, {True: 0, False: 0}
    noted = train.Run.note_decision

    def noting(run, *given):
        before, explores = run.step, run.explores
        noted(run, *given)
        taken[explores] += run.step - before
        assert run.lead == taken[True] - taken[False] and -7 < run.lead <= 7

    NumPyEnv.explored = False
    monkeypatch.setattr(NumPyEnv, "step", step)
    monkeypatch.setattr("train.act", acting)
    monkeypatch.setattr("train.explore", exploring)
    monkeypatch.setattr("train.Run.note_decision", noting)
    folder = str(tmp_path / "run")
    arguments = ["--env", "NumPy-v0", "--steps", "140", "--collect", "both", "--run-dir", folder]
    assert main([*arguments, *TINY]) == 0
    assert min(taken.values()) > 60


class Told(gym.Env):
    """Writes down what it was told and gave; of its episodes of six steps every other one is cut
    off by a limit, the rest end."""

    metadata: ClassVar = {"render_modes": ["rgb_array"]}
    action_space = gym.spaces.Box(-1, 1, (2,), np.float32)
    observation_space = gym.spaces.Box(-1, 1, (1,), np.float32)
    made: ClassVar[list] = []

    def __init__(self, render_mode=None):
        self.render_mode, self.episode, self.seeds, self.rows = render_mode, 0, [], []
        self.made.append(self)

    def reset(self, *, seed=None, options=None):
        self.episode, self.t = self.episode + 1, 0
        self.seeds.append(seed)
        self.rows.append((np.zeros(2, np.float32), 0.0, False, True))
        return np.zeros(1, np.float32), {}

    def step(self, action):
        self.t += 1
        over, limit, reward = self.t == 6, self.episode % 2 == 0, len(self.rows) / 8
        self.rows.append((action, reward, over and not limit, False))
        return np.zeros(1, np.float32), reward, over and not limit, over and limit, {}

    def render(self):
        return np.full((64, 64, 3), len(self.rows) % 256, np.uint8)


def test_a_run_stores_what_happened_and_learns_when_it_is_due(tmp_path, monkeypatch, register):
    """A truncation is no termination, an image stands beside the action that led to it, no two
    episodes have one seed, prefill is uniform, and β is that of the step."""
    register(Told, "Told-v0")
    monkeypatch.setattr(Told, "made", [])
    betas, views, update, make = [], [], train.update, train.make_env

    def updating(agent, batch, beta, look):
        betas.append(beta)
        return update(agent, batch, beta, look)

    def making(*given):
        views.append(given)
        return make(*given)

    monkeypatch.setattr("train.update", updating)
    monkeypatch.setattr("train.make_env", making)
    arguments = "--env Told-v0 --steps 120 --updates 3 --train-every 20 --action-repeat 1".split()
    assert main([*arguments, "--run-dir", str(tmp_path / "run"), *TINY]) == 0
    assert views == 2 * [("Told-v0", 1, 1.7, 0.4)]
    due = [0.2 + (0.0001 - 0.2) * step / 120 for step in (60, 80, 100, 120) for _ in range(3)]
    assert betas == pytest.approx(due)
    (row,) = metrics(tmp_path / "run")
    assert float(row["beta"]) == pytest.approx(np.mean(due), rel=1e-5)
    added = read_checkpoint(tmp_path / "run")[1]["kept"]["saved_rows"]
    replay = train.Replay(500_000, 2, tmp_path / "run" / "replay.bin")
    stored = np.frombuffer(b"".join(map(replay.read, range(added))), replay.dtype)
    told = Told.made[0]
    actions, rewards, ends, firsts = zip(*told.rows[-added:], strict=True)
    np.testing.assert_array_equal(stored["action"], actions)
    np.testing.assert_array_equal(stored["reward"], np.float32(rewards))
    assert stored["terminated"].tolist() == list(ends) and 5 < sum(ends) < 12
    assert stored["is_first"].tolist() == list(firsts)
    assert (np.diff(stored["image"][:, 0, 0, 0].astype(int)) == 1).all()  # each beside its step
    assert len(set(told.seeds[-sum(firsts) :])) == sum(firsts) > 15
    drawn = stored["action"][~stored["is_first"]][:60].ravel()
    assert stats.kstest(drawn, stats.uniform(-1, 2).cdf).pvalue > 0.001


def test_an_evaluation_is_of_greedy_actions_and_leaves_the_random_numbers_as_they_were(numpy_env):
    s = Settings(
        arm="revised", deterministic_actor=False, entropy=False, deter=8, stoch=4, hidden=8,
        units=8, depth=2, eval_episodes=2,
    )  # fmt: skip
    agent, env = Agent(s, 2, torch.device("cpu"), False), train.make_env("NumPy-v0")
    agent.players["stochastic"].forward = None  # it would sample
    before = torch.get_rng_state()
    assert train.evaluate(agent, env, lambda text: None) == [(7.0, 7), (7.0, 7)]
    assert torch.equal(torch.get_rng_state(), before)


# ---- runs that are never lost --------------------------------------------------------------------

LONG = ["--steps", 600, "--eval-every", 200, "--checkpoint-minutes", 0.005, *TINY]


@pytest.fixture(scope="module")
def uninterrupted(tmp_path_factory) -> Path:
    folder = tmp_path_factory.mktemp("runs") / "uninterrupted"
    done = run("--run-dir", folder, *LONG)
    assert done.returncode == 0, done.stderr
    return folder


def start(*arguments) -> subprocess.Popen:
    environment = os.environ | {"OMP_NUM_THREADS": "1"}
    return subprocess.Popen(
        command(*arguments),
        env=environment,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
    )


def wait_for(path: Path, process: subprocess.Popen) -> None:
    until(path.exists, process)


def until(true: Callable[[], bool], process: subprocess.Popen) -> None:
    """Wait until something is true or the process has ended: two minutes at most."""
    end = time.monotonic() + 120
    while not true() and process.poll() is None:
        assert time.monotonic() < end, "waited in vain"
        time.sleep(0.01)


def written(folder: Path) -> int:
    """When the newest checkpoint was written; 0 if there is none."""
    try:
        return (folder / "checkpoint.pt").stat().st_mtime_ns
    except FileNotFoundError:
        return 0


def kill_and_resume(folder: Path, kills: int, arguments: list) -> int:
    """Starts a run and kills it, first before and then after its first checkpoint, at random
    moments; resumes it to its end: how often it was killed."""
    process, killed, delays = start("--run-dir", folder, *arguments), 0, random.Random(0)
    wait_for(folder / "settings.json", process)
    while killed < kills:
        process.send_signal(signal.SIGKILL)
        process.communicate()
        killed += process.returncode == -signal.SIGKILL
        before = written(folder)
        process = start("--resume", folder)
        until(lambda before=before: written(folder) != before, process)
        time.sleep(delays.uniform(0, 0.2))
        assert not (folder / "weights.pt").exists(), "it ended before it was killed often enough"
        assert process.poll() is None, process.communicate()[1]
    _, errors = process.communicate()
    assert process.returncode == 0, errors
    return killed


def test_a_run_killed_and_resumed_equals_one_never_interrupted(uninterrupted, tmp_path):
    assert kill_and_resume(tmp_path / "run", 3, LONG) == 3
    assert metrics(tmp_path / "run") == metrics(uninterrupted)


@pytest.mark.slow
def test_a_run_killed_twenty_times_equals_one_never_interrupted(tmp_path):
    longer = [*LONG, "--steps", 3000]
    assert run("--run-dir", tmp_path / "whole", *longer).returncode == 0
    assert kill_and_resume(tmp_path / "run", 20, longer) == 20
    assert metrics(tmp_path / "run") == metrics(tmp_path / "whole")


def test_ctrl_c_saves_and_says_how_to_go_on(uninterrupted, tmp_path):
    folder = tmp_path / "run"
    process = start("--run-dir", folder, *LONG)
    wait_for(folder / "checkpoint.previous.pt", process)
    process.send_signal(signal.SIGINT)
    said, errors = process.communicate()
    assert process.returncode == 0, errors
    assert f"--resume {folder}" in said
    assert run("--resume", folder).returncode == 0
    assert metrics(folder) == metrics(uninterrupted)


def test_a_run_whose_replay_has_wrapped_around_can_be_resumed(tmp_path):
    ring = ["--steps", 400, "--eval-every", 200, "--replay-capacity", 20, *TINY]
    assert run("--run-dir", tmp_path / "whole", *ring).returncode == 0
    folder = tmp_path / "run"
    process = start("--run-dir", folder, *ring)

    def wrapped() -> bool:  # the ring holds 80: the 20 that are sampled, three times 20 in reserve
        return written(folder) and read_checkpoint(folder)[1]["kept"]["saved_rows"] > 110

    until(wrapped, process)
    process.send_signal(signal.SIGKILL)
    process.communicate()
    assert process.returncode == -signal.SIGKILL
    assert run("--resume", folder).returncode == 0
    assert metrics(folder) == metrics(tmp_path / "whole")


def test_a_full_disk_leaves_the_last_checkpoint_and_one_sentence(uninterrupted, tmp_path):
    """A limit on the size of files stands in for the disk: the replay reaches it first."""
    folder = tmp_path / "run"
    limit = 2 * 2**20  # bytes: 170 rows of replay

    def limited() -> None:
        resource.setrlimit(resource.RLIMIT_FSIZE, (limit, limit))

    full = run("--run-dir", folder, *LONG, preexec_fn=limited)
    assert full.returncode == 1
    assert "Traceback" not in full.stderr and f"--resume {folder}" in full.stderr
    resumed = run("--resume", folder)
    assert resumed.returncode == 0, resumed.stderr
    assert metrics(folder) == metrics(uninterrupted)


def test_a_disk_that_is_full_for_tensorboard_first_is_one_sentence_too(
    tmp_path, monkeypatch, capfd
):
    def full(*_) -> None:
        raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr("tensorboard.summary.writer.record_writer.RecordWriter.write", full)
    folder = tmp_path / "run"
    assert main(["--run-dir", str(folder), "--steps", "100", *TINY]) == 1
    said = capfd.readouterr().err
    assert "Traceback" not in said and f"--resume {folder}" in said and "No space" in said


def test_settings_of_another_version_are_named(tmp_path, capsys):
    (tmp_path / "settings.json").write_text(json.dumps({"env": "HopperBulletEnv-v0", "warp": 9}))
    assert main(["--resume", str(tmp_path)]) == 2
    said = capsys.readouterr().err
    assert one_sentence(said) and "warp" in said and "gamma" in said


def test_a_run_of_numpys_own_scalars_can_be_resumed(tmp_path, numpy_env):
    """They would make a checkpoint that loads only by executing what is in it."""
    folder = str(tmp_path / "run")
    assert main(["--env", "NumPy-v0", "--steps", "90", "--run-dir", folder, *TINY]) == 0
    assert main(["--resume", folder]) == 0


# ---- bad input -----------------------------------------------------------------------------------

BAD = {
    "--env HoperBulletEnv-v0": "HopperBulletEnv-v0",
    "--env CartPole-v1": "bounded Box",
    "--arm maxxent": "dreamer-maxent",
    "--preset tiny": "paper",
    "--batchsize 3": "--batch-size",
    "--batch-size many": "--batch-size",
    "--batch-size 0": "--batch-size",
    "--steps -5": "--steps",
    "--gamma -1": "--gamma",
    "--gamma nan": "--gamma",
    "--gamma 5": "--gamma",
    "--model-lr inf": "--model-lr",
    "--seed 99999999999999999999": "--seed",
    "--steps 100": "--prefill",
    "--preset paper --steps 4999": "give 5000",  # where the first hundred updates are due
    "--arm": "--arm",
    "--resume": "--resume",
    "--run-dir /dev/null/run": "/dev/null",
    "--length 5000": "--prefill",
    "--replay-capacity 10": "--length",
    "--device tpu": "cpu",
    "--resume nowhere": "nowhere is no run's folder",
    "--resume nowhere --steps 7": "nowhere is no run's folder",
    "--resume /dev/null": "/dev/null is no run's folder",
    "--prefill many": "default: 2000",  # of `small`, not of the paper's
    "--horizon 1000000": "--horizon",
    "--burn-in 24": "--burn-in",  # of 25 rows
    "--density knn --batch-size 1 --burn-in 18": "--batch-size",
    "--density knn --batch-size 1 --length 7": "--batch-size",
    "--density knn --batch-size 1 --length 9": "--batch-size",  # four of its rows may be no ends
    "--density gauss": "knn",
    "--length 7": "--ends-ahead 5",  # after a burn-in of two, no dream of five steps
    "--ends-ahead 23": "--length above 25",
    "--ends-ahead 30": "--length above 32",
    "--updates 1000000000": "--updates",
    "--eval-episodes 1000000000000": "--eval-episodes",
    "--floor-brightness 2": "--floor-brightness",
    "--grad-clip 0": "--grad-clip",  # it would not take the bound away, but all that is learnt
    "--play-rate 0": "--play-rate",
    "--precision float8": "float32",
}  # fmt: skip


@pytest.mark.parametrize("arguments", BAD)
def test_bad_input_ends_with_one_sentence_and_code_2_and_nothing_written(
    arguments, tmp_path, monkeypatch, capsys
):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(train, "train_run", lambda *_: 0)  # what is not refused fails at once
    assert main(arguments.split()) == 2
    said = capsys.readouterr().err
    assert one_sentence(said) and BAD[arguments] in said, said
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("arm, changes", [
    ("revised", dict(density="knn", batch_size=1)), ("dreamer", dict(length=7)),  # not used
    ("maxent", dict(length=5, burn_in=0)),  # its dreams along what was done take four steps
])  # fmt: skip
def test_what_can_be_is_not_refused(arm, changes):
    s = dataclasses.replace(default_settings(arm), **changes)
    assert check(s.to_json()) == s


@pytest.mark.skipif(torch.cuda.is_available(), reason="a CUDA device is here")
def test_a_device_that_is_not_there_is_refused(capsys):
    assert main(["--device", "cuda"]) == 2
    assert one_sentence(capsys.readouterr().err)


@pytest.mark.parametrize("slower", [0.5, 6.0])
def test_bfloat16_is_used_where_it_is_in_hardware_and_convolutions_use_it(
    slower, monkeypatch, capsys
):
    seconds, cpu = {torch.bfloat16: slower, torch.float32: 1.0}, torch.device("cpu")
    monkeypatch.setattr("train.convolution_seconds", seconds.get)
    monkeypatch.setattr("torch.cpu.get_capabilities", lambda: {"avx512_bf16": True})
    assert has_bfloat16.__wrapped__(cpu) == (slower < 1)
    assert ("6 times slower here" in capsys.readouterr().err) == (slower > 1)
    monkeypatch.setattr("torch.cpu.get_capabilities", lambda: {"avx512_bf16": False})
    assert not has_bfloat16.__wrapped__(cpu)


def test_a_folder_that_holds_a_run_is_never_overwritten(uninterrupted, capsys):
    before = {path: path.stat().st_mtime_ns for path in uninterrupted.iterdir()}
    assert main(["--run-dir", str(uninterrupted), *TINY]) == 2
    assert one_sentence(capsys.readouterr().err)
    assert {path: path.stat().st_mtime_ns for path in uninterrupted.iterdir()} == before


def test_help_explains_every_setting(capsys):
    with pytest.raises(SystemExit):
        main(["--arm", "dreamer", "--help"])
    text = capsys.readouterr().out
    for name in Settings.__dataclass_fields__:
        assert f"--{name.replace('_', '-')}" in text
    options = re.split(r"\n\W*?(?=--?[a-z])", text)[1:]  # from one option to the next
    assert len(options) > len(Settings.__dataclass_fields__)
    for option in options:
        assert re.search(r"\s[a-z]+\s", option.split("(default")[0]), option
    assert "stoch INT" in text and "30" in text  # the arm's own value is shown
