"""What to look at first when a run does not learn: is the model true, and believed rightly?

    python results/diagnose.py runs/NAME

plays fresh episodes with each actor of the newest checkpoint, and holds what the model says of them
against what happened. Prints the figures and draws diagnosis-STEP.png in the run's folder. The run
may still be going on: nothing of it is changed.
"""

import argparse
import csv
import itertools
import sys
from collections import defaultdict
from pathlib import Path

import matplotlib as mpl
import matplotlib.pyplot as plt
import numpy as np
import torch
from torch import Tensor

sys.path.insert(0, str(Path(__file__).parents[1]))
from actors import Episode, imagined_returns, play
from env import EnvironmentFault
from results.play import add_loading, load, open_loop
from train import Agent, Patient

OPEN_LOOP = 15  # steps that the model is followed without images

# Names of the figures that the verdict looks at.
DEVIATION = "deviation of the greedy action over states (near 0: frozen)"
REWARDS = "rewards, R² (1: exact, 0: no better than their mean)"
SIGMA = "σ of the explorer before its tanh (5 at first)"
ENDS = "ends of episodes that happened"
EXPECTED = "ends of episodes that the model expected"
PROMISED = "discounted return that the model promised"
EARNED = "discounted return that then happened"
AFTER = f"rewards, R² after {OPEN_LOOP} steps without images"


def r_squared(predicted: np.ndarray, real: np.ndarray) -> float:
    """The share of the variance that is predicted: 1 is exact, 0 no better than the mean of all."""
    return 1 - np.square(predicted - real).mean() / max(np.var(real), 1e-12)


def discounted(rewards: np.ndarray, gamma: float) -> np.ndarray:
    """(L,) r_1 … r_L to (L,) returns that followed s_0 … s_{L−1}, up to the episode's end."""
    following = itertools.accumulate(rewards[::-1], lambda later, reward: reward + gamma * later)
    return np.array(list(following))[::-1]


def windows(x: Tensor, length: int) -> Tensor:
    """(L, …) to (length, L − length + 1, …): every stretch of consecutive rows, time first."""
    return x.unfold(0, length, 1).movedim(-1, 0)


def to_levels(picture: Tensor) -> Tensor:
    """What the decoder gives, in grey levels from 0 to 255."""
    return (255 * (picture + 0.5)).clamp(0, 255)


@torch.no_grad()
def measure(agent: Agent, name: str, episode: Episode) -> dict[str, np.ndarray]:
    """What the model says of one episode of an actor, beside what happened.

    Returns:
        reward, terminated, return: (M, 2) predicted and real, of each row; returns only where
        the real one is known, which in an episode cut off by a time limit is long before its end.
        open_reward: (M, H, 2) predicted and real after 1 … H steps without images.
        open_image: (M, H, 2) squared error of a pixel in grey levels: of the prediction, and of
        the last image seen.
        seen_image: (L,) squared error of a pixel of an image that is seen: its reconstruction.
        saturated: (L, A) whether an action is within 0.01 of its bound.
        greedy, sigma: (L, A) the actor's mode in each state, and the explorer's σ.
    """
    s, model, device = agent.s, agent.model, agent.device
    images, actions, rewards = (
        torch.from_numpy(x).to(device) for x in (episode.images, episode.actions, episode.rewards)
    )
    arrived_by = torch.cat([torch.zeros_like(actions[:1]), actions])
    is_first = torch.arange(len(images), device=device) == 0
    states = model.observe(images[None], arrived_by[None], is_first[None]).state[0]  # (L + 1, D)

    ended = np.zeros(len(rewards))
    ended[-1] = episode.terminated
    said = {
        "reward": (model.predict_reward(states[1:]), episode.rewards),
        "terminated": (1 - model.predict_continues(states[1:]), ended),
    }
    dream = model.imagine(states[:-1], agent.actors[name], s.horizon)
    believed = imagined_returns(dream, agent.critics[name], s.gamma, s.lam)[0]
    # a reward 300 decisions ahead counts 0.05 at γ = 0.99: what a time limit cut off is then little
    unknown = 0 if episode.terminated else int(np.log(0.05) / np.log(min(s.gamma, 0.999)))
    known = slice(0, max(0, len(rewards) - unknown))
    said["return"] = believed[known], discounted(episode.rewards, s.gamma)[known]
    found = {key: np.stack([p.cpu().numpy(), real], -1) for key, (p, real) in said.items()}
    found["saturated"] = np.abs(episode.actions) > 0.99
    if hasattr(agent.actors[name], "distribution"):
        found["sigma"] = agent.actors[name].distribution(states[:-1]).stddev.cpu().numpy()
    found["greedy"] = agent.actors[name].mode(states[:-1]).cpu().numpy()
    seen = to_levels(model.decoder(model.decoded(states[1:])))
    found["seen_image"] = (seen - images[1:].float()).square().mean((1, 2, 3)).cpu().numpy()

    if len(rewards) > OPEN_LOOP:
        taken = iter(windows(actions, OPEN_LOOP + 1)[:, ::5])  # the last one is chosen, not taken
        starts = states[: len(rewards) - OPEN_LOOP : 5]
        dream = model.imagine(starts, lambda _: next(taken), OPEN_LOOP)
        real = windows(rewards, OPEN_LOOP)[:, : len(rewards) - OPEN_LOOP : 5]
        found["open_reward"] = torch.stack([dream.reward, real], -1).transpose(0, 1).cpu().numpy()
        picture = to_levels(model.decoder(model.decoded(dream.state[1:]).flatten(0, 1)))
        picture = picture.unflatten(0, dream.reward.shape)
        truth = windows(images[1:], OPEN_LOOP)[:, : len(rewards) - OPEN_LOOP : 5].float()
        last_seen = images[: len(rewards) - OPEN_LOOP : 5].float()
        errors = [(x - truth).square().mean((2, 3, 4)) for x in (picture, last_seen)]
        found["open_image"] = torch.stack(errors, -1).transpose(0, 1).cpu().numpy()
    return found


def figures(found: dict[str, np.ndarray], episodes: list[Episode]) -> dict[str, float]:
    """The named figures of one actor, of all its episodes together."""
    reward, ended, returns = (found[key].T for key in ("reward", "terminated", "return"))
    named = {
        "return earned, mean of the episodes": np.mean([e.total for e in episodes]),
        "environment steps an episode": np.mean([e.length for e in episodes]),
        "share of saturated actions (near 1: the actor hardly learns)": found["saturated"].mean(),
        DEVIATION: found["greedy"].std(0).mean(),
        REWARDS: r_squared(*reward),
        "image error where it is seen, grey levels of 255": np.sqrt(found["seen_image"].mean()),
        ENDS: ended[1].sum(),
        EXPECTED: ended[0].sum(),
    }
    if "sigma" in found:
        named[SIGMA] = found["sigma"].mean()
    if returns.size:
        named |= {
            PROMISED: returns[0].mean(),
            EARNED: returns[1].mean(),
            "returns, R² (below 0: worse than their mean)": r_squared(*returns),
        }
    if "open_reward" in found:
        for k in (1, OPEN_LOOP):
            error, still = np.sqrt(found["open_image"][:, k - 1].mean(0))
            r2 = r_squared(*found["open_reward"][:, k - 1].T)
            named[AFTER if k == OPEN_LOOP else f"rewards, R² after {k} step without images"] = r2
            named[f"image error after {k} steps, grey levels of 255"] = error
            named[f"the same, of the last image seen for {k} steps"] = still
    return named


def draw_images(axes, agent: Agent, name: str, episode: Episode) -> None:
    """Truth, prediction and difference in ten images: five seen, then 15 steps dreamt."""
    seen = open_loop(agent, episode, frames=5 + OPEN_LOOP)
    some = seen[:, np.linspace(0, seen.shape[1] - 1, 10).astype(int)]
    axes.imshow(np.concatenate([np.concatenate(list(row), axis=1) for row in some]))
    axes.set_title(f"{name}: truth; dream from its first 5 images; difference", fontsize=9)
    axes.axis("off")


def draw_reliability(axes, predicted: np.ndarray, real: np.ndarray, label: str) -> None:
    """How often an episode ended where the model gave its end this probability."""
    edges = np.linspace(0, 1, 6)
    bins = np.digitize(predicted, edges[1:-1])
    filled = np.unique(bins)
    points = [(predicted[bins == b].mean(), real[bins == b].mean()) for b in filled]
    axes.plot(*np.array(points).T, "o-", label=f"{label}, {real.sum():.0f} ends")


def draw_metrics(axes, metrics: list[dict[str, str]], names: list[str]) -> None:
    """Columns of metrics.csv over environment steps, each on a scale of its own from 0 to 1."""
    steps = [float(row["env_steps"]) for row in metrics]
    for name in names:
        if not metrics or name not in metrics[0]:
            continue
        values = np.array([float(row[name]) for row in metrics])
        low, high = np.nanmin(values), np.nanmax(values)
        scaled = (values - low) / max(high - low, 1e-12)
        axes.plot(steps, scaled, label=f"{name}: {low:.3g} to {high:.3g}")
    axes.set_title("metrics.csv, each from its least to its greatest", fontsize=9)
    axes.set_xlabel("environment steps")
    axes.legend(fontsize=6)


def draw(path: Path, agent: Agent, played, found, metrics) -> None:
    """Writes the page."""
    figure = plt.figure(figsize=(13, 10), layout="constrained")
    above, below = figure.subfigures(2, 1, height_ratios=[1, 3])
    strips = above.subplots(1, len(played), squeeze=False)[0]
    for axes, (name, episodes) in zip(strips, played.items(), strict=True):
        draw_images(axes, agent, name, max(episodes, key=lambda e: e.total))
    panels = below.subplots(2, 3).ravel()
    titles = ("rewards", "discounted returns", "end of the episode", "rewards, R²", "image error")
    for axes, title in zip(panels, titles, strict=False):
        axes.set_title(title, fontsize=9)
    for name, of in found.items():
        for axes, key in zip(panels, ("reward", "return"), strict=False):
            axes.plot(of[key][:, 1], of[key][:, 0], ".", markersize=2, alpha=0.3, label=name)
        draw_reliability(panels[2], *of["terminated"].T, name)
        if "open_reward" in of:
            steps = np.arange(1, OPEN_LOOP + 1)
            r2 = [r_squared(*of["open_reward"][:, k - 1].T) for k in steps]
            panels[3].plot(steps, r2, label=name)
            error, still = np.sqrt(of["open_image"].mean(0)).T
            (line,) = panels[4].plot(steps, error, label=name)
            panels[4].plot(steps, still, ":", color=line.get_color(), label="last image seen")
    for axes in panels[:3]:
        axes.axline((0, 0), slope=1, color="grey", linewidth=0.8)
        axes.set(xlabel="happened", ylabel="predicted")
    panels[2].set(xlabel="predicted", ylabel="happened", xlim=(-0.05, 1.05), ylim=(-0.05, 1.05))
    for axes in panels[3:5]:
        axes.set_xlabel("steps without images")
    for axes in panels[:5]:
        if axes.lines:  # episodes shorter than 15 decisions leave two panels empty
            axes.legend(fontsize=6)
    draw_metrics(panels[5], metrics, ["eval_return", "beta", "mdn/entropy", "coverage"])
    figure.savefig(path, dpi=100)


# What to look at first, in this order: the first whose condition holds of any actor.
VERDICTS = (
    (
        lambda of: of[DEVIATION] < 0.05,  # of a range of 2; rewards hardly vary then
        "the actor does the same whatever it sees: raise --action-penalty, and look at what it was "
        "taught before it froze.",
    ),
    (
        lambda of: of[REWARDS] < 0.3,  # whatever follows is learnt from these
        "the model does not know the rewards that it is shown: see reward_r2 in metrics.csv; give "
        "it more prefill, or weigh rewards more.",
    ),
    (
        lambda of: of[ENDS] >= 3 and of[EXPECTED] < 0.5 * of[ENDS],
        "the model does not see ends coming: weigh terminations more.",
    ),
    (
        lambda of: of[EXPECTED] > 2 * of[ENDS] + 1,
        "the model expects ends that do not come: nothing far off counts in its dreams.",
    ),
    (
        lambda of: of.get(PROMISED, 0) - of.get(EARNED, 0) > 0.5 * abs(of.get(EARNED, 0)) + 1,
        "more is promised than earned: the actor exploits the model's errors, or the critic lags.",
    ),
    (
        lambda of: of.get(AFTER, 1) < of[REWARDS] - 0.6,
        "rewards are known where the image is seen and not in dreams: the dynamics are weak.",
    ),
)


def verdict(named: dict[str, dict[str, float]]) -> str:
    """One sentence: what to look at first, given each actor's figures."""
    for holds, sentence in VERDICTS:
        for name, of in named.items():
            if holds(of):
                return f"Look first at the {name} actor: {sentence}"
    return "Nothing stands out: the model is true to what these actors meet."


def read_metrics(folder: Path) -> list[dict[str, str]]:
    """The whole rows of metrics.csv; the last may be half written, the file not there yet."""
    path = folder / "metrics.csv"
    lines = path.read_text(errors="replace").splitlines() if path.is_file() else []
    rows = csv.DictReader(lines)
    return [row for row in rows if None not in [*row, *row.values()] and "env_steps" in row]


def diagnose(command: argparse.Namespace) -> Path:
    """Prints the figures of a run and returns the page that it drew.

    Raises:
        ValueError: in one sentence, if the folder holds no run or no checkpoint yet.
        EnvironmentFault: if the environment fails.
    """
    if command.episodes < 1:
        raise ValueError(f"--episodes is {command.episodes}: give 1 or more.")
    folder = command.folder
    s, env, agent, networks = load(folder, command.checkpoint, command.device, command.precision)
    played, found, named = {}, {}, {}
    for name, actor in agent.actors.items():
        seeds = [2**31 - 1 - k for k in range(command.episodes)]
        played[name] = [play(agent, env, actor, seed, s.eval_max_steps) for seed in seeds]
        parts = defaultdict(list)
        for episode in played[name]:
            for key, value in measure(agent, name, episode).items():
                parts[key].append(value)
        found[name] = {key: np.concatenate(values) for key, values in parts.items()}
        named[name] = figures(found[name], played[name])
    print(f"{s.env}, arm {s.arm}, networks {networks}")
    print(f"{'':68}" + "".join(f"{name:>15}" for name in named))
    for key in dict.fromkeys(itertools.chain(*named.values())):
        values = [f"{of[key]:15.3f}" if key in of else f"{'–':>15}" for of in named.values()]
        print(f"{key:68}" + "".join(values))
    print(verdict(named))
    path = folder / f"diagnosis-{networks}.png"
    draw(path, agent, played, found, read_metrics(folder))
    return path


def main(arguments: list[str]) -> int:
    """Runs a command line. Returns the exit code: 0 done, 1 the environment failed, 2 bad input."""
    parser = argparse.ArgumentParser(
        prog="python results/diagnose.py",
        description="Holds what a run's model predicts against what happens in fresh episodes.",
    )
    parser.add_argument("folder", type=Path, help="a run's folder, runs/NAME")
    parser.add_argument("--episodes", type=int, default=5, help="of each actor (%(default)s)")
    add_loading(parser)
    mpl.use("Agg")
    try:
        print(diagnose(parser.parse_args(arguments)))
    except (ValueError, OSError, EnvironmentFault) as error:
        print(error, file=sys.stderr)
        return 1 if isinstance(error, EnvironmentFault) else 2
    return 0


if __name__ == "__main__":
    sys.stdout, sys.stderr = Patient(sys.stdout), Patient(sys.stderr)
    sys.exit(main(sys.argv[1:]))
