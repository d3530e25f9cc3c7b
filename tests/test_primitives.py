"""Scan, compaction, reduction and sort against NumPy."""

import numpy as np
import pytest

from psf_cl.device.primitives import Primitives

COUNTS = [0, 1, 63, 64, 65, 255, 257, 16384, 10**6]


@pytest.fixture
def primitives(device):
    made = Primitives(device)
    yield made
    made.release()


@pytest.fixture
def buffers(device):
    """Return a function that uploads an array, or makes a buffer of ones (never zeros)."""
    made = []

    def buffer(array_or_dtype, count=None):
        if count is None:
            made.append(device.upload("test", np.asarray(array_or_dtype)))
        else:
            made.append(device.allocate("test", array_or_dtype, count))
            device.fill(made[-1], 0xFF)
        return made[-1]

    yield buffer
    device.release(*made)


def exclusive_sums(values):
    return np.concatenate([[0], np.cumsum(values[:-1])]).astype(np.uint32)[: len(values)]


@pytest.mark.parametrize("count", COUNTS)
def test_scan_equals_numpy_and_may_be_in_place(device, primitives, buffers, count):
    values = np.random.default_rng(count).integers(0, 1000, count, np.uint32)
    source = buffers(values)
    target = buffers(np.uint32, count)
    assert device.read(primitives.scan(source, target, count))[0] == values.sum()
    np.testing.assert_array_equal(device.read(target, count), exclusive_sums(values))
    np.testing.assert_array_equal(device.read(source, count), values)

    primitives.scan(source, source, count)
    np.testing.assert_array_equal(device.read(source, count), exclusive_sums(values))


def test_sums_wrap_at_32_bits(device, primitives, buffers):
    values = np.full(1000, 0xF0000001, np.uint32)
    assert device.read(primitives.sum(buffers(values), 1000))[0] == 1000 * 0xF0000001 % 2**32


@pytest.mark.parametrize("count", COUNTS)
@pytest.mark.parametrize("share", [0.0, 0.3, 1.0])
def test_compaction_keeps_the_order(device, primitives, buffers, count, share):
    flags = (np.random.default_rng(count).random(count) < share).astype(np.uint32)
    ranks = buffers(np.uint32, count)
    indices = buffers(np.uint32, count)
    total = device.read(primitives.compact(buffers(flags), ranks, indices, count))[0]
    assert total == flags.sum()
    np.testing.assert_array_equal(device.read(indices, int(total)), np.flatnonzero(flags))
    np.testing.assert_array_equal(device.read(ranks, count), exclusive_sums(flags))


@pytest.mark.parametrize("count", COUNTS)
def test_bounds_equal_numpy(device, primitives, buffers, count):
    points = np.random.default_rng(count).normal(size=(count, 3)).astype(np.float32)
    expected = np.full((2, 3), [[np.inf], [-np.inf]], np.float32)
    if count:
        expected = np.stack([points.min(axis=0), points.max(axis=0)])
    found = device.read(primitives.bounds(buffers(points), count))
    np.testing.assert_array_equal(found, expected.ravel())


def test_bounds_leave_nan_out_wherever_it_is(device, primitives, buffers):
    points = np.random.default_rng(1).normal(size=(1000, 3)).astype(np.float32)
    points[[0, 1, 300, 999]] = np.nan
    found = device.read(primitives.bounds(buffers(points), 1000))
    expected = np.stack([np.nanmin(points, axis=0), np.nanmax(points, axis=0)])
    np.testing.assert_array_equal(found, expected.ravel())


def sort_on_device(device, primitives, buffers, keys, values, key_bits=None):
    count = len(keys)
    sorted_keys, sorted_values = primitives.sort(
        buffers(keys),
        buffers(values),
        buffers(keys.dtype, count),
        buffers(np.uint32, count),
        count,
        key_bits,
    )
    return device.read(sorted_keys, count), device.read(sorted_values, count)


@pytest.mark.parametrize("count", COUNTS)
@pytest.mark.parametrize("dtype", [np.uint32, np.uint64])
def test_sort_uses_all_bits_of_the_key(device, primitives, buffers, count, dtype):
    rng = np.random.default_rng(count)
    keys = rng.integers(0, np.iinfo(dtype).max, count, dtype, endpoint=True)
    values = rng.integers(0, 2**32, count, np.uint32)
    order = np.argsort(keys, kind="stable")
    found_keys, found_values = sort_on_device(device, primitives, buffers, keys, values)
    np.testing.assert_array_equal(found_keys, keys[order])
    np.testing.assert_array_equal(found_values, values[order])


@pytest.mark.parametrize("bit", [0, 7, 8, 31, 32, 62, 63])
def test_every_single_bit_decides(device, primitives, buffers, bit):
    set_first = np.uint64(1 << bit) * np.array([1, 0] * 100, np.uint64)
    values = np.arange(200, dtype=np.uint32)
    _, found = sort_on_device(device, primitives, buffers, set_first, values)
    np.testing.assert_array_equal(found, [*range(1, 200, 2), *range(0, 200, 2)])


@pytest.mark.parametrize("dtype", [np.uint32, np.uint64])
@pytest.mark.parametrize("different", [1, 3])
def test_sort_keeps_the_order_of_equal_keys(device, primitives, buffers, dtype, different):
    choices = np.random.default_rng(1).integers(0, np.iinfo(dtype).max, different, dtype)
    keys = np.random.default_rng(2).choice(choices, 100_000)
    values = np.arange(len(keys), dtype=np.uint32)
    _, found = sort_on_device(device, primitives, buffers, keys, values)
    np.testing.assert_array_equal(found, np.argsort(keys, kind="stable"))


@pytest.mark.parametrize(("dtype", "key_bits"), [(np.uint32, 8), (np.uint32, 20), (np.uint64, 40)])
def test_sort_by_the_low_bits_alone(device, primitives, buffers, dtype, key_bits):
    keys = np.random.default_rng(3).integers(0, 2**key_bits, 10_000, dtype)
    values = np.arange(len(keys), dtype=np.uint32)
    found_keys, found_values = sort_on_device(device, primitives, buffers, keys, values, key_bits)
    np.testing.assert_array_equal(found_keys, np.sort(keys))
    np.testing.assert_array_equal(found_values, np.argsort(keys, kind="stable"))
