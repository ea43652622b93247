"""Rays in packets: memory that goes on to whole packets is not copied, and no ray depends on what fills it up."""

import numpy as np
import pytest

import pachon
from pachon.raytrace.kernels.packet import LANES, to_packets, whole_packets
from pachon.raytrace.rays import Rays

N = 3 * LANES + 5


def test_values_with_room_for_whole_packets_are_not_copied():
    for shape in ((), (3,), (2, 3)):
        values = whole_packets(shape, N)
        values[...] = np.arange(N)
        packets = to_packets(values)
        assert packets.shape == (*shape, 4, LANES)
        assert np.shares_memory(packets, values)
        assert packets.flags.c_contiguous
        np.testing.assert_array_equal(packets.reshape(*shape, -1)[..., :N], values)


@pytest.mark.parametrize(
    "values",
    [
        np.arange(3.0 * N).reshape(3, N),
        np.arange(3.0 * N).reshape(3, N)[1:],
        np.arange(6.0 * N).reshape(3, 2 * N)[:, :N],
        np.arange(6.0 * N).reshape(3, 2 * N)[:, ::2],
        np.arange(8.0 * LANES).reshape(2, -1)[:, LANES : LANES + N - LANES],
        np.arange(4 * LANES).reshape(1, -1)[:, :N],
        np.arange(N + LANES, dtype=float)[LANES:],
    ],
    ids=["no room", "rows", "other room", "steps", "room ends early", "integers", "end of memory"],
)
def test_other_values_are_copied_and_filled_up_with_the_last(values):
    n = values.shape[-1]
    packets = to_packets(values)
    filled = packets.reshape(*values.shape[:-1], -1)
    np.testing.assert_array_equal(filled[..., :n], values)
    np.testing.assert_array_equal(filled[..., n:], np.repeat(values[..., -1:], -n % LANES, axis=-1))


def test_rays_do_not_depend_on_what_fills_up_their_packets():
    telescope = pachon.load_telescope("lsst_v3.3_r")
    angle = np.linspace(0.0, 6.0, N)
    rays = pachon.launch_rays(telescope, (0.01, 0.02), 620e-9, (3.5 * np.cos(angle), 3.5 * np.sin(angle)))
    assert np.shares_memory(to_packets(rays.position.T[None]), rays.position)
    rays.position.base[..., N:] = rays.direction.base[..., N:] = rays.path_length.base[N:] = np.nan
    copied = Rays(rays.position.copy(), rays.direction.copy(), rays.path_length.copy(), rays.wavelength)
    ends = [pachon.trace(telescope, r, threads=t) for r, t in ((rays, 1), (copied, 2))]
    for name in ("position", "direction", "path_length", "status"):
        np.testing.assert_array_equal(*(getattr(end, name) for end in ends))
