"""env.py on real PyBullet environments and on toys with known rewards; replay by exhaustion."""

import gc
import os
import subprocess
import sys
import time
from types import SimpleNamespace

import gymnasium as gym
import numpy as np
import pytest
from conftest import Base
from gymnasium import spaces
from gymnasium.spaces import Box
from gymnasium.utils.env_checker import check_env
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy import stats

import env as env_module
from env import EnvironmentFault, Replay, coverage, make_env, resize

IDS = [f"{robot}BulletEnv-v0" for robot in ("Hopper", "Walker2D", "HalfCheetah", "Ant")]


class NoRenderMode(Base):
    def __init__(self):
        super().__init__()


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


def test_an_episode_does_not_show_how_many_images_were_drawn_before_it(make):
    """PyBullet draws the last of these images in two ways, in turn: one number of a pixel differs.
    On other machines it may not; there the test holds the count alone."""
    env, images = make(IDS[0], camera_distance=1.7), []
    nearly_alike = [
        [-0.29635530710220337, -0.007498043589293957, 0.4204024374485016],
        [-0.30274656414985657, -0.01902066543698311, 0.4126828908920288],
        [-0.2961111068725586, -0.026265431195497513, 0.4150659739971161],
        [-0.29366806149482727, -0.01309439167380333, 0.42299026250839233],
    ]
    robot, drawn = env.unwrapped, []
    draw = robot.render
    robot.render = lambda: (drawn.append(1), draw())[1]
    before = env.get_wrapper_attr("images")
    for more in (0, 1, 0, 2, 3):
        images.append(play(env, 522690950, np.float32(nearly_alike))[0])
        assert (before + len(drawn) - 5) % 2 == 0  # without the episode's own five
        for _ in range(more):
            env.render()
    assert all(np.array_equal(images[0], other) for other in images)


def test_action_repeat_sums_rewards_and_stops_at_the_episodes_end(make):
    """Doing nothing, Hopper falls after 57 of its own steps from this seed: 28 and a half pairs."""
    still = np.zeros((100, 3), np.float32)
    _, single, terminated, truncated, info = play(make(IDS[0], 1), 5, still)
    assert terminated and not truncated and info["episode"]["l"] == len(single) == 57
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
    assert "bounded Box" in refusal(register(Base, action_space=Box(-np.inf, np.inf, (2,))))
    assert "bounded Box" in refusal(register(Base, action_space=Box(np.zeros(2, "f4"), np.inf)))


def test_environment_without_images_is_refused(register):
    assert "render_mode" in refusal(register(NoRenderMode))


def test_environment_whose_renderer_is_missing_is_refused(register):
    def render():  # as of Pendulum-v1 without pygame, made without complaint
        raise gym.error.DependencyNotInstalled("pygame is not installed")

    assert "pygame" in refusal(register(Base, render=render))


# --- somebody's environment ---


def test_arrays_that_an_environment_refills_are_copied_where_they_enter(make, register):
    canvas, buffer = np.zeros((64, 64, 3), np.uint8), np.zeros(3, np.float32)

    def image():
        canvas[:] += 1
        return canvas

    def obs():
        buffer[:] += 1
        return buffer

    env = make(register(Base, image=image, obs=obs))
    outcomes = [env.step(np.zeros(2, np.float32)) for _ in range(3)]
    assert np.diff([outcome[0].mean() for outcome in outcomes]).tolist() == [1, 1]
    assert np.diff([outcome[4]["state"][0] for outcome in outcomes]).tolist() == [2, 2]


GREY = np.random.default_rng(0).integers(256, size=(64, 64), dtype=np.uint8)
RGB = np.random.default_rng(1).integers(256, size=(64, 64, 3), dtype=np.uint8)


@pytest.mark.parametrize(
    "given, seen",
    [
        (RGB / 255, RGB),
        ((RGB / 255).astype(np.float32), RGB),
        (RGB.astype(np.int64), RGB),
        (RGB > 99, 255 * (RGB > 99)),
        (np.dstack([RGB, GREY]), RGB),
        (np.dstack([RGB, GREY]) / 255, RGB),
        (GREY, np.dstack([GREY] * 3)),
        (GREY[..., None], np.dstack([GREY] * 3)),
        (np.full((64, 64, 3), 1 + 1e-7), np.full((64, 64, 3), 255)),
        (RGB.repeat(3, 0).repeat(2, 1), RGB),  # 192×128
    ],
)
def test_image_with_one_meaning_is_seen_as_it_is_meant(make, register, given, seen):
    env = make(register(Base, image=lambda: given))
    image, _ = env.reset()
    assert image.dtype == np.uint8 and np.array_equal(image, seen)
    assert np.array_equal(env.step(np.zeros(2, np.float32))[0], seen)


@pytest.mark.parametrize(
    "image",
    [
        RGB.astype(np.float32),
        RGB / 255 - 0.5,
        RGB.astype(np.int16) * 2,
        np.full((64, 64, 3), np.nan),
        np.moveaxis(RGB, 2, 0),
        RGB[..., :2],
        RGB[None],
        RGB[:0],
        RGB * 1j,
        "text",
        None,
        [RGB, RGB[:3]],
    ],
    ids=lambda image: f"{type(image).__name__}{np.shape(image) if type(image) is not list else ''}",
)
def test_image_without_one_meaning_is_refused(register, image):
    assert "image" in refusal(register(Base, image=lambda: image))


def test_image_of_another_size_each_time_is_resized_each_time(make, register):
    sizes = iter([(64, 64), (10, 20), (300, 65), (64, 64), (1, 1), (128, 64)])
    env = make(register(Base, image=lambda: np.full((*next(sizes), 3), 7, np.uint8)))
    images = [env.reset()[0], *(env.step(np.zeros(2, np.float32))[0] for _ in range(3))]
    assert all(image.shape == (64, 64, 3) and (image == 7).all() for image in images)


@pytest.mark.parametrize(
    "reward", [2, True, np.float32(0.5), np.array(3), np.array([1.0]), np.array([[2]]), [1.5]]
)
def test_reward_that_is_one_number_becomes_a_float(make, register, reward):
    one = make(register(Base, outcome=lambda: (np.zeros(3), reward, 0, np.True_, {})))
    one.reset()
    _, given, terminated, truncated, info = one.step(np.zeros(2, np.float32))
    assert type(given) is float and given == np.ravel(reward)[0]
    assert terminated is False and truncated is True
    assert info["episode"]["r"] == given and type(info["episode"]["r"]) is float


@pytest.mark.parametrize("reward", [np.ones(2), None, "1", 1j, {}, np.nan, -np.inf, 1e30, -(2**63)])
def test_reward_that_is_no_reasonable_number_is_refused(register, reward):
    outcome = np.zeros(3), reward, False, False, {}
    assert "gave the reward" in refusal(register(Base, outcome=lambda: outcome))


def test_environments_own_episode_in_info_gives_way_and_the_rest_of_it_stays(make, register):
    info = {"episode": {"r": 7}, "_episode": True, "success": 1}
    env = make(register(Base, outcome=lambda: (np.zeros(3), 1.0, True, False, dict(info))))
    env.reset()
    told = env.step(np.zeros(2, np.float32))[4]
    assert told["episode"]["r"] == 1 and told["success"] == 1 and "_episode" not in told


@pytest.mark.parametrize(
    "given",
    [
        {"outcome": lambda: (np.zeros(3), 1.0, False, {})},
        {"outcome": lambda: (np.zeros(3), 1.0, False, False, None)},
        {"outcome": lambda: np.zeros(5)},
        {"outcome": lambda: None},
        {"reset": lambda seed=None, options=None: np.zeros(3)},
        {"reset": lambda seed=None, options=None: np.zeros(2)},
        {"reset": lambda seed=None, options=None: (np.zeros(3), [])},
        {"reset": lambda: (np.zeros(3), {})},
        {"render": lambda: 1 / 0},
        {"outcome": sys.exit},
        {"obs": lambda: [][0]},
        {"outcome": lambda: exec("raise ValueError('two\\nlines')")},
        {"action_space": None},
        {"metadata": None},
        {"action_space": Box(-1, 1, (0,))},
        {"nowhere": 1, "render_mode": None, "render": None},
    ],
)
def test_what_is_no_gymnasium_environment_is_refused_in_one_sentence(register, given):
    refusal(register(Base, **given))


def test_interrupt_while_an_environment_is_made_passes(register):
    def interrupt():
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        make_env(register(Base, render=interrupt))


def give_or_raise(value):
    if isinstance(value, BaseException):
        raise value
    return value


@pytest.mark.parametrize(
    "name, later, words",
    [
        ("image", ZeroDivisionError("a\nb"), "raised ZeroDivisionError: a b"),
        ("image", RGB.astype(np.float32), "rendered float32"),
        ("image", RGB[..., :2], r"\(64, 64, 2\)"),
        ("obs", AssertionError(), "raised AssertionError"),
        ("obs", SystemExit(3), "raised SystemExit: 3"),
        ("outcome", (np.zeros(3), np.nan, False, False, {}), "gave the reward nan at its step 3"),
        ("outcome", (np.zeros(3), -2e9, False, False, {}), "gave the reward -2000000000.0"),
        ("outcome", (np.zeros(3), np.ones(2), False, False, {}), "gave the reward"),
        ("outcome", (np.zeros(3), 1.0, False, {}), "did not return"),
        ("outcome", (np.zeros(3), 1.0, np.ones(2, bool), False, {}), "raised ValueError"),
    ],
)
def test_what_goes_wrong_later_is_one_kind_of_fault_in_one_line(make, register, name, later, words):
    env_id = register(Base)
    env = make(env_id, action_repeat=1)
    env.reset(seed=0)
    for _ in range(2):
        env.step(np.zeros(2, np.float32))
    setattr(env.unwrapped, name, lambda: give_or_raise(later))
    with pytest.raises(EnvironmentFault, match=words) as fault:
        env.step(np.zeros(2, np.float32))
    assert env_id in str(fault.value) and "\n" not in str(fault.value)
    if name == "obs":
        with pytest.raises(EnvironmentFault, match=words):
            env.reset()


@pytest.mark.parametrize(
    "box",
    [
        Box(0, 10, (2,), np.int64),
        Box(-3, 3, (2,), np.int8),
        Box(0, 2**64 - 1, (2,), np.uint64),
        Box(np.array([-1, 0], "f4"), np.array([1, 0], "f4")),
        Box(5, 5, (2,), np.int32),
        Box(np.float32(-0.1), np.float32(0.7), (2,), np.float32),
        Box(np.float32(0.1), np.float32(0.3), (2,), np.float32),
        Box(-1.7e308, 1.7e308, (2,), np.float64),
        Box(-0.1, 0.7, (2,), np.float64),
        Box(np.float16(-0.1), np.float16(0.7), (2,), np.float16),
    ],
    ids=str,
)
def test_action_that_arrives_lies_in_the_environments_box_and_is_linear_in_ours(
    make, register, box
):
    env = make(register(Base, action_space=box), action_repeat=1)
    assert env.action_space == Box(-1, 1, (2,), np.float32)
    env.reset()
    ours = np.concatenate([[-1, 0, 1, 1.5, -0.3], np.random.default_rng(0).uniform(-1, 1, 14)])
    for a in ours:  # `Base.step` asserts that it lies in the box
        env.step(np.full(2, a, np.float32))
    arrived = np.array(env.unwrapped.actions[1:], np.longdouble)
    assert np.isfinite(arrived).all()
    assert (arrived[0] == box.low).all() and (arrived[[2, 3]] == box.high).all()
    low, high = box.low.astype(np.longdouble), box.high.astype(np.longdouble)
    share = (np.clip(ours, -1, 1).astype("f4").astype(np.longdouble)[:, None] + 1) / 2
    exact = low * (1 - share) + high * share
    within = 0.5 if box.dtype.kind in "iu" else np.abs(high).max() * np.finfo(box.dtype).eps
    assert (np.abs(arrived - exact) <= within * (1 + 1e-9)).all()


OWN = {
    "box": (Box(-9, 9, (2, 3)), np.arange(6).reshape(2, 3), range(6)),
    "discrete": (spaces.Discrete(3), 1, [0, 1, 0]),
    "dict": (
        spaces.Dict({"b": Box(0, 9, (2,)), "a": spaces.Tuple([spaces.Discrete(2)])}),
        {"a": (1,), "b": np.array([5, 6])},
        [0, 1, 5, 6],
    ),
    "not what it says": (Box(-9, 9, (3,)), [[1, 2], [3]], [np.nan] * 3),
    "too long": (Box(-9, 9, (3,)), np.zeros(4), [np.nan] * 3),
    "one number": (Box(-9, 9, (3,)), 3, [np.nan] * 3),
    "not finite": (Box(-9, 9, (2,)), np.array([np.inf, 1]), [np.inf, 1]),
    "sequence": (spaces.Sequence(Box(0, 1, (2,))), (), []),
    "graph": (spaces.Graph(Box(0, 1, (2,)), None), None, []),
    "long text": (spaces.Text(99), "abc", []),
    "image": (Box(0, 255, (96, 96, 3), np.uint8), np.zeros((96, 96, 3), np.uint8), []),
    "much": (spaces.Discrete(10**15), 1, []),
    "of its own": (None, "?", []),
}


@pytest.mark.parametrize("space, own, flat", OWN.values(), ids=OWN)
def test_environments_own_state_is_a_vector_of_numbers_or_empty(make, register, space, own, flat):
    env = make(register(Base, observation_space=space, obs=lambda: own))
    infos = [env.reset()[1], *(env.step(np.zeros(2, np.float32))[4] for _ in range(5))]
    states = np.stack([info["state"] for info in infos])
    assert states.dtype == np.float64 and states.shape == (6, len(flat))
    np.testing.assert_array_equal(states[-1], list(flat))
    assert np.isfinite(coverage(states)) == bool(np.isfinite(list(flat)).all() and len(flat))


@pytest.mark.parametrize("space", [spaces.Text(5), Box(-10, 10, (3,), np.float32)])
def test_nothing_that_an_environment_observes_stops_an_episode(make, register, space):
    for own in ("abc", "§", "much too long", None, 3, [[1], [2, 3]], object()):
        env = make(register(Base, observation_space=space, obs=lambda own=own: own))
        _, rewards, terminated, *_ = play(env, 0, np.zeros((20, 2), np.float32))
        assert terminated and rewards.sum() == 20


def test_environment_that_says_nothing_of_its_rendering_is_taken_for_what_it_does(make, register):
    for metadata in ({}, {"render_modes": ["human"], "render_fps": None}, {"render_fps": "fast"}):

        class Silent(Base):
            def __init__(self, render_mode=None):
                pass  # nor does it keep its render mode

            t = 0

            def step(self, action):
                return np.zeros(3), 0.0, False, False, {}

        Silent.metadata = metadata
        env = make(register(Silent))
        assert env.reset()[0][0].max() == 255
        assert env.metadata["render_fps"] == 15


def test_render_fps_counts_decisions(make, register):
    assert make(register(Base), action_repeat=3).metadata["render_fps"] == 10
    assert make(IDS[0], action_repeat=2).metadata["render_fps"] == 30


def test_environment_that_fails_to_close_is_closed(register):
    env = make_env(register(Base, close=lambda: 1 / 0))
    env.close()
    refusal(register(Base, close=lambda: 1 / 0, render=lambda: None))


def test_seed_reaches_the_environment_as_it_is_given(make, register):
    class Seeded(Base):
        def reset(self, *, seed=None, options=None):
            self.seed, self.options = seed, options
            return super().reset(seed=seed)

    env = make(register(Seeded))
    env.reset(seed=2**31 - 1, options={"a": 1})
    assert (env.unwrapped.seed, env.unwrapped.options) == (2**31 - 1, {"a": 1})


@pytest.mark.filterwarnings("ignore")  # that it has wrappers
@pytest.mark.parametrize("env_id", [IDS[0], "Pendulum-v1"])
def test_gymnasiums_own_check_passes(make, env_id):
    if env_id == "Pendulum-v1":
        pytest.importorskip("pygame")
    env = make(env_id)
    assert env.spec.id == env_id
    check_env(env)


def test_environment_is_imported_from_the_module_before_its_colon(make, tmp_path, monkeypatch):
    monkeypatch.syspath_prepend(tmp_path)
    register = f"import gymnasium\ngymnasium.register('Mine-v0', '{__name__}:Base')\n"
    (tmp_path / "mine_of_test.py").write_text(register)
    (tmp_path / "broken_of_test.py").write_text("raise SystemExit('two\\nlines')\n")
    try:
        assert make("mine_of_test:Mine-v0").reset()[0].shape == (64, 64, 3)
        assert "did you mean mine_of_test:Mine-v0" in refusal("mine_of_test:Mine-v1")
    finally:
        del gym.registry["Mine-v0"]
    assert "No module named 'nowhere'" in refusal("nowhere:Mine-v0")
    assert "SystemExit" in refusal("broken_of_test:Mine-v0")
    for malformed in (":", ":Mine-v0", "a:b:Mine-v0", ".a:Mine-v0", "mine_of_test:", "", "a/b/c"):
        refusal(malformed)


# --- several PyBullet environments in one process ---


def test_environment_made_after_another_was_dropped_or_closed_works():
    """In a process of its own: this one holds others open, which hides it. Nor is anything printed,
    be it at the end, when C empties its buffers into a pipe, or with its streams closed."""
    code = """
import gc
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


@pytest.mark.parametrize("env_id", IDS)
def test_floor_brightness_dims_the_floor_and_leaves_its_texture(make, env_id):
    """The floor is what changes. Of its brightness and contrast, the part asked for is left."""
    own, untouched, dim = make(env_id), *(make(env_id, floor_brightness=f) for f in (1.0, 0.4))
    actions = random_actions(own, 8)
    images, rewards, *_ = play(own, 3, actions)
    same, *_ = play(untouched, 3, actions)
    dimmed, same_rewards, *_ = play(dim, 3, actions)
    dimmed_again, *_ = play(dim, 3, actions)
    assert np.array_equal(images, same)
    assert np.array_equal(dimmed, dimmed_again)  # resets leave it
    assert rewards.tolist() == same_rewards.tolist()
    floor = (images != dimmed).any(-1)
    assert floor.mean() > 0.2
    assert dimmed[floor].mean() == pytest.approx(0.4 * images[floor].mean(), rel=0.1)
    assert dimmed[floor].std() == pytest.approx(0.4 * images[floor].std(), rel=0.1)
    assert np.array_equal(images[~floor], dimmed[~floor])


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


def test_a_row_that_the_disk_takes_a_part_of_is_not_added():
    replay = filled(capacity=5, added=2)
    replay.file = SimpleNamespace(name="a file", seek=lambda at: at, write=lambda row: len(row) - 1)
    with pytest.raises(OSError, match="a file: no space"):
        replay.add(np.zeros((64, 64, 3)))
    assert replay.added == 2


def test_a_replays_file_takes_five_percent_more_than_its_images_at_most():
    replay = filled(capacity=3, added=20)  # the ring holds nine rows more
    assert os.fstat(replay.file.fileno()).st_size <= 12 * 1.05 * 64 * 64 * 3


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


@pytest.mark.parametrize("d", [2, 64])
def test_coverage_takes_about_a_second_at_most(d):
    states = np.random.default_rng(0).standard_normal((20_000, d), np.float32)
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
