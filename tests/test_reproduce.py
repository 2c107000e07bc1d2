"""results/reproduce.py: which runs there are, what becomes of each, and the figure at the end.

Most tests put a stand-in in the place of train.py, which notes how it was called and is done at
once; the last ones train.
"""

import os
import signal
import subprocess
import sys
import threading
import time
from pathlib import Path

import filelock
import pytest
from test_train import wait_for

import results.reproduce as reproduce

SCRIPT = Path(reproduce.__file__)
HOPPER = "HopperBulletEnv-v0"
NARROW = ["--arms", "revised", "maxent", "--envs", HOPPER, "--seeds", "0", "--workers", "2"]
STAND_IN = """
import os, pathlib, signal, sys, time
words = dict(zip(sys.argv[1:], sys.argv[2:])) | dict(w.split("=") for w in sys.argv if "=" in w)
how = "--resume" if "--resume" in words else "--run-dir"
folder = pathlib.Path(words[how])
print("began", flush=True)
with open(folder.with_name("calls"), "a") as calls:
    print(how, folder.name, words["--steps"], os.environ["OMP_NUM_THREADS"], file=calls)
if "Fails" in folder.name:
    sys.exit("There is no such thing.")
if "Taken" in folder.name:  # its owner, whose first caller is gone, has the same log
    print(f"{folder} is in use by process 7: stop it.\\n 40%|####  |", flush=True)
    sys.exit(2)
if "Slow" in folder.name:
    def end(number, _):
        folder.with_name("told").write_text(signal.Signals(number).name)
        sys.exit()
    for number in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP):
        signal.signal(number, end)
    folder.with_name("ready").touch()
    time.sleep(60)
folder.mkdir(exist_ok=True)
(folder / "run.owner").write_text(f"{os.getpid()} on a machine")
for name in ("settings.json", "weights.pt"):
    (folder / name).touch()
(folder / "metrics.csv").write_text(f"env_steps,eval_return\\n{words['--steps']},1\\n")
"""


@pytest.fixture
def stand_in(tmp_path, monkeypatch) -> Path:
    """An empty folder for runs that the stand-in makes; nothing is drawn of them."""
    (tmp_path / "stand_in.py").write_text(STAND_IN)
    monkeypatch.setattr("train.__file__", str(tmp_path / "stand_in.py"))
    monkeypatch.setattr("results.plot.main", lambda arguments: 0)
    return tmp_path / "figure"


def calls(folder: Path) -> list[str]:
    return sorted((folder / "calls").read_text().splitlines())


def write_run(folder: Path, steps: int, *others: str) -> None:
    folder.mkdir(parents=True)
    (folder / "metrics.csv").write_text(f"env_steps,eval_return\n{steps - 10},1\n{steps},1\n")
    for name in others:
        (folder / name).touch()


# ---- which runs there are ------------------------------------------------------------------------


def test_all_sixteen_cells_of_a_seed_come_before_the_next_seed(capsys):
    assert reproduce.main(["--list"]) == 0
    lines = capsys.readouterr().out.splitlines()
    assert len(lines) == 32 and lines[:2] == [f"0 {HOPPER}-dreamer-seed0",
                                              f"1 {HOPPER}-dreamer-maxent-seed0"]  # fmt: skip
    assert all(line.endswith("seed0") for line in lines[:16])
    assert all(line.endswith("seed1") for line in lines[16:])
    robots = {line.split()[1].split("Bullet")[0] for line in lines}
    assert robots == {"Hopper", "Walker2D", "HalfCheetah", "Ant"}


def test_arms_environments_seeds_and_options_narrow_and_change_them():
    command = reproduce.parse([*NARROW, "--envs", "mine:Reach-v0", "--", "--horizon", "7"])
    assert [folder.name for folder in command.runs] == [
        "mine-Reach-v0-revised-seed0", "mine-Reach-v0-maxent-seed0"]  # fmt: skip
    assert command.out == Path("runs/figure")
    settings = reproduce.train.parse(list(command.runs.values())[1]).settings
    assert (settings.env, settings.arm, settings.seed) == ("mine:Reach-v0", "maxent", 0)
    assert (settings.steps, settings.horizon) == (100_000, 7)


def test_smoke_is_all_cells_of_one_seed_in_a_folder_of_its_own():
    command = reproduce.parse(["--smoke"])
    assert len(command.runs) == 16 and command.out == Path("runs/smoke") and command.steps < 1000
    assert len(reproduce.parse(["--smoke", "--seeds", "0", "1"]).runs) == 32
    settings = reproduce.train.parse(next(iter(command.runs.values()))).settings
    assert settings.deter == 16


@pytest.mark.parametrize("arguments, word", [
    (["--steps", "5"], "--steps 5"), (["--workers", "0"], "--workers"),
    (["--seeds", "-1"], "--seeds"), (["--index", "32"], "--index"), (["--index", "-1"], "--index"),
    (["--arms", "warp"], "warp"), (["--bogus"], "--bogus"), (["--out", __file__], "test_"),
    (["--", "--deter", "much"], "--deter"), (["--", "--steps", "5000"], "--steps"),
    (["--", "--seed=3"], "--seed"), (["--smok"], "--smok"), (["--", "--run_dir", "x"], "--out"),
])  # fmt: skip
def test_bad_input_ends_with_one_sentence_before_anything_is_made(
    arguments, word, capsys, monkeypatch, tmp_path
):
    monkeypatch.chdir(tmp_path)
    with pytest.raises(SystemExit) as end:
        reproduce.main(arguments)
    said = capsys.readouterr().err.strip()
    assert end.value.code == 2 and len(said.splitlines()) == 1 and word in said
    assert not list(tmp_path.glob("runs/figure/*"))


def test_a_run_of_other_settings_is_not_taken_for_the_one_asked_for(stand_in, capsys):
    folder = stand_in / f"{HOPPER}-maxent-seed0"
    write_run(folder, 3000, "weights.pt")
    asked = reproduce.train.parse([f"--env={HOPPER}", "--steps=3000", "--eval-episodes=4",
                                     "--checkpoint-minutes=1"])  # fmt: skip
    (folder / "settings.json").write_text(asked.settings.to_json())
    arguments = ["--arms", "maxent", "--envs", HOPPER, "--seeds", "0", "--steps", "3000"]
    arguments += ["--out", str(stand_in)]
    assert reproduce.main(arguments) == 0  # evaluated less often, it is the same experiment
    with pytest.raises(SystemExit) as end:
        reproduce.main([*arguments, "--", "--horizon", "7"])
    said = capsys.readouterr().err.splitlines()[-1]
    assert end.value.code == 2 and "a run with horizon 5: name another --out." in said
    with pytest.raises(SystemExit):  # which a run may change as it goes on, but not a figure
        reproduce.main([*arguments, "--", "--actor-lr", "1e-3", "--eval-every", "1000"])
    assert "a run with actor_lr 0.0002, eval_every 5000: name" in capsys.readouterr().err
    with pytest.raises(SystemExit):  # a longer one, cut off, has another schedule of β
        reproduce.main([*arguments[:-4], "--steps", "2500", *arguments[-2:]])
    assert "a run with steps 3000: name" in capsys.readouterr().err
    older = asked.settings.to_json().replace('"ends_ahead"', '"heads_ahead"')
    (folder / "settings.json").write_text(older)
    with pytest.raises(SystemExit):
        reproduce.main(arguments)
    assert "a run with ends_ahead None, heads_ahead 5:" in capsys.readouterr().err


# ---- what becomes of each ------------------------------------------------------------------------


def test_finished_runs_are_skipped_others_taken_up_and_missing_ones_begun(stand_in, capsys):
    for seed, steps, *others in (
        (0, 3000, "settings.json", "weights.pt"),  # finished
        (1, 2000, "settings.json", "weights.pt"),  # finished when --steps was 2000
        (2, 3000, "settings.json"),  # evaluated at its end, then killed
        (3, 3000),  # no settings.json, but results: not ours to delete
    ):
        write_run(stand_in / f"{HOPPER}-maxent-seed{seed}", steps, *others)
    born = stand_in / f"{HOPPER}-maxent-seed4"
    born.mkdir()
    (born / "replay.bin").touch()  # killed before settings.json was there
    arguments = ["--arms", "maxent", "--envs", HOPPER, "--seeds", *"012345", "--steps", "3000"]
    assert reproduce.main([*arguments, "--out", str(stand_in)]) == 0
    how = ["--resume", "--resume", "--run-dir", "--run-dir", "--run-dir"]
    assert calls(stand_in) == [
        f"{h} {HOPPER}-maxent-seed{k} 3000 1" for h, k in zip(how, range(1, 6), strict=True)
    ]
    said = capsys.readouterr().err
    (line,) = [line for line in said.splitlines() if "deleted" in line]
    assert str(born) in line and not (born / "replay.bin").exists()
    assert "18.0k/18.0k" in said  # the steps of all, those made before included
    assert reproduce.main([*arguments, "--out", str(stand_in)]) == 0
    assert len(calls(stand_in)) == 5


def test_a_run_that_another_process_is_beginning_is_not_deleted(stand_in):
    folder = stand_in / f"{HOPPER}-maxent-seed0"
    folder.mkdir(parents=True)
    (folder / "replay.bin").touch()
    with filelock.FileLock(folder / "run.lock"), open(os.devnull) as log:
        reproduce.start(folder, ["--steps=3000"], log).wait()
    assert (folder / "replay.bin").exists()


def test_a_failure_stops_no_other_run_and_is_listed_with_its_last_words(stand_in, capsys):
    envs = ["--envs", "Fails-v0", HOPPER, "--workers", "1"]
    assert reproduce.main([*NARROW, *envs, "--out", str(stand_in)]) == 1
    said = capsys.readouterr().err.splitlines()
    assert said[-2:] == [
        f"Fails-v0-{arm}-seed0 failed with exit code 1: There is no such thing."
        for arm in ("revised", "maxent")
    ]
    assert any("200k/200k" in line for line in said)  # none of theirs is waited for
    assert len(list(stand_in.glob(f"{HOPPER}*/weights.pt"))) == 2
    assert len(list(stand_in.glob("*.log"))) == 4


def test_a_run_of_another_process_is_no_failure_though_that_one_writes_to_its_log(stand_in, capsys):
    folder = stand_in / "Taken-v0-maxent-seed0"
    write_run(folder, 1000, "settings.json")
    arguments = ["--arms", "maxent", "--envs", "Taken-v0", "--seeds", "0", "--out", str(stand_in)]
    assert reproduce.main(arguments) == 0
    assert f"{folder} is another process's, and left to it." in capsys.readouterr().err


def test_one_of_them_alone_by_its_index_in_the_foreground(stand_in, capfd, monkeypatch):
    monkeypatch.setattr("results.plot.main", None)
    out = ["--out", str(stand_in)]
    assert reproduce.main([*NARROW, "--index", "1", *out]) == 0
    assert calls(stand_in) == [f"--run-dir {HOPPER}-maxent-seed0 100000 1"]
    said = capfd.readouterr()
    assert said.out == "began\n" and said.err == "" and not list(stand_in.glob("*.log"))
    assert (stand_in / f"{HOPPER}-maxent-seed0" / "made_with.json").exists()
    assert reproduce.main([*NARROW, "--envs", "Fails-v0", "--index", "0", *out]) == 1


@pytest.mark.parametrize("name", ["SIGINT", "SIGTERM", "SIGHUP"])
@pytest.mark.parametrize("alone", [[], ["--index", "0"]])
def test_a_signal_is_passed_on_and_the_way_to_go_on_is_said(name, alone, stand_in, capsys):
    def send() -> None:
        while not (stand_in / "ready").exists():
            time.sleep(0.01)
        os.kill(os.getpid(), getattr(signal, name))

    threading.Thread(target=send, daemon=True).start()
    arguments = [*NARROW, "--envs", "Slow-v0", "--out", str(stand_in), "--workers", "1", *alone]
    assert reproduce.main(arguments) == 75
    assert (stand_in / "told").read_text() == name
    assert len(calls(stand_in)) == 1  # no other run was begun after it
    last = capsys.readouterr().err.splitlines()[-1]
    assert last.startswith(f"Stopped. Go on with: {sys.executable} {SCRIPT} --arms revised maxent")


# ---- with train.py itself ------------------------------------------------------------------------


def test_two_cells_are_trained_and_drawn_and_those_of_others_left_alone(tmp_path, capsys):
    out = tmp_path / "figure"
    arguments = ["--smoke", *NARROW, "--out", str(out)]
    assert reproduce.main(arguments) == 0
    table = capsys.readouterr().out
    assert table.count("| 0 | 20") == 2 and (out / "curves.png").exists()
    folders = [out / f"{HOPPER}-{arm}-seed0" for arm in ("revised", "maxent")]
    assert all((folder / "made_with.json").exists() for folder in folders)
    with filelock.FileLock(folders[0] / "run.lock"):  # as long as another process trains it
        assert reproduce.main([*arguments, "--steps", "260"]) == 0
    said = capsys.readouterr()
    assert f"{folders[0]} is another process's, and left to it." in said.err
    made = [reproduce.steps_made(folder, 260) for folder in folders]
    assert made[0] < 203 and made[1] == 260
    assert "| 0 | 26" in said.out  # drawn with the unfinished one


@pytest.mark.parametrize("number", [
    signal.SIGTERM, pytest.param(signal.SIGINT, marks=pytest.mark.slow),
])  # fmt: skip
def test_a_signal_saves_the_real_thing(number, tmp_path):
    line = [sys.executable, str(SCRIPT), "--smoke", *NARROW, "--steps", "9000", "--out",
            str(tmp_path), "--workers", "1"]  # fmt: skip
    first, second = (tmp_path / f"{HOPPER}-{arm}-seed0" for arm in ("revised", "maxent"))
    process = subprocess.Popen(
        line, stderr=subprocess.PIPE, text=True,  # a shell's background has SIGINT ignored
        preexec_fn=lambda: signal.signal(signal.SIGINT, signal.SIG_DFL),
    )  # fmt: skip
    wait_for(first / "metrics.csv", process)
    process.send_signal(number)
    _, said = process.communicate(timeout=120)
    assert process.returncode == 75 and "Go on with: " in said and "Traceback" not in said, said
    log = first.with_name(first.name + ".log").read_text()
    assert log.splitlines()[-1].startswith("Stopped. Go on with: ")
    assert 0 < reproduce.steps_made(first, 9000) < 9000 and not second.exists()
