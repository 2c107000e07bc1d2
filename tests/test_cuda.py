"""What only a CUDA device can show: `pytest -m cuda` where there is one."""

import csv
import warnings

import pytest
import torch
from test_arms import make_batch, tiny

from train import Agent, main, new_run, parse, update

CUDA = torch.device("cuda")
TINY = (
    "--deter 16 --stoch 8 --hidden 16 --units 16 --depth 2 --mdn-units 16 --horizon 5 "
    "--device cuda --batch-size 4 --length 8 --prefill 60 --steps 120 --eval-episodes 2"
).split()
pytestmark = [
    pytest.mark.cuda,
    pytest.mark.skipif(not torch.cuda.is_available(), reason="no CUDA device is here"),
]


@pytest.mark.parametrize("precision", ["float32", "bfloat16"])
def test_a_run_trains_and_goes_on(precision, tmp_path):
    folder = tmp_path / "run"
    begun = ["--precision", precision, "--run-dir", str(folder), *TINY]
    assert main(begun) == 0
    weights = torch.load(folder / "weights.pt", map_location="cpu", weights_only=True)
    goes_on = ["--resume", str(folder), "--steps", "240", "--device", "cuda"]
    assert main([*goes_on, "--precision", precision]) == 0
    later = torch.load(folder / "weights.pt", map_location="cpu", weights_only=True)
    assert not any(torch.equal(weights[name], later[name]) for name in weights)
    with open(folder / "metrics.csv", newline="") as file:
        assert len(list(csv.DictReader(file))) == 2


def test_a_checkpoint_brings_back_random_numbers_and_optimisers(tmp_path):
    run = new_run(parse(["--run-dir", str(tmp_path / "run"), *TINY]))
    with run.lock:
        for optimiser in run.agent.optimisers.values():
            for parameter in optimiser.param_groups[0]["params"]:
                parameter.grad = torch.ones_like(parameter)
            optimiser.step()
        run.save()
        after = torch.rand(3, device=CUDA)
        run.load()
        assert torch.equal(torch.rand(3, device=CUDA), after)
        for optimiser in run.agent.optimisers.values():
            for state in optimiser.state.values():
                assert {value.device.type for value in state.values()} == {"cuda"}
                assert state["step"] == 1


@pytest.mark.parametrize("density", ["mdn", "knn"])
def test_an_update_waits_for_the_device_at_its_start_and_at_its_end_alone(density):
    switches = dict(
        starts=0.5, decode_share=0.5, dream_noise=0.3, critic_norm=True, ends_ahead=5,
        burn_in=2, action_penalty=0.01, smooth_l1=False,
    )  # fmt: skip
    s = tiny("maxent", density=density, **switches)
    agent = Agent(s, 2, CUDA, bfloat16=True)
    batch = {name: value.to(CUDA) for name, value in make_batch(s).items()}
    update(agent, batch, 0.1)
    with warnings.catch_warnings(record=True, action="always") as warned:
        torch.cuda.set_sync_debug_mode("warn")
        try:
            update(agent, batch, 0.1, look=True)
        finally:
            torch.cuda.set_sync_debug_mode("default")
    said = [str(each.message) for each in warned]
    assert len([text for text in said if "synchronizing" in text]) == 2, said


@pytest.mark.parametrize("arm", ["dreamer", "maxent"])
def test_the_models_loss_and_gradients_are_those_of_a_cpu(arm, monkeypatch):
    monkeypatch.setattr(
        torch, "randn", lambda *size, device=None: torch.full(size, 0.3, device=device)
    )
    s, found = tiny(arm, free_nats=0.0), []
    for device in (torch.device("cpu"), CUDA):
        torch.manual_seed(0)
        agent = Agent(s, 2, device, bfloat16=False)
        batch = {name: value.to(device) for name, value in make_batch(s).items()}
        loss = sum(agent.model.loss(batch)[0].values())
        loss.backward()
        gradient = torch.cat([p.grad.flatten().cpu() for p in agent.model.parameters()])
        found.append((loss.item(), gradient))
    (loss, gradient), (same, other) = found
    assert same == pytest.approx(loss, rel=1e-3)
    assert (other - gradient).norm() < 0.01 * gradient.norm()
