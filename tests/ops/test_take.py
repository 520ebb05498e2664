"""`take` against indexing by torch: fields of every layout and size of values."""

import pytest
import torch

OP = torch.ops.torch_mpm.take


def fields(P: int, device: str) -> list[torch.Tensor]:
    """Fields of several types, in rows, in columns, with gaps, and empty ones."""
    generator = torch.Generator().manual_seed(1)
    numbers = torch.randn(P, 3, 3, generator=generator)
    given = [
        numbers,
        numbers.double().permute(1, 2, 0).contiguous().permute(2, 0, 1),
        numbers[:, 1, ::2],
        numbers[:, 0, 0].half(),
        numbers[:, 0, 0] > 0,
        (numbers[:, 0, 0] * 1e9).int(),
        torch.arange(P) << 40,
        torch.randn(P, 2, 5, 7, generator=generator),  # of more columns than a kernel takes
        numbers[:1, 0, 0].expand(P),
        numbers[:, :0],
    ]
    return [t.to(device) for t in given]


@pytest.mark.parametrize("index", [torch.int32, torch.int64])
@pytest.mark.parametrize("particles", [1, 7, 5000])
def test_takes_as_indexing_does(index, particles, device):
    given = fields(particles, device)
    places = torch.randint(particles, (particles + 3,), dtype=index, device=device)
    for field, taken in zip(given, OP(given, places), strict=True):
        assert taken.dtype == field.dtype and torch.equal(taken, field[places.long()])
        assert taken.numel() == 0 or taken.stride(0) == 1


def test_takes_many(device):
    """More than the memory cache of the CPU has small pieces of memory for."""
    numbers = torch.arange(1_200_000, device=device)
    given = [
        numbers << 20,
        numbers.double(),
        numbers.float(),
        numbers.int(),
        numbers.short(),
        numbers.half(),
        numbers > 9,
    ]
    places = numbers.flip(0)
    for field, taken in zip(given, OP(given, places), strict=True):
        assert torch.equal(taken, field.flip(0)), field.dtype


def test_particles_that_do_not_exist_have_zeros(device):
    given = fields(7, device)
    places = torch.tensor([3, -1, 7, 2**31, -(2**63)], device=device)
    for field, taken in zip(given, OP(given, places), strict=True):
        assert torch.equal(taken[0], field[3]) and not taken[1:].any()


def test_takes_nothing(device):
    none = torch.zeros(0, dtype=torch.int64, device=device)
    assert OP([], none) == []
    assert [t.shape[0] for t in OP(fields(5, device), none)] == [0] * 10
    empty = torch.zeros(0, 2, device=device)
    assert OP([empty], torch.zeros(2, dtype=torch.int32, device=device))[0].tolist() == [[0, 0], [0, 0]]


def test_moves_bits(device):
    """NaN keep what they carry."""
    bits = torch.tensor([0x7FA12345, 0x7FF00001, 1], dtype=torch.int32, device=device)
    taken = OP([bits.view(torch.float32)], torch.tensor([2, 0, 1], device=device))[0]
    assert taken.view(torch.int32).tolist() == bits[[2, 0, 1]].tolist()


def test_refuses_what_it_cannot_take(device):
    x, places = torch.zeros(3, 2, device=device), torch.zeros(2, dtype=torch.int64, device=device)
    for given, index, message in (
        ([x, x[:2]], places, r"one number of particles, got \[3, 2\] and \[2, 2\]"),
        ([x[0, 0]], places, "one number of particles"),
        ([x.to(torch.complex128)], places, "at most 8 bytes"),
        ([x], places.short(), "particles must be int32 or int64, got Short"),
        ([x], places.reshape(1, 2), r"particles must have 1 dimensions, got shape \[1, 2\]"),
        ([x], torch.zeros(4, dtype=torch.int64, device=device)[::2], "particles must be contiguous"),
    ):
        with pytest.raises(RuntimeError, match=message):
            OP(given, index)


def test_op_is_well_formed(device):
    places = torch.tensor([1, 0], dtype=torch.int32, device=device)
    torch.library.opcheck(OP, (fields(7, device)[:7], places))
