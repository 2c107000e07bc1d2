"""results/: the diagnosis holds predictions against the right row; the figure needs files alone."""

import dataclasses
import json
import shutil
from pathlib import Path

import numpy as np
import pytest
import torch

import results.diagnose as diagnose
import results.plot as plot
from train import Agent, Episode, Settings, default_settings, main

TINY = dict(
    deter=16, stoch=8, hidden=16, units=16, depth=2, mdn_units=16, horizon=5, batch_size=3,
    length=8, prefill=60, eval_episodes=2, steps=120, eval_every=60,
)  # fmt: skip
RESULTS = Path(plot.__file__).parent


def test_r_squared_of_hand_worked_predictions():
    real = np.array([1.0, 2.0, 3.0])
    assert diagnose.r_squared(real, real) == 1
    assert diagnose.r_squared(np.full(3, 2.0), real) == 0
    assert diagnose.r_squared(real[::-1], real) == -3  # (4 + 0 + 4) / 3 against a variance of 2/3


def test_discounted_returns_of_hand_worked_rewards():
    assert diagnose.discounted(np.array([1.0, 2.0, 4.0]), 0.5).tolist() == [3, 4, 4]


def test_windows_are_time_first():
    x = torch.arange(10.0).view(5, 2)
    found = diagnose.windows(x, 3)
    assert found.shape == (3, 3, 2)
    assert torch.equal(found[:, 1], x[1:4])


def made_up_episode(length: int, terminated: bool) -> Episode:
    rng = np.random.default_rng(0)
    images = rng.integers(0, 256, (length + 1, 64, 64, 3), np.uint8)
    actions = rng.uniform(-1, 1, (length, 3)).astype(np.float32)
    rewards = rng.standard_normal(length).astype(np.float32)
    return Episode(
        images, actions, rewards, torch.zeros(length, 24), terminated, rewards.sum(), 2 * length
    )


def test_each_prediction_stands_beside_what_happened_at_its_step():
    torch.manual_seed(0)
    agent = Agent(Settings(**TINY), actions=3, device=torch.device("cpu"), bfloat16=False)
    episode = made_up_episode(30, terminated=True)
    found = diagnose.measure(agent, "deterministic", episode)
    rewards, images = episode.rewards, episode.images.astype(float)
    np.testing.assert_array_equal(found["reward"][:, 1], rewards)
    assert found["terminated"][:, 1].tolist() == [0] * 29 + [1]
    np.testing.assert_allclose(found["return"][-1, 1], rewards[-1], rtol=1e-6)
    assert len(found["open_reward"]) == 3  # begun at steps 0, 5, 10
    np.testing.assert_array_equal(found["open_reward"][2, :, 1], rewards[10:25])
    still = np.square(images[5] - images[5 + 4]).mean()
    np.testing.assert_allclose(found["open_image"][1, 3, 1], still, rtol=1e-5)


def test_open_loop_follows_the_actions_taken():
    torch.manual_seed(0)
    agent = Agent(Settings(**TINY), actions=3, device=torch.device("cpu"), bfloat16=False)
    asked = []
    agent.model.dense_action.register_forward_hook(lambda _, inputs, __: asked.append(inputs[0]))
    episode = made_up_episode(30, terminated=True)
    diagnose.measure(agent, "stochastic", episode)
    opened = torch.stack(asked[-diagnose.OPEN_LOOP :]).numpy()  # (15, starts, A)
    np.testing.assert_array_equal(opened[:, 1], episode.actions[5:20])


def test_returns_that_a_time_limit_cut_off_are_left_out():
    agent = Agent(Settings(**TINY), actions=3, device=torch.device("cpu"), bfloat16=False)
    found = diagnose.measure(agent, "deterministic", made_up_episode(320, terminated=False))
    assert len(found["return"]) == 320 - 298  # 0.99 ** 298 = 0.05


def test_a_run_is_diagnosed_and_left_as_it_is(tmp_path, capsys):
    folder = tmp_path / "run"
    options = [f"--{name.replace('_', '-')}={value}" for name, value in TINY.items()]
    assert main(["--run-dir", str(folder), *options]) == 0
    before = {path: path.read_bytes() for path in folder.iterdir()}
    assert diagnose.main([str(folder), "--episodes", "1"]) == 0
    page = folder / "diagnosis-120.png"
    assert page.stat().st_size > 10_000
    assert {path: path.read_bytes() for path in folder.iterdir() if path != page} == before
    assert "deterministic" in capsys.readouterr().out


def test_bad_input_ends_with_one_sentence(tmp_path, capsys):
    for program in (diagnose, plot):
        assert program.main([str(tmp_path)]) == 2
        assert len(capsys.readouterr().err.strip().splitlines()) == 1


def write_run(folder: Path, rows: str, **changes) -> None:
    """A run's folder of a line of settings and these rows of return at steps 5,000, 10,000 …"""
    settings = dataclasses.asdict(dataclasses.replace(default_settings(), **changes))
    folder.mkdir(parents=True)
    (folder / "settings.json").write_text(json.dumps(settings))
    lines = [f"{5000 * k},60,{r},1,9,2.5" for k, r in enumerate(rows.split(), 1)]
    names = "env_steps,wall_seconds,eval_return,eval_interval95,eval_length,coverage"
    (folder / "metrics.csv").write_text("\n".join([names, *lines]) if lines else "")


def test_a_run_with_a_switch_of_its_own_is_another_line(tmp_path):
    write_run(tmp_path / "a", "1 2", seed=0)
    write_run(tmp_path / "b", "3 5", seed=1, run_dir="elsewhere")
    write_run(tmp_path / "c", "7", seed=1, q_critic=False, preset="paper")
    write_run(tmp_path / "d", "")  # not yet evaluated: left out
    runs = plot.read_runs(tmp_path)["HopperBulletEnv-v0"]
    assert sorted(runs["maxent"]) == [0, 1]
    (other,) = runs.keys() - {"maxent"}
    assert other.startswith("maxent, preset paper") and "q_critic False" in other


def test_an_environment_without_reference_is_drawn_too(tmp_path):
    write_run(tmp_path / "a", "1 2", env="HumanoidBulletEnv-v0")
    assert plot.main([str(tmp_path)]) == 0
    assert "| HumanoidBulletEnv-v0 | maxent | 0 | 10,000 |" in (tmp_path / "table.md").read_text()


@pytest.mark.parametrize("seed, rows, wrong", [(0, "1 2", "repeats the seed"), (1, "1", "steps")])
def test_runs_that_cannot_be_averaged_are_refused(seed, rows, wrong, tmp_path, capsys):
    write_run(tmp_path / "a", "1 2")
    write_run(tmp_path / "b", rows, seed=seed)
    path = tmp_path / "b" / "metrics.csv"
    path.write_text(path.read_text().replace("\n5000,", "\n7000,"))
    assert plot.main([str(tmp_path)]) == 2
    assert wrong in capsys.readouterr().err


def test_committed_runs_give_the_committed_table(tmp_path):
    for name in ("", "20k"):
        folder = tmp_path / f"results{name}"
        for path in (RESULTS / name).glob("*/settings.json"):
            shutil.copytree(path.parent, folder / path.parent.name)
        assert plot.main([str(folder)]) == 0
        assert (folder / "table.md").read_text() == (RESULTS / name / "table.md").read_text()
        assert (folder / "curves.png").stat().st_size > 10_000


def test_committed_runs_are_whole_and_of_this_programs_settings():
    fields = set(Settings.__dataclass_fields__)
    for path in RESULTS.glob("**/settings.json"):
        saved = json.loads(path.read_text())
        assert saved.keys() == fields, path
        last = path.with_name("metrics.csv").read_text().splitlines()[-1]
        assert int(last.split(",")[0]) >= saved["steps"], path
