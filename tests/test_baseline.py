"""results/baseline.py: counted and evaluated as train.py does, and a line of the same figure. SB3
itself is not installed here; results/README.md says what was run with it."""

import json
import sys
from types import SimpleNamespace

import gymnasium as gym
import numpy as np
import pytest

import results.baseline as baseline
import results.plot as plot
import results.reference as reference
from train import default_settings


def test_without_sb3_one_sentence_says_what_to_install(tmp_path, capsys, monkeypatch):
    monkeypatch.setitem(sys.modules, "stable_baselines3", None)
    assert baseline.main(["--from", "states", "--run-dir", str(tmp_path / "a")]) == 2
    assert capsys.readouterr().err.count("\n") == 1 and not (tmp_path / "a").exists()


@pytest.mark.parametrize("sees", ["states", "pixels"])
def test_a_name_that_is_no_environment_leaves_one_sentence_and_no_folder(
    sees, tmp_path, capsys, monkeypatch
):
    def make_all(makers):
        return [make() for make in makers]

    vector = SimpleNamespace(DummyVecEnv=make_all)
    sb3 = SimpleNamespace(common=SimpleNamespace(vec_env=vector))
    monkeypatch.setitem(sys.modules, "stable_baselines3", sb3)
    arguments = ["--from", sees, "--env", "Hoper-v0", "--run-dir", str(tmp_path / "a")]
    assert baseline.main(arguments) == 2
    said = capsys.readouterr().err
    assert said.count("\n") == 1 and said.endswith("?\n") and said.count("Hoper-v0") <= 1
    assert not (tmp_path / "a").exists()
    assert baseline.main([*arguments[:-1], str(tmp_path)]) == 2
    assert "there already" in capsys.readouterr().err
    for wrong in (["--minutes", "0"], ["--steps", "-1"]):
        assert baseline.main([*arguments, *wrong]) == 2
        assert "above 0" in capsys.readouterr().err and not (tmp_path / "a").exists()


def test_an_environment_that_cannot_be_made_and_ctrl_c_leave_no_traceback(
    tmp_path, capsys, monkeypatch
):
    def fail(*_, **__):
        raise gym.error.DependencyNotInstalled("no box2d")

    def interrupt(*_):
        raise KeyboardInterrupt

    vector = SimpleNamespace(DummyVecEnv=lambda makers: [make() for make in makers])
    sb3 = SimpleNamespace(common=SimpleNamespace(vec_env=vector))
    monkeypatch.setitem(sys.modules, "stable_baselines3", sb3)
    arguments = ["--from", "states", "--run-dir", str(tmp_path / "a")]
    with monkeypatch.context() as patch:
        patch.setattr(baseline.gym, "make", fail)
        assert baseline.main(arguments) == 2
    assert "no box2d" in capsys.readouterr().err
    monkeypatch.setattr(baseline, "learn", interrupt)
    assert baseline.main(arguments) == 130


@pytest.mark.parametrize("arm", baseline.USUAL)
def test_worlds_are_those_of_train_py(arm):
    """Seed by seed what `reference` and so train.py's evaluation earns; the agent of `pixels` has
    the image alone, that of `states` the state alone."""
    world, same = baseline.make_world(arm, "HopperBulletEnv-v0"), reference.make("Hopper")
    repeat = baseline.USUAL[arm]["action_repeat"]
    if arm == "sac-pixels":
        assert repeat == default_settings().action_repeat
        assert world.reset(seed=3)[0].shape == (64, 64, 3)
    else:
        assert repeat == 1 and world.step(np.zeros(3))[0].shape == (15,)
    action = np.ones(3, np.float32)
    earned, length = reference.episode(same, 2**31 - 1, lambda: action)
    found, over, _ = 0.0, False, world.reset(seed=2**31 - 1)
    while not over:
        _, reward, over, _, info = world.step(action)
        found += reward
    assert found == pytest.approx(earned) and info["episode"]["l"] == length


def test_env_steps_are_counted_through_ends_and_rows_come_when_due(tmp_path, monkeypatch):
    """Episodes of 7 environment steps in 4 decisions of 2: row after row at each multiple of 10,
    the last at the end; `plot` reads them as a line of its own."""
    played = iter(range(1000))
    monkeypatch.setattr(baseline, "EVERY", 10)
    monkeypatch.setattr(baseline, "episode", lambda model, world, seed: (next(played), 7))
    settings = {"env": "E-v0", "arm": "sac-pixels", "seed": 0} | baseline.USUAL["sac-pixels"]
    (tmp_path / "settings.json").write_text(json.dumps(settings))
    record, steps = baseline.Record(settings | {"steps": 27}, tmp_path, None), []
    going, k = True, 0
    while going:
        k += 1
        info = {"state": np.full(2, k)} | ({"episode": {"l": 7}} if k % 4 == 0 else {})
        going = record({"infos": [info], "dones": [k % 4 == 0], "self": None}, {})
        steps.append(record.step)
    assert steps == [2, 4, 6, 7, 9, 11, 13, 14, 16, 18, 20, 21, 23, 25, 27]
    (arms,) = plot.read_runs(tmp_path).values()
    run = arms["sac-pixels"]["0"]
    assert run["env_steps"].tolist() == [11, 20, 27]
    assert (
        run["eval_return"].tolist() == [4.5, 14.5, 24.5] and run["eval_length"].tolist() == [7] * 3
    )


@pytest.mark.parametrize("arm", baseline.USUAL)
def test_coverage_is_of_a_state_each_two_steps(arm, tmp_path, monkeypatch):
    """As in train.py, whose decisions take two."""
    covered = []
    monkeypatch.setattr(baseline, "EVERY", 10)
    monkeypatch.setattr(baseline, "episode", lambda *_: (1.0, 7))
    monkeypatch.setattr(baseline, "coverage", lambda states: covered.append(len(states)) or 0.0)
    settings = {"env": "E-v0", "arm": arm, "seed": 0} | baseline.USUAL[arm] | {"steps": 20}
    record, going = baseline.Record(settings, tmp_path, None), True
    while going:
        info = {"state": np.zeros(2)}
        going = record({"infos": [info], "dones": [False], "self": None}, {})
    assert covered == [5, 5]


def test_an_hour_ends_a_run_that_has_steps_left(tmp_path, monkeypatch):
    monkeypatch.setattr(baseline, "episode", lambda *_: (1.0, 2))
    settings = {"minutes": 60, "steps": 100, "action_repeat": 2}
    record = baseline.Record(settings, tmp_path, None)
    now = {"infos": [{"state": np.zeros(2)}], "dones": [False], "self": None}
    assert record(now, {})
    record.began -= 3600
    assert not record(now, {})


def test_a_shorter_baseline_is_another_line():
    usual = {"env": "E-v0", "arm": "sac-states", "seed": 0} | baseline.USUAL["sac-states"]
    assert plot.label(usual) == "sac-states"
    assert plot.label(usual | {"steps": 7}) == "sac-states, steps 7"
