"""What every test begins with: one thread, one seed, and the signals' handlers as they were."""

import signal

import pytest
import torch

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
