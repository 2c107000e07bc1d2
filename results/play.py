"""Plays a run's networks: what they earn, what they see and what they dream.

    python results/play.py runs/NAME --video

prints the returns of fresh episodes and draws the best of them, strip.png: the episode, what the
model sees of it, and what it dreams after its first five images. The run may still be going on.
"""

import argparse
import sys
from pathlib import Path

import numpy as np
import torch
from PIL import Image, ImageDraw

sys.path.insert(0, str(Path(__file__).parents[1]))
from actors import Episode, play
from env import EnvironmentFault, make_env
from train import (
    Agent,
    Patient,
    interval95,
    load_networks,
    make_agent,
    read_checkpoint,
    read_settings,
)

SHORTEST = 20  # milliseconds: browsers show a GIF's frame no shorter


def load(folder: Path, checkpoint: str, device: str, precision: str):
    """A run's settings, environment and agent, and what its networks are called.

    Raises:
        ValueError: in one sentence, if the folder holds none, or not for this machine.
    """
    s = read_settings(folder)
    env = make_env(s.env, s.action_repeat, s.camera_distance, s.floor_brightness)
    agent = make_agent(s, env, device, precision)
    if checkpoint == "newest":
        saved = read_checkpoint(folder)[1]
        load_networks(agent, saved["agent"])
        return s, env, agent, f"{saved['kept']['step']}"
    path = folder / "best.pt"
    if not path.exists():
        raise ValueError(f"{folder} was not evaluated yet: it has no best.pt.")
    try:
        load_networks(agent, torch.load(path, map_location="cpu", weights_only=True))
    except Exception as error:  # damage has many
        raise ValueError(f"{path} is damaged: {type(error).__name__}.") from None
    return s, env, agent, "best"


@torch.no_grad()
def open_loop(agent: Agent, episode: Episode, frames: int, context: int = 5) -> np.ndarray:
    """What the model dreams when it sees `context` images and then only the actions taken.

    Returns:
        (3, F, 64, 64, 3) uint8: truth, prediction (the first `context` are reconstructions), and
        their difference about grey; F is `frames`, or the episode's length if that is less.
    """
    frames = min(frames, len(episode.states))
    context = min(context, frames)
    actions = iter(torch.from_numpy(episode.actions[context - 1 :]).to(agent.device).split(1))
    with agent.autocast(), torch.random.fork_rng():
        torch.manual_seed(0)
        start = episode.states[context - 1 : context]
        dream = agent.model.imagine(start, lambda _: next(actions), frames - context)
        states = torch.cat([episode.states[:context], dream.state[1:, 0]])
        prediction = agent.model.decoder(agent.model.decoded(states))
    prediction = (255 * (prediction + 0.5)).clamp(0, 255).byte().cpu().numpy()
    truth = episode.images[:frames]
    difference = (128 + (prediction.astype(int) - truth) // 2).astype(np.uint8)
    return np.stack([truth, prediction, difference])


def strip(*pictures: np.ndarray) -> np.ndarray:
    """Ten of the frames of each row of pictures (R, F, 64, 64, 3), below each other: an image."""
    rows = [row[np.linspace(0, len(row) - 1, 10).astype(int)] for some in pictures for row in some]
    return np.concatenate([np.concatenate(list(row), axis=1) for row in rows])


def film(path: Path, pictures: np.ndarray, fps: float) -> None:
    """(3, F, 64, 64, 3) as an animated GIF in real time, its columns labelled, in one palette."""
    every = max(1, int(np.ceil(SHORTEST * fps / 1000)))  # frames left out rather than slowed down
    frames = []
    for frame in np.concatenate(pictures[:, ::every], axis=2):  # side by side
        image = Image.new("RGB", (384, 140))
        image.paste(Image.fromarray(frame).resize((384, 128)), (0, 12))
        for column, label in enumerate(("truth", "dream after 5 images", "difference")):
            ImageDraw.Draw(image).text((128 * column + 4, 0), label, "white")
        frames.append(image)
    mosaic = Image.fromarray(
        np.concatenate([np.asarray(f) for f in frames[:: len(frames) // 10 + 1]])
    )
    palette = mosaic.quantize(128)  # of the whole film: a frame's own would leave out rare colours
    frames = [f.quantize(palette=palette, dither=Image.Dither.NONE) for f in frames]
    frames[0].save(
        path, save_all=True, append_images=frames[1:], duration=1000 * every / fps, loop=0
    )


def show(folder: Path, command: argparse.Namespace) -> None:
    """Plays, prints and draws.

    Raises:
        ValueError: in one sentence, if there is nothing to play.
        EnvironmentFault: if the environment fails.
    """
    if command.episodes < 1:
        raise ValueError(f"--episodes is {command.episodes}: give 1 or more.")
    s, env, agent, name = load(folder, command.checkpoint, command.device, command.precision)
    actor = agent.evaluated if command.actor == "evaluated" else agent.actors["stochastic"]
    seeds = [2**31 - 1 - k for k in range(command.episodes)]  # those of every evaluation
    episodes = [play(agent, env, actor.mode, seed, s.eval_max_steps) for seed in seeds]
    returns, lengths = np.array([(e.total, e.length) for e in episodes]).T
    spread = f" ± {interval95(returns):.1f} (95% interval)" if len(returns) > 1 else ""
    print(
        f"{s.env}, arm {s.arm}, networks {name}, {command.actor} actor's mode: return "
        f"{returns.mean():.1f}{spread}, {lengths.mean():.0f} environment steps an episode"
    )
    print("returns:", *(f"{one:.1f}" for one in returns))
    best = episodes[returns.argmax()]
    seen, dreamt = open_loop(agent, best, 10_000, 10_000), open_loop(agent, best, frames=25)
    path = folder / f"strip-{name}.png"
    Image.fromarray(strip(seen, dreamt)).save(path)
    print(f"{path}: the episode, what is seen of it, difference; dream from 5 images, difference")
    if command.video:
        path = folder / f"episode-{name}.gif"
        film(path, open_loop(agent, best, frames=150), env.metadata["render_fps"])
        print(f"{path}: truth, dream from its first 5 images and the actions taken, difference")


def main(arguments: list[str]) -> int:
    """Runs a command line. Returns the exit code: 0 done, 1 the environment failed, 2 bad input."""
    parser = argparse.ArgumentParser(
        prog="python results/play.py", description="Plays the networks of a run."
    )
    parser.add_argument("folder", type=Path, help="a run's folder, runs/NAME")
    parser.add_argument("--episodes", type=int, default=10, help="how many (%(default)s)")
    actors = "the one that evaluations play, or the explorer (%(default)s)"
    parser.add_argument(
        "--actor", choices=("evaluated", "stochastic"), default="evaluated", help=actors
    )
    parser.add_argument("--video", action="store_true", help="an animated GIF of the best episode")
    add_loading(parser)
    command = parser.parse_args(arguments)
    try:
        show(command.folder, command)
    except (ValueError, OSError) as error:
        print(error, file=sys.stderr)
        return 2
    except EnvironmentFault as error:
        print(error, file=sys.stderr)
        return 1
    return 0


def add_loading(parser: argparse.ArgumentParser) -> None:
    """The options of `load`."""
    which = "its newest networks, or those of its best evaluation (%(default)s)"
    parser.add_argument("--checkpoint", choices=("newest", "best"), default="newest", help=which)
    parser.add_argument("--device", choices=("auto", "cpu", "cuda"), default="auto")
    parser.add_argument("--precision", choices=("auto", "bfloat16", "float32"), default="auto")


if __name__ == "__main__":
    sys.stdout, sys.stderr = Patient(sys.stdout), Patient(sys.stderr)
    sys.exit(main(sys.argv[1:]))
