"""Plays a run's networks: what they earn, what they see and what they dream.

    python results/play.py runs/NAME --video

prints the returns of the evaluation's episodes (of its seeds, by which best.pt was chosen too), and
draws the best of them in the run's folder, as strip-STEP.png: the episode, what the model sees of
it, and what it dreams after its first five images; with --video as episode-STEP.gif too. The run
may still be going on.
"""

import argparse
import sys
from collections.abc import Callable
from pathlib import Path

import numpy as np
import torch
from PIL import Image, ImageDraw
from torch import Tensor

sys.path.insert(0, str(Path(__file__).parents[1]))
import train
from actors import Episode, drawn_by, play
from env import EnvironmentFault

ACTORS = ("stochastic", "deterministic")
SHORTEST = 20  # milliseconds: browsers show a GIF's frame no shorter


def load(folder: Path, checkpoint: str, device: str):
    """A run's settings, environment and agent, and what its networks are called. A ValueError, in
    one sentence, if the folder holds none, or not for this machine."""
    s = train.read_settings(folder)
    env = train.make_env_of(s)
    agent = train.make_agent(s, env, device, "float32")  # as it acts, see actors.act
    if checkpoint == "newest":
        if not train.has_checkpoint(folder):
            best = ": --checkpoint best plays its best.pt" if (folder / "best.pt").exists() else ""
            raise ValueError(f"{folder} holds no checkpoint{best}.")
        saved = train.read_checkpoint(folder)[1]
        weights, name = saved["agent"], f"{saved['kept']['step']}"
    else:
        try:
            path, name = folder / "best.pt", "best"
            weights = torch.load(path, map_location="cpu", weights_only=True)
        except FileNotFoundError:
            raise ValueError(f"{folder} has no best.pt: not evaluated yet, or not kept.") from None
        except Exception as error:  # damage has many
            raise ValueError(f"{path} is damaged: {type(error).__name__}.") from None
    train.load_weights(agent, weights)
    return s, env, agent, name


def pictured(model, states: Tensor) -> Tensor:
    """What the decoder makes of states: (M, D) -> (M, 64, 64, 3), grey levels from 0 to 255."""
    return (255 * (model.decoder(model.decoder_input(states)) + 0.5)).clamp(0, 255)


@torch.no_grad()
def open_loop(agent: train.Agent, episode: Episode, frames: int, context: int = 5) -> np.ndarray:
    """What the model dreams when it sees `context` images and then only the actions taken.

    Returns:
        (3, F, 64, 64, 3) uint8: truth, prediction (the first `context` are reconstructions), and
        their difference about grey; F is `frames`, or the episode's length if that is less.
    """
    frames = min(frames, len(episode.states))
    context = min(context, frames)
    actions = torch.from_numpy(episode.actions[context - 1 : frames - 1]).to(agent.device)
    with drawn_by(0, agent.device):
        start = episode.states[context - 1 : context]
        dreamt = agent.model.along(start, actions.unsqueeze(1))[1:, 0]
        states = torch.cat([episode.states[:context], dreamt])
    prediction = pictured(agent.model, states).byte().cpu().numpy()
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
    some = np.concatenate([np.asarray(f) for f in frames[:: len(frames) // 10 + 1]])
    palette = Image.fromarray(some).quantize(128)  # a frame's own would leave out rare colours
    frames = [f.quantize(palette=palette, dither=Image.Dither.NONE) for f in frames]
    # A GIF counts hundredths of a second: rounded one by one, 33 ms would be 30.
    shown = np.diff(np.rint(np.arange(len(frames) + 1) * 100 * every / fps) * 10).tolist()
    frames[0].save(path, save_all=True, append_images=frames[1:], duration=shown, loop=0)


def show(command: argparse.Namespace) -> None:
    """Plays, prints and draws. A ValueError, in one sentence, if there is nothing to play."""
    if command.episodes < 1:
        raise ValueError(f"--episodes is {command.episodes}: give 1 or more.")
    folder = command.folder
    s, env, agent, name = load(folder, command.checkpoint, command.device)
    if command.actor not in ("evaluated", *agent.players):
        raise ValueError(f"{folder} has no {command.actor} actor: leave out --actor.")
    actor = agent.evaluated if command.actor == "evaluated" else agent.players[command.actor]
    seeds = [train.evaluation_seed(k) for k in range(command.episodes)]
    episodes = [play(agent, env, actor.greedy, seed, s.eval_max_steps) for seed in seeds]
    returns, lengths = np.array([(e.total, e.length) for e in episodes]).T
    spread = f" ± {train.interval95(returns):.1f} (95% interval)" if len(returns) > 1 else ""
    print(
        f"{s.env}, arm {s.arm}, networks {name}, {command.actor} actor's greedy actions: return "
        f"{returns.mean():.1f}{spread}, {lengths.mean():.0f} environment steps an episode"
    )
    each = (f"{r:.1f} ({n:.0f})" for r, n in zip(returns, lengths, strict=True))
    print("returns (and lengths):", *each)
    best = episodes[returns.argmax()]
    whole = len(best.states)  # all of it is seen: no dream
    seen, dreamt = open_loop(agent, best, whole, whole), open_loop(agent, best, frames=25)
    path = folder / f"strip-{name}.png"
    Image.fromarray(strip(seen, dreamt)).save(path)
    print(f"{path}: the episode, what is seen of it, difference; dream from 5 images, difference")
    if command.video:
        path = folder / f"episode-{name}.gif"
        film(path, open_loop(agent, best, frames=75), env.metadata["render_fps"])
        print(f"{path}: the episode, dream from its first 5 images and its actions, difference")


def command_line(program: str, says: str, episodes: int) -> argparse.ArgumentParser:
    """What this and diagnose.py take: a run's folder, and how to play it."""
    parser = argparse.ArgumentParser(prog=f"python results/{program}", description=says)
    add, which = parser.add_argument, "its newest networks, or its best evaluation's (%(default)s)"
    add("folder", type=Path, help="a run's folder, runs/NAME; it may still be going on")
    add("--episodes", type=int, default=episodes, help="of an actor (%(default)s)")
    add("--checkpoint", choices=("newest", "best"), default="newest", help=which)
    add("--device", choices=("auto", "cpu", "cuda"), default="auto")
    return parser


def exit_code(work: Callable[[], object]) -> int:
    """Does it: 0 done, 1 it failed, 2 bad input, 130 Ctrl-C; what was wrong, in one sentence."""
    try:
        work()
    except KeyboardInterrupt:
        return 130
    except (EnvironmentFault, FloatingPointError, ValueError, OSError) as error:
        print(error, file=sys.stderr)
        return 1 if isinstance(error, (EnvironmentFault, FloatingPointError)) else 2
    return 0


def main(arguments: list[str]) -> int:
    """Runs a command line. Returns its `exit_code`."""
    parser = command_line("play.py", "Plays the networks of a run.", episodes=10)
    add, which = parser.add_argument, "who plays; evaluated: who evaluations play (%(default)s)"
    add("--actor", choices=("evaluated", *ACTORS), default="evaluated", help=which)
    add("--video", action="store_true", help="the best episode's beginning as an animated GIF")
    return exit_code(lambda: show(parser.parse_args(arguments)))


if __name__ == "__main__":
    sys.stdout, sys.stderr = train.Patient(sys.stdout), train.Patient(sys.stderr)
    sys.exit(main(sys.argv[1:]))
