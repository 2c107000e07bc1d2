"""env.py on real PyBullet environments and on toys with known rewards; replay by exhaustion."""

import gc
import subprocess
import sys
import time

import gymnasium as gym
import numpy as np
import pytest
from gymnasium.spaces import Box
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy import stats

import env as env_module
from env import Replay, coverage, make_env, resize

IDS = [f"{robot}BulletEnv-v0" for robot in ("Hopper", "Walker2D", "HalfCheetah", "Ant")]


class Toy(gym.Env):
    """Rewards with the sum of its action, ends after `life` steps, shows the image it was given."""

    metadata = {"render_modes": ["rgb_array"]}  # noqa: RUF012
    observation_space = Box(-1, 1, (1,))

    def __init__(self, render_mode=None, space=None, image=None, life=4):
        self.render_mode, self.image, self.life = render_mode, image, life
        self.action_space = Box(-2, 3, (2,)) if space is None else space

    def reset(self, seed=None, options=None):
        self.age = 0
        return np.zeros(1, np.float32), {}

    def step(self, action):
        self.age += 1
        over = self.age >= self.life
        return np.zeros(1, np.float32), float(action.sum()), over, False, {}

    def render(self):
        return np.zeros((64, 64, 3), np.uint8) if self.image is None else self.image


class NoRenderMode(Toy):
    def __init__(self):
        super().__init__()


class MissingRenderer(Toy):
    """As Pendulum-v1 without pygame: made without complaint, and fails at the first image."""

    def render(self):
        raise gym.error.DependencyNotInstalled("pygame is not installed")


@pytest.fixture(scope="module")
def make():
    """make_env, but every environment stays open to the module's end and is closed in order:
    a PyBullet client that is collected after another was opened disconnects the other."""
    opened = []

    def make(*args, **kwargs):
        opened.append(make_env(*args, **kwargs))
        return opened[-1]

    yield make
    for env in opened:
        env.close()
    opened.clear()
    gc.collect()  # here, not after another module has opened its own


@pytest.fixture
def register():
    """Registers a toy environment for one test: its id."""
    ids = []

    def register(entry_point, **kwargs):
        ids.append(f"Toy{len(ids)}-v0")
        gym.register(ids[-1], entry_point=entry_point, kwargs=kwargs)
        return ids[-1]

    yield register
    for env_id in ids:
        del gym.registry[env_id]


def play(env, seed, actions):
    """Images, rewards and the last step's flags and info, up to the end of episode or actions."""
    images, rewards = [env.reset(seed=seed)[0]], []
    for action in actions:
        image, reward, terminated, truncated, info = env.step(action)
        images.append(image)
        rewards.append(reward)
        if terminated or truncated:
            break
    return np.array(images), np.array(rewards), terminated, truncated, info


def random_actions(env, n, seed=0):
    return np.random.default_rng(seed).uniform(-1, 1, (n, *env.action_space.shape)).astype("f4")


# --- real PyBullet environments ---


@pytest.mark.parametrize("env_id", IDS)
def test_observation_is_the_image_rendered_at_64_by_64(make, env_id):
    env = make(env_id)
    images, *_ = play(env, 1, random_actions(env, 5))
    assert env.observation_space == Box(0, 255, (64, 64, 3), np.uint8)
    assert env.observation_space.contains(images[-1])
    assert env.unwrapped.render().shape == (64, 64, 3)  # never resized from 320×240
    assert np.array_equal(env.unwrapped.render(), images[-1])
    assert images[-1].std() > 5 and not np.array_equal(images[0], images[-1])
    assert (env.action_space.low == -1).all() and (env.action_space.high == 1).all()
    assert env.action_space.dtype == np.float32


@pytest.mark.parametrize("env_id", IDS)
def test_same_seed_and_actions_give_the_same_episode_whatever_was_played_before(make, env_id):
    one, other = make(env_id), make(env_id)
    play(one, 5, random_actions(one, 15, seed=1))
    actions = random_actions(one, 15, seed=2)
    images, rewards, *_ = play(one, 7, actions)
    play(other, 9, random_actions(one, 1, seed=3))
    again, rewards_again, *_ = play(other, 7, actions)
    assert np.array_equal(images, again)
    assert rewards.tolist() == rewards_again.tolist()
    first_image, _ = one.reset(seed=8)
    assert not np.array_equal(first_image, images[0])  # another seed, another episode


def test_action_repeat_sums_rewards_and_stops_at_the_episodes_end(make):
    """Doing nothing, Hopper falls after 57 of its own steps from this seed: 28 and a half pairs."""
    still = np.zeros((100, 3), np.float32)
    _, single, terminated, truncated, info = play(make(IDS[0], 1), 5, still)
    assert terminated and not truncated and info["episode"]["l"] == len(single)
    _, rewards, terminated, truncated, info = play(make(IDS[0], 2), 5, still)
    sums = [single[i : i + 2].sum() for i in range(0, len(single), 2)]
    np.testing.assert_allclose(rewards, sums)
    assert terminated and not truncated
    assert info["episode"]["l"] == len(single)  # in environment steps
    assert info["episode"]["r"] == pytest.approx(single.sum(), rel=1e-5)


def test_half_cheetah_is_truncated_at_1000_environment_steps_and_not_terminated(make):
    env = make("HalfCheetahBulletEnv-v0")
    _, rewards, terminated, truncated, info = play(env, 1, np.zeros((600, 6), np.float32))
    assert truncated and not terminated
    assert len(rewards) == 500 and info["episode"]["l"] == 1000


def test_camera_distance_moves_the_camera_and_none_leaves_it(make):
    at_own, at_three, near = (make(IDS[0], camera_distance=d) for d in (None, 3.0, 1.7))
    images = [env.reset(seed=0)[0] for env in (at_own, at_three, near)]
    assert np.array_equal(images[0], images[1])  # PyBullet's own distance is 3
    assert not np.array_equal(images[0], images[2])


# --- toy environments ---


def test_actions_are_rescaled_from_minus_one_to_one_to_the_environments_box(make, register):
    env = make(register(Toy), action_repeat=1)  # its Box is [−2, 3] twice
    actions = [[-1, -1], [1, 1], [0, -1], [0.6, -0.2]]
    _, rewards, *_ = play(env, 0, np.array(actions, np.float32))
    np.testing.assert_allclose(rewards, [-2 - 2, 3 + 3, 0.5 - 2, 2 + 0], atol=1e-6)


def test_last_decision_of_an_episode_may_be_shorter(make, register):
    env = make(register(Toy, life=5), action_repeat=3)
    _, rewards, terminated, truncated, info = play(env, 0, np.ones((9, 2), np.float32))
    assert rewards.tolist() == [18, 12] and terminated and not truncated
    assert info["episode"]["r"] == 30 and info["episode"]["l"] == 5


def test_environment_that_renders_at_another_size_is_averaged_to_64_by_64(make, register):
    small = np.random.default_rng(0).integers(256, size=(64, 64, 3), dtype=np.uint8)
    env = make(register(Toy, image=small.repeat(3, 0).repeat(2, 1)))  # 192×128
    image, _ = env.reset()
    assert env.observation_space == Box(0, 255, (64, 64, 3), np.uint8)
    assert image.dtype == np.uint8 and np.array_equal(image, small)
    assert np.array_equal(env.step(np.zeros(2, np.float32))[0], small)


def test_resize_averages():
    stripes = np.tile(np.array([0, 100], np.uint8)[:, None, None], (64, 128, 3))
    assert (resize(stripes) == 50).all()


def refusal(env_id):
    """The one sentence with which make_env refuses an environment."""
    with pytest.raises(ValueError) as refused:
        make_env(env_id)
    sentence = str(refused.value)
    assert env_id in sentence and "\n" not in sentence
    return sentence


def test_unknown_environment_is_refused_with_close_matches():
    assert "did you mean HopperBulletEnv-v0" in refusal("HoperBulletEnv-v0")
    assert "HopperBulletEnv-v0" in refusal("HopperBulletEnv")
    assert "registry" in refusal("qqqqqq")


def test_discrete_actions_are_refused():
    assert "Discrete(2)" in refusal("CartPole-v1")


def test_unbounded_actions_are_refused(register):
    assert "bounded Box" in refusal(register(Toy, space=Box(-np.inf, np.inf, (2,))))
    assert "bounded Box" in refusal(register(Toy, space=Box(np.zeros(2, "f4"), np.inf)))


def test_environment_without_images_is_refused(register):
    assert "cannot be learnt from its images" in refusal(register(NoRenderMode))


def test_environment_whose_renderer_is_missing_is_refused(register):
    assert "pygame" in refusal(register(MissingRenderer))


# --- several PyBullet environments in one process ---


def test_environment_made_after_another_was_dropped_or_closed_works():
    """In a process of its own: this one holds others open, which hides it. Nor is anything printed,
    be it at the end, when C empties its buffers into a pipe, or with its streams closed."""
    code = """
import gc
import subprocess
import sys
from env import make_env
for close in (True, False, False):
    env = make_env("HopperBulletEnv-v0")
    env.reset(seed=0)
    env.step([0, 0, 0])
    if close:
        env.close()
    del env
    gc.collect()
"""
    for closed in ("", "import os; os.close(1); os.close(2); os.close(0)"):
        command = [sys.executable, "-c", closed + code]
        done = subprocess.run(command, capture_output=True, text=True)
        assert (done.returncode, done.stdout, done.stderr) == (0, "", "")


def test_silence_covers_both_streams_and_ends_after_an_error(capfd):
    with pytest.raises(KeyError), env_module.silence():
        subprocess.run("echo out; echo err >&2", shell=True)
        raise KeyError
    subprocess.run("echo out after; echo err after >&2", shell=True)
    assert capfd.readouterr() == ("out after\n", "err after\n")


# --- replay ---


def filled(capacity, added, episode=3) -> Replay:
    """A replay whose row i has i for its reward, begins or ends an episode by its place in it."""
    replay = Replay(capacity, actions=2)
    for i in range(added):
        first, last = i % episode == 0, i % episode == episode - 1
        replay.add(np.full((64, 64, 3), i % 256), (i, -i), i, terminated=last, is_first=first)
    return replay


@settings(max_examples=40, deadline=None)
@given(capacity=st.integers(2, 12), added=st.integers(1, 40), data=st.data())
def test_every_window_in_time_is_sampled_and_none_across_the_write_head(capacity, added, data):
    """Whatever was overwritten, all windows of consecutive rows are found, and no other."""
    replay = filled(capacity, added)
    length = data.draw(st.integers(1, len(replay)))
    windows = replay.sample(300, length, np.random.default_rng(0))
    assert len(replay) == min(capacity, added) and windows.shape == (300, length)
    rewards = {tuple(window) for window in windows["reward"]}
    oldest = added - len(replay)
    assert rewards == {tuple(range(i, i + length)) for i in range(oldest, added - length + 1)}


def test_every_stored_row_is_reachable_terminal_and_newest_ones_included():
    replay = filled(10, 24)  # rows 14 … 23 are left; 14, 17, 20 and 23 are terminal
    windows = replay.sample(300, 4, np.random.default_rng(0))
    assert set(windows["reward"].ravel()) == set(range(14, 24))
    assert set(windows["reward"][windows["terminated"]]) == {14, 17, 20, 23}
    assert set(windows["reward"][windows["is_first"]]) == {15, 18, 21}


def test_windows_are_equally_likely():
    replay, rng = filled(12, 20), np.random.default_rng(0)
    starts = [replay.sample(100, 3, rng)["reward"][:, 0] for _ in range(40)]
    _, counts = np.unique(starts, return_counts=True)
    assert len(counts) == 10 and stats.chisquare(counts).pvalue > 0.001


def test_a_row_comes_back_as_it_was_added():
    replay = filled(10, 24)
    rows = replay.sample(50, 1, np.random.default_rng(0))[:, 0]
    for row in rows:
        i = int(row["reward"])
        assert (row["image"] == i).all() and row["image"].shape == (64, 64, 3)
        assert row["action"].tolist() == [i, -i]
        assert row["is_first"] == (i % 3 == 0) and row["terminated"] == (i % 3 == 2)
    assert replay.last["reward"] == 23


def test_row_of_a_reset_leaves_nothing_of_the_row_it_overwrites():
    replay = filled(3, 5)  # row 2, terminal and with a reward, is the next to go
    replay.add(np.full((64, 64, 3), 9), is_first=True)
    row = replay.last
    assert (row["image"] == 9).all() and row["is_first"] and not row["terminated"]
    assert row["reward"] == 0 and row["action"].tolist() == [0, 0]


def test_replay_takes_five_percent_more_memory_than_its_images_at_most():
    replay = Replay(1000, actions=8)
    assert replay.rows["image"].dtype == np.uint8
    assert replay.rows.nbytes <= 1.05 * 1000 * 64 * 64 * 3


def test_replay_shorter_than_a_window_is_refused():
    replay = filled(10, 4)
    assert replay.sample(1, 4, np.random.default_rng(0))["reward"].tolist() == [[0, 1, 2, 3]]
    with pytest.raises(ValueError, match="holds 4 rows"):
        replay.sample(1, 5, np.random.default_rng(0))


@pytest.mark.parametrize("d", [1, 2, 5])
def test_coverage_is_a_gaussians_entropy(d):
    rng = np.random.default_rng(0)
    std = np.linspace(0.5, 2, d)
    exact = stats.multivariate_normal(cov=np.diag(std**2)).entropy()
    estimates = [coverage(std * rng.standard_normal((4000, d))) for _ in range(5)]
    assert np.mean(estimates) == pytest.approx(exact, abs=0.1)


def test_coverage_grows_by_the_log_of_the_scale():
    states = np.random.default_rng(0).standard_normal((500, 3))
    assert coverage(2 * states + 7) == pytest.approx(coverage(states) + 3 * np.log(2))


def test_coverage_of_repeated_states_is_finite_and_of_too_few_nan():
    assert np.isfinite(coverage(np.zeros((10, 3))))
    assert np.isnan(coverage(np.zeros((3, 3))))


@pytest.mark.parametrize(
    "states",
    [
        np.full((9, 3), np.nan),
        np.where(np.arange(27).reshape(9, 3) == 4, np.inf, 1.0),
        np.zeros((9, 0)),
        np.zeros((0, 3)),
        np.zeros((0, 0)),
        np.zeros((9, 65)),
        np.zeros(9),
        np.zeros((9, 3, 2)),
        np.array([["a", "b"]] * 9),
        [[1, 2], [3]],
        None,
    ],
    ids=str,
)
def test_coverage_of_what_has_none_is_nan(states):
    assert np.isnan(coverage(states))


def test_coverage_of_extreme_states_raises_nothing():
    for scale in (1e-300, 1e30, 1e300):
        coverage(scale * np.random.default_rng(0).standard_normal((100, 3)))


@pytest.mark.parametrize("d", [2, 64, 27648])
def test_coverage_takes_about_a_second_at_most(d):
    states = np.random.default_rng(0).standard_normal((20_000 if d < 99 else 700, d), np.float32)
    start = time.process_time()
    coverage(states)
    assert time.process_time() - start < 5  # 1 here, and minutes without its bounds


def test_coverage_of_many_states_is_that_of_evenly_spaced_ones():
    states = np.random.default_rng(0).standard_normal((9999, 2))
    assert coverage(states) == coverage(states[::2])
    assert coverage(states) == pytest.approx(np.log(2 * np.pi) + 1, abs=0.1)


def test_the_environments_own_state_is_in_info_and_not_in_the_observation(make):
    env = make("HopperBulletEnv-v0")
    image, _ = env.reset(seed=0)
    _, _, _, _, info = env.step(np.zeros(3, np.float32))
    assert image.shape == (64, 64, 3)
    assert np.array_equal(info["state"], env.unwrapped.robot.calc_state())
