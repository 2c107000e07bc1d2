"""What to look at first when a run does not learn: is the model true, and believed rightly?

    python results/diagnose.py runs/NAME

plays episodes of the evaluation's seeds with each actor (the explorer's actions drawn, as in its
dreams; in an arm without another actor also its greedy ones, which evaluations play), holds what
the model says of them against what happened, and takes the actions that it dreams of. Prints the
figures and a verdict, and draws diagnosis-STEP.png in the run's folder. The run may still be going
on: nothing of it is changed.
"""

import argparse
import itertools
import sys
from collections import defaultdict
from pathlib import Path

import matplotlib as mpl
import matplotlib.pyplot as plt
import numpy as np
import torch
from torch import Tensor, nn

sys.path.insert(0, str(Path(__file__).parents[1]))
from actors import Episode, imagined_returns, play
from results.play import command_line, exit_code, load, open_loop, pictured, strip
from results.plot import read_metrics
from returns import survival
from train import Agent, Patient, evaluation_seed

EVALUATED = "evaluated"  # the name of what evaluations play where it is no actor of its own
LATE = 3  # decisions that a dream may be late with an end
OPEN_LOOP = 15  # steps that the model is followed without images
SOON = 5  # the first of these decisions, told apart
MOMENTS = 4  # of an episode, from which its actor's dreams are taken at their word

# Names of the figures that the verdict looks at.
DEVIATION = "deviation of the greedy action over states (near 0: frozen)"
REWARDS = "rewards, R² (1: exact, 0: no better than their mean)"
PARTS = ("being alive", "progress", "electricity", "joints at their limits", "colliding feet")
ALIVE = "share of the rewards' variance that is the part for being alive"
BLIND = "correlation of that part with the error of predicted rewards (0: it is known)"
DECISIONS = "decisions"
SIGMA = "σ of the explorer before its tanh (5 at first)"
ENDS = "ends of episodes that happened"
EXPECTED = "ends of episodes that the model expected"
OUTLIVED = f"chance that dreams outlive an end that came by {LATE} decisions"
PROMISED = "discounted return that the model promised"
EARNED = "discounted return that then happened"
AFTER = f"rewards, R² after {OPEN_LOOP} steps without images"


class Greedy(nn.Module):
    """The greedy actions of an explorer, as an actor."""

    def __init__(self, explorer: nn.Module):
        super().__init__()
        self.greedy = explorer.greedy

    def forward(self, state: Tensor) -> Tensor:
        return self.greedy(state)


def own_and_taken(decisions: int) -> tuple[str, str]:
    """Names of the figures of what `take_at_its_word` finds in so many decisions."""
    dreamt = f"rewards of the first {decisions} decisions of its own dreams, sum"
    return dreamt, f"what these {decisions} earned when their actions were taken"


OWN, TAKEN = own_and_taken(OPEN_LOOP)


def r_squared(predicted: np.ndarray, real: np.ndarray) -> float:
    """The share of the variance that is predicted: 1 is exact, 0 no better than the mean of all;
    nan where nothing varies, as where each step earns 1."""
    variance = np.var(real)
    return 1 - np.square(predicted - real).mean() / (variance if variance > 1e-12 else np.nan)


def discounted(rewards: np.ndarray, gamma: float) -> np.ndarray:
    """(L,) r_1 … r_L to (L,) returns that followed s_0 … s_{L−1}, up to the episode's end."""
    following = itertools.accumulate(rewards[::-1], lambda later, reward: reward + gamma * later)
    return np.array(list(following))[::-1]


def known(episode: Episode, gamma: float) -> slice:
    """The rows of an episode whose return is known: all of one that ended. Of one that was cut off
    only those long before: a reward 300 decisions ahead counts 0.05 at γ = 0.99."""
    unknown = 0 if episode.terminated else int(np.log(0.05) / np.log(min(gamma, 0.999)))
    return slice(0, max(0, len(episode.rewards) - unknown))


def windows(x: Tensor, length: int) -> Tensor:
    """(L, …) to (length, L − length + 1, …): every stretch of consecutive rows, time first."""
    return x.unfold(0, length, 1).movedim(-1, 0)


def watch_parts(env) -> list[list[float]]:
    """The PARTS of each reward that a PyBullet robot gives from now on, a physics step each; it
    stays empty where the environment does not tell them apart."""
    robot, parts = env.unwrapped, []
    if isinstance(getattr(robot, "_alive", None), float):  # since the step that make_env takes
        plain = robot.step

        def step(action):
            result = plain(action)
            parts.append(robot.rewards)
            return result

        robot.step = step
    return parts


def play_all(agent: Agent, env, name: str, parts: list[list[float]], count: int):
    """Episodes of an actor, and what `measure` says of them together; also parts: (M, 5) those of
    each decision's reward, if `watch_parts` tells them, and own: what `take_at_its_word` says."""
    s, episodes, found = agent.s, [], defaultdict(list)
    for k in range(count):
        parts.clear()
        seed = evaluation_seed(k)
        episode = play(agent, env, agent.players[name], seed, s.eval_max_steps)
        episodes.append(episode)
        for key, value in measure(agent, name, episode).items():
            found[key].append(value)
        if parts:  # the last decision may have fewer physics steps than the others
            first_steps = np.arange(0, len(parts), s.action_repeat)
            found["parts"].append(np.add.reduceat(parts, first_steps))
        found["own"].append(take_at_its_word(agent, env, name, episode, seed))
    return episodes, {key: np.concatenate(values) for key, values in found.items()}


@torch.no_grad()
def measure(agent: Agent, name: str, episode: Episode) -> dict[str, np.ndarray]:
    """What the model says of one episode of an actor, beside what happened.

    Returns, beside what `follow` does:
        reward, terminated, return: (M, 2) predicted and real, of each row; returns only where
        the real one is known, which in an episode cut off by a time limit is long before its end.
        outlived: (at most 12,) chance that a dream outlives the end by 3, begun so far before.
        seen_image: (L,) squared error of a pixel of an image that is seen: its reconstruction.
        saturated: (L, A) whether an action is within 0.01 of its bound.
        greedy, sigma: (L, A) the actor's greedy action in each state, and the explorer's σ.
    """
    s, model, actor, rewards = agent.s, agent.model, agent.players[name], episode.rewards
    images, actions = (
        torch.from_numpy(x).to(agent.device) for x in (episode.images, episode.actions)
    )
    arrived_by = torch.cat([torch.zeros_like(actions[:1]), actions])
    is_first = torch.arange(len(images), device=agent.device) == 0
    states = model.observe(images[None], arrived_by[None], is_first[None]).state[0]  # (L + 1, D)
    dream = model.imagine(states[:-1], actor, s.horizon)
    believed = imagined_returns(dream, agent.critics[name], s.gamma, s.lam)[0]
    rows = known(episode, s.gamma)
    ended = np.append(np.zeros(len(rewards) - 1), episode.terminated)
    ends = 1 - model.predict_continues(states[1:])
    if model.termination is None:  # it expects none, and cannot: no figure of it says anything
        ends.fill_(torch.nan)
    said = {
        "reward": (model.predict_reward(states[1:]), rewards),
        "terminated": (ends, ended),
        "return": (believed[rows], discounted(rewards, s.gamma)[rows]),
    }
    found = {key: np.stack([p.cpu().numpy(), real], -1) for key, (p, real) in said.items()}
    if episode.terminated and model.termination is not None:
        left = torch.arange(min(len(rewards), OPEN_LOOP - LATE), 0, -1)
        before_end = model.imagine(states[-1 - len(left) : -1], actor, OPEN_LOOP)
        alive = before_end.continues.cumprod(0).cpu()  # in s_1 … s_15
        found["outlived"] = alive[left - 1 + LATE, torch.arange(len(left))].numpy()
    found["saturated"] = np.abs(episode.actions) > 0.99
    found["greedy"] = actor.greedy(states[:-1]).cpu().numpy()
    if hasattr(actor, "distribution"):
        found["sigma"] = actor.distribution(states[:-1]).stddev.cpu().numpy()
    seen = pictured(model, states[1:])
    found["seen_image"] = (seen - images[1:].float()).square().mean((1, 2, 3)).cpu().numpy()
    if len(rewards) > OPEN_LOOP:
        found |= follow(model, states, images, actions, torch.from_numpy(rewards))
    return found


def follow(model, states: Tensor, images: Tensor, actions: Tensor, rewards: Tensor) -> dict:
    """What the model predicts without images, from every fifth state, of the actions taken.

    Returns:
        open_reward: (M, H, 2) predicted and real after 1 … H steps.
        open_image: (M, H, 2) squared error of a pixel in grey levels: of the prediction, and of
        the last image seen.
    """
    begun = slice(0, len(rewards) - OPEN_LOOP, 5)
    dreamt = model.along(states[begun], windows(actions, OPEN_LOOP)[:, begun])[1:]
    both = model.predict_reward(dreamt).cpu(), windows(rewards, OPEN_LOOP)[:, begun]
    picture = pictured(model, dreamt.flatten(0, 1))
    truth = windows(images[1:], OPEN_LOOP)[:, begun].float()
    pictures = picture.unflatten(0, dreamt.shape[:2]), images[begun].float()
    errors = [(x - truth).square().mean((2, 3, 4)) for x in pictures]
    return {
        "open_reward": torch.stack(both, -1).transpose(0, 1).numpy(),
        "open_image": torch.stack(errors, -1).transpose(0, 1).cpu().numpy(),
    }


@torch.no_grad()
def take_at_its_word(agent: Agent, env, name: str, episode: Episode, seed: int) -> np.ndarray:
    """What dreams of an actor's own actions promise, and what these actions earn.

    It dreams on from a few moments of its episode. In the environment the episode is repeated up to
    there, and then the dream's actions are taken, whatever is met.

    Returns:
        (M, 15, 2) dreamt and real reward of each of 15 decisions: dreamt, times survival until
        then; real, 0 after an end. What a time limit cuts off is left out. No rows, M = 0, if the
        environment does not repeat itself.
    """
    last = len(episode.rewards) - (1 if episode.terminated else OPEN_LOOP)
    moments = np.unique(np.linspace(0, max(0, last), MOMENTS).astype(int))
    dream = agent.model.imagine(episode.states[moments], agent.players[name].greedy, OPEN_LOOP)
    dreamt = (survival(dream.continues) * dream.reward).T.cpu().numpy()
    chosen, both = dream.action[:-1].transpose(0, 1).cpu().numpy(), []
    for moment, own, promised in zip(moments, chosen, dreamt, strict=True):
        image, _ = env.reset(seed=seed)
        images, rewards = [image], []
        for action in [*episode.actions[:moment], *own]:
            image, reward, ended, cut_off, _ = env.step(action)
            images.append(image), rewards.append(reward)
            if ended or cut_off:
                break
        before, came = rewards[:moment], rewards[moment:]
        if not (
            came
            and np.array_equal(images[moment], episode.images[moment])
            and np.array_equal(before, episode.rewards[:moment])
        ):
            return np.zeros((0, OPEN_LOOP, 2))
        if ended or len(came) == OPEN_LOOP:
            real = np.zeros(OPEN_LOOP)
            real[: len(came)] = came
            both.append(np.stack([promised, real], -1))
    return np.array(both).reshape(-1, OPEN_LOOP, 2)


def figures(found: dict[str, np.ndarray], episodes: list[Episode]) -> dict[str, float]:
    """The named figures of one actor, of all its episodes together."""
    reward, ended, returns = (found[key].T for key in ("reward", "terminated", "return"))
    named = {
        "return earned, mean of the episodes": np.mean([e.total for e in episodes]),
        "environment steps an episode": np.mean([e.length for e in episodes]),
        DECISIONS: len(reward[0]),
        "share of saturated actions (near 1: the actor hardly learns)": found["saturated"].mean(),
        DEVIATION: found["greedy"].std(0).mean(),
        REWARDS: r_squared(*reward),
        "image error where it is seen, grey levels of 255": np.sqrt(found["seen_image"].mean()),
        ENDS: ended[1].sum(),
        EXPECTED: ended[0].sum(),
    }
    if "parts" in found:
        earned = found["parts"].sum(0) / len(episodes)
        named |= {f"of the return, for {part}": of for part, of in zip(PARTS, earned, strict=True)}
        alive = found["parts"][:, 0]
        if np.ptp(alive) and np.ptp(reward[1]):
            # covariances with the whole of the parts of a sum are shares of its variance
            named[ALIVE] = np.cov(alive, reward[1])[0, 1] / np.var(reward[1], ddof=1)
            named[BLIND] = np.corrcoef(alive, reward[1] - reward[0])[0, 1]
    if "sigma" in found:
        named[SIGMA] = found["sigma"].mean()
    if "outlived" in found:
        named[OUTLIVED] = found["outlived"].mean()
    if returns.size:
        named |= {PROMISED: returns[0].mean(), EARNED: returns[1].mean()}
        named["returns, R² (below 0: worse than their mean)"] = r_squared(*returns)
    if "open_reward" in found:
        for k in (1, OPEN_LOOP):
            error, still = np.sqrt(found["open_image"][:, k - 1].mean(0))
            r2 = r_squared(*found["open_reward"][:, k - 1].T)
            named[AFTER if k == OPEN_LOOP else f"rewards, R² after {k} step without images"] = r2
            named[f"image error after {k} steps, grey levels of 255"] = error
            named[f"the same, of the last image seen for {k} steps"] = still
    if "own" in found and len(found["own"]):
        for count in (SOON, OPEN_LOOP):
            sums = found["own"][:, :count].sum(1).mean(0)
            named |= dict(zip(own_and_taken(count), sums, strict=True))
    return named


def draw_images(axes, agent: Agent, name: str, episode: Episode) -> None:
    """Truth, prediction and difference in ten images: five seen, then 15 steps dreamt."""
    axes.imshow(strip(open_loop(agent, episode, frames=5 + OPEN_LOOP)))
    axes.set_title(f"{name}: truth; dream from its first 5 images; difference", fontsize=9)
    axes.axis("off")


def draw_reliability(axes, predicted: np.ndarray, real: np.ndarray, label: str) -> None:
    """How often an episode ended where the model gave its end this probability."""
    if np.isnan(predicted).all():  # of a model that knows no ends
        return
    bins = np.digitize(predicted, [0.2, 0.4, 0.6, 0.8])
    points = [(predicted[bins == b].mean(), real[bins == b].mean()) for b in np.unique(bins)]
    axes.plot(*np.array(points).T, "o-", label=f"{label}, {real.sum():.0f} ends")


def draw_metrics(axes, metrics: dict[str, np.ndarray], names: list[str]) -> None:
    """Columns of metrics.csv over environment steps, each on a scale of its own from 0 to 1."""
    for name in names:
        finite = np.isfinite(metrics.get(name, []))
        if finite.any():
            values, steps = metrics[name][finite], metrics["env_steps"][finite]
            scaled = (values - values.min()) / max(np.ptp(values), 1e-12)
            label = f"{name}: {values.min():.3g} to {values.max():.3g}"
            axes.plot(steps, scaled, "o-" if len(steps) == 1 else "-", label=label)
            axes.legend(fontsize=6)
    axes.set_title("metrics.csv, each from its least to its greatest", fontsize=9)
    axes.set_xlabel("environment steps")


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
        if axes.get_legend_handles_labels()[0]:  # short episodes and no ends leave some empty
            axes.legend(fontsize=6)
    draw_metrics(panels[5], metrics, ["eval_return", "mdn/entropy", "coverage"])
    figure.savefig(path, dpi=100)


def exceeds(of: dict[str, float], promised: str, earned: str) -> bool:
    """Whether one figure is above the other by more than half of that and 1, which is for those
    about 0; a critic that lags is off by less."""
    return of.get(promised, 0) - of.get(earned, 0) > 0.5 * abs(of.get(earned, 0)) + 1


# What to look at first, in this order: the first whose condition holds of an actor.
VERDICTS = (
    # Of a range of 2. First, since rewards hardly vary where actions do not.
    (lambda of: of[DEVIATION] < 0.05,
     "the actor does the same whatever it sees: see reward_r2 early on; raise --action-penalty."),
    # Whatever follows is learnt from these; a model that learns has 0.5 by 10,000 steps.
    (lambda of: of[REWARDS] < 0.3,
     "the model does not know the rewards that it is shown: more prefill, or weigh rewards more."),
    # A single end may be of a rare kind.
    (lambda of: of[ENDS] >= 3 and of[EXPECTED] < 0.5 * of[ENDS],
     "the model does not see ends coming: weigh terminations more."),
    # Hopper and Walker2D had 0.59 to 0.83 when they did not stand.
    (lambda of: of[ENDS] >= 3 and of.get(OUTLIVED, 0) > 0.6,
     "dreams outlive ends that came: nothing is feared; try a higher --termination-weight."),
    # At 0.005 a decision, dreams lose half as much again of what is far off as by γ = 0.99.
    (lambda of: of[EXPECTED] > 2 * of[ENDS] + 0.005 * of[DECISIONS],
     "the model expects ends that do not come: nothing far off counts in its dreams."),
    (lambda of: of[ENDS] >= 3 and np.isnan(of[EXPECTED]) and exceeds(of, PROMISED, EARNED),
     "more is promised than earned, and its dreams know no ends: --termination learns them."),
    # Of what is promised too much: are the dreams wrong, or what the critic makes of them?
    (lambda of: exceeds(of, PROMISED, EARNED) and exceeds(of, OWN, TAKEN),
     "its dreams earn what their actions do not: the model is wrong about what this actor does."),
    (lambda of: exceeds(of, PROMISED, EARNED),
     "more is promised than earned: the critic lags, or believes too much of its dreams."),
    # Chance alone takes some of it in 15 steps.
    (lambda of: of.get(AFTER, 1) < of[REWARDS] - 0.6,
     "rewards are known where the image is seen and not in dreams: the dynamics are weak, or "
     "nothing moves, and rewards hardly vary."),
)  # fmt: skip


def verdict(named: dict[str, dict[str, float]]) -> str:
    """One sentence: what to look at first, given each actor's figures. Of what is evaluated, the
    last of them, before the explorer."""
    for name, of in reversed(named.items()):
        for holds, sentence in VERDICTS:
            if holds(of):
                return f"Look first at the {name} actor: {sentence}"
    if all({PROMISED, AFTER} <= of.keys() for of in named.values()):
        return "Nothing stands out: the model is true to what these actors meet."
    return "Nothing stands out in what was measured; episodes are too short for returns or dreams."


def diagnose(command: argparse.Namespace) -> Path:
    """Prints the figures of a run and returns the page that it drew. A ValueError, in one
    sentence, if the folder holds no run or no checkpoint yet."""
    if command.episodes < 1:
        raise ValueError(f"--episodes is {command.episodes}: give 1 or more.")
    folder = command.folder
    s, env, agent, networks = load(folder, command.checkpoint, command.device)
    played, found, named = {}, {}, {}
    parts = watch_parts(env)
    if not s.deterministic_actor:
        agent.players[EVALUATED] = Greedy(agent.players["stochastic"])
        agent.critics[EVALUATED] = agent.critics["stochastic"]  # which is of drawn actions
    for name in agent.players:
        played[name], found[name] = play_all(agent, env, name, parts, command.episodes)
        named[name] = figures(found[name], played[name])
    print(f"{s.env}, arm {s.arm}, networks {networks}")
    print(f"{'':78}" + "".join(f"{name:>15}" for name in named))
    for key in dict.fromkeys(itertools.chain(*named.values())):
        values = [of.get(key, np.nan) for of in named.values()]
        print(f"{key:78}" + "".join("–".rjust(15) if np.isnan(x) else f"{x:15.3f}" for x in values))
    print(verdict(named))
    try:
        metrics = read_metrics(folder / "metrics.csv")
    except ValueError as error:
        print(error, file=sys.stderr)
        metrics = {}
    path = folder / f"diagnosis-{networks}.png"
    draw(path, agent, played, found, metrics)
    return path


def main(arguments: list[str]) -> int:
    """Runs a command line. Returns its `exit_code`."""
    says = "Holds what a run's model predicts against what happens in the evaluation's episodes."
    parser = command_line("diagnose.py", says, episodes=5)
    mpl.use("Agg")
    return exit_code(lambda: print(diagnose(parser.parse_args(arguments))))


if __name__ == "__main__":
    sys.stdout, sys.stderr = Patient(sys.stdout), Patient(sys.stderr)
    sys.exit(main(sys.argv[1:]))
