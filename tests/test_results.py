"""results/: the diagnosis holds predictions against the right row; the figure needs files alone."""

import csv
import dataclasses
import json
import shutil
from pathlib import Path

import numpy as np
import pytest
import torch
from PIL import Image

import results.diagnose as diagnose
import results.play as play
import results.plot as plot
from actors import Episode
from train import Agent, Settings, default_settings, main

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


def test_what_is_seen_and_what_is_dreamt_are_held_apart():
    """The reconstruction's error is of the image in the same row; a perfect decoder makes none."""
    torch.manual_seed(0)
    agent = Agent(Settings(**TINY), actions=3, device=torch.device("cpu"), bfloat16=False)
    episode = made_up_episode(30, terminated=True)
    exact = torch.from_numpy(episode.images[1:]).float() / 255 - 0.5
    agent.model.decoder.forward = lambda x: (
        exact if len(x) == 30 else torch.zeros(len(x), 64, 64, 3)
    )
    found = diagnose.measure(agent, "deterministic", episode)
    assert found["seen_image"] == pytest.approx(np.zeros(30), abs=1e-6)
    assert found["open_image"][:, :, 0].min() > 100


GOOD = {
    diagnose.REWARDS: 0.9, diagnose.DEVIATION: 0.4, diagnose.ENDS: 5, diagnose.EXPECTED: 4.5,
    diagnose.PROMISED: 100, diagnose.EARNED: 95, diagnose.AFTER: 0.6,
}  # fmt: skip


@pytest.mark.parametrize("worse, word", [
    ({}, "Nothing stands out"),
    ({diagnose.REWARDS: 0.1}, "does not know the rewards"),
    ({diagnose.DEVIATION: 0.01, diagnose.REWARDS: -7}, "the same whatever it sees"),
    ({diagnose.EXPECTED: 1}, "see ends coming"),
    ({diagnose.EXPECTED: 30}, "do not come"),
    ({diagnose.PROMISED: 200}, "promised than earned"),
    ({diagnose.PROMISED: -20, diagnose.EARNED: -90}, "promised than earned"),
    ({diagnose.AFTER: -0.5}, "dynamics are weak"),
])  # fmt: skip
def test_the_verdict_names_what_to_look_at_first(worse, word):
    assert word in diagnose.verdict({"stochastic": GOOD, "deterministic": GOOD | worse})


def test_a_verdict_needs_no_figure_that_short_episodes_lack():
    short = {k: v for k, v in GOOD.items() if k not in (diagnose.AFTER, diagnose.PROMISED)}
    assert "Nothing stands out" in diagnose.verdict({"stochastic": short})


@pytest.fixture(scope="module")
def trained(tmp_path_factory) -> Path:
    folder = tmp_path_factory.mktemp("a run") / "moved"
    options = [f"--{name.replace('_', '-')}={value}" for name, value in TINY.items()]
    assert main(["--run-dir", str(folder.with_name("made")), *options]) == 0
    folder.with_name("made").rename(folder)
    return folder


@pytest.mark.parametrize("which", ["newest", "best"])
def test_any_run_can_be_played_and_filmed(trained, which, capsys):
    arguments = [str(trained), "--episodes", "2", "--video", "--checkpoint", which]
    assert play.main(arguments) == 0
    with open(trained / "metrics.csv", newline="") as file:
        last = list(csv.DictReader(file))[-1]
    said = capsys.readouterr().out
    if which == "newest":  # the same seeds as evaluation's
        assert f"return {float(last['eval_return']):.1f} " in said
    name = "120" if which == "newest" else "best"
    with Image.open(trained / f"episode-{name}.gif") as gif:
        assert gif.size == (3 * 128, 140) and gif.n_frames > 1
        assert gif.info["duration"] >= play.SHORTEST
    assert Image.open(trained / f"strip-{name}.png").size == (640, 6 * 64)


def test_train_py_evaluates_by_it(trained, tmp_path, capfd):
    assert main(["--evaluate", str(trained), "--episodes", "1", "--checkpoint", "best"]) == 0
    assert "networks best" in capfd.readouterr().out
    for arguments in (["--evaluate", str(tmp_path)], ["--evaluate", "x", "--episodes", "0"]):
        assert main(arguments) == 2
        assert len(capfd.readouterr().err.strip().splitlines()) == 1


def test_one_episode_has_no_interval(trained, capsys):
    assert play.main([str(trained), "--episodes", "1", "--actor", "stochastic"]) == 0
    said = capsys.readouterr().out
    assert "±" not in said and "nan" not in said


def test_a_film_keeps_real_time_and_its_colours(tmp_path):
    pictures = np.zeros((3, 100, 64, 64, 3), np.uint8)
    pictures[0, :, :32] = (0, 180, 0)  # green above, a little of it
    for k in range(100):
        pictures[1, k, k // 2] = (250, 200, 10)  # a line that falls: no two frames are the same
    play.film(tmp_path / "a.gif", pictures, fps=100)  # 10 ms a frame: every other one is shown
    with Image.open(tmp_path / "a.gif") as gif:
        assert gif.info["duration"] == 20 and gif.n_frames <= 50
        pixel = np.array(gif.convert("RGB").getpixel((60, 60)), int)
        assert np.abs(pixel - (0, 180, 0)).max() < 12


def test_bad_input_ends_with_one_sentence(tmp_path, capsys):
    for program in (diagnose, play, plot):
        assert program.main([str(tmp_path)]) == 2
        assert len(capsys.readouterr().err.strip().splitlines()) == 1
    for program in (diagnose, play):
        assert program.main([str(tmp_path), "--episodes", "0"]) == 2
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
    write_run(tmp_path / "b", "3 5", seed=1, checkpoint_minutes=1.0)
    write_run(tmp_path / "c", "7", seed=1, q_critic=False, preset="paper")
    write_run(tmp_path / "d", "")  # not yet evaluated: left out
    runs = plot.read_runs(tmp_path)["HopperBulletEnv-v0"]
    assert sorted(runs["maxent"]) == ["0", "1"]
    (other,) = runs.keys() - {"maxent"}
    assert other.startswith("maxent, preset paper") and "q_critic False" in other


def test_an_environment_without_reference_is_drawn_too(tmp_path):
    write_run(tmp_path / "a", "1 2", env="HumanoidBulletEnv-v0")
    assert plot.main([str(tmp_path)]) == 0
    assert "| HumanoidBulletEnv-v0 | maxent | 0 | 10,000 |" in (tmp_path / "table.md").read_text()


def test_two_runs_of_one_seed_are_two_lines_and_both_count(tmp_path):
    write_run(tmp_path / "a", "1 2")
    write_run(tmp_path / "b", "3 4")
    runs = plot.read_runs(tmp_path)["HopperBulletEnv-v0"]["maxent"]
    assert list(runs) == ["0", "0, b"]
    assert plot.main([str(tmp_path)]) == 0


def test_a_seed_that_cannot_be_averaged_is_left_out_with_a_word(tmp_path, capsys):
    write_run(tmp_path / "a", "1 2")
    write_run(tmp_path / "b", "1", seed=1)
    path = tmp_path / "b" / "metrics.csv"
    path.write_text(path.read_text().replace("\n5000,", "\n7000,"))
    assert plot.main([str(tmp_path)]) == 0
    said = capsys.readouterr()
    assert "steps" in said.err and "maxent | 1 |" not in said.out


def test_coverage_that_is_unknown_leaves_the_returns_drawn(tmp_path):
    write_run(tmp_path / "a", "1 2")
    path = tmp_path / "a" / "metrics.csv"
    path.write_text(path.read_text().replace(",2.5", ",nan"))
    assert plot.main([str(tmp_path)]) == 0


@pytest.mark.parametrize("file, content", [
    ("settings.json", ""), ("settings.json", "[]"), ("settings.json", "{}"),
    ("settings.json", '{"arm": "warp", "preset": "small"}'), ("settings.json", '{"arm"'),
    ("metrics.csv", "a,b\n1,2\n"), ("metrics.csv", "env_steps\nmany\n"),
])  # fmt: skip
def test_what_is_no_run_is_left_out_with_a_word(file, content, tmp_path, capsys):
    write_run(tmp_path / "a", "1 2")
    write_run(tmp_path / "b", "3 4", seed=1)
    (tmp_path / "b" / file).write_text(content)
    assert plot.main([str(tmp_path)]) == 0
    said = capsys.readouterr()
    assert "maxent | 0 |" in said.out and "maxent | 1 |" not in said.out
    assert len(said.err.splitlines()) == 1 and str(tmp_path / "b") in said.err


def test_a_row_that_is_half_written_is_left_out(tmp_path, trained):
    write_run(tmp_path / "a", "1 2 3")
    path = tmp_path / "a" / "metrics.csv"
    path.write_text(path.read_text()[:-8])
    (columns,) = plot.read_runs(tmp_path)["HopperBulletEnv-v0"]["maxent"].values()
    assert columns["eval_return"].tolist() == [1, 2]
    assert len(diagnose.read_metrics(tmp_path / "a")) == 2
    assert diagnose.read_metrics(tmp_path) == []


def test_committed_runs_give_the_committed_table(tmp_path):
    for name in ("", "old_view", "old_view/20k"):
        folder = tmp_path / name.replace("/", "-") / "runs"
        for path in (RESULTS / name).glob("*/settings.json"):
            shutil.copytree(path.parent, folder / path.parent.name)
        if not folder.exists():
            continue
        assert plot.main([str(folder)]) == 0
        assert (folder / "table.md").read_text() == (RESULTS / name / "table.md").read_text()
        assert (folder / "curves.png").stat().st_size > 10_000


def test_committed_runs_are_of_this_programs_settings():
    fields = set(Settings.__dataclass_fields__)
    for path in RESULTS.glob("*/settings.json"):
        assert json.loads(path.read_text()).keys() == fields, path


def test_committed_runs_of_the_old_view_are_whole():
    paths = list(RESULTS.glob("old_view/**/settings.json"))
    assert len(paths) == 19
    for path in paths:
        last = path.with_name("metrics.csv").read_text().splitlines()[-1]
        assert int(last.split(",")[0]) >= json.loads(path.read_text())["steps"], path
