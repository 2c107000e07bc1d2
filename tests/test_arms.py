"""The four arms, the two presets, one update of each, against the table of the paper's figure."""

import dataclasses
import functools
import math
from collections import defaultdict

import numpy as np
import pytest
import torch
from benchmark_update import PARTS, TimedAgent, clock
from scipy import stats

import train
from actors import critic_loss
from env import Replay
from train import (
    ARMS,
    PRESETS,
    Agent,
    Settings,
    act,
    as_numbers,
    beta_at,
    default_settings,
    evaluation_seed,
    interval95,
    live_rows,
    parse,
    reward_r2,
    to_tensors,
    update,
)

# What each arm sets, in this order. All four see o_0 before a_0, as the authors' own Dreamer does
# though the paper says otherwise: the blind first action is the other side of a switch, no arm.
NAMES = "dreamer", "dreamer-maxent", "revised", "maxent"
TABLE = {
    "termination": (False, False, True, True),
    "fixed_prior": (False, False, True, True),
    "q_critic": (False, False, True, True),
    "smooth_l1": (False, False, True, True),
    "decode_stoch_only": (False, False, True, True),
    "first_state_only": (False, False, True, True),
    "stoch": (30, 30, 128, 128),
    "entropy": (False, True, False, True),
    "deterministic_actor": (False, True, False, True),
    "action_noise": (0.3, 0.0, 0.3, 0.0),
    "random_action": (0.0, 0.0, 0.1, 0.1),
}
# What the paper, or the authors' Dreamer where the paper is silent, gives for every arm.
PAPER = dict(
    observe_first=True, action_repeat=2, deter=200, hidden=200, units=400, depth=32, batch_size=50,
    length=50, horizon=15, prefill=5000, train_every=1000, updates=100, steps=1_000_000, gamma=0.99,
    lam=0.95, gamma_q=0.9, beta_start=0.2, beta_end=0.0001, mdn_components=8, mdn_units=256,
    target_rate=0.1, model_lr=6e-4, actor_lr=8e-5, critic_lr=8e-5, mdn_lr=2e-4, grad_clip=100,
    free_nats=3, reward_weight=1, kl_weight=1, kl_standard_weight=0.1, jeffreys_weight=0.1,
    eval_episodes=10, termination_weight=10,
)  # fmt: skip
SIZES = {"deter", "stoch", "hidden", "units", "depth", "batch_size", "length", "mdn_units"}
CADENCE = {"steps", "prefill", "train_every", "updates", "eval_every"}
# What the small preset changes so that the agent learns in an hour, and the paper's literal value.
# Of what is in the table above it also squares the critics' errors in all arms (`smooth_l1`), and
# disturbs all explorers by noise, those that act at random more seldom.
LEARNING = {
    "floor_brightness": (0.4, 1.0), "reward_weight": (20.0, 1.0), "squared_reward": (True, False),
    "action_penalty": (0.01, 0.0), "starts": (0.25, 1.0),
    "critic_lr": (5e-4, 8e-5),
    "critic_norm": (True, False), "actor_lr": (2e-4, 8e-5), "horizon": (5, 15),
    "play_rate": (0.01, 1.0), "decode_share": (0.25, 1.0),
    "dream_noise": (0.3, 0.0), "collect": ("both", "explorer"), "ends_ahead": (5, 0),
    "burn_in": (2, 0),
}  # fmt: skip
ACTIONS = 2


def tiny(arm: str, **changes) -> Settings:
    """The paper's literal settings, in tiny networks."""
    paper = default_settings(arm, "paper")
    small = {name: getattr(paper, name) for name in LEARNING.keys() | TABLE.keys()} | dict(
        deter=8, stoch=4, hidden=8, units=8, depth=2, batch_size=3, length=6, horizon=3, mdn_units=8
    )
    return dataclasses.replace(default_settings(arm), **(small | changes))


def make_agent(s: Settings, bfloat16: bool = False) -> Agent:
    torch.manual_seed(0)
    return Agent(s, ACTIONS, torch.device("cpu"), bfloat16)


def make_batch(s: Settings) -> dict[str, torch.Tensor]:
    """Windows of random episodes of seven rows, the last of them terminal."""
    rng, replay = np.random.default_rng(0), Replay(40, ACTIONS)
    for i in range(40):
        image = rng.integers(256, size=(64, 64, 3))
        if i % 7 == 0:
            replay.add(image, is_first=True)
        else:
            replay.add(image, rng.uniform(-1, 1, ACTIONS), rng.normal(), terminated=i % 7 == 6)
    batch = to_tensors(replay.sample(s.batch_size, s.length, rng), torch.device("cpu"))
    assert batch["terminated"].any() and batch["is_first"].any()
    return batch


def networks(agent: Agent) -> dict[str, torch.nn.Module]:
    """Every network by the name of its optimiser, and the averaged ones, which have none."""
    named = {"model": agent.model}
    named |= {f"{name}_actor": net for name, net in agent.actors.items()}
    named |= {f"{name}_player": net for name, net in agent.players.items()}
    named |= {f"{name}_critic": net for name, net in agent.critics.items()}
    if hasattr(agent, "mdn"):
        named |= {"mdn": agent.mdn, "target_mdn": agent.target_mdn}
    assert sum(len(list(net.parameters())) for net in named.values()) == len(
        list(agent.parameters())
    )
    return named


def snapshot(agent: Agent, what=lambda p: p.detach()) -> dict[str, list[torch.Tensor]]:
    """A copy of something of every parameter, by network."""
    return {
        name: [torch.clone(what(p)) for p in net.parameters()]
        for name, net in networks(agent).items()
    }


def gradients(agent: Agent) -> dict[str, list[torch.Tensor]]:
    return snapshot(agent, lambda p: torch.zeros_like(p) if p.grad is None else p.grad)


def changed(before, after) -> set[str]:
    """Networks of which anything differs between two snapshots."""
    return {
        name
        for name in before
        if not all(torch.equal(a, b) for a, b in zip(before[name], after[name], strict=True))
    }


def updated(s: Settings, beta=0.1, bfloat16=False) -> tuple[Agent, dict[str, float]]:
    agent = make_agent(s, bfloat16)
    torch.manual_seed(1)
    return agent, update(agent, make_batch(s), beta)


def watched_update(s: Settings, watch, bfloat16=False) -> dict[str, float]:
    """One update, of whose every step watch(agent, name, loss, step) makes what it likes."""
    agent = make_agent(s, bfloat16)
    torch.manual_seed(1)
    step = agent.optimise
    agent.optimise = lambda name, *rest: watch(agent, name, rest[0], lambda: step(name, *rest))
    return update(agent, make_batch(s), 0.1)


# --- settings ---


def test_arms_differ_as_in_the_table_and_in_nothing_else():
    arms = {name: dataclasses.asdict(default_settings(name, "paper")) for name in NAMES}
    assert tuple(ARMS) == NAMES
    for field, values in TABLE.items():
        assert tuple(arms[name][field] for name in NAMES) == values, field
    differing = {f for f in arms["maxent"] if len({arms[name][f] for name in NAMES}) > 1}
    assert differing == {"arm", *TABLE}


@pytest.mark.parametrize("arm", NAMES)
def test_paper_preset_holds_the_papers_numbers(arm):
    s = dataclasses.asdict(default_settings(arm, "paper"))
    assert {name: s[name] for name in PAPER} == PAPER


@pytest.mark.parametrize("arm", NAMES)
def test_presets_change_sizes_cadence_and_what_learning_was_found_to_need(arm):
    small, paper = (dataclasses.asdict(default_settings(arm, name)) for name in PRESETS)
    differing = {name for name in small if small[name] != paper[name]}
    learning = LEARNING | {
        "smooth_l1": (False, paper["smooth_l1"]), "action_noise": (0.3, paper["action_noise"]),
        "random_action": (paper["random_action"] / 10, paper["random_action"]),
    }  # fmt: skip
    assert differing and differing <= SIZES | CADENCE | learning.keys() | {"preset"}
    assert all(small[name] <= paper[name] for name in differing & SIZES)
    assert {name: (small[name], paper[name]) for name in learning} == learning


def test_maxent_is_the_default():
    assert default_settings() == default_settings("maxent", "small")
    assert (Settings().arm, Settings().preset) == ("maxent", "small")


@pytest.mark.parametrize("arm", NAMES)
def test_arms_hold_the_networks_of_the_table_and_evaluate_the_right_actor(arm):
    s = tiny(arm, free_nats=2.0, mdn_components=3, mdn_min_std=0.3)
    agent = make_agent(s)
    with_entropy = arm in ("dreamer-maxent", "maxent")
    actors = ["stochastic", "deterministic"] if with_entropy else ["stochastic"]
    assert list(agent.actors) == list(agent.critics) == actors
    assert agent.evaluated is agent.players[actors[-1]]
    assert hasattr(agent, "mdn") == hasattr(agent, "target_mdn") == with_entropy
    assert (agent.model.termination is not None) == (arm in ("revised", "maxent"))
    critic = agent.critics["stochastic"].net[0].in_features
    assert critic == 8 + s.stoch + ACTIONS * (arm in ("revised", "maxent"))  # Q(s, a) or V(s)
    seen = agent.model.decoder.linear[0].in_features
    assert seen == s.stoch + 8 * (arm in ("dreamer", "dreamer-maxent"))  # z or (h, z)
    assert agent.model.free_nats == 2
    assert not with_entropy or (agent.mdn.components, agent.mdn.min_std) == (3, 0.3)


SWITCHES = [name for name, value in dataclasses.asdict(Settings()).items() if value is True]


@pytest.mark.parametrize("name", SWITCHES)
def test_each_modification_can_be_taken_away_alone_and_still_trains(name):
    s = parse(["--preset", "paper", f"--no-{name.replace('_', '-')}"]).settings
    paper = default_settings("maxent", "paper")
    assert s == dataclasses.replace(paper, **{name: False}) != paper
    _, metrics = updated(tiny("maxent", **{name: False}))
    assert all(math.isfinite(value) for value in metrics.values())
    assert metrics != plain_metrics()


@functools.cache
def plain_metrics() -> dict[str, float]:
    return updated(tiny("maxent"))[1]


@pytest.mark.parametrize("observe_first", [True, False])
def test_first_action_depends_on_the_first_observation_unless_blind(observe_first):
    agent = make_agent(tiny("maxent", observe_first=observe_first))
    actions = []
    for pixel in (0, 255):
        torch.manual_seed(0)
        image, zeros = np.full((64, 64, 3), pixel, np.uint8), np.zeros(ACTIONS, np.float32)
        actions.append(act(agent, agent.evaluated.greedy, image, zeros, None)[0])
    assert (actions[0] != actions[1]).all() == observe_first
    assert np.array_equal(*actions) != observe_first


def test_to_act_image_by_image_is_to_observe_them_all():
    """What acts remembers: its state is that of the sequence up to now."""
    agent, rng = make_agent(tiny("maxent", stoch=16)), np.random.default_rng(0)  # randn's blocks
    images = rng.integers(256, size=(4, 64, 64, 3), dtype=np.uint8)
    actions = rng.uniform(-1, 1, (4, ACTIONS)).astype(np.float32)
    torch.manual_seed(0)
    state, states = None, []
    for image, last in zip(images, actions, strict=True):
        action, state = act(agent, agent.evaluated.greedy, image, last, state)
        np.testing.assert_array_equal(action, agent.evaluated.greedy(state)[0].detach())
        states.append(state)
    torch.manual_seed(0)
    first = torch.tensor([[True, False, False, False]])
    whole = agent.model.observe(torch.tensor(images)[None], torch.tensor(actions)[None], first)
    torch.testing.assert_close(torch.cat(states), whole.state[0].detach(), rtol=1e-4, atol=1e-5)


def test_beta_falls_linearly_from_a_fifth_to_a_ten_thousandth():
    s = default_settings("maxent", "paper")
    betas = [beta_at(step, s) for step in (0, 500_000, 1_000_000, 1_000_007)]
    assert betas == pytest.approx([0.2, 0.10005, 0.0001, 0.0001], abs=1e-12)


def test_each_episode_of_an_evaluation_has_a_seed_of_its_own_that_any_environment_takes():
    """Those of the committed runs and of reference.csv: others would not compare."""
    assert [evaluation_seed(k) for k in range(3)] == [2147483647, 2147483646, 2147483645]


def test_interval_is_students():
    returns = np.array([12.0, 15.5, 9.0, 20.0, 11.0, 13.0, 8.5, 17.0, 14.0, 10.0])
    scale = returns.std(ddof=1) / math.sqrt(10)
    low, high = stats.t.interval(0.95, 9, loc=returns.mean(), scale=scale)
    assert interval95(returns) == pytest.approx((high - low) / 2)
    assert math.isnan(interval95(returns[:1]))


# --- one update ---


def test_batches_are_in_memory_of_torchs_own_alignment():
    for tensor in make_batch(tiny("maxent")).values():
        assert tensor.is_contiguous() and tensor.data_ptr() % 64 == 0


@pytest.mark.parametrize("bfloat16", [False, True])
@pytest.mark.parametrize("arm", NAMES)
def test_one_update_moves_every_parameter_of_every_network(arm, bfloat16):
    s = tiny(arm, free_nats=0.0)  # so that the original KL, small at first, has a gradient
    before = snapshot(make_agent(s))
    agent, metrics = updated(s, bfloat16=bfloat16)
    for name, net in networks(agent).items():
        for old, (path, new) in zip(before[name], net.named_parameters(), strict=True):
            assert not torch.equal(old, new), f"{name}.{path}"
    assert all(math.isfinite(value) for value in metrics.values())


@pytest.mark.parametrize("arm", NAMES)
def test_an_update_in_bfloat16_is_that_in_float32_but_for_its_rounding(arm):
    """Each loss within 1%, each parameter's gradient within 15% of its length: bfloat16 rounds a
    number to 0.2%, but small gradients are sums of large ones."""
    s = tiny(arm, horizon=15, free_nats=0.0)

    def run(bfloat16):
        seen = {}

        def watch(agent, name, loss, step):
            step()
            named = networks(agent)[name].named_parameters()
            seen[name] = loss.item(), {path: p.grad.clone() for path, p in named}

        watched_update(s, watch, bfloat16)
        return seen

    exact, rounded = run(False), run(True)
    for name, (loss, gradients) in exact.items():
        assert rounded[name][0] == pytest.approx(loss, rel=0.01), name
        differences = {
            path: rounded[name][1][path] - gradient for path, gradient in gradients.items()
        }
        assert any(difference.any() for difference in differences.values())  # it was rounded
        for path, difference in differences.items():
            assert difference.norm() <= 0.15 * gradients[path].norm(), f"{name}: {path}"


def test_target_mdn_starts_as_the_online_one_and_moves_a_tenth_of_the_way_to_it():
    s = tiny("maxent")
    (agent, _), before = updated(s), snapshot(make_agent(s))
    assert len(before["mdn"]) == len(before["target_mdn"]) == 6
    assert all(torch.equal(*pair) for pair in zip(before["mdn"], before["target_mdn"], strict=True))
    assert not any(p.requires_grad for p in agent.target_mdn.parameters())
    after = snapshot(agent)
    for old, online, target in zip(
        before["target_mdn"], after["mdn"], after["target_mdn"], strict=True
    ):
        torch.testing.assert_close(target, 0.9 * old + 0.1 * online)


@pytest.mark.parametrize("rate", [0.0, 0.3, 1.0])
def test_players_start_as_the_actors_and_move_at_their_rate_to_what_was_learnt(rate):
    """At 1, the default, they are the actors, to the bit."""
    s = tiny("maxent", play_rate=rate, actor_lr=0.1)
    (agent, _), before = updated(s), snapshot(make_agent(s))
    after = snapshot(agent)
    for name in ("stochastic", "deterministic"):
        of_player = before[f"{name}_player"], after[f"{name}_player"]
        for old, new, first, now in zip(
            before[f"{name}_actor"], after[f"{name}_actor"], *of_player, strict=True
        ):
            assert torch.equal(old, first) and not torch.equal(old, new)
            torch.testing.assert_close(now, (1 - rate) * old + rate * new)
            assert torch.equal(now, new) == (rate == 1) and torch.equal(now, old) == (rate == 0)


@pytest.mark.parametrize("arm", NAMES)
def test_each_step_of_an_update_touches_only_its_own_network(arm):
    """No actor's loss leaves a gradient in model, critic or MDN; no step moves another network."""
    steps = []

    def watch(agent, name, loss, step):
        parameters, grads = snapshot(agent), gradients(agent)
        step()
        assert changed(parameters, snapshot(agent)) == {name}
        assert changed(grads, gradients(agent)) == {name}
        steps.append(name)

    s = tiny(arm)
    watched_update(s, watch)
    learners = networks(make_agent(s)).keys() - {"target_mdn"}
    assert sorted(steps) == sorted(name for name in learners if "player" not in name)


def test_a_step_is_adams_on_the_clipped_gradient_of_its_own_loss():
    """Adam steps by its learning rate against the sign of a gradient that stays the same."""
    s = tiny("maxent", grad_clip=0.5, critic_lr=3e-4)
    agent = make_agent(s)
    rates = dict(model=s.model_lr, mdn=s.mdn_lr, actor=s.actor_lr, critic=s.critic_lr)
    for name in agent.optimisers:
        parameters = list(networks(agent)[name].parameters())
        size = sum(p.numel() for p in parameters)
        for _ in range(2):  # the second does not add to the gradient of the first
            before, metrics = snapshot(agent), {}
            agent.optimise(name, sum(7 * p.sum() for p in agent.parameters()), metrics)
            norm = metrics[f"{name}/grad_norm"].item()
            assert norm == pytest.approx(7 * math.sqrt(size), rel=1e-4)  # before clipping
            clipped = torch.cat([p.grad.flatten() for p in parameters])
            assert clipped.norm().item() == pytest.approx(0.5, rel=1e-3)
            assert changed(before, snapshot(agent)) == {name}
            for old, p in zip(before[name], parameters, strict=True):
                rate = torch.full_like(p, rates[name.split("_")[-1]])
                torch.testing.assert_close(old - p, rate, rtol=0.02, atol=0)


def test_the_benchmark_times_each_part_of_an_update():
    s = tiny("maxent")
    agent = TimedAgent(s, ACTIONS, torch.device("cpu"), bfloat16=False)
    agent.seconds, agent.clock = defaultdict(float), clock()
    update(agent, make_batch(s), 0.1)
    assert agent.seconds.keys() == set(PARTS.values()) and min(agent.seconds.values()) > 0


@pytest.mark.parametrize("arm", NAMES)
def test_losses_are_the_weighted_sums_of_their_named_terms(arm):
    """Model: each by its own setting. Actors: −R_0, the stochastic one's − β Ĥ."""
    losses = {}

    def watch(agent, name, loss, step):
        losses[name] = loss.item()
        step()

    weights = {
        "image": 0.5, "reward": 2.0, "termination": 4.0, "kl": 1.5, "kl_standard": 0.3,
        "jeffreys": 0.7,
    }  # fmt: skip
    s = tiny(arm, **{f"{name}_weight": weight for name, weight in weights.items()})
    metrics = watched_update(s, watch)
    terms = {k.removeprefix("model/"): v for k, v in metrics.items() if k.startswith("model/")}
    del terms["grad_norm"]
    revised = arm in ("revised", "maxent")
    names = {"image", "reward"} | (
        {"termination", "kl_standard", "jeffreys"} if revised else {"kl"}
    )
    assert terms.keys() == names
    total = sum(weights[name] * term for name, term in terms.items())
    assert losses["model"] == pytest.approx(total, rel=1e-6)
    if revised:  # first state only
        expected = -metrics["stochastic_actor/return"]
        if arm == "maxent":
            assert abs(metrics["mdn/entropy"]) > 0.1
            expected -= 0.1 * metrics["mdn/entropy"]
            deterministic = -metrics["deterministic_actor/return"]
            assert losses["deterministic_actor"] == pytest.approx(deterministic)
        assert losses["stochastic_actor"] == pytest.approx(expected, abs=1e-6)


def test_the_online_mdn_learns_and_the_target_mdn_rewards():
    def metrics(perturbed):
        s = tiny("maxent")
        agent = make_agent(s)
        for p in networks(agent)[perturbed].parameters() if perturbed else ():
            p.data += 0.1
        torch.manual_seed(1)
        return update(agent, make_batch(s), 0.1)

    plain, online, target = metrics(None), metrics("mdn"), metrics("target_mdn")
    assert online["mdn/entropy"] == plain["mdn/entropy"] != target["mdn/entropy"]
    assert target["mdn/nll"] == plain["mdn/nll"] != online["mdn/nll"]


@pytest.mark.parametrize("name", ["stochastic", "deterministic"])
def test_each_actor_climbs_its_own_critic(name):
    other = {"stochastic": "deterministic", "deterministic": "stochastic"}[name]
    _, plain = updated(tiny("maxent"))
    agent = make_agent(tiny("maxent"))
    for p in agent.critics[name].parameters():
        p.data += 0.1
    torch.manual_seed(1)
    metrics = update(agent, make_batch(agent.s), 0.1)
    for what in ("actor/return", "critic/loss"):
        assert metrics[f"{name}_{what}"] != plain[f"{name}_{what}"]
        assert metrics[f"{other}_{what}"] == plain[f"{other}_{what}"]


def test_nothing_counts_after_an_end_in_what_is_learnt_of_future_states():
    """With c = 0 everywhere a dream's first step is all of q: longer ones say the same of it."""
    found = []
    for horizon in (1, 3):
        agent = make_agent(tiny("maxent", horizon=horizon, deterministic_actor=False))
        agent.model.predict_continues = lambda state: torch.zeros(state.shape[:-1])
        torch.manual_seed(1)
        metrics = update(agent, make_batch(agent.s), 0.1)
        found.append([metrics["mdn/entropy"], metrics["mdn/nll"]])
    assert found[0] == pytest.approx(found[1], rel=1e-5)


def test_beta_moves_the_stochastic_actor_and_not_the_deterministic_one():
    """Eq. (7): the entropy is the stochastic actor's alone."""
    for arm in ("dreamer-maxent", "maxent"):
        (one, _), (other, _) = (updated(tiny(arm), beta) for beta in (0.0, 0.2))
        assert changed(snapshot(one), snapshot(other)) == {"stochastic_actor", "stochastic_player"}


def test_ends_ahead_reach_the_model():
    (_, alone), (agent, both) = (updated(tiny("maxent", ends_ahead=n)) for n in (0, 2))
    assert agent.model.ends_ahead == 2
    assert both["model/termination"] > 1.5 * alone["model/termination"]  # of two guesses alike
    assert both["model/reward"] == alone["model/reward"]


def test_terminal_states_start_no_dream():
    s = tiny("maxent")
    agent, batch, starts = make_agent(s), make_batch(s), []
    loss, imagine = agent.model.loss, agent.model.imagine
    agent.model.loss = lambda batch: starts.append(loss(batch)) or starts[-1]
    agent.model.imagine = lambda start, *rest: starts.append(start) or imagine(start, *rest)
    update(agent, batch, 0.1)
    (_, states), *starts = starts
    assert len(starts) == 2
    for start in starts:
        assert not start.requires_grad
        assert torch.equal(start, states[~batch["terminated"]])


@pytest.mark.parametrize("arm", ["maxent", "revised"])
def test_dreamt_actions_are_noisy_and_stay_in_range(arm):
    """Each of a_0 … a_H, of each actor."""
    for noise, saturates in ((0.1, False), (5.0, True)):
        s = tiny(arm, dream_noise=noise, batch_size=50)
        agent, dreams, asked = make_agent(s), [], {}
        for name, actor in agent.actors.items():
            with torch.no_grad():  # actions near 0, so that little noise is not clipped
                actor.net[-1].weight.mul_(0.01)
                actor.net[-1].bias[ACTIONS:] = -10  # of a σ
            asked[name] = []
            actor.register_forward_hook(
                lambda *given, to=asked[name]: to.append(given[-1].detach())
            )
        imagine = agent.model.imagine
        agent.model.imagine = lambda *given, imagine=imagine, dreams=dreams: (
            dreams.append(imagine(*given)) or dreams[-1]
        )
        update(agent, make_batch(s), 0.1)
        for meant, dream in zip(asked.values(), dreams, strict=True):
            for taken, action in zip(dream.action.detach(), meant[: s.horizon + 1], strict=True):
                added = (taken - action).flatten().numpy()
                assert taken.abs().max() <= 1 and (taken.abs() == 1).any() == saturates
                assert (stats.kstest(added / noise, "norm").pvalue > 0.001) != saturates


def test_a_share_of_the_images_is_decoded_as_the_settings_say():
    s = tiny("maxent", decode_share=0.5)
    agent, decoded = make_agent(s), []
    nll = agent.model.decoder.nll
    agent.model.decoder.nll = lambda z, image: decoded.append(len(z)) or nll(z, image)
    update(agent, make_batch(s), 0.1)
    assert decoded == [s.batch_size * s.length // 2]


# --- what is not finite ---


def all_state(agent: Agent):
    """Parameters and the optimisers' own state, flat."""
    moments = [
        value
        for optimiser in agent.optimisers.values()
        for of_parameter in optimiser.state.values()
        for value in of_parameter.values()
    ]
    return [t.detach().clone() for t in (*agent.parameters(), *moments)]


@pytest.mark.parametrize("name", make_agent(tiny("maxent")).optimisers)
def test_a_loss_or_gradient_that_is_not_finite_changes_nothing_and_is_refused_by_name(name):
    agent, _ = updated(tiny("maxent"))
    before = all_state(agent)
    parameters = list(networks(agent)[name].parameters())
    total = sum(p.sum() for p in parameters)
    no_number = total * math.nan
    steep = (total - total.detach()).abs().sqrt()  # 0, of slope ∞ · 0
    for loss in (no_number, steep, total + math.inf):
        agent.optimise(name, loss, metrics := {})
        with pytest.raises(FloatingPointError, match=f"Not finite: .*{name}"):
            as_numbers(metrics)
    after = all_state(agent)
    assert len(before) == len(after) > 4 * len(parameters)
    assert all(torch.equal(a, b) for a, b in zip(before, after, strict=True))


def test_a_reward_that_is_not_a_number_stops_the_update_before_anything_moves():
    s = tiny("maxent", play_rate=0.5)
    (agent, _), batch = updated(s), make_batch(s)
    batch["reward"][:] = math.nan
    before = all_state(agent)
    with pytest.raises(FloatingPointError, match="Not finite: model/reward"):
        update(agent, batch, 0.1)
    assert all(torch.equal(a, b) for a, b in zip(before, all_state(agent), strict=True))


@pytest.mark.parametrize("density", ["mdn", "knn"])
def test_a_model_that_knows_no_numbers_any_more_stops_the_update_and_nothing_moves(density):
    s = tiny("maxent", density=density, play_rate=0.5)
    (agent, _), batch = updated(s), make_batch(s)
    agent.model.gru.weight_hh.data.fill_(math.nan)
    before = all_state(agent)
    with pytest.raises(FloatingPointError, match=r"Not finite: model/image, .*model/grad_norm"):
        update(agent, batch, 0.1)
    pairs = zip(before, all_state(agent), strict=True)
    assert all(torch.equal(a, b) or a.isnan().all() for a, b in pairs)


# --- what learning was found to need ---


def test_half_of_the_live_states_are_drawn_each_time_for_both_actors():
    s = tiny("maxent", starts=0.5)
    agent, batch, starts = make_agent(s), make_batch(s), []
    imagine = agent.model.imagine
    agent.model.imagine = lambda start, *rest: starts.append(start) or imagine(start, *rest)
    for _ in range(2):
        update(agent, batch, 0.1)
    live = (~batch["terminated"]).flatten().nonzero().squeeze(1)
    assert [len(start) for start in starts] == 4 * [round(len(live) / 2)]
    assert len(starts[0].unique(dim=0)) == len(starts[0])  # none twice
    assert torch.equal(*starts[:2]) and not torch.equal(*starts[1:3])
    states, drawn = torch.arange(18.0).view(3, 6, 1), []
    for _ in range(200):
        drawn.append(train.dream_starts(states, live, 0.5).flatten().long())
        assert len(drawn[-1].unique()) == len(drawn[-1])  # none twice
    times = torch.cat(drawn).bincount(minlength=18)[live]
    assert times.sum() == 200 * round(len(live) / 2) and stats.chisquare(times).pvalue > 0.001


@pytest.mark.parametrize("detach_policy", [True, False])
def test_gradient_passes_through_what_the_policy_sees_unless_it_is_detached(detach_policy):
    """The first action moves the states after it; whether it moves the actions in them is the
    switch."""
    agent = make_agent(tiny("revised", detach_policy=detach_policy))
    state = torch.randn(5, agent.model.size, requires_grad=True)
    action = train.dream_policy(agent, "stochastic")(state).sum()
    (gradient,) = torch.autograd.grad(action, state, allow_unused=True)
    assert (gradient is None) == detach_policy
    one, other = (updated(tiny("revised", detach_policy=on))[1] for on in (True, False))
    assert one["stochastic_actor/return"] == other["stochastic_actor/return"]
    assert one["stochastic_actor/grad_norm"] != other["stochastic_actor/grad_norm"]


def test_saturated_and_deviation_are_of_an_actors_actions():
    agent = make_agent(tiny("maxent"))
    last = agent.actors["deterministic"].net[-1]
    torch.nn.init.zeros_(last.weight)
    last.bias.data = torch.tensor([40.0, 0.0])  # tanh(5) is beyond 0.99, 0 is not
    metrics = update(agent, make_batch(agent.s), 0.1)
    assert metrics["deterministic_actor/saturated"] == 0.5
    assert metrics["deterministic_actor/deviation"] == pytest.approx(0, abs=1e-6)
    assert metrics["stochastic_actor/deviation"] > 1e-4


@pytest.mark.parametrize("density", ["mdn", "knn"])
def test_each_discount_goes_where_it_belongs(density, monkeypatch):
    """γ and λ into returns, γ_q into the distribution of future states."""
    asked = defaultdict(set)

    def watch(name):
        function = getattr(train, name)

        def watched(*given):
            asked[name].add(tuple(x for x in given if isinstance(x, float)))
            return function(*given)

        monkeypatch.setattr(train, name, watched)

    of_q = ["entropy", "mdn_loss"] if density == "mdn" else ["particle_entropy"]
    for name in ("imagined_returns", *of_q):
        watch(name)
    updated(tiny("maxent", density=density, gamma=0.9, lam=0.7, gamma_q=0.6))
    assert asked == {"imagined_returns": {(0.9, 0.7)}} | {name: {(0.6,)} for name in of_q}


@pytest.mark.parametrize("name", ["stochastic", "deterministic"])
def test_action_penalty_is_the_sum_of_squares_before_the_bounds(name):
    losses = []
    for penalty in (0.0, 0.5):
        agent = make_agent(tiny("maxent", action_penalty=penalty))
        last, step = agent.actors[name].net[-1], agent.optimise
        torch.nn.init.zeros_(last.weight)
        torch.nn.init.constant_(last.bias[:ACTIONS], 2.0)

        def watched(n, loss, *rest, step=step):
            losses.extend([loss.item()] if n == f"{name}_actor" else [])
            step(n, loss, *rest)

        agent.optimise = watched
        torch.manual_seed(1)
        update(agent, make_batch(agent.s), 0.1)
    assert losses[1] - losses[0] == pytest.approx(0.5 * 4 * ACTIONS, rel=1e-4)


@pytest.mark.parametrize("name", ["stochastic", "deterministic"])
def test_action_penalty_draws_saturated_actions_back(name):
    """From a corner, where tanh has no slope, the penalty alone moves the actor, towards 0."""
    s = tiny("maxent", action_penalty=1.0, actor_lr=0.01)
    agent, batch = make_agent(s), make_batch(s)
    actor = agent.actors[name]
    torch.nn.init.constant_(actor.net[-1].bias[:ACTIONS], 40.0)
    state = torch.zeros(1, agent.model.size)
    before = actor.raw(state).detach()
    assert (before > 30).all()
    update(agent, batch, 0.1)
    assert (actor.raw(state) < before).all()


@pytest.mark.parametrize("critic", [{}, {"q_critic": False}])
@pytest.mark.parametrize("norm", [False, True])
def test_critics_alone_are_normalised_where_asked(critic, norm):
    agent = make_agent(tiny("maxent", critic_norm=norm, **critic))
    normalised = {
        name
        for name, net in networks(agent).items()
        if any(isinstance(module, torch.nn.LayerNorm) for module in net.modules())
    }
    assert normalised == ({"stochastic_critic", "deterministic_critic"} if norm else set())


@pytest.mark.parametrize("arm", NAMES)
def test_the_explorers_sigma_is_five_at_first(arm):
    metrics = updated(tiny(arm))[1]
    assert metrics["stochastic_actor/sigma"] == pytest.approx(5, rel=0.1)
    assert "deterministic_actor/sigma" not in metrics


@pytest.mark.parametrize("bfloat16", [False, True])
def test_neighbours_take_the_place_of_the_mdn(bfloat16):
    """No MDN is there to be trained; the explorer alone follows the entropy, that of z alone."""
    s = tiny("maxent", density="knn")
    assert not {"mdn", "target_mdn"} & networks(make_agent(s)).keys()
    one, other = (updated(s, beta, bfloat16) for beta in (0.1, 0.0))
    assert changed(snapshot(one[0]), snapshot(other[0])) == {
        "stochastic_actor",
        "stochastic_player",
    }
    assert one[1]["mdn/entropy"] == other[1]["mdn/entropy"] and "mdn/nll" not in one[1]
    asked = []
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("train.particle_entropy", lambda z, *_: asked.append(z) or z.sum(-1))
        imagine, dreams = train.WorldModel.imagine, []
        noting = lambda *a: dreams.append(imagine(*a)) or dreams[-1]  # noqa: E731
        patch.setattr("train.WorldModel.imagine", noting)
        updated(s, 0.1, bfloat16)
    (z,), dream = asked, dreams[0]
    assert torch.equal(z, dream.state[..., s.deter :]) and z.shape[::2] == (s.horizon + 1, s.stoch)


@pytest.mark.parametrize("smooth, squared, of_rewards", [
    (True, False, True), (False, False, False), (True, True, False),
])  # fmt: skip
def test_smooth_l1_is_of_both_critics_and_of_rewards_but_where_these_are_squared(
    smooth, squared, of_rewards
):
    s, asked = tiny("maxent", smooth_l1=smooth, squared_reward=squared), []
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("train.critic_loss", lambda *a: asked.append(a[-1]) or critic_loss(*a))
        updated(s)
    assert asked == [smooth, smooth] and make_agent(s).model.smooth_l1 == of_rewards


def test_both_gradients_of_the_objective_are_measured_when_asked():
    s = tiny("maxent")
    agent = make_agent(s)
    torch.manual_seed(1)
    looked = update(agent, make_batch(s), 0.1, look=True)
    _, plain = updated(s)
    apart = {f"stochastic_actor/{term}_grad_norm" for term in ("return", "entropy")}
    assert looked.keys() - plain.keys() == apart
    assert all(looked[name] == plain[name] for name in plain)  # looking changes nothing
    total = looked["stochastic_actor/grad_norm"]
    parts = [looked[name] for name in apart]
    assert abs(parts[0] - parts[1]) <= total * 1.001 and total <= sum(parts) * 1.001


@pytest.mark.parametrize("bfloat16", [False, True])
def test_the_gradient_measured_apart_is_the_one_that_the_actor_follows(bfloat16):
    s = tiny("maxent", action_penalty=0.0)
    looked = update(make_agent(s, bfloat16), make_batch(s), 0.0, look=True)  # β = 0: R_0 alone
    followed = looked["stochastic_actor/grad_norm"]
    assert looked["stochastic_actor/return_grad_norm"] == pytest.approx(followed, rel=1e-5)
    assert looked["stochastic_actor/entropy_grad_norm"] == 0


def test_reward_r2_is_one_of_exact_predictions_and_leaves_first_rows_out():
    s = tiny("maxent")
    agent, batch = make_agent(s), make_batch(s)
    batch["reward"][batch["is_first"]] = 1e6
    states = torch.randn(*batch["reward"].shape, agent.model.size)
    agent.model.predict_reward = lambda states: batch["reward"].where(~batch["is_first"], 0)
    assert reward_r2(agent, states, batch).item() == 1
    mean = batch["reward"][~batch["is_first"]].mean()
    agent.model.predict_reward = lambda states: mean
    assert reward_r2(agent, states, batch).item() == pytest.approx(0, abs=1e-6)
    batch["reward"][~batch["is_first"]] = 2  # of a robot that is paid for each step: no variance
    assert reward_r2(agent, states, batch).item() == 0


def test_reward_r2_and_dreams_leave_rows_out_that_are_not_settled():
    s = tiny("maxent", burn_in=2)
    agent, batch = make_agent(s), make_batch(s)
    batch["is_first"][:] = False  # all sequences begin within an episode
    batch["is_first"][0, 1] = True
    known = torch.ones_like(batch["is_first"])
    known[0, 0] = known[1:, :2] = False
    live = torch.zeros_like(known).flatten()
    live[live_rows(agent, batch)] = True
    assert torch.equal(live.view_as(known), known & ~batch["terminated"])
    batch["reward"][~known] = 1e6
    agent.model.predict_reward = lambda states: batch["reward"].where(known, 0)
    assert reward_r2(agent, torch.randn(*known.shape, agent.model.size), batch).item() == 1
