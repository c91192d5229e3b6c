"""Two threads are enough for tests, and keep them honest on a shared machine."""

import os
import signal

for name in ("OMP_NUM_THREADS", "MKL_NUM_THREADS", "OPENBLAS_NUM_THREADS"):
    os.environ.setdefault(name, "2")
os.environ.setdefault("OMP_WAIT_POLICY", "PASSIVE")  # idle threads that spin take the cores from the other tests

# A shell's background job starts with Ctrl-C ignored, and so would the programs that tests start and interrupt.
if signal.getsignal(signal.SIGINT) == signal.SIG_IGN:
    signal.signal(signal.SIGINT, signal.default_int_handler)

import cv2  # noqa: E402 (after the limits, which the libraries read when they load)

cv2.setNumThreads(2)

try:
    import torch
except ModuleNotFoundError:  # the onboard install
    HAS_GPU = False
else:
    HAS_GPU = torch.cuda.is_available()
    torch.set_num_threads(2)

import pytest  # noqa: E402
from hypothesis import settings  # noqa: E402

# On a busy machine an example may take as long as it likes; examples are the same in every run.
settings.register_profile("patient", deadline=None, derandomize=True)
settings.load_profile("patient")


def pytest_runtest_setup(item: pytest.Item) -> None:
    """Leave out the tests that need a CUDA device where there is none, and say so."""
    if item.get_closest_marker("gpu") is not None and not HAS_GPU:
        pytest.skip("needs a CUDA device")


@pytest.fixture
def file(tmp_path):
    """Write a file: file(name, text) gives its path."""

    def write(name, text):
        path = tmp_path / name
        path.write_text(text)
        return path

    return write
