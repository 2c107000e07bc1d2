"""What every test begins with: one thread, one seed, and the signals' handlers as they were."""

import signal

import pytest
import torch

torch.set_num_threads(1)  # tiny tensors gain nothing by a second one; as OMP_NUM_THREADS=1 has it


@pytest.fixture(autouse=True)
def one_seed():
    torch.manual_seed(0)


@pytest.fixture(autouse=True)
def handlers():
    """A run that is trained in the test's own process takes them, and does not give them back."""
    numbers = signal.SIGINT, signal.SIGTERM, signal.SIGHUP
    before = [signal.getsignal(number) for number in numbers]
    signal.signal(signal.SIGHUP, signal.SIG_DFL)  # nohup ignores it; a run leaves it so
    yield
    for number, handler in zip(numbers, before, strict=True):
        signal.signal(number, handler)
