"""world_model.py against closed forms, hand-worked numbers, torch's own layers and scipy."""

import math

import numpy as np
import pytest
import torch
import torch.nn.functional as F
from scipy import stats
from torch import nn
from torch.distributions import Normal

import world_model
from world_model import Decoder, Encoder, TransposedConv2d, WorldModel, in_slices

ACTIONS, DETER, STOCH = 2, 8, 4


def make_model(**changes) -> WorldModel:
    torch.manual_seed(0)
    sizes = dict(deter=DETER, stoch=STOCH, hidden=8, units=8, depth=2)
    switches = dict(
        termination=True, fixed_prior=True, smooth_l1=True, decode_stoch_only=True,
        decode_share=1.0, burn_in=0, ends_ahead=0, observe_first=True, free_nats=0.0,
    )  # fmt: skip
    return WorldModel(ACTIONS, **(sizes | switches | changes))


def make_batch(batch=3, length=6, seed=1) -> dict[str, torch.Tensor]:
    """Random rows; each sequence begins an episode, the second another one at row 3."""
    draw = torch.Generator().manual_seed(seed)
    is_first = torch.zeros(batch, length, dtype=torch.bool)
    is_first[:, 0] = True
    is_first[1:2, 3:4] = True
    return {
        "image": torch.randint(256, (batch, length, 64, 64, 3), generator=draw, dtype=torch.uint8),
        "action": torch.rand(batch, length, ACTIONS, generator=draw) * 2 - 1,
        "reward": torch.randn(batch, length, generator=draw) * 2,
        "terminated": torch.rand(batch, length, generator=draw) < 0.3,
        "is_first": is_first,
    }


def observe(model, batch, rows=slice(None), previous=None, seed=0):
    if seed is not None:
        torch.manual_seed(seed)
    image, action, first = (batch[k][:, rows] for k in ("image", "action", "is_first"))
    return model.observe(image, action, first, previous)


def loss(model, batch, seed=0):
    torch.manual_seed(seed)
    return model.loss(batch)


def moves(scalar, parameters) -> list[bool]:
    """Whether each parameter receives gradient from the scalar."""
    grads = torch.autograd.grad(scalar, list(parameters), retain_graph=True, allow_unused=True)
    return [g is not None and bool(g.any()) for g in grads]


def gaussians(mean, std, *shape) -> Normal:
    return Normal(torch.full(shape, mean), torch.full(shape, std))


def constant_head(head, value):
    """Make a head answer `value` whatever the state."""
    nn.init.zeros_(head[-1].weight)
    nn.init.constant_(head[-1].bias, value)


# --- divergences: the revised KL of §4.2 and Dreamer's ---


def test_revised_divergences_of_hand_worked_gaussians():
    """N(1, 2²) against N(0, 1), thrice: KL = 2 − ln 2, D_J = ½ [(4+1)/1 + (1+1)/4] − 1 = 1.75."""
    post, prior, seen = gaussians(1.0, 2.0, 2, 5, 3), gaussians(0.0, 1.0, 2, 5, 3), torch.ones(2, 5)
    terms = make_model().divergences(post, prior, seen)
    assert terms.keys() == {"kl_standard", "jeffreys"}
    assert terms["kl_standard"].item() == pytest.approx(3 * (2 - math.log(2)))
    assert terms["jeffreys"].item() == pytest.approx(3 * 1.75)


def test_jeffreys_is_its_closed_form_symmetric_and_zero_only_between_equals():
    m1, m2 = torch.randn(2, 4, 5, 3, generator=torch.Generator().manual_seed(0)).double()
    s1, s2 = torch.rand(2, 4, 5, 3, generator=torch.Generator().manual_seed(1)).double() + 0.1
    post, prior, seen = Normal(m1, s1), Normal(m2, s2), torch.ones(4, 5)
    square = (m1 - m2) ** 2
    closed = 0.5 * ((s1**2 + square) / s2**2 + (s2**2 + square) / s1**2) - 1
    divergences = make_model().divergences
    torch.testing.assert_close(divergences(post, prior, seen)["jeffreys"], closed.sum(-1).mean())
    torch.testing.assert_close(divergences(prior, post, seen)["jeffreys"], closed.sum(-1).mean())
    assert divergences(post, post, seen)["jeffreys"] == 0
    assert divergences(post, Normal(m1, s1 * 1.01), seen)["jeffreys"] > 0
    assert divergences(post, Normal(m1 + 0.01, s1), seen)["jeffreys"] > 0


def test_original_kl_is_from_posterior_to_prior():
    """KL(N(0, 2²) ‖ N(0, 1)) = 1.5 − ln 2; the other way round it is ln 2 − 0.375."""
    model = make_model(fixed_prior=False)
    wide, narrow = gaussians(0.0, 2.0, 1, 1, 1), gaussians(0.0, 1.0, 1, 1, 1)
    seen = torch.ones(1, 1)
    assert model.divergences(wide, narrow, seen)["kl"].item() == pytest.approx(1.5 - math.log(2))
    assert model.divergences(narrow, wide, seen)["kl"].item() == pytest.approx(math.log(2) - 0.375)


def test_free_nats_clamp_the_mean_kl_and_stop_its_gradient_below():
    """KL(N(μ, 1) ‖ N(0, 1)) = μ²/2: the mean of 0 and 4.5 is under 3 nats, of 0 and 8 over."""
    model, prior = make_model(fixed_prior=False, free_nats=3.0), gaussians(0.0, 1.0, 1, 2, 1)
    for mean, expected, slope in ((3.0, 3.0, 0.0), (4.0, 4.0, 2.0)):
        mean = torch.tensor([[[0.0], [mean]]], requires_grad=True)
        kl = model.divergences(Normal(mean, torch.ones(1, 2, 1)), prior, torch.ones(1, 2))["kl"]
        kl.backward()
        assert kl.item() == pytest.approx(expected)
        assert mean.grad[0, 1, 0].item() == pytest.approx(slope)  # μ / 2 rows


def test_unseen_rows_have_no_part_in_the_divergences():
    post, prior = gaussians(1.0, 2.0, 1, 2, 1), gaussians(0.0, 1.0, 1, 2, 1)
    post.loc[0, 0] = 100
    seen = torch.tensor([[0.0, 1.0]])
    terms = make_model().divergences(post, prior, seen)
    terms |= make_model(fixed_prior=False, free_nats=0.0).divergences(post, prior, seen)
    expected = {"kl_standard": 2 - math.log(2), "jeffreys": 1.75, "kl": 2 - math.log(2)}
    assert {name: term.item() for name, term in terms.items()} == pytest.approx(expected)


def test_kl_to_the_fixed_prior_moves_the_posterior_alone_and_jeffreys_moves_both():
    model = make_model()
    terms, _ = loss(model, make_batch())
    prior, posterior = model.prior_net.parameters(), model.posterior_out.parameters()
    assert moves(terms["kl_standard"], prior) == [False] * 4
    assert moves(terms["kl_standard"], posterior) == [True] * 2
    assert moves(terms["jeffreys"], model.prior_net.parameters()) == [True] * 4
    assert moves(terms["jeffreys"], model.posterior_out.parameters()) == [True] * 2


def test_original_kl_moves_prior_and_posterior():
    model = make_model(fixed_prior=False)
    terms, _ = loss(model, make_batch())
    assert "jeffreys" not in terms and "kl_standard" not in terms
    assert all(moves(terms["kl"], model.prior_net.parameters()))
    assert all(moves(terms["kl"], model.posterior_out.parameters()))


# --- what the terms teach ---


@pytest.mark.parametrize("name", ["image", "reward", "termination"])
def test_what_is_seen_and_predicted_shapes_the_states(name):
    model = make_model()
    term = loss(model, make_batch())[0][name]
    for part in (model.encoder, model.posterior_out, model.gru, model.dense_action):
        assert all(moves(term, part.parameters()))


def test_ends_in_dreams_shape_the_states_too():
    gradients = []
    for ahead in (0, 2):
        model = make_model(ends_ahead=ahead)
        term = loss(model, make_batch())[0]["termination"]
        gradients += torch.autograd.grad(term, model.posterior_out.weight)
    assert not torch.allclose(*gradients)


@pytest.mark.parametrize("name, fixed_prior", [("jeffreys", True), ("kl", False)])
def test_divergences_teach_what_the_prior_knows(name, fixed_prior):
    """Through the prior alone, into what h is made of."""
    model, batch = make_model(fixed_prior=fixed_prior), make_batch()
    observed, seen = observe(model, batch), torch.ones(3, 6)
    given = Normal(observed.posterior.mean.detach(), observed.posterior.stddev.detach())
    term = model.divergences(given, observed.prior, seen)[name]
    assert all(moves(term, [*model.gru.parameters(), *model.dense_action.parameters()]))


@pytest.mark.parametrize("by", ["h", "z"])
def test_states_learn_from_all_that_came_before_in_their_episode(by):
    """Through time, by either half of the state alone."""
    model, batch = make_model(), make_batch()
    if by == "h":
        nn.init.zeros_(model.dense_stoch.weight)
    else:
        nn.init.zeros_(model.gru.weight_hh)
        model.gru.bias_ih.data[DETER : 2 * DETER] = -200  # of the gate that keeps h
    batch["action"].requires_grad_()
    last = observe(model, batch).state[:, -1, :DETER].sum()
    (gradient,) = torch.autograd.grad(last, batch["action"])
    reached = [[0, 1, 1, 1, 1, 1], [0, 0, 0, 0, 1, 1], [0, 1, 1, 1, 1, 1]]
    assert gradient.ne(0).any(-1).int().tolist() == reached


# --- decoder, encoder and the image loss ---


@pytest.mark.parametrize("stoch_only", [True, False])
def test_decoder_depends_on_h_only_without_minor_modification_3(stoch_only):
    model = make_model(decode_stoch_only=stoch_only)
    state = torch.randn(2, DETER + STOCH, requires_grad=True)
    model.decoder(model.decoder_input(state)).square().sum().backward()
    assert state.grad[:, :DETER].any() == (not stoch_only)
    assert state.grad[:, DETER:].all()


def test_images_that_are_no_bytes_are_refused():
    """Floats would be centred in their own place, and so once for each network that sees them."""
    batch = make_batch()
    with pytest.raises(AssertionError):
        loss(make_model(), batch | {"image": batch["image"].float()})


def test_image_loss_is_minus_the_log_density_of_a_unit_normal_but_for_a_constant():
    """Mean over batch and time, *sum* over the 64·64·3 pixels: the constant is ½ ln 2π a pixel."""
    model, batch = make_model(), make_batch()
    terms, states = loss(model, batch)
    pixels = batch["image"].flatten(0, 1).double() / 255 - 0.5
    with torch.no_grad():
        decoded = model.decoder(states[..., DETER:].flatten(0, 1)).double()
    log_density = Normal(decoded, 1.0).log_prob(pixels).sum((1, 2, 3)).mean()
    constant = -0.5 * math.log(2 * math.pi) * 64 * 64 * 3
    assert terms["image"].item() + log_density.item() == pytest.approx(constant, abs=0.01)


@pytest.mark.parametrize("observe_first", [True, False])
def test_image_loss_of_a_share_of_the_images_is_that_of_all_on_average(observe_first):
    """Six of 18 images a draw; the states of both models are the same, seed by seed."""
    whole = make_model(observe_first=observe_first)
    part = make_model(observe_first=observe_first, decode_share=1 / 3)
    batch, drawn = make_batch(), []
    nll = part.decoder.nll
    part.decoder.nll = lambda z, image: drawn.append(nll(z, image)) or drawn[-1]
    with torch.no_grad():
        errors = torch.stack([
            loss(part, batch, seed)[0]["image"] - loss(whole, batch, seed)[0]["image"]
            for seed in range(60)
        ])  # fmt: skip
    assert {len(each) for each in drawn} == {6}
    assert 0 < abs(errors.mean()) < 3 * errors.std() / 60**0.5 < 0.1 * drawn[0].mean()


def test_image_loss_plus_the_log_density_is_the_same_for_every_reconstruction():
    decoder, image = make_model().decoder, make_batch()["image"][0]
    z = torch.randn(6, STOCH) * torch.tensor([0, 1, 3, 10, 30, 100]).unsqueeze(1)
    with torch.no_grad():
        nll = decoder.nll(z, image).double()
        density = Normal(decoder(z).double(), 1.0).log_prob(image.double() / 255 - 0.5)
    total = nll + density.sum((1, 2, 3))
    assert nll.max() > nll.min() + 10  # the reconstructions do differ
    torch.testing.assert_close(total, total[:1].expand(6), rtol=0, atol=0.01)


def test_decoder_is_the_authors_stack_of_four_transposed_convolutions():
    """Dreamer: linear to a 1×1 map of 32·depth channels, then kernels 5, 5, 6, 6 of stride 2."""
    depth, decoder = 2, Decoder(STOCH, 2)
    first, second = decoder.linear[0], decoder.linear[1]
    nn.init.constant_(second.bias, 0.1)  # a transposed convolution has one bias a channel
    opening = nn.ConvTranspose2d(32 * depth, 4 * depth, 5, stride=2)
    with torch.no_grad():
        opening.weight.copy_(second.weight.view(5, 5, 4 * depth, -1).permute(3, 2, 0, 1))
        opening.bias.fill_(0.1)
    x = torch.randn(3, STOCH)
    maps = F.relu(opening(first(x)[..., None, None]))
    assert maps.shape == (3, 4 * depth, 5, 5)
    layers = [layer for layer in decoder.net if isinstance(layer, nn.ConvTranspose2d)]
    assert [layer.kernel_size for layer in layers] == [(5, 5), (6, 6), (6, 6)]
    for layer in layers[:-1]:
        maps = F.relu(F.conv_transpose2d(maps, layer.weight, layer.bias, stride=2))
    images = F.conv_transpose2d(maps, layers[-1].weight, layers[-1].bias, stride=2)
    torch.testing.assert_close(decoder(x), images.permute(0, 2, 3, 1))


@pytest.mark.parametrize("kernel, n", [(5, 5), (6, 13), (6, 30), (2, 1)])
def test_transposed_convolution_is_torchs_in_values_and_gradients(kernel, n):
    fast = TransposedConv2d(6, 4, kernel)
    plain = nn.ConvTranspose2d(6, 4, kernel, stride=2)
    plain.load_state_dict(fast.state_dict())
    x = torch.randn(3, 6, n, n, requires_grad=True)

    def run(layer):
        y = layer(x)
        weights = torch.linspace(-1, 1, y.numel()).view(y.shape)
        return [y, *torch.autograd.grad((weights * y.square()).sum(), [x, *layer.parameters()])]

    for own, torchs in zip(run(fast), run(plain), strict=True):
        torch.testing.assert_close(own, torchs, rtol=1e-4, atol=1e-4)


@pytest.mark.parametrize("dtype", [torch.float32, torch.bfloat16])
def test_transposed_convolution_keeps_the_precision_of_its_input_under_autocast(dtype):
    layer, x = TransposedConv2d(6, 4, 6), torch.randn(3, 6, 13, 13).to(dtype).requires_grad_()
    with torch.autocast("cpu", torch.bfloat16):
        y = layer(x)
    y.float().square().sum().backward()
    assert y.dtype == x.grad.dtype == dtype
    assert layer.weight.grad.dtype == torch.float32


def test_encoder_is_the_authors_stack_of_four_convolutions():
    """Dreamer: channels 32, 64, 128, 256, kernel 4, stride 2, ReLU: 1024 numbers an image."""
    encoder, image = Encoder(32), make_batch()["image"][0, :2]
    maps = image.permute(0, 3, 1, 2).float() / 255 - 0.5
    layers = [layer for layer in encoder.net if isinstance(layer, nn.Conv2d)]
    assert [layer.weight.shape[:1] + layer.kernel_size for layer in layers] == [
        (32, 4, 4), (64, 4, 4), (128, 4, 4), (256, 4, 4)
    ]  # fmt: skip
    for layer in layers:
        maps = F.relu(F.conv2d(maps, layer.weight, layer.bias, stride=2))
    assert encoder.size == 1024
    torch.testing.assert_close(encoder(image), maps.flatten(1))


def test_sliced_convolutions_equal_unsliced_in_values_and_gradients(monkeypatch):
    model, image, x = make_model(), make_batch()["image"][0, :5], torch.randn(5, STOCH)
    parameters = [*model.encoder.parameters(), *model.decoder.parameters()]

    def run(size):
        monkeypatch.setattr(world_model, "SLICE", size)
        embedding, nll = model.encoder(image), model.decoder.nll(x, image)
        total = embedding.square().sum() + nll.square().sum()
        return [embedding, nll, *torch.autograd.grad(total, parameters)]

    for sliced, whole in zip(run(2), run(5), strict=True):  # 2 does not divide 5
        torch.testing.assert_close(sliced, whole, rtol=1e-4, atol=1e-4)


def test_slices_are_no_longer_than_they_should_be_and_keep_their_order(monkeypatch):
    monkeypatch.setattr(world_model, "SLICE", 2)
    lengths = []
    out = in_slices(lambda a, b: lengths.append(len(a)) or a - b, torch.arange(5), torch.ones(5))
    assert lengths == [2, 2, 1]
    assert out.tolist() == [-1, 0, 1, 2, 3]


# --- observe: the order of §4.2, the reset at is_first, the arrival index ---


def with_other_image(batch, row):
    return batch | {"image": batch["image"].index_fill(1, torch.tensor([row]), 7)}


def test_first_state_depends_on_the_first_observation():
    model, batch = make_model(), make_batch()
    before, after = observe(model, batch), observe(model, with_other_image(batch, 0))
    assert (before.state[:, 0, DETER:] != after.state[:, 0, DETER:]).all()


def test_blind_first_state_is_zero_and_the_first_observation_is_never_seen():
    """The other side of the switch: neither a state nor a term of the loss depends on o_0."""
    model, batch = make_model(observe_first=False), make_batch()
    terms, states = loss(model, batch)
    assert states[1, 3, DETER:].abs().max() == 0  # where a later episode starts, too
    assert states[:, 0, DETER:].abs().max() == 0
    assert states[:, 1, DETER:].all()
    other, other_states = loss(model, with_other_image(batch, 0))
    assert torch.equal(states, other_states)
    assert terms == other


@pytest.mark.parametrize("observe_first", [True, False])
def test_first_rows_count_in_image_loss_and_divergences_only_if_observed(observe_first):
    terms, _ = loss(make_model(observe_first=observe_first), make_batch(length=1))
    for name in ("image", "kl_standard", "jeffreys"):
        assert (terms[name] > 0) == observe_first, name
    assert terms["reward"] == 0 and terms["termination"] == 0


def test_observed_z_is_a_reparametrised_sample_of_the_posterior():
    model, batch = make_model(), make_batch(batch=40)
    state, posterior, _ = observe(model, batch)
    noise = ((state[..., DETER:] - posterior.mean) / posterior.stddev).detach()
    assert stats.kstest(noise.flatten().numpy(), "norm").pvalue > 0.001
    (grad,) = torch.autograd.grad(state[:, :, DETER:].sum(), model.posterior_out.bias)
    assert grad.all()  # of means and standard deviations


def test_later_observation_changes_its_own_state_and_no_earlier_one():
    model, batch = make_model(), make_batch()
    before, after = observe(model, batch), observe(model, with_other_image(batch, 1))
    assert torch.equal(before.state[:, 0], after.state[:, 0])
    assert (before.state[:, 1, DETER:] != after.state[:, 1, DETER:]).all()


def test_action_of_a_row_led_to_it_and_is_ignored_where_an_episode_starts():
    model, batch = make_model(), make_batch()
    before = observe(model, batch).state
    led_to_1 = batch | {"action": batch["action"].index_fill(1, torch.tensor([1]), 0.9)}
    after = observe(model, led_to_1).state
    assert torch.equal(before[:, 0], after[:, 0])
    assert (before[:, 1, :DETER] != after[:, 1, :DETER]).all()
    led_to_0 = batch | {"action": batch["action"].index_fill(1, torch.tensor([0]), 0.9)}
    assert torch.equal(before, observe(model, led_to_0).state)
    assert before[:, 0, :DETER].abs().max() == 0  # h_0 = 0


# In the next two z has 16 numbers: torch draws normals in blocks of 16, so that short draws in
# turn are the same noise as one long draw.


def test_two_episodes_in_one_window_equal_the_two_run_apart():
    model, batch = make_model(stoch=16), make_batch(batch=1, length=7)
    batch["is_first"][0, 3] = False
    batch["is_first"][0, 4] = True
    together = observe(model, batch)
    apart = [observe(model, batch, slice(0, 4)), observe(model, batch, slice(4, 7), seed=None)]
    for part, whole in (("state", together.state), ("mean", together.prior.mean)):
        pieces = [a.state if part == "state" else a.prior.mean for a in apart]
        torch.testing.assert_close(torch.cat(pieces, 1), whole, rtol=1e-4, atol=1e-5)
    one = batch | {"is_first": batch["is_first"].index_fill(1, torch.tensor([4]), False)}
    assert not torch.allclose(observe(model, one).state[:, 4:], together.state[:, 4:], atol=1e-3)


def test_observing_row_by_row_as_acting_does_equals_observing_the_window():
    model, batch = make_model(stoch=16), make_batch(batch=1, length=5)
    batch["is_first"][0, 3] = True
    whole, state = observe(model, batch).state, None
    torch.manual_seed(0)
    for t in range(5):
        state = observe(model, batch, slice(t, t + 1), previous=state, seed=None).state[:, 0]
        torch.testing.assert_close(state, whole[:, t], rtol=1e-4, atol=1e-5)


def test_standard_deviation_is_softplus_plus_a_tenth():
    gaussian = world_model.normal(torch.tensor([3.0, 0.0]))  # mean 3, softplus(0) = ln 2
    assert gaussian.mean.item() == 3
    assert gaussian.stddev.item() == pytest.approx(math.log(2) + 0.1)
    assert world_model.normal(torch.tensor([0.0, -100.0])).stddev.item() == pytest.approx(0.1)


# --- reward and termination ---


@pytest.mark.parametrize("smooth_l1, expected", [(True, (0.125 + 2.5) / 2), (False, 4.625 / 2)])
def test_reward_loss_of_hand_worked_errors(smooth_l1, expected):
    """Of errors 0.5 and 3 Smooth L1 makes ½ · 0.25 and 3 − ½, and squares ½ · 0.25 and ½ · 9."""
    model, batch = make_model(smooth_l1=smooth_l1), make_batch(batch=1, length=3)
    constant_head(model.reward, 1.0)
    batch["reward"] = torch.tensor([[99.0, 1.5, -2.0]])  # the first row arrives with no reward
    assert loss(model, batch)[0]["reward"].item() == pytest.approx(expected)


def test_termination_loss_is_the_bernoulli_nll_of_one_minus_continues():
    model, batch = make_model(), make_batch(length=20)
    terms, states = loss(model, batch)
    p = 1 - model.predict_continues(states).detach().double().numpy()
    arrived = ~batch["is_first"].numpy()
    log_pmf = stats.bernoulli(p).logpmf(batch["terminated"].numpy())
    assert 0.1 < batch["terminated"].float().mean() < 0.9
    assert terms["termination"].item() == pytest.approx(-log_pmf[arrived].mean(), rel=1e-5)


def test_rows_of_which_too_little_was_seen_teach_no_reward_and_no_end():
    model, batch = make_model(burn_in=2), make_batch()
    batch["is_first"][2, 0] = False  # it begins within an episode, as the others do not
    before, _ = loss(model, batch)
    for name, wrong in (("reward", batch["reward"] + 50), ("terminated", ~batch["terminated"])):
        term = {"reward": "reward", "terminated": "termination"}[name]
        for row, counts in (
            ((2, 0), False), ((2, 1), False), ((2, 2), True),
            ((0, 0), False), ((0, 1), True), ((1, 3), False), ((1, 4), True),  # first ones
        ):  # fmt: skip
            changed = batch[name].clone()
            changed[row] = wrong[row]
            same = loss(model, batch | {name: changed})[0][term] == before[term]
            assert same != counts
    all_taught, _ = loss(make_model(), batch)
    for name in ("image", "kl_standard", "jeffreys"):  # they teach of all that was seen
        assert before[name] == all_taught[name]


def test_ends_are_learnt_in_dreams_too():
    """Of six rows dreams of two steps meet the last four, but of no other episode: the second
    sequence's begins at its row 3. The loss then moves the prior."""
    terms = {}
    for ahead in (0, 2):
        model, batch = make_model(ends_ahead=ahead), make_batch()
        term = loss(model, batch)[0]["termination"]
        assert set(moves(term, model.prior_net.parameters())) == {ahead > 0}
        assert not any(moves(loss(model, batch)[0]["reward"], model.prior_net.parameters()))
        constant_head(model.termination, 1.0)
        terms[ahead] = loss(model, batch)[0]["termination"]
    taught = torch.zeros(3, 6)
    taught[:, 2:] = 1
    taught[1, 3] = 0
    met = model.end_loss(torch.zeros(3, 6, model.size), batch["terminated"], taught)
    assert terms[2].item() == pytest.approx((terms[0] + met).item())


@pytest.fixture
def taught(monkeypatch):
    """What a model's `end_loss` was given: states, ends, and which of them count."""
    given, end_loss = [], WorldModel.end_loss
    noting = lambda model, *a: given.append(a) or end_loss(model, *a)  # noqa: E731
    monkeypatch.setattr(WorldModel, "end_loss", noting)
    return given


@pytest.mark.parametrize("ahead, starts", [(1, (0, 1, 2, 3, 4)), (2, (1, 3)), (9, (0,))])
def test_dreams_of_ends_take_the_actions_that_were_taken(ahead, starts, taught):
    model, batch = make_model(ends_ahead=ahead), make_batch()
    _, states = loss(model, batch)
    of_start = (3, len(starts))
    dream, terminated = (x.unflatten(1, of_start) for x in taught[1][:2])
    assert len(dream) == min(ahead, 5)
    for n, start in enumerate(starts):
        state = states[:, start]
        for k, arrived in enumerate(dream[:, :, n]):
            row = start + 1 + k
            h = model.recur(
                *state.split([DETER, STOCH], -1), model.dense_action(batch["action"][:, row])
            )
            torch.testing.assert_close(arrived[:, :DETER], h)
            assert torch.equal(terminated[k, :, n], batch["terminated"][:, row])
            state = arrived


@pytest.mark.parametrize("ahead, rows", [
    (5, [[[1, 1, 1, 1, 1]], [[1, 1, 0, 0, 0]], [[0, 0, 0, 0, 0]]]),  # from row 0
    (2, [[[1, 1], [1, 1]], [[1, 0], [1, 1]], [[0, 0], [1, 1]]]),  # from rows 1 and 3
])  # fmt: skip
def test_dreams_of_ends_end_with_their_episode_and_begin_where_enough_was_seen(ahead, rows, taught):
    model, batch = make_model(burn_in=2, ends_ahead=ahead), make_batch()
    batch["is_first"][2, 0] = False  # it begins within an episode, as the others do not
    loss(model, batch)
    assert taught[1][2].T.unflatten(0, (3, -1)).tolist() == rows


def test_dreams_of_ends_teach_the_states_that_they_start_from():
    model, batch = make_model(ends_ahead=2), make_batch()
    _, states = loss(model, batch)
    assert all(moves(model.end_loss_ahead(states, batch), model.encoder.parameters()))


def test_continues_is_one_minus_the_probability_of_the_end():
    model = make_model()
    constant_head(model.termination, math.log(3))  # d = 3/4
    batch = make_batch()
    torch.testing.assert_close(model.predict_continues(torch.randn(5, 12)), torch.full((5,), 0.25))
    terminal = batch | {"terminated": torch.ones_like(batch["terminated"])}
    assert loss(model, terminal)[0]["termination"].item() == pytest.approx(-math.log(3 / 4))


def test_without_termination_nothing_ends():
    model = make_model(termination=False)
    terms, states = loss(model, make_batch())
    assert "termination" not in terms
    dream = model.imagine(states[:, 0], lambda s: s[:, :ACTIONS], 4)
    assert torch.equal(dream.continues, torch.ones(4, 3))


# --- imagine ---


def policy(state):
    return torch.tanh(state[:, -ACTIONS:])


def test_imagine_returns_states_and_actions_one_longer_than_rewards_and_continues():
    model, start = make_model(), torch.randn(5, DETER + STOCH)
    dream = model.imagine(start, policy, 3)
    assert dream.state.shape == (4, 5, DETER + STOCH) and dream.action.shape == (4, 5, ACTIONS)
    assert dream.reward.shape == dream.continues.shape == (3, 5)
    assert torch.equal(dream.state[0], start)
    for state, action in zip(dream.state, dream.action, strict=True):  # a_k = π(s_k), a_H too
        assert torch.equal(action, policy(state))
    torch.testing.assert_close(dream.reward, model.predict_reward(dream.state)[1:])
    torch.testing.assert_close(dream.continues, model.predict_continues(dream.state)[1:])


def test_gradient_of_every_later_reward_reaches_the_first_action():
    model, first = make_model(), torch.zeros(5, ACTIONS, requires_grad=True)
    given = iter([first])
    dream = model.imagine(
        torch.randn(5, DETER + STOCH), lambda state: next(given, policy(state)), 3
    )
    assert torch.equal(dream.action[0], first)
    assert torch.equal(dream.action[1], policy(dream.state[1]))
    for later in (*dream.reward, *dream.continues, dream.state[1, :, DETER:]):  # through z, too
        (grad,) = torch.autograd.grad(later.sum(), first, retain_graph=True)
        assert grad.all()


def test_last_action_is_chosen_and_never_taken():
    taken = []

    def remember(state):
        taken.append(torch.zeros(len(state), ACTIONS, requires_grad=True))
        return taken[-1]

    dream = make_model().imagine(torch.randn(2, DETER + STOCH), remember, 3)
    assert moves(dream.reward.sum() + dream.state.sum(), taken) == [True, True, True, False]


def test_imagined_step_is_the_observed_one_with_z_from_the_prior():
    """The action of row 1, taken in s_0, makes row 1's h exactly, and a z of its prior."""
    model, batch = make_model(), make_batch(batch=1, length=2)
    with torch.no_grad():
        observed = observe(model, batch)
        starts = observed.state[:, 0].expand(4000, -1)
        dream = model.imagine(starts, lambda _: batch["action"][:, 1].expand(4000, -1), 1)
    h, z = dream.state[1].split([DETER, STOCH], -1)
    torch.testing.assert_close(h, observed.state[:, 1, :DETER].expand(4000, -1))
    noise = (z - observed.prior.mean[0, 1]) / observed.prior.stddev[0, 1]
    assert stats.kstest(noise.flatten().numpy(), "norm").pvalue > 0.001
    assert np.abs(np.corrcoef(noise.T.numpy()) - np.eye(STOCH)).max() < 0.06  # 4 σ


# --- precision ---


@pytest.mark.parametrize("fixed_prior", [True, False])
def test_bfloat16_terms_are_within_two_percent_of_float32(fixed_prior):
    """bfloat16 rounds to 2⁻⁹ = 0.2 %; terms and states themselves stay float32."""
    model, batch = make_model(fixed_prior=fixed_prior), make_batch()
    exact, states = loss(model, batch)
    with torch.autocast("cpu", torch.bfloat16):
        rounded, rounded_states = loss(model, batch)
    assert rounded.keys() == exact.keys()
    assert rounded_states.dtype == torch.float32
    assert (rounded_states - states).abs().max() > 1e-5  # autocast did round
    for name, term in rounded.items():
        assert term.dtype == torch.float32, name
        assert term.item() == pytest.approx(exact[name].item(), rel=0.02), name


def test_rewards_keep_their_digits_in_bfloat16():
    """bfloat16 would make 150 of 150.3: the last layer is in float32 whatever the others are."""
    model = make_model()
    nn.init.zeros_(model.reward[-1].weight)
    nn.init.constant_(model.reward[-1].bias, 150.3)
    with torch.autocast("cpu", torch.bfloat16):
        reward = model.predict_reward(torch.randn(5, model.size))
    torch.testing.assert_close(reward, torch.full((5,), 150.3))
