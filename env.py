"""Experience: environments seen through their pixels, the replay buffer of what was seen, and
how much of the environment's own states that covers.

The observation is the rendered 64×64 image and nothing else (§5). Rows of experience are
arrival-indexed: an observation stands beside the action that led to it and the reward and
termination received with it.
"""

import contextlib
import ctypes
import difflib
import os

import gymnasium as gym
import numpy as np
from gymnasium import wrappers
from PIL import Image
from scipy.spatial import KDTree
from scipy.special import digamma, gammaln

IMAGE_SIZE = 64
MAX_STATES, MAX_DIMENSIONS = 5000, 64  # of `coverage`: a second


@contextlib.contextmanager
def silence():
    """Discards what C code prints, which `contextlib.redirect_stdout` does not see."""
    with open(os.devnull, "w") as null, contextlib.ExitStack() as last:
        for stream in (1, 2):
            with contextlib.suppress(OSError):  # it is closed
                last.callback(os.close, copy := os.dup(stream))
                last.callback(os.dup2, copy, stream)
                os.dup2(null.fileno(), stream)
        if hasattr(ctypes.pythonapi, "fflush"):  # else C prints later, to a pipe; not on Windows
            last.callback(ctypes.pythonapi.fflush, None)
        yield


with silence():
    import pybullet
    import pybullet_envs_gymnasium  # noqa: F401, registers the PyBullet environments

    # Robots ask client 0 for their Euler angles, whichever is theirs. Were that the first robot's,
    # no other could go on after it is closed: "Not connected to physics server".
    pybullet.connect(pybullet.DIRECT)


def make_env(env_id: str, action_repeat: int = 2, camera_distance: float | None = None) -> gym.Env:
    """An environment whose observation is its 64×64×3 uint8 image and whose actions lie in [−1, 1].

    Each action is repeated, its rewards summed, up to the end of the episode; `terminated` and
    `truncated` stay apart. A step's info["state"] is the environment's own observation, which the
    agent never sees; the last step's info["episode"] holds return "r" and length "l" in environment
    steps.

    Args:
        env_id: any registered environment with bounded `Box` actions that renders `rgb_array`.
        action_repeat: environment steps per decision.
        camera_distance: metres from the camera to a PyBullet robot (None: the environment's own);
            nothing elsewhere.

    Raises:
        ValueError: in one sentence, what is wrong with `env_id` and what to do.
    """
    spec = find_spec(env_id)
    env = None
    try:
        env = gym.make(spec, render_mode="rgb_array", disable_env_checker=True)
        space = env.action_space
        if not (isinstance(space, gym.spaces.Box) and space.is_bounded() and len(space.shape) == 1):
            raise ValueError(f"its actions are {space}, not a bounded Box of one dimension")
        if hasattr(env.unwrapped, "_render_width"):  # PyBullet: never resized from 320×240
            env.unwrapped._render_width = env.unwrapped._render_height = IMAGE_SIZE
            if camera_distance is not None:
                env.unwrapped._cam_dist = camera_distance
        # PyBullet loads its world at the first reset and restores it at later ones, with other
        # contacts: after this one, an episode is a function of its seed and actions alone, in this
        # process or in one that resumes it.
        with silence():
            env.reset(seed=0)
        if not isinstance(env.render(), np.ndarray):
            raise ValueError("it renders no images")
        env = wrappers.RecordEpisodeStatistics(env)
        env = StateInInfo(env)
        env = wrappers.RescaleAction(env, np.float32(-1), np.float32(1))
        env = wrappers.RepeatAction(env, action_repeat)
        env = wrappers.AddRenderObservation(env)
    except Exception as error:  # whatever a foreign environment raises, a missing library above all
        if env is not None:
            env.close()
        raise ValueError(f"{env_id} cannot be learnt from its images: {error}.") from error
    if env.observation_space.shape != (IMAGE_SIZE, IMAGE_SIZE, 3):
        space = gym.spaces.Box(0, 255, (IMAGE_SIZE, IMAGE_SIZE, 3), np.uint8)
        env = wrappers.TransformObservation(env, resize, space)
    return env


def find_spec(env_id: str) -> gym.envs.registration.EnvSpec:
    """The registered environment of that name.

    Raises:
        ValueError: in one sentence, with those of a similar name.
    """
    try:
        return gym.spec(env_id)
    except gym.error.Error:
        close = difflib.get_close_matches(env_id, gym.registry, n=3, cutoff=0.5)
        hint = (
            f"did you mean {' or '.join(close)}?"
            if close
            else "gymnasium.pprint_registry() lists all."
        )
        raise ValueError(f"There is no environment {env_id!r}: {hint}") from None


def resize(image: np.ndarray) -> np.ndarray:
    """Any image to 64×64 by averaging."""
    return np.asarray(Image.fromarray(image).resize((IMAGE_SIZE, IMAGE_SIZE), Image.Resampling.BOX))


class StateInInfo(gym.Wrapper):
    """Keeps the environment's own observation in `info`, for `coverage`."""

    def step(self, action):
        state, reward, terminated, truncated, info = self.env.step(action)
        return state, reward, terminated, truncated, info | {"state": np.ravel(state)}


def coverage(states: np.ndarray, k: int = 3) -> float:
    """Entropy of the distribution that visited states are samples of: exploration, measured.

    The Kozachenko-Leonenko (particle) estimate from the distance ε_i of each state to its k-th
    nearest neighbour, V the volume of the unit ball of d dimensions, ψ the digamma function:

        ψ(n) − ψ(k) + log V + d/n Σ_i log ε_i

    It is consistent, but biased where n is small for d, so compare only equal n. ε is taken as
    1e-6 at least: states that repeat exactly have no density.

    Args:
        states: (n, d), in the environment's own units; of more than 5,000, as many evenly spaced.
        k: neighbours; more have less variance and more bias.

    Returns:
        nats; nan for fewer than k + 1 states, if any is not finite, and for no dimensions or more
        than 64, where the estimate means nothing and takes minutes.
    """
    try:
        states = np.asarray(states, np.float64)
        n, d = states.shape
    except (TypeError, ValueError):  # no array of so many numbers each
        return float("nan")
    if n <= k or not 0 < d <= MAX_DIMENSIONS or not np.isfinite(states).all():
        return float("nan")
    n = min(n, MAX_STATES)
    states = states[np.linspace(0, len(states) - 1, n).astype(int)]
    distance = KDTree(states).query(states, k + 1)[0][:, k]  # the nearest is the state itself
    log_ball = d / 2 * np.log(np.pi) - gammaln(d / 2 + 1)
    spread = d * np.log(np.maximum(distance, 1e-6)).mean()
    return float(digamma(n) - digamma(k) + log_ball + spread)


class Replay:
    """A preallocated ring of rows of experience, sampled as windows of consecutive rows.

    A row is a record of image, action, reward, terminated and is_first: one array, one copy of each
    observation.

    Args:
        capacity: rows it holds; older ones are overwritten.
        actions: A.
    """

    def __init__(self, capacity: int, actions: int):
        row = np.dtype([
            ("image", np.uint8, (IMAGE_SIZE, IMAGE_SIZE, 3)),
            ("action", np.float32, (actions,)),
            ("reward", np.float32),
            ("terminated", np.bool_),
            ("is_first", np.bool_),
        ], align=True)  # fmt: skip
        self.rows = np.zeros(capacity, row)
        self.added = 0  # rows ever added; row i lies at i % capacity

    def __len__(self) -> int:
        return min(self.added, len(self.rows))

    def add(self, image, action=0.0, reward=0.0, terminated=False, is_first=False) -> None:
        """Append one row. A reset's has action and reward 0: `add(image, is_first=True)`."""
        row = self.rows[self.added % len(self.rows)]
        row["image"], row["action"], row["reward"] = image, action, reward
        row["terminated"], row["is_first"] = terminated, is_first
        self.added += 1

    @property
    def last(self) -> np.void:
        """The newest row."""
        return self.rows[(self.added - 1) % len(self.rows)]

    def parts(self, start: int, stop: int) -> list[np.ndarray]:
        """Rows start … stop − 1 of all ever added, in order, as one or two views of the ring."""
        if start == stop:
            return []
        first, last = start % len(self.rows), (stop - 1) % len(self.rows) + 1
        if first < last:
            return [self.rows[first:last]]
        return [self.rows[first:], self.rows[:last]]

    def sample(self, batch: int, length: int, rng: np.random.Generator) -> np.ndarray:
        """`batch` windows of `length` consecutive rows, each equally likely, as records (B, T).

        Windows may cross episodes; none crosses the write head, where time jumps.

        Raises:
            ValueError: if fewer than `length` rows were added.
        """
        if len(self) < length:
            raise ValueError(f"The replay holds {len(self)} rows, fewer than a window of {length}.")
        first = self.added - len(self) + rng.integers(len(self) - length + 1, size=batch)
        return self.rows[(first[:, None] + np.arange(length)) % len(self.rows)]
