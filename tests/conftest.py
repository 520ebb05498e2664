import pytest
import torch

from torch_mpm import _library

# Small tensors: more threads only wait for each other, above all on a busy machine.
torch.set_num_threads(min(2, torch.get_num_threads()))

DEVICES = ["cpu"]
if torch.cuda.is_available() and _library.cuda_error is None:
    DEVICES.append("cuda")


@pytest.fixture(params=DEVICES)
def device(request: pytest.FixtureRequest) -> str:
    """Every device that this machine can use, so that the same test runs on each."""
    return request.param


@pytest.fixture(autouse=True)
def seeded() -> None:
    torch.manual_seed(0)


@pytest.fixture(params=["quadratic", "cubic"])
def kernel(request: pytest.FixtureRequest) -> str:
    return request.param


@pytest.fixture(params=[2, 3])
def dim(request: pytest.FixtureRequest) -> int:
    return request.param
