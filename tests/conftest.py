"""What every test begins with: one thread, one seed, the signals' handlers as they were. And
somebody's environment, as small as can be."""

import signal

import gymnasium as gym
import numpy as np
import pytest
import torch
from gymnasium.envs.registration import EnvSpec
from gymnasium.spaces import Box

BEFORE = {n: signal.getsignal(n) for n in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)}


@pytest.fixture(scope="session", autouse=True)
def one_thread(request):
    """Tiny tensors gain nothing by a second one; benchmark_update.py measures what a run has."""
    if not request.config.getoption("benchmark_only", False):
        torch.set_num_threads(1)


@pytest.fixture(autouse=True)
def one_seed():
    torch.manual_seed(0)


@pytest.fixture(autouse=True)
def handlers():
    """A run that is trained in this process, a fixture's too, takes them and keeps them."""
    for number in BEFORE:  # nohup and a shell's background ignore some, and a run leaves them so
        usual = signal.default_int_handler if number == signal.SIGINT else signal.SIG_DFL
        signal.signal(number, usual)
    yield
    for number, handler in BEFORE.items():
        signal.signal(number, handler)


class Base(gym.Env):
    """Ends after 20 steps, each worth 1; and whatever is `given` in the place of its own."""

    metadata = {"render_modes": ["rgb_array"], "render_fps": 30}  # noqa: RUF012
    action_space = Box(-1, 1, (2,), np.float32)
    observation_space = Box(-10, 10, (3,), np.float32)

    def __init__(self, render_mode=None, **given):
        self.render_mode, self.t, self.steps, self.actions = render_mode, 0, 0, []
        for name, value in given.items():
            setattr(self, name, value)

    def obs(self):
        return self.np_random.normal(size=3).astype(np.float32)

    def image(self):
        image = np.zeros((64, 64, 3), np.uint8)
        image[min(self.t, 63)] = 255
        return image

    def outcome(self):
        return self.obs(), 1.0, self.t >= 20, False, {}

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.t = 0
        return self.obs(), {}

    def step(self, action):
        assert self.action_space.contains(action), f"{action!r} is not in {self.action_space}"
        self.t, self.steps = self.t + 1, self.steps + 1
        self.actions.append(action)
        return self.outcome()

    def render(self):
        return self.image()


@pytest.fixture
def register(monkeypatch):
    """Registers an environment for one test: its name."""

    def register(entry_point, name="Stub-v0", **given) -> str:
        monkeypatch.setitem(gym.registry, name, EnvSpec(name, entry_point, kwargs=given))
        return name

    return register
