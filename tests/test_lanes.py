"""Lane arithmetic against NumPy in double precision."""

import numpy as np
import planes
import pytest

F32_MAX = float(np.finfo(np.float32).max)
F32_TINY = float(np.finfo(np.float32).tiny)


def run(device, kernel, inputs, outputs, **arguments):
    return planes.run(device, "lanes_test.cl", kernel, inputs, outputs, **arguments)


def test_sine_and_cosine_of_turns(lane_device):
    eighths = np.arange(9) / 8
    near = np.concatenate(
        [np.nextafter(eighths, 2, dtype=np.float32), np.nextafter(eighths, -1, dtype=np.float32)]
    )
    turns = np.concatenate([np.linspace(0, 1, 20001), eighths, near.clip(0, 1)]).astype(np.float32)
    cosines, sines = run(
        lane_device,
        "turn",
        {"turns": turns},
        {"cosines": (np.float32, 1), "sines": (np.float32, 1)},
    )
    angle = 2 * np.pi * turns.astype(np.float64)
    # A rounding or two of values of at most 1; the series adds less.
    np.testing.assert_allclose(cosines, np.cos(angle), rtol=0, atol=2e-7)
    np.testing.assert_allclose(sines, np.sin(angle), rtol=0, atol=2e-7)
    assert max(abs(cosines).max(), abs(sines).max()) <= 1


def test_angle_of_a_point(lane_device):
    rng = np.random.default_rng(1)
    y, x = rng.normal(size=(2, 20000)) * 10.0 ** rng.uniform(-12, 12, 20000)
    axes = np.array([0, 1, -1, 1e-30, -1e-30, 1e30, -1e30])
    y = np.concatenate([y, np.repeat(axes, len(axes))]).astype(np.float32)
    x = np.concatenate([x, np.tile(axes, len(axes))]).astype(np.float32)
    (angles,) = run(lane_device, "angle_of", {"y": y, "x": x}, {"angles": (np.float32, 1)})
    expected = np.arctan2(y.astype(np.float64), x.astype(np.float64))
    np.testing.assert_allclose(angles, expected, rtol=0, atol=6e-7)


@pytest.mark.parametrize("size", [F32_TINY, 1e-30, 1e-18, 1.0, 1e18, 1e30, F32_MAX / 4])
def test_vectors_of_every_length_become_unit(lane_device, size):
    v = np.random.default_rng(2).uniform(-1, 1, (3, 4096))
    # The longest component stays a normal number.
    v = (v / abs(v).max(axis=0) * size).astype(np.float32)
    (unit,) = run(lane_device, "normalize_vectors", {"v": v}, {"units": (np.float32, 3)})
    exact = v.astype(np.float64)
    expected = exact / np.linalg.norm(exact, axis=0)
    np.testing.assert_allclose(unit, expected, rtol=0, atol=3e-7)


def test_neighbours_of_very_different_length_become_unit(lane_device):
    rng = np.random.default_rng(6)
    v = rng.normal(size=(3, 20000))
    # Each vector, and each component of half of them, of its own order of magnitude; none vanishes.
    v *= 2.0 ** rng.uniform(-80, 120, 20000)
    v[:, ::2] *= 2.0 ** rng.uniform(-40, 0, (3, 10000))
    v = v.astype(np.float32)
    # Of the first work items all lanes are of usual length: nothing to scale.
    v[:, :64] = rng.normal(size=(3, 64))
    (unit,) = run(lane_device, "normalize_vectors", {"v": v}, {"units": (np.float32, 3)})
    exact = v.astype(np.float64)
    np.testing.assert_allclose(unit, exact / np.linalg.norm(exact, axis=0), rtol=0, atol=3e-7)


@pytest.mark.parametrize("error", [0.0, 1e-6, 1e-4])
def test_lengths_that_rounding_changed_become_one(lane_device, error):
    rng = np.random.default_rng(7)
    v = rng.normal(size=(3, 4096))
    v *= (1 + error * rng.uniform(-1, 1, 4096)) / np.linalg.norm(v, axis=0)
    v = v.astype(np.float32)
    (unit,) = run(lane_device, "renormalize_vectors", {"v": v}, {"units": (np.float32, 3)})
    exact = v.astype(np.float64)
    # Newton's step leaves 3/2 of the square of the error, and its own roundings.
    atol = 2e-7 + 1.5 * error**2
    np.testing.assert_allclose(unit, exact / np.linalg.norm(exact, axis=0), rtol=0, atol=atol)


def test_vectors_without_direction_become_the_z_axis(lane_device):
    inf, subnormal = np.inf, 1e-41
    v = np.array(
        [[0, 0, 0], [inf, 0, 0], [-1, inf, 2], [inf, -inf, inf], [subnormal, 0, -subnormal]],
        np.float32,
    ).T
    (unit,) = run(lane_device, "normalize_vectors", {"v": v}, {"units": (np.float32, 3)})
    np.testing.assert_array_equal(unit, np.tile([[0], [0], [1]], v.shape[1]))


def test_frames_are_orthonormal_and_right_handed(lane_device):
    n = np.random.default_rng(3).normal(size=(3, 20000))
    # The construction is delicate where n.z is near -1 and jumps where it is 0.
    n[:2, :2000] *= 10.0 ** -np.linspace(0, 9, 2000)
    n[2, :2000] = -1
    n[2, 2000:3000] = 0
    n = np.concatenate([n, np.vstack([np.eye(3), -np.eye(3)]).T, [[0.6], [0.8], [-0.0]]], axis=1)
    n = (n / np.linalg.norm(n, axis=0)).astype(np.float32)
    s, t = run(lane_device, "frame_of", {"n": n}, {"s": (np.float32, 3), "t": (np.float32, 3)})
    n, s, t = (v.astype(np.float64) for v in (n, s, t))
    for a, b, product in ((s, s, 1), (t, t, 1), (s, t, 0), (s, n, 0), (t, n, 0)):
        np.testing.assert_allclose((a * b).sum(axis=0), product, rtol=0, atol=1e-6)
    np.testing.assert_allclose(np.cross(s, t, axis=0), n, rtol=0, atol=1e-6)


def test_masks_count_rank_and_pick(lane_device):
    lanes = lane_device.traits.lanes
    rng = np.random.default_rng(4)
    # Whole work items of no lane, all lanes, each single lane, and at random.
    blocks = [np.zeros(16), np.ones(16), *np.eye(16), *(rng.random((300, 16)) < 0.5)]
    flags = (np.concatenate(blocks) * 7).astype(np.uint32)
    then = rng.normal(size=len(flags)).astype(np.float32)
    otherwise = np.full(len(flags), np.nan, np.float32)
    uint, float32 = (np.uint32, 1), (np.float32, 1)
    counts, ranks, some, inverted, picked, bits, vectors = run(
        lane_device,
        "mask_lanes",
        {"flags": flags, "then": then, "otherwise": otherwise},
        {
            "counts": uint,
            "ranks": uint,
            "some": uint,
            "inverted": uint,
            "picked": float32,
            "picked_bits": uint,
            "picked_vectors": (np.float32, 3),
        },
    )
    on = (flags != 0).reshape(-1, lanes)
    count = on.sum(axis=1, keepdims=True)
    rank = np.cumsum(on, axis=1) - on
    np.testing.assert_array_equal(counts.reshape(-1, lanes), np.broadcast_to(count, on.shape))
    np.testing.assert_array_equal(
        inverted.reshape(-1, lanes), np.broadcast_to(lanes - count, on.shape)
    )
    np.testing.assert_array_equal(ranks.reshape(-1, lanes), rank)
    np.testing.assert_array_equal(some.reshape(-1, lanes), np.broadcast_to(count > 0, on.shape))
    on = on.ravel()
    np.testing.assert_array_equal(picked, np.where(on, then, otherwise))
    np.testing.assert_array_equal(bits, picked.view(np.uint32))
    swapped = np.where(on, otherwise, then)
    np.testing.assert_array_equal(vectors, [picked, swapped, picked])


def masks(lanes):
    """Return flags of whole work items: no lane, all, each single one, and at random."""
    rng = np.random.default_rng(8)
    blocks = [np.zeros(16), np.ones(16), *np.eye(16), *(rng.random((300, 16)) < 0.5)]
    flags = np.concatenate(blocks).astype(np.uint32)
    return flags, (flags != 0).reshape(-1, lanes)


def test_bits_of_a_mask_are_its_lanes_and_lead_back(lane_device):
    lanes = lane_device.traits.lanes
    flags, on = masks(lanes)
    outputs = {"bits": (np.uint32, 1), "back": (np.uint32, 1)}
    bits, back = run(lane_device, "mask_bits", {"flags": flags}, outputs)
    expected = (on << np.arange(lanes)).sum(axis=1, keepdims=True)
    np.testing.assert_array_equal(bits.reshape(-1, lanes), np.broadcast_to(expected, on.shape))
    np.testing.assert_array_equal(back, flags)


def test_least_of_all_lanes(lane_device):
    lanes = lane_device.traits.lanes
    x = np.random.default_rng(9).normal(size=4096).astype(np.float32)
    # The least in each lane once, an infinite one, one of its own sign.
    x[: 16 * 16].reshape(16, 16)[np.arange(16), np.arange(16)] = -10
    x[512], x[600], x[640:672] = -np.inf, np.inf, np.abs(x[640:672])
    (least,) = run(lane_device, "least_of", {"x": x}, {"least": (np.float32, 1)})
    expected = np.repeat(x.reshape(-1, lanes).min(axis=1), lanes)
    np.testing.assert_array_equal(least, expected)


def test_gathers_read_every_lane_of_its_own_index(lane_device):
    rng = np.random.default_rng(5)
    table = rng.integers(0, 2**32, (1000, 2), np.uint32)
    table[:, 0] = rng.normal(size=1000).astype(np.float32).view(np.uint32)
    indices = rng.integers(0, 1000, 4096, np.uint32)
    buffer = lane_device.upload("entries", table.view(np.float32))
    values, numbers, words = run(
        lane_device,
        "gather_entries",
        {"indices": indices},
        {"values": (np.float32, 1), "numbers": (np.uint32, 1), "words": (np.uint32, 1)},
        entries=buffer,
    )
    lane_device.release(buffer)
    np.testing.assert_array_equal(values.view(np.uint32), table[indices, 0])
    np.testing.assert_array_equal(numbers, table[indices, 1])
    np.testing.assert_array_equal(words, table.ravel()[indices])
