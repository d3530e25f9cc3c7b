"""The hash map of cells against NumPy: integer sums are the same in every order."""

import numpy as np
import planes
import pytest

from psf_cl.device import hash_map, layout

NO_SLOT = 0xFFFFFFFF
FILE = "hash_map_test.cl"


def insert(device, key, value, slots, steps, u=None, **defines):
    """Insert samples of ``value`` (3, n); return keys, cells, and the slot of each sample."""
    keys = device.allocate("keys", np.uint32, slots)
    cells = device.allocate("cells", layout.CELL.dtype, slots)
    if u is None:
        u = np.random.default_rng(9).random(value.shape, np.float32) * np.float32(0.999)
    (slot,) = planes.run(
        device,
        FILE,
        "insert_samples",
        {"key": key, "value": value, "u": u},
        {"slot": (np.uint32, 1)},
        defines,
        keys=keys,
        cells=cells,
        slots=slots,
        steps=steps,
    )
    found = device.read(keys), device.read(cells), slot
    device.release(keys, cells)
    return found


def fixed(value, steps, u):
    """Return the fixed-point numbers as the device makes them, in double precision."""
    x = value.astype(np.float64) * steps
    # The sum with u is rounded to single precision on the device.
    nudged = np.floor((np.float32(x) + u).astype(np.float32).astype(np.float64))
    return np.where(x < 2.0**23, nudged, x).astype(np.uint64)


def total(cells):
    """Return the sums of cells in steps, (n, 3) uint64."""
    return cells["low"].astype(np.uint64) + (cells["high"].astype(np.uint64) << np.uint64(32))


def samples(count, distinct, seed=1):
    """Return keys and values; a multiple of what ``planes`` pads to, so that nothing is added."""
    rng = np.random.default_rng(seed)
    count -= count % planes.MULTIPLE
    key = rng.permutation(np.arange(count, dtype=np.uint32) % distinct)
    value = (10.0 ** rng.uniform(-6, 4, (3, count))).astype(np.float32)
    value[:, rng.random(count) < 0.3] = 0
    return key, value


def check_sums(key, value, u, steps, keys, cells, slot):
    taken = slot != NO_SLOT
    assert cells["count"].sum() == taken.sum()
    expected = np.zeros((len(keys), 3), np.uint64)
    for channel in range(3):
        steps_of = fixed(value[channel], steps, u[channel])
        np.add.at(expected[:, channel], slot[taken], steps_of[taken])
    np.testing.assert_array_equal(total(cells), expected)
    np.testing.assert_array_equal(
        cells["count"], np.bincount(slot[taken].astype(np.int64), minlength=len(keys))
    )
    # One key, one slot.
    number_of = np.full(len(keys), -1, np.int64)
    number_of[slot[taken]] = key[taken]
    np.testing.assert_array_equal(number_of[slot[taken]], key[taken])
    assert len(np.unique(slot[taken])) == len(np.unique(key[taken])) == np.count_nonzero(keys)


@pytest.mark.parametrize("distinct", [1, 16, 500, 20000])
def test_sums_equal_those_of_numpy(lane_device, distinct):
    key, value = samples(40000, distinct)
    slots = 1 << 16
    steps = hash_map.fixed_point(1e4, len(key))
    u = np.random.default_rng(2).random(value.shape, np.float32) * np.float32(0.999)
    keys, cells, slot = insert(lane_device, key, value, slots, steps, u)
    assert (slot != NO_SLOT).all()
    check_sums(key, value, u, steps, keys, cells, slot)


@pytest.mark.slow
@pytest.mark.parametrize("distinct", [1, 16, 20000, 2_000_000])
def test_two_million_inserts_lose_nothing(device, distinct):
    key, value = samples(2_000_000, distinct)
    steps = hash_map.fixed_point(1e4, len(key))
    u = np.random.default_rng(3).random(value.shape, np.float32) * np.float32(0.999)
    keys, cells, slot = insert(device, key, value, 1 << 22, steps, u)
    # At a load of 0.48: buckets hold 30 keys on average, and 64 is six deviations away.
    assert (slot != NO_SLOT).all()
    check_sums(key, value, u, steps, keys, cells, slot)


def test_a_dark_and_a_bright_sample_share_a_cell(device):
    count = 1 << 20
    value = np.full((3, count), 1e-4, np.float32)
    value[:, ::2] = 1e8
    steps = hash_map.fixed_point(1e8, count)
    u = np.random.default_rng(4).random(value.shape, np.float32) * np.float32(0.999)
    keys, cells, _ = insert(device, np.zeros(count, np.uint32), value, 64, steps, u)
    bright = 10**8 * count // 2
    # What is left after the bright ones is the dark ones' sum, to the noise of its rounding: each
    # dark sample is a 0 or a 1 of 2^-16 with a mean of 1e-4.
    dark = 1e-4 * count / 2
    noise = np.sqrt(count / 2 * 1e-4 / steps)
    for channel in total(cells)[keys != 0][0]:
        left = (int(channel) - bright * int(steps)) / steps
        # Steps fit the bright samples exactly; u below 0.999 costs a thousandth.
        assert abs(left - dark) < 5 * noise + 2e-3 * dark
    assert cells["count"][keys != 0] == [count]


def test_dark_samples_alone_keep_their_mean(lane_device):
    count = 1 << 16
    value = np.full((3, count), 0.002, np.float32)
    u = np.random.default_rng(5).random(value.shape, np.float32)
    keys, cells, _ = insert(lane_device, np.zeros(count, np.uint32), value, 64, 16.0, u)
    mean = total(cells)[keys != 0][0] / (16.0 * count)
    # A sample is one step with the chance 0.032: Bernoulli.
    np.testing.assert_allclose(mean, 0.002, rtol=5 / np.sqrt(0.032 * count))


#: With and without atomics of 64 bits.
ADDS = pytest.mark.parametrize("defines", [{}, {"PLAIN_C": 1}], ids=["long", "short"])


@ADDS
def test_words_carry(lane_device, defines):
    count = 4096
    steps = 1.0
    value = np.full((3, count), 2.0**31, np.float32)
    value[1] = 2.0**40 + 2.0**20
    value[2] = 1.0
    keys, cells, _ = insert(lane_device, np.zeros(count, np.uint32), value, 64, steps, **defines)
    expected = [count << 31, count * ((1 << 40) + (1 << 20)), count]
    assert total(cells)[keys != 0].tolist() == [expected]


@ADDS
def test_a_carry_that_fills_the_word_beside_it_stays_in_its_own_sum(lane_device, defines):
    value = np.zeros((3, planes.MULTIPLE), np.float32)
    # Two work items: whichever comes second carries out of red where green has all bits set.
    value[0, [0, 16]] = 2.0**31
    value[1, [0, 16]] = 2.0**32 - 256.0, 255.0
    zeros = np.zeros(value.shape[1], np.uint32)
    keys, cells, _ = insert(lane_device, zeros, value, 64, 1.0, **defines)
    assert total(cells)[keys != 0].tolist() == [[2**32, 2**32 - 1, 0]]


@pytest.mark.parametrize("slots", [1, 2, 64, 256])
def test_a_full_table_refuses_and_counts(lane_device, slots):
    key, value = samples(8192, 1000)
    steps = hash_map.fixed_point(1e4, len(key))
    u = np.random.default_rng(6).random(value.shape, np.float32) * np.float32(0.999)
    keys, cells, slot = insert(lane_device, key, value, slots, steps, u)
    failed = slot == NO_SLOT
    assert failed.any() and cells["count"].sum() + failed.sum() == len(key)
    assert keys.all()
    check_sums(key, value, u, steps, keys, cells, slot)


def mix_bits(x):
    """Return lowbias32 of Wellons's hash-prospector, uint32."""
    x = x.astype(np.uint32)
    for shift, factor in ((16, 0x7FEB352D), (15, 0x846CA68B)):
        x ^= x >> np.uint32(shift)
        x *= np.uint32(factor)
    return x ^ (x >> np.uint32(16))


def test_which_buckets_overflow_does_not_depend_on_the_order(lane_device):
    """About 64 keys for each bucket of 64: half of the buckets overflow."""
    key = np.arange(16384, dtype=np.uint32)
    value = np.ones((3, len(key)), np.float32)
    bucket = mix_bits(key) % 16384 // 64
    overflowing = np.flatnonzero(np.bincount(bucket, minlength=256) > 64)
    assert 50 < len(overflowing) < 200
    failures = set()
    for seed in range(3):
        order = np.random.default_rng(seed).permutation(len(key))
        _, _, slot = insert(lane_device, key[order], value, 16384, 1.0)
        failed = key[order][slot == NO_SLOT]
        np.testing.assert_array_equal(np.unique(bucket[failed]), overflowing)
        failures.add(tuple(sorted(failed.tolist())))
    # Which keys of these buckets fail does depend on it.
    assert len(failures) > 1


def test_keys_are_found_again_and_others_are_not(lane_device):
    key, value = samples(8192, 3000)
    slots = 8192
    keys = lane_device.allocate("keys", np.uint32, slots)
    cells = lane_device.allocate("cells", layout.CELL.dtype, slots)
    outputs = {"slot": (np.uint32, 1)}
    (slot,) = planes.run(
        lane_device,
        FILE,
        "insert_samples",
        {"key": key, "value": value, "u": np.zeros_like(value)},
        outputs,
        keys=keys,
        cells=cells,
        slots=slots,
        steps=1.0,
    )
    absent = np.arange(5000, 13192, dtype=np.uint32)
    buckets = hash_map.buckets_of(slots)
    full = lane_device.allocate("full", np.uint32, buckets)
    state = {"keys": keys, "full": full, "slots": slots}
    (found,) = planes.run(lane_device, FILE, "find_keys", {"key": key}, outputs, **state)
    (missed,) = planes.run(lane_device, FILE, "find_keys", {"key": absent}, outputs, **state)
    marks = (np.arange(buckets) % 2).astype(np.uint32)
    lane_device.write(full, marks)
    (usable,) = planes.run(lane_device, FILE, "find_keys", {"key": key}, outputs, **state)
    lane_device.release(full)
    lane_device.release(keys, cells)
    np.testing.assert_array_equal(found, slot)
    assert (missed == NO_SLOT).all()
    np.testing.assert_array_equal(usable, np.where(marks[slot // 64], NO_SLOT, slot))


def test_fixed_point_numbers_are_exact_where_they_can_be(lane_device):
    rng = np.random.default_rng(7)
    value = (2.0 ** rng.uniform(-30, 62, 20000)).astype(np.float32)
    value[:4] = [0, 2.0**23, np.nextafter(np.float32(2.0**23), np.float32(0)), 2.0**62]
    low, high = planes.run(
        lane_device,
        FILE,
        "fix_numbers",
        {"value": value, "u": np.zeros_like(value)},
        {"low": (np.uint32, 1), "high": (np.uint32, 1)},
        steps=1.0,
    )
    found = low.astype(np.uint64) + (high.astype(np.uint64) << np.uint64(32))
    np.testing.assert_array_equal(found, np.floor(value.astype(np.float64)).astype(np.uint64))


@pytest.mark.parametrize("samples", [1, 2, 1000, 1 << 20])
@pytest.mark.parametrize("largest", [1e-6, 1.0, 1e12])
def test_no_sum_can_overflow(largest, samples):
    steps = hash_map.fixed_point(largest, samples)
    assert largest * samples * steps <= 2.0**63
    assert largest * samples * steps > 2.0**60
    assert np.log2(steps) == round(np.log2(steps))


def test_tables_are_powers_of_two_with_whole_buckets():
    assert [hash_map.slots_for(n) for n in (0, 1, 2, 3, 64, 65, 1000)] == [
        1,
        1,
        2,
        4,
        64,
        128,
        1024,
    ]
    assert [hash_map.buckets_of(n) for n in (1, 32, 64, 128, 1 << 20)] == [1, 1, 1, 2, 1 << 14]
