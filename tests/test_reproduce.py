"""results/reproduce.py: which runs there are, what becomes of each, and the figure at the end."""

import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest

import results.reproduce as reproduce

SCRIPT = Path(reproduce.__file__)
NARROW = ["--arms", "revised", "maxent", "--envs", "HopperBulletEnv-v0", "--seeds", "0"]


def test_all_sixteen_curves_are_there_and_a_cut_figure_is_fair():
    command = reproduce.parse([])
    found = [name for name, _ in reproduce.names(command)]
    assert len(found) == len(set(found)) == 32
    assert all(name.endswith("seed0") for name in found[:16])
    assert reproduce.parse(["--workers", "3", "--", "--horizon", "7"]).options == ["--horizon", "7"]


def made(folder: Path, steps: int, whole: bool) -> None:
    folder.mkdir(parents=True)
    (folder / "settings.json").touch()
    (folder / "metrics.csv").write_text(f"env_steps,eval_return\n{steps},1\n")
    if whole:
        (folder / "weights.pt").touch()


def test_finished_runs_are_skipped_others_taken_up_and_missing_ones_begun(tmp_path, monkeypatch):
    made(tmp_path / "whole", 100, True)
    made(tmp_path / "longer", 100, True)
    made(tmp_path / "half", 60, False)
    assert reproduce.finished(tmp_path / "whole", 100)
    assert not reproduce.finished(tmp_path / "longer", 200)
    assert not reproduce.finished(tmp_path / "half", 60)
    assert reproduce.steps_made(tmp_path / "none") == 0
    started = []
    monkeypatch.setattr("subprocess.Popen", lambda line, **_: started.append(line))
    command = reproduce.parse(["--steps", "100", "--", "--horizon", "7"])
    for name in ("half", "none"):
        reproduce.start(tmp_path / name, ["--arm", "revised"], command)
    assert started[0][2:] == ["--resume", str(tmp_path / "half"), "--steps", "100"]
    assert started[1][2:4] == ["--run-dir", str(tmp_path / "none")]
    assert started[1][-4:] == ["--arm", "revised", "--horizon", "7"]


def test_a_failure_stops_no_other_run_and_figure_and_table_are_drawn(tmp_path, capsys):
    out = tmp_path / "figure"
    envs = ["--envs", "HopperBulletEnv-v0", "NoSuchEnv-v0"]
    narrow = ["--smoke", "--arms", "maxent", *envs, "--workers", "2", "--out", str(out)]
    assert reproduce.main(narrow) == 1
    said = capsys.readouterr()
    assert "NoSuchEnv-v0-maxent-seed0 failed: " in said.err and "no environment" in said.err
    assert "| HopperBulletEnv-v0 | maxent" in said.out
    assert (out / "curves.png").exists() and (out / "made_with.json").exists()
    before = (out / "HopperBulletEnv-v0-maxent-seed0" / "metrics.csv").stat().st_mtime_ns
    again = ["--smoke", "--arms", "maxent", *envs[:2], "--out", str(out)]
    assert reproduce.main(again) == 0
    assert (out / "HopperBulletEnv-v0-maxent-seed0" / "metrics.csv").stat().st_mtime_ns == before


def test_one_of_them_alone_by_its_index(tmp_path, capsys):
    assert reproduce.main([*NARROW, "--list"]) == 0
    assert capsys.readouterr().out.splitlines()[1] == "1 HopperBulletEnv-v0-maxent-seed0"
    assert reproduce.main([*NARROW, "--index", "2"]) == 2
    assert reproduce.main([*NARROW, "--smoke", "--index", "1", "--out", str(tmp_path)]) == 0
    assert [path.name for path in tmp_path.glob("*/weights.pt")] == ["weights.pt"]


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_a_signal_saves_all_runs_and_the_same_command_goes_on(number, tmp_path):
    arguments = [*NARROW, "--workers", "1", "--out", str(tmp_path), "--smoke"]
    longer = ["--", "--updates", "30"]
    process = subprocess.Popen(
        [sys.executable, str(SCRIPT), *arguments, *longer],
        stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, env=os.environ,
    )  # fmt: skip
    first = tmp_path / "HopperBulletEnv-v0-revised-seed0"
    while not (first / "checkpoint.pt").exists() and process.poll() is None:
        time.sleep(0.05)
    time.sleep(1)
    process.send_signal(number)
    said, errors = process.communicate(timeout=60)
    assert "Traceback" not in errors and "Go on with: " in said, errors
    assert not (tmp_path / "HopperBulletEnv-v0-maxent-seed0").exists()
    assert (first / "settings.json").exists() and not (first / "weights.pt").exists()
