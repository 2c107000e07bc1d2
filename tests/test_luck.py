"""A user's ordinary luck: any environment, any terminal, a second run, damaged files."""

import csv
import json
import os
import re
import shlex
import shutil
import signal
import subprocess
import sys
import zipfile
from pathlib import Path

import filelock
import gymnasium as gym
import numpy as np
import pytest
import torch
from conftest import Base
from gymnasium.envs.registration import EnvSpec
from gymnasium.spaces import Box
from scipy import stats
from test_train import LONG, TINY, command, metrics, one_sentence, start, wait_for

import train

FAST = [*TINY, "--steps", "120", "--eval-every", "60", "--eval-episodes", "1"]


@pytest.fixture(scope="module")
def finished(tmp_path_factory) -> Path:
    folder = tmp_path_factory.mktemp("finished") / "run"
    with pytest.MonkeyPatch.context() as patch:
        patch.setitem(gym.registry, "Stub-v0", EnvSpec("Stub-v0", Base))
        assert train.main(["--env", "Stub-v0", "--run-dir", str(folder), *FAST]) == 0
    return folder


@pytest.fixture
def stub_run(finished, register, tmp_path) -> Path:
    """The folder of a short finished run."""
    register(Base)
    return Path(shutil.copytree(finished, tmp_path / "run"))


def contents(folder: Path) -> dict[str, bytes]:
    return {path.name: path.read_bytes() for path in folder.iterdir()}


def refused(arguments, capsys, *words) -> None:
    """One sentence with these words, exit code 2."""
    capsys.readouterr()
    assert train.main([str(a) for a in arguments]) == 2
    said = capsys.readouterr().err
    assert one_sentence(said) and all(word in said for word in words), said


# ---- check, then create --------------------------------------------------------------------------


def test_runs_begun_in_the_same_second_have_a_folder_each(register, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr("time.strftime", lambda _: "20260101-000000")
    name = register(Base, "space/Stub-v0")
    for _ in range(3):
        assert train.main(["--env", name, *FAST]) == 0
    folders = list((tmp_path / "runs").iterdir())  # none nested, whatever the id
    assert len(folders) == 3
    assert all(len(metrics(folder)) == 2 for folder in folders)


def test_a_run_that_goes_on_elsewhere_is_not_resumed_and_who_has_it_is_said(tmp_path, capsys):
    folder = tmp_path / "run"
    process = start("--run-dir", folder, *LONG, "--steps", 100_000)
    try:
        wait_for(folder / "settings.json", process)
        refused(["--resume", folder], capsys, str(process.pid))
    finally:
        process.kill()
        process.communicate()
    assert train.main(["--resume", str(folder), "--steps", "200"]) == 0  # the lock died with it


@pytest.mark.parametrize("other", ["goes on", "is done"])
def test_a_folder_taken_while_all_else_was_checked_is_left_to_its_owner(
    other, register, tmp_path, monkeypatch, capsys
):
    folder, make_agent = tmp_path / "run", train.make_agent
    arguments = ["--env", register(Base), "--run-dir", str(folder), *FAST]
    lock = filelock.FileLock(folder / "run.lock")

    def meanwhile(*given):
        monkeypatch.setattr("train.make_agent", make_agent)
        assert train.main(arguments) == 0
        if other == "goes on":
            lock.acquire()
        before.update(contents(folder))
        return make_agent(*given)

    before = {}
    monkeypatch.setattr("train.make_agent", meanwhile)
    assert train.main(arguments) == 2
    said = capsys.readouterr().err.splitlines()[-1]
    assert ("in use" if other == "goes on" else "is there already") in said
    lock.release()
    assert before and contents(folder) == before


def test_two_processes_that_want_one_folder_get_it_once(tmp_path, module):
    folder = tmp_path / "run"
    line = mine(folder)
    done = shell(f"{line} & first=$!; {line}; echo $?; wait $first; echo $?", module)
    codes = [line for line in done.stdout.decode().splitlines() if line in ("0", "1", "2")]
    assert sorted(codes) == ["0", "2"] and b"Traceback" not in done.stderr
    assert len(metrics(folder)) == 2 and (folder / "weights.pt").exists()


def test_a_folder_that_cannot_be_filled_is_not_left_behind(register, tmp_path, monkeypatch):
    def full(*_, **__):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr("train.write_whole", full)
    assert train.main(["--env", register(Base), "--run-dir", str(tmp_path / "run"), *FAST]) == 2
    assert list(tmp_path.iterdir()) == []


# ---- what only measures --------------------------------------------------------------------------


class Infinite(Base):
    def obs(self):
        return np.array([np.inf, 0, 0], np.float32)


class Words(Base):
    observation_space = gym.spaces.Dict({"a": Box(-1, 1, (2,)), "b": gym.spaces.Text(500)})

    def obs(self):
        return {"a": np.zeros(2, np.float32), "b": "word"}


@pytest.mark.parametrize("environment", [Infinite, Words])
def test_states_that_cannot_be_measured_stop_nothing(environment, register, tmp_path):
    folder = tmp_path / "run"
    assert train.main(["--env", register(environment), "--run-dir", str(folder), *FAST]) == 0
    assert [row["coverage"] for row in metrics(folder)] == ["nan", "nan"]


class Endless(Base):
    def step(self, action):
        return *super().step(action)[:2], False, False, {}


def test_an_endless_episode_is_evaluated_and_makes_no_checkpoint_of_many_parts(register, tmp_path):
    """A part of a checkpoint for each action of the episode took 11 s after 50,000 of them."""
    folder, parts = tmp_path / "run", []
    arguments = ["--env", register(Endless), "--run-dir", str(folder), "--eval-max-steps", "30"]
    assert train.main([*arguments, *FAST]) == 0
    assert [row["eval_length"] for row in metrics(folder)] == ["30", "30"]
    for steps in ("180", "240"):
        with zipfile.ZipFile(folder / "checkpoint.pt") as file:
            parts.append(len(file.namelist()))
        assert train.main(["--resume", str(folder), "--steps", steps]) == 0
    assert parts[0] == parts[1]


# ---- environments that fail later ----------------------------------------------------------------


class Fails(Base):
    """In the 90th step of its life, as the class says."""

    def step(self, action):
        result = super().step(action)
        return self.fail(result) if self.steps == 90 else result


class Raises(Fails):
    def fail(self, result):
        return 1 / 0


class Leaves(Fails):
    def fail(self, result):
        sys.exit("bye")


class RaisesAtReset(Base):
    def reset(self, **given):
        if self.steps > 80:
            raise RuntimeError("could not\nallocate")
        return super().reset(**given)


class RaisesWhenItRenders(Base):
    def render(self):
        assert self.steps not in (90, 91), "no screen"
        return super().render()


@pytest.mark.parametrize("environment, word", [
    (Leaves, "SystemExit"), (RaisesAtReset, "could not allocate"),
    (RaisesWhenItRenders, "no screen"),
])  # fmt: skip
def test_what_an_environment_does_later_is_one_sentence_that_names_it(
    environment, word, register, tmp_path, capfd
):
    folder, name = tmp_path / "run", register(environment)
    assert train.main(["--env", name, "--run-dir", str(folder), *FAST]) == 1
    said = capfd.readouterr().err
    assert "Traceback" not in said and f"{name} " in said and word in said
    assert "--model-lr" not in said
    kept = train.read_checkpoint(folder)[1]["kept"]
    assert "What was learnt is saved." in said
    assert 80 <= kept["step"] < 100 and kept["over"]  # what was learnt is saved; another follows
    assert train.main(["--resume", str(folder)]) == 0  # another one, whose steps are fewer
    assert len(metrics(folder)) == 2


def test_nothing_is_said_to_be_saved_that_is_not(register, tmp_path, monkeypatch, capfd):
    def full(run):
        if run.step > 60:  # an evaluation is saved
            raise OSError(28, "No space left on device")
        save(run)

    save = train.Run.save
    monkeypatch.setattr("train.Run.save", full)
    arguments = ["--env", register(Raises), "--run-dir", str(tmp_path / "run"), *FAST]
    assert train.main(arguments) == 1
    said = capfd.readouterr().err
    assert "ZeroDivisionError" in said and "saved" not in said and "Traceback" not in said


class Second(Base):
    """Knows its number: the second of a run's two environments is that of its evaluations."""

    made = 0

    def __init__(self, render_mode=None):
        super().__init__(render_mode)
        type(self).made += 1
        self.number = self.made


class FailsWhenEvaluated(Second):
    def step(self, action):
        if self.number == 2 and self.steps > 5:
            raise OSError("no")
        return super().step(action)


def test_an_environment_that_fails_in_an_evaluation_stops_nothing(register, tmp_path, capfd):
    folder = tmp_path / "run"
    Second.made = FailsWhenEvaluated.made = 0
    assert train.main(["--env", register(FailsWhenEvaluated), "--run-dir", str(folder), *FAST]) == 0
    assert "left out: Stub-v0 raised OSError" in capfd.readouterr().err
    assert (folder / "weights.pt").exists()


class Repeats(Second):
    """Its episodes of 50 steps are the same in each process."""

    tint, reward = 0, 0.1  # what is not the same in another one

    def step(self, action):
        obs, _, _, truncated, info = super().step(action)
        reward = 0.1 if self.number <= 2 else self.reward
        return obs, reward, self.t >= 50, truncated, info

    def render(self):
        return super().render() | np.uint8(0 if self.number <= 2 else self.tint)


class OtherReward(Repeats):
    reward = 0.1 + 1e-6


class OtherImage(Repeats):
    tint = 1


@pytest.mark.parametrize(
    "environment, said", [(Repeats, False), (OtherReward, True), (OtherImage, True)]
)
def test_an_environment_that_does_not_repeat_itself_ends_the_episode_under_way(
    environment, said, register, tmp_path, monkeypatch, capsys
):
    monkeypatch.setattr(environment, "made", 0)
    folder, name = tmp_path / "run", register(environment)
    assert train.main(["--env", name, "--run-dir", str(folder), *FAST]) == 0  # 120: amid the third
    capsys.readouterr()
    assert train.main(["--resume", str(folder), "--steps", "180"]) == 0
    assert ("does not repeat itself" in capsys.readouterr().err) == said
    assert train.read_checkpoint(folder)[1]["kept"]["episode"] == 4 + said


def test_an_action_that_is_not_finite_is_not_the_environments_fault(
    register, tmp_path, monkeypatch, capfd
):
    folder = tmp_path / "run"

    def greedy(actor, state):
        checkpoints.update(contents(folder))
        return state[..., :2] * float("nan")

    checkpoints = {}
    monkeypatch.setattr("actors.DeterministicActor.greedy", greedy)
    name = register(Base)
    assert train.main(["--env", name, "--run-dir", str(folder), *FAST]) == 1
    said = capfd.readouterr().err
    assert "Not finite" in said and "action" in said and f"{name} gave" not in said
    assert (folder / "checkpoint.pt").read_bytes() == checkpoints["checkpoint.pt"]


# ---- facts of the machine ------------------------------------------------------------------------


def test_a_run_holds_nothing_of_its_machine_and_may_move(stub_run, register, capsys):
    saved = json.loads((stub_run / "settings.json").read_text())
    assert not saved.keys() & {"device", "precision", "run_dir"}
    moved = stub_run.with_name("moved away")
    stub_run.rename(moved)
    arguments = ["--resume", str(moved), "--steps", "180", "--precision", "float32"]
    assert train.main(arguments) == 0
    said = capsys.readouterr().err
    was = "bfloat16" if train.has_bfloat16(torch.device("cpu")) else "float32"
    assert ("otherwise than it would have" in said) == (was == "bfloat16")


class Signalled(Second):
    """Sends its own process a signal, in training or in an evaluation, and goes elsewhere."""

    which, number_sent = 1, signal.SIGTERM

    def step(self, action):
        os.chdir("/")
        if (self.number, self.steps) == (self.which, 90 if self.which == 1 else 12):
            os.kill(os.getpid(), self.number_sent)
        return super().step(action)


@pytest.mark.parametrize("which, number, name", [
    (1, signal.SIGTERM, "-dash"), (2, signal.SIGTERM, "a folder/with blanks/"),
    (1, signal.SIGHUP, "~/run"), (2, signal.SIGINT, "plain"),
])  # fmt: skip
def test_a_run_stopped_anywhere_goes_on_by_its_own_advice_as_if_it_had_not(
    which, number, name, finished, register, tmp_path, monkeypatch, capfd
):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("HOME", str(tmp_path))
    monkeypatch.setattr(Signalled, "made", 0)
    monkeypatch.setattr(Signalled, "which", which)
    monkeypatch.setattr(Signalled, "number_sent", number)
    env = register(Signalled)
    own = "bfloat16" if train.has_bfloat16(torch.device("cpu")) else "float32"
    precision = [] if which == 1 else ["--precision", own]  # in no settings.json
    assert train.main(["--env", env, f"--run-dir={name}", *precision, *FAST]) == 0
    assert Path.cwd() == Path("/")
    advice = shlex.split(capfd.readouterr().out.split("Go on with: ")[1])
    assert advice[4:] == precision
    assert Path(advice[0]) == Path(sys.executable) and Path(advice[1]) == Path(train.__file__)
    assert train.main(advice[2:]) == 0
    assert "Done" in capfd.readouterr().out
    assert metrics(tmp_path / name.removeprefix("~/")) == metrics(finished)


@pytest.mark.skipif(not Path("/usr/bin/nohup").exists(), reason="there is no nohup")
def test_a_run_under_nohup_outlives_its_terminal(tmp_path, module):
    folder = tmp_path / "run"
    line = f"nohup {mine(folder)} --checkpoint-minutes 0 & run=$!; "
    line += f"until [ -e {folder}/best.pt ]; do sleep 0.05; done; kill -HUP $run; wait $run"
    done = shell(line, module)
    assert done.returncode == 0 and b"Stopped" not in done.stdout
    assert (folder / "weights.pt").exists()


def test_a_finished_run_can_be_made_longer_and_says_what_changed(stub_run, capsys):
    before = metrics(stub_run)
    assert train.main(["--resume", str(stub_run), "--steps", "180", "--actor-lr", "1e-5"]) == 0
    said = capsys.readouterr().err
    assert "steps: 180 instead of 120" in said and "β" in said
    assert "actor_lr: 1e-05 instead of 0.0002" in said
    rows = metrics(stub_run)
    assert rows[: len(before)] == before and int(rows[-1]["env_steps"]) == 180
    assert json.loads((stub_run / "settings.json").read_text())["actor_lr"] == 1e-5
    optimisers = train.read_checkpoint(stub_run)[1]["optimisers"]
    rates = {name: o["param_groups"][0]["lr"] for name, o in optimisers.items()}
    assert rates["stochastic_actor"] == 1e-5 and rates["model"] == 6e-4


def test_a_last_decision_that_oversteps_leaves_the_bar_whole(stub_run, capsys):
    """Of two steps each, 121 end at 122; and a run that is there begins there."""
    for _ in range(2):
        assert train.main(["--resume", str(stub_run), "--steps", "121"]) == 0
        assert "100%" in (said := capsys.readouterr().err) and "121/121" in said
    assert metrics(stub_run)[-1]["env_steps"] == "122"


def test_what_makes_a_run_what_it_is_cannot_be_changed(stub_run, capsys):
    before = contents(stub_run)
    refused(["--resume", stub_run, "--gamma", "0.5"], capsys, "gamma")
    refused(["--resume", stub_run, "--run-dir", "x"], capsys, "run_dir")
    assert contents(stub_run) == before


def test_a_run_of_more_processes_is_not_gone_on_with_by_fewer(stub_run, capsys):
    before, other = contents(stub_run), stub_run / "rank-1"
    other.mkdir()
    refused(["--resume", stub_run, "--steps", "180"], capsys, "--nproc-per-node 2")
    other.rmdir()
    assert contents(stub_run) == before


def test_each_evaluation_is_followed_by_a_checkpoint_that_knows_it(stub_run, monkeypatch):
    """Else a run that ends before the next one has a best.pt that no row speaks of."""
    saved = []
    save = train.Run.save
    monkeypatch.setattr(train.Run, "save", lambda run: (saved.append(len(run.rows)), save(run)))
    before = len(metrics(stub_run))
    assert train.main(["--resume", str(stub_run), "--steps", "240"]) == 0
    rows = len(metrics(stub_run))
    assert rows > before + 1 and saved == [*range(before + 1, rows + 1), rows]


def test_a_rate_edited_in_settings_json_is_said(stub_run, capsys):
    path = stub_run / "settings.json"
    path.write_text(json.dumps(json.loads(path.read_text()) | {"model_lr": 1e-5}), "utf-8-sig")
    assert train.main(["--resume", str(stub_run), "--steps", "180"]) == 0
    said = capsys.readouterr().err
    assert "model_lr: 1e-05 instead of 0.0006 from step 120 on." in said
    assert train.main(["--resume", str(stub_run)]) == 0
    assert "instead of" not in capsys.readouterr().err


def test_steps_below_what_was_done_end_the_run_and_lose_nothing(stub_run, capsys):
    before = metrics(stub_run)
    assert train.main(["--resume", str(stub_run), "--steps", "80"]) == 0
    assert "Done" in capsys.readouterr().out
    assert metrics(stub_run) == before


def test_best_is_of_the_whole_run_also_after_it_was_resumed(register, tmp_path, monkeypatch):
    returns, best = iter([3.0, 9.0, 5.0, 9.0]), []
    monkeypatch.setattr("train.evaluate", lambda *_: [((r := next(returns)) - 1, 4), (r + 1, 10)])
    folder = tmp_path / "run"
    assert train.main(["--env", register(Repeats), "--run-dir", str(folder), *FAST]) == 0
    row = {name: float(value) for name, value in metrics(folder)[0].items()}
    _, end = stats.t.interval(0.95, 1, loc=3, scale=1)  # two returns, 2 and 4, of standard error 1
    assert row["eval_return"] == 3 and row["eval_interval95"] == pytest.approx(end - 3, rel=1e-5)
    assert [row[f"eval_length{kind}"] for kind in ("", "_min", "_max")] == [7, 4, 10]
    assert (row["train_return"], row["train_length"]) == (5, 50)
    for steps in ("180", "240"):
        best.append((folder / "best.pt").read_bytes())
        assert train.main(["--resume", str(folder), "--steps", steps]) == 0
    best.append((folder / "best.pt").read_bytes())
    assert best[0] == best[1] != best[2]  # of equal ones, the later


# ---- text and shells -----------------------------------------------------------------------------


@pytest.fixture(scope="module")
def module(tmp_path_factory) -> dict[str, str]:
    """Environment variables with which `--env mine:Mine-v0` finds its module."""
    folder = tmp_path_factory.mktemp("modules")
    own = "import test_luck, gymnasium\ngymnasium.register('Mine-v0', test_luck.Base)\n"
    (folder / "mine.py").write_text(own)
    path = os.pathsep.join([str(folder), str(Path(__file__).parent)])
    return {"PYTHONPATH": path, "OMP_NUM_THREADS": "1"}


def shell(line: str, module: dict[str, str], **variables) -> subprocess.CompletedProcess:
    return subprocess.run(
        line, shell=True, executable="/bin/bash", capture_output=True, timeout=120,
        env=os.environ | module | variables,
    )  # fmt: skip


def mine(folder: Path) -> str:
    return shlex.join(command("--env", "mine:Mine-v0", "--run-dir", folder, *FAST))


def test_a_terminal_that_knows_few_letters_stops_nothing(tmp_path, module):
    done = shell(mine(tmp_path / "run"), module, PYTHONIOENCODING="ascii")
    assert done.returncode == 0 and b"Traceback" not in done.stderr, done.stderr
    assert b"argv[0]" not in done.stdout + done.stderr and b"pybullet" not in done.stderr
    help_text = shell(shlex.join(command("--help")), module, PYTHONIOENCODING="ascii")
    assert help_text.returncode == 0 and b"--beta-start" in help_text.stdout


@pytest.mark.parametrize("ending", ["> /dev/full 2> /dev/full", ">&- 2>&- <&-", "2>&1 | head -c 1"])
def test_a_reader_who_goes_away_stops_nothing(ending, tmp_path, module):
    folder = tmp_path / "run"
    strict = mine(folder).replace(sys.executable, f"{sys.executable} -W error", 1)
    done = shell(f"set -o pipefail; {strict} {ending}", module, COLUMNS="20", TERM="dumb")
    assert b"Traceback" not in done.stderr and b"Exception" not in done.stderr, done.stderr
    assert done.returncode == 0 and len(metrics(folder)) == 2


# ---- files that are damaged or edited ------------------------------------------------------------


def flip(path: Path, at: float) -> None:
    content = bytearray(path.read_bytes())
    content[int(at * len(content))] ^= 255
    path.write_bytes(content)


@pytest.mark.parametrize("at", np.linspace(0, 0.999, 12))
def test_a_checkpoint_damaged_anywhere_is_said_and_the_one_before_it_taken(at, stub_run, capsys):
    path = stub_run / "checkpoint.pt"
    content = bytearray(path.read_bytes())
    with zipfile.ZipFile(path) as file:  # between its parts is padding, whose bits mean nothing
        parts = [part for part in map(file.read, file.namelist()) if len(part) > 63]
    part = parts[int(at * len(parts))]
    content[content.index(part) + len(part) // 2] ^= 1
    path.write_bytes(content)
    read, saved = train.read_checkpoint(stub_run)
    assert read.name == "checkpoint.previous.pt" and f"{path} is damaged" in capsys.readouterr().err
    assert saved["kept"].keys() == set(train.Run.KEPT)


@pytest.mark.parametrize("damage", ["flipped", "shorter", "gone"])
def test_a_replay_that_is_not_its_checkpoints_is_refused(damage, stub_run, capsys):
    path = stub_run / "replay.bin"
    if damage == "flipped":
        flip(path, 0.3)
    elif damage == "shorter":
        path.write_bytes(path.read_bytes()[:50_000])
    else:
        path.unlink()
        path.touch()
    before = contents(stub_run)
    refused(["--resume", stub_run, "--steps", "180"], capsys, "replay.bin")
    assert contents(stub_run) == before


@pytest.mark.parametrize("change", [
    {"arm": "warp"}, {"collect": "nobody"}, {"steps": "many"}, {"steps": 1.5}, {"gamma": [1]},
    {"entropy": "no"}, {"seed": -1}, {"env": 7}, {"gamma": 2.0},
])  # fmt: skip
def test_settings_that_cannot_be_are_refused_by_name(change, stub_run, capsys):
    path = stub_run / "settings.json"
    path.write_text(json.dumps(json.loads(path.read_text()) | change))
    (name,) = change
    refused(["--resume", stub_run], capsys, name)


def test_an_edited_setting_that_made_the_run_what_it_is_is_not_taken(stub_run, capsys):
    path = stub_run / "settings.json"
    path.write_text(json.dumps(json.loads(path.read_text()) | {"gamma": 0.5}))
    before = contents(stub_run)
    refused(["--resume", stub_run, "--steps", "180"], capsys, "gamma 0.99")
    assert contents(stub_run) == before


@pytest.mark.parametrize(
    "text", ["", "{", "[]", "7", "null", '"a"', "\0\0", "\ufeff{}", "[" * 100_000, '[["a", 1]]']
)
def test_settings_that_are_none_are_refused(text, stub_run, capsys):
    (stub_run / "settings.json").write_text(text)
    refused(["--resume", stub_run], capsys, "settings")


def test_a_damaged_checkpoint_is_put_aside_and_what_is_gone_on_from_is_said(stub_run, capsys):
    newest, older = stub_run / "checkpoint.pt", (stub_run / "checkpoint.pt").read_bytes()
    assert train.main(["--resume", str(stub_run), "--steps", "180"]) == 0
    before = metrics(stub_run)
    (stub_run / "checkpoint.previous.pt").write_bytes(older)
    newest.unlink()
    newest.mkdir()
    capsys.readouterr()
    assert train.main(["--resume", str(stub_run)]) == 0
    said = capsys.readouterr()
    assert metrics(stub_run) == before and before[-1]["env_steps"] == "180"
    assert "checkpoint.pt is damaged" in said.err and "from step 120" in said.out
    assert (stub_run / "checkpoint.damaged").is_dir() and (stub_run / "checkpoint.pt").is_file()


@pytest.mark.parametrize("damage", ["no text", "half a row", "gone"])
def test_metrics_that_were_damaged_are_written_anew_with_the_next_row(damage, stub_run):
    """The rows are in the checkpoint."""
    path, content = stub_run / "metrics.csv", (stub_run / "metrics.csv").read_bytes()
    before = metrics(stub_run)
    if damage == "gone":
        path.unlink()
    else:
        path.write_bytes(bytes(range(256)) * 1000 if damage == "no text" else content[:-50])
    assert train.main(["--resume", str(stub_run), "--steps", "180"]) == 0
    *first, last = metrics(stub_run)
    assert first == before and last["env_steps"] == "180" and [*last.values()].count("nan") < 5


def test_a_run_without_checkpoints_is_refused_and_left_as_it_is(stub_run, capsys):
    for name in (*train.CHECKPOINTS, "replay.bin", "run.lock"):
        (stub_run / name).unlink(missing_ok=True)
    before = contents(stub_run)
    refused(["--resume", stub_run, "--steps", "180"], capsys, "no whole checkpoint")
    assert contents(stub_run) == before


def test_a_run_of_which_no_checkpoint_is_whole_is_refused_and_left_as_it_is(stub_run, capsys):
    for name in train.CHECKPOINTS:
        (stub_run / name).write_bytes(b"damaged")
    before = contents(stub_run)
    for _ in range(2):
        assert train.main(["--resume", str(stub_run), "--steps", "180"]) == 2
        *damaged, last = capsys.readouterr().err.splitlines()
        assert len(damaged) == 2 and "no whole checkpoint" in last
    assert contents(stub_run) == before


def test_a_run_that_goes_on_on_another_processor_says_so(stub_run, monkeypatch, capsys):
    monkeypatch.setattr("torch.backends.cpu.get_cpu_capability", lambda: "another")
    assert train.main(["--resume", str(stub_run), "--steps", "180", "--device", "cpu"]) == 0
    assert "(another)" in capsys.readouterr().err


def test_a_checkpoint_of_other_networks_is_refused(stub_run, capsys):
    path = stub_run / "checkpoint.pt"
    saved = torch.load(path, weights_only=True)
    saved["agent"].popitem()
    torch.save(saved, path)
    refused(["--resume", stub_run, "--steps", "180"], capsys, "another version's networks")


def test_what_is_not_finite_leaves_the_checkpoint_before_it_and_a_lower_rate_is_taken(
    register, tmp_path, capsys
):
    folder = tmp_path / "run"
    arguments = ["--env", register(Base), "--run-dir", str(folder), *FAST]
    assert train.main([*arguments, "--model-lr", "1e30"]) == 1
    checkpoints = {k: v for k, v in contents(folder).items() if k.startswith("checkpoint")}
    for _ in range(2):
        assert train.main(["--resume", str(folder)]) == 1
    assert checkpoints == {k: v for k, v in contents(folder).items() if k.startswith("checkpoint")}
    said = capsys.readouterr().err
    assert re.search(r"Not finite: \w+/\w+", said) and "--model-lr" in said
    assert "Traceback" not in said
    assert train.main(["--resume", str(folder), "--model-lr", "1e-4"]) == 0


def test_memory_that_runs_out_in_an_update_names_what_asked_for_it(
    register, tmp_path, monkeypatch, capfd
):
    def sample(*_):
        return torch.empty(2**60)

    monkeypatch.setattr("env.Replay.sample", sample)
    folder = tmp_path / "run"
    assert train.main(["--env", register(Base), "--run-dir", str(folder), *FAST]) == 1
    said = capfd.readouterr().err
    assert "Traceback" not in said and "--batch-size 3" in said and "--resume" in said

    def nothing(*_):
        raise MemoryError

    monkeypatch.setattr("env.Replay.sample", nothing)
    assert train.main(["--resume", str(folder)]) == 1
    said = capfd.readouterr().err
    assert "Traceback" not in said and "--length 8. Go on with: " in said


def test_a_driver_that_is_seen_and_cannot_be_used_does_not_stop_a_run_on_the_cpu(
    register, tmp_path, monkeypatch
):
    def too_old():
        raise RuntimeError("The NVIDIA driver on your system is too old")

    monkeypatch.setattr("torch.cuda.is_available", lambda: False)
    monkeypatch.setattr("torch.cuda.device_count", lambda: 1)
    monkeypatch.setattr("torch.cuda.random.device_count", lambda: 1)
    for module in ("torch.cuda", "torch.cuda.random"):
        monkeypatch.setattr(f"{module}._lazy_init", too_old)
    folder = str(tmp_path / "run")
    assert train.main(["--env", register(Base), "--run-dir", folder, *FAST]) == 0
    assert train.main(["--resume", folder, "--steps", "120"]) == 0


# ---- the command line ----------------------------------------------------------------------------


def test_bad_input_is_named_in_one_line_whatever_the_terminal(tmp_path, monkeypatch, capsys):
    monkeypatch.setenv("COLUMNS", "20")
    monkeypatch.setenv("FORCE_COLOR", "1")
    monkeypatch.chdir(tmp_path)
    refused(["--bath-size", "3"], capsys, "--bath-size", "--batch-size")
    refused(["--arm", "maxxent"], capsys, "--arm", "maxxent", "dreamer-maxent")
    refused(["--steps", "1e5"], capsys, "--steps", "1e5")
    refused(["--env", "two\nlines"], capsys, "two lines")
    refused(["--length", "1"], capsys, "--length")
    refused(["--run-dir", "\udcff"], capsys, "UTF-8")  # as Python reads it in the C locale
    refused(["--resume", "\udcff"], capsys, "UTF-8")
    assert list(tmp_path.iterdir()) == []


# ---- what is kept --------------------------------------------------------------------------------


def test_the_best_evaluations_networks_are_kept(register, tmp_path, monkeypatch):
    returns = iter([3.0, 9.0, 5.0])
    states = []

    def evaluate(agent, env, show):
        states.append({k: v.clone() for k, v in agent.state_dict().items()})
        return [(next(returns), 1)]

    monkeypatch.setattr("train.evaluate", evaluate)
    folder = tmp_path / "run"
    arguments = ["--env", register(Base), "--run-dir", str(folder), *FAST, "--steps", "180"]
    assert train.main(arguments) == 0
    best = torch.load(folder / "best.pt", weights_only=True)
    equal = [all(torch.equal(best[k], state[k]) for k in best) for state in states]
    assert equal == [False, True, False]


def test_losses_are_in_tensorboard_before_the_first_evaluation(register, tmp_path):
    from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

    folder = tmp_path / "run"
    arguments = ["--env", register(Base), "--run-dir", str(folder), *FAST]
    assert train.main([*arguments, "--eval-every", "120"]) == 0
    events = EventAccumulator(str(folder)).Reload()
    first = events.Scalars("update/model/image")[0].step
    assert first < events.Scalars("eval_return")[0].step == 120
    with open(folder / "metrics.csv", newline="") as file:
        assert next(csv.reader(file))[0] == "env_steps"
