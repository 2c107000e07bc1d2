"""Experience: environments seen through their pixels, the replay buffer of what was seen, and
how much of the environment's own states that covers. `make_env` and `Replay` are what the algorithm
needs; most of the rest keeps a stranger's environment from breaking a run.

The observation is the rendered 64×64 image and nothing else (§5). Rows are arrival-indexed: an
observation stands beside the action that led to it, and the reward and termination received.
"""

import contextlib
import ctypes
import difflib
import importlib
import numbers
import os
import tempfile
import traceback
import warnings
import zlib
from pathlib import Path

import gymnasium as gym
import numpy as np
from gymnasium import wrappers
from PIL import Image
from scipy.spatial import KDTree
from scipy.special import digamma, gammaln

IMAGE_SIZE = 64
MAX_REWARD = 1e9  # of one environment step; more is a fault of the environment, not a reward
MAX_STATES, MAX_DIMENSIONS = 5000, 64  # at most, in `coverage`: it takes a second


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
    from pybullet_envs_gymnasium.env_bases import MJCFBaseBulletEnv  # registers them, too

    # Robots ask client 0 for their Euler angles, whichever is theirs. Were that the first robot's,
    # no other could go on after it is closed: "Not connected to physics server".
    pybullet.connect(pybullet.DIRECT)


class EnvironmentFault(RuntimeError):
    """An environment raised or gave what cannot be learnt from: which and what, in one line."""


@contextlib.contextmanager
def blame(env_id: str, when: str = ""):
    """Makes an `EnvironmentFault` of whatever foreign code raises. Ctrl-C passes."""
    try:
        yield
    except (Exception, SystemExit) as error:
        what = str(error)
        if not isinstance(error, EnvironmentFault):
            what = "raised " + "".join(traceback.format_exception_only(error)).rstrip(" .\n")
            what += "," if when else ""
        raise EnvironmentFault(" ".join(f"{env_id} {what} {when}".split()) + ".") from error


def make_env(env_id: str, action_repeat=2, camera_distance=None, floor_brightness=1.0) -> gym.Env:
    """An environment whose observation is its 64×64×3 uint8 image and whose actions lie in [−1, 1].

    Each action is repeated, its rewards summed, up to the end of the episode; `terminated` and
    `truncated` stay apart. info["state"] is what the agent never sees, see `Foreign`; the last
    step's info["episode"] holds return "r" and length "l" in environment steps;
    metadata["render_fps"] counts decisions.

    Args:
        env_id: any environment with bounded `Box` actions that renders `rgb_array`, by its
            registered name, or as module:name where the module registers it.
        action_repeat: environment steps per decision.
        camera_distance, floor_brightness: see `set_up_pybullet`; nothing elsewhere.

    Raises:
        ValueError: in one sentence, what is wrong with `env_id` and what to do.
        EnvironmentFault: later, from `reset` and `step`.
    """
    env = None
    try:
        spec = find_spec(env_id)
        # What it declares may be wrong, and is warned of; what counts is what it does.
        with blame(env_id), warnings.catch_warnings(action="ignore"):
            env = gym.make(spec, render_mode="rgb_array", disable_env_checker=True)
        env = Foreign(env, camera_distance, floor_brightness)
        env = wrappers.RecordEpisodeStatistics(env)
        env = wrappers.RepeatAction(env, action_repeat)
        env = wrappers.AddRenderObservation(env)
        env.metadata = env.metadata | {"render_fps": env.metadata["render_fps"] / action_repeat}
        return env
    except Exception as error:
        with contextlib.suppress(Exception):  # it may be None, or no better at closing
            env.close()
        raise ValueError(f"{env_id} cannot be learnt from its images: {error}") from error


def find_spec(env_id: str) -> gym.envs.registration.EnvSpec:
    """The environment of that name, after the import of the module before its colon, if any. If
    there is none, an EnvironmentFault names similar ones."""
    module, colon, name = env_id.rpartition(":")
    if colon:
        with blame(env_id):
            importlib.import_module(module)
    try:
        return gym.spec(name)
    except gym.error.Error:
        close = difflib.get_close_matches(name, gym.registry, n=3, cutoff=0.5)
        close = " or ".join(module + colon + other for other in close)
        hint = f"did you mean {close}?" if close else "gymnasium.pprint_registry() lists all."
        raise EnvironmentFault(f"there is no environment of that name, {hint}") from None


def set_up_pybullet(robot: gym.Env, camera_distance: float | None, floor_brightness: float) -> None:
    """Loads a PyBullet robot's world, with the camera at a distance in metres (None: its own) and
    a factor on the floor's texture. Its bright checkerboard is most of the image loss, yet the only
    cue of forward speed: dim it, but leave it to be seen."""
    robot._render_width = robot._render_height = IMAGE_SIZE  # never resized from 320×240
    if camera_distance is not None:
        robot._cam_dist = camera_distance
    # Its world is loaded at the first reset and restored at later ones, with other contacts: after
    # this one, an episode is a function of its seed and actions alone, in this process or in one
    # that resumes it.
    with silence():
        robot.reset(seed=0)
    if floor_brightness == 1.0:
        return
    for i in range(robot._p.getNumBodies()):
        body = robot._p.getBodyUniqueId(i)
        name = b" ".join(robot._p.getBodyInfo(body)).lower()
        if any(word in name for word in (b"floor", b"plane", b"stadium")):
            for _, link, *_, (*rgb, alpha) in robot._p.getVisualShapeData(body):
                colour = [*np.multiply(rgb, floor_brightness), alpha]
                robot._p.changeVisualShape(body, link, rgbaColor=colour)


def resize(image: np.ndarray) -> np.ndarray:
    """Any image to 64×64 by averaging."""
    return np.asarray(Image.fromarray(image).resize((IMAGE_SIZE, IMAGE_SIZE), Image.Resampling.BOX))


def to_pixels(image) -> np.ndarray:
    """A new (64, 64, 3) uint8 image of one that is grey, RGB or RGBA (alpha is dropped). An
    EnvironmentFault for what is neither bool, nor integers in 0 … 255, nor floats in 0 … 1."""
    image = np.asarray(image)
    image = image[..., None] if image.ndim == 2 else image
    white = 255 if image.dtype.kind in "iu" else 1
    known = image.dtype.kind in "biuf" and image.ndim == 3 and image.shape[2] in (1, 3, 4)
    # A float that is white but for its rounding is white.
    if not (known and image.size and -1e-3 < image.min() and image.max() < white + 1e-3):
        raise EnvironmentFault(
            f"rendered {image.dtype} of shape {image.shape}, no grey, RGB or RGBA image of "
            "integers from 0 to 255 or floats from 0 to 1,"
        )
    if white == 1:
        image = np.rint(image * 255.0)
    return resize(np.broadcast_to(image[..., :3].astype(np.uint8), (*image.shape[:2], 3)))


class Foreign(gym.Wrapper, gym.utils.RecordConstructorArgs):
    """The door to somebody else's environment: what comes in is copied, checked, and converted if
    it has one meaning; what goes out, an action in [−1, 1], is mapped into the environment's box.
    Whatever it does wrong is raised as an EnvironmentFault, by all methods.

    It begins with a reset, an image and a step, so that what is wrong shows at once. info["state"]
    is the environment's own observation as a new float64 vector of constant size: nan where it is
    not what its space says; empty if it has more than 64 numbers, or no fixed number of them.
    """

    render_mode = "rgb_array"

    def __init__(self, env, camera_distance=None, floor_brightness=1.0):
        settings = {"camera_distance": camera_distance, "floor_brightness": floor_brightness}
        gym.utils.RecordConstructorArgs.__init__(self, **settings)
        super().__init__(env)
        self.name, self.state_size = env.spec.id, 0
        self.age, self.images = 0, 0  # steps of the episode, images since the environment was made
        with blame(self.name):
            self.box = box = env.action_space
            bounded = isinstance(box, gym.spaces.Box) and box.is_bounded()
            if not (bounded and len(box.shape) == 1 and box.shape[0] > 0):
                raise EnvironmentFault(f"has the actions {box}, not a bounded Box of one dimension")
            self.action_space = gym.spaces.Box(-1, 1, box.shape, np.float32)
            fps = env.metadata.get("render_fps")
            fps = fps if isinstance(fps, numbers.Real) and 0 < fps < np.inf else 30  # as most do
            self.metadata = {"render_modes": ["rgb_array"], "render_fps": fps}
            with contextlib.suppress(Exception):  # a sequence, a graph, one of its own
                size = gym.spaces.flatdim(env.observation_space)
                self.state_size = size if size <= MAX_DIMENSIONS else 0
            self.pybullet = isinstance(env.unwrapped, MJCFBaseBulletEnv)
            if self.pybullet:
                set_up_pybullet(env.unwrapped, **settings)
        self.reset(seed=0)
        self.render()
        self.step(np.zeros(box.shape, np.float32))

    def reset(self, *, seed=None, options=None):
        # PyBullet normalises its normals in place at each image, so every second one rounds
        # otherwise: one pixel differs in one of some thousand images. Hence each episode begins
        # after an even number of them.
        if self.pybullet and self.images % 2:
            self.render()
        self.age = 0
        with blame(self.name, "at its reset"):
            return self.accept(self.env.reset(seed=seed, options=options), "observation, info")

    def step(self, action):
        self.age += 1
        # In longdouble, the one float that holds every int64; halved first, no sum overflows.
        low, high = self.box.low.astype(np.longdouble), self.box.high.astype(np.longdouble)
        value = np.clip(low / 2 + high / 2 + (high / 2 - low / 2) * action, low, high)
        value = value if self.box.dtype.kind == "f" else np.rint(value)
        with blame(self.name, f"at its step {self.age}"):
            result = self.env.step(value.astype(self.box.dtype))
            names = "observation, reward, terminated, truncated, info"
            state, reward, terminated, truncated, info = self.accept(result, names)
            number = np.asarray(reward)
            one = number.size == 1 and number.dtype.kind in "biuf"
            if not (one and -MAX_REWARD <= number.item() <= MAX_REWARD):
                raise EnvironmentFault(f"gave the reward {reward}")
            return state, float(number.item()), bool(terminated), bool(truncated), info

    def render(self):
        self.images += 1
        with blame(self.name, f"after its step {self.age}"):
            return to_pixels(self.env.render())

    def close(self):
        with contextlib.suppress(Exception):  # all that it was wanted for is done
            self.env.close()

    def accept(self, result, names: str) -> tuple:
        """What `reset` or `step` returned, with the state in `info`."""
        whole = isinstance(result, tuple) and len(result) == len(names.split())
        if not (whole and isinstance(result[-1], dict)):
            raise EnvironmentFault(f"did not return ({names}) with a dict for info")
        state = np.full(self.state_size, np.nan)
        if self.state_size:
            with contextlib.suppress(Exception):  # what only measures never stops a run
                flat = gym.spaces.flatten(self.env.observation_space, result[0])
                state[:] = flat.reshape(self.state_size)  # one of another size raises
        # RecordEpisodeStatistics, next to come, asserts that there is no other "episode".
        info = {k: v for k, v in result[-1].items() if k not in ("episode", "_episode")}
        return *result[:-1], info | {"state": state}


def coverage(states: np.ndarray) -> float:
    """Entropy of the distribution that visited states are samples of: exploration, measured.

    The Kozachenko-Leonenko (particle) estimate from the distance ε_i of each state to its k-th
    nearest neighbour, V the volume of the unit ball of d dimensions, ψ the digamma function:

        ψ(n) − ψ(k) + log V + d/n Σ_i log ε_i

    It is consistent, but biased where n is small for d, so compare only equal n. k is 3: more
    neighbours have less variance and more bias. ε is taken as 1e-6 at least: states that repeat
    exactly have no density.

    Args:
        states: (n, d), in the environment's own units; of more than 5,000, as many evenly spaced.

    Returns:
        nats; nan for k states or fewer, if any is not finite, and for no dimensions or more than
        64, where the estimate means nothing and takes minutes.
    """
    k = 3
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
    """A ring of rows of experience in a file, sampled as windows of consecutive rows. Its memory is
    the page cache's.

    Args:
        capacity: newest rows that are sampled; older ones are overwritten.
        actions: A.
        path: the file; without one, a temporary one.
    """

    def __init__(self, capacity: int, actions: int, path: Path | None = None):
        self.dtype = np.dtype([
            ("image", np.uint8, (IMAGE_SIZE, IMAGE_SIZE, 3)),
            ("action", np.float32, (actions,)),
            ("reward", np.float32),
            ("terminated", np.bool_),
            ("is_first", np.bool_),
        ], align=True)  # fmt: skip
        # A checkpoint is due every `save_every` rows; `restore` can go back two of them.
        self.capacity, self.save_every = capacity, min(500, capacity)
        self.ring = capacity + 3 * self.save_every
        self.checksums = np.zeros(self.ring, np.uint32)  # CRC-32 of each row
        self.added = 0  # rows ever added; row i lies at i % ring
        if path:
            path.touch()
        self.file = open(path, "r+b", buffering=0) if path else tempfile.TemporaryFile(buffering=0)

    def __len__(self) -> int:
        return min(self.added, self.capacity)

    def add(self, image, action=0.0, reward=0.0, terminated=False, is_first=False) -> None:
        """Append one row, of a reset without action and reward. An OSError if the disk is full."""
        row, at = np.zeros((), self.dtype), self.added % self.ring
        row["image"], row["action"], row["reward"] = image, action, reward
        row["terminated"], row["is_first"] = terminated, is_first
        self.file.seek(at * row.nbytes)
        if self.file.write(row.tobytes()) < row.nbytes:
            raise OSError(f"{self.file.name}: no space is left for a row")
        self.checksums[at] = zlib.crc32(row.tobytes())
        self.added += 1

    def read(self, number: int) -> bytes:
        """A row, by its number among all ever added; less of it if the file ends before."""
        self.file.seek(number % self.ring * self.dtype.itemsize)
        return self.file.read(self.dtype.itemsize)

    @property
    def last(self) -> np.void:
        """The newest row."""
        return np.frombuffer(self.read(self.added - 1), self.dtype)[0]

    def flush(self) -> np.ndarray:
        """Bring the file onto the disk: the checksums of the rows that can be sampled."""
        os.fsync(self.file.fileno())
        return self.checksums[np.arange(self.added - len(self), self.added) % self.ring]

    def restore(self, added: int, checksums: np.ndarray) -> None:
        """Go back to when `added` rows had been added and `flush` returned these checksums. A
        ValueError, in one sentence, if the file does not hold those rows."""
        self.added = added
        for number, known in zip(range(added - len(self), added), checksums, strict=True):
            if zlib.crc32(self.read(number)) != known:
                where = f"{self.file.name} does not hold its checkpoint's rows"
                raise ValueError(f"{where}: start a new run.")
            self.checksums[number % self.ring] = known

    def sample(self, batch: int, length: int, rng: np.random.Generator) -> np.ndarray:
        """`batch` windows of `length` consecutive rows, each equally likely, as records (B, T).
        They may cross episodes; none crosses the write head, where time jumps. A ValueError if
        fewer rows were added."""
        if len(self) < length:
            raise ValueError(f"The replay holds {len(self)} rows, fewer than a window of {length}.")
        first = self.added - len(self) + rng.integers(len(self) - length + 1, size=batch)
        wanted = first[:, None] + np.arange(length)
        rows = b"".join(map(self.read, wanted.flat))
        return np.frombuffer(rows, self.dtype).reshape(wanted.shape)
