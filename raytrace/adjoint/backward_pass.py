"""Backward pass: exact derivatives of outputs of rays by every surface, in reverse mode.

:func:`~pachon.raytrace.adjoint.forward_pass.forward_pass` traces rays to every surface. :func:`backward_pass` takes the
gradient of some outputs with respect to the rays at the last surface (landing points, optical paths to a sphere: any
function of those rays) and carries it back through all surfaces.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import warp as wp

from ...core.launch import launch
from ...core.warp_arrays import warp_array
from ..kernels.packet import LANES, from_packets, lanes
from ..pack.surfaces import pack_surfaces
from .adjoint_matrix import AdjointMatrix, Polynomials, column_count, column_table, polynomial_tables
from .backward_kernels import backward_rays
from .column_kernels import FORCE, GROOVE, INDEX
from .forward_pass import ForwardPass


@dataclass(frozen=True)
class OutputGradient:
    """Derivatives of outputs with respect to the rays at the last surface, telescope frame."""

    position: np.ndarray  #: by the position of each ray [1/m], [n_output, 3, n]
    direction: np.ndarray  #: by its direction, taken as a free vector, [n_output, 3, n]
    path: np.ndarray  #: by the optical path: 1 or 0, [n_output]
    #: By the refractive index before the last surface, where an output depends on that directly, [n_output, n].
    index: np.ndarray | None = None
    own_frame: bool = False  #: outputs are x and y in the frame of the last surface, which then moves with it


def landing_gradient(forward: ForwardPass) -> OutputGradient:
    """Return the gradient of the landing x and y in the frame of the last surface: two outputs [m]."""
    axes = forward.telescope.surfaces[-1].matrix[:, :2].T
    position = np.broadcast_to(axes[:, :, None], (2, 3, forward.n_rays))
    return OutputGradient(position, np.zeros_like(position), np.zeros(2), own_frame=True)


def image_gradient(forward: ForwardPass) -> OutputGradient:
    """Return the gradient of the image x and y of :attr:`~.ForwardPass.image`: two outputs [m]."""
    if not forward.telescope.design_data.afocal:
        return landing_gradient(forward)
    matrix = forward.telescope.surfaces[-1].matrix
    u, v, w = matrix.T @ forward.direction
    # By (u, v, w) of (u, v) / abs(w).
    zero, inverse_w, side = np.zeros_like(w), 1.0 / np.abs(w), np.sign(w)
    local = np.array([[inverse_w, zero, -u * side / w**2], [zero, inverse_w, -v * side / w**2]])
    direction = np.einsum("ij,ojn->oin", matrix, local)
    return OutputGradient(np.zeros_like(direction), direction, np.zeros(2), own_frame=True)


def direction_gradient(forward: ForwardPass) -> OutputGradient:
    """Return the gradient of the direction behind the last surface in the telescope frame: three outputs."""
    direction = np.broadcast_to(np.eye(3)[:, :, None], (3, 3, forward.n_rays))
    return OutputGradient(np.zeros_like(direction), direction, np.zeros(3))


def position_gradient(forward: ForwardPass) -> OutputGradient:
    """Return the gradient of the landing point in the telescope frame: three outputs [m]."""
    position = np.broadcast_to(np.eye(3)[:, :, None], (3, 3, forward.n_rays))
    return OutputGradient(position, np.zeros_like(position), np.zeros(3))


def backward_pass(
    forward: ForwardPass,
    gradient: OutputGradient,
    columns: np.ndarray | None = None,
    *,
    polynomials: Polynomials = (),
    start: bool = False,
    threads: int | None = None,
) -> AdjointMatrix:
    """Carry the gradient of outputs back through all surfaces.

    ``columns`` [n_surface + 1, 15] are those to compute, from :func:`column_table`; all by default. Each of
    ``polynomials`` (surface, scale, degree, columns) adds derivatives by polynomial sags of a surface: the column of
    each term of :func:`polynomial_terms`, -1 for terms left out, with x and y in units of the scale [m]; its "sag" and
    "intersection" must be among the columns. With ``start``, derivatives by the start of the rays are returned too.
    """
    packets, packed = forward.packets, pack_surfaces(forward.telescope)
    outputs, count = len(gradient.path), packets.start.position.shape[2]
    columns = column_table(forward.telescope) if columns is None else columns
    matrix = wp.empty((outputs, column_count(columns, polynomials), count), dtype=lanes, device="cpu")
    at_start = wp.empty((outputs if start else 0, 6, count), dtype=lanes, device="cpu")
    launch(
        backward_rays.variant_for(packed),
        outputs * count,
        [
            packed,
            warp_array(packets.light),
            count,
            packets.start,
            packets.end,
            _zero_filled(gradient.position, count),
            _zero_filled(gradient.direction, count),
            warp_array(gradient.path),
            warp_array(columns, wp.int32),
            *polynomial_tables(columns, polynomials),
            matrix,
            at_start,
        ],
        threads=threads,
    )
    values = from_packets(matrix, forward.n_rays)
    if gradient.index is not None and columns[-2, INDEX] >= 0:
        values[:, columns[-2, INDEX]] += gradient.index
    if gradient.own_frame and columns[-1, FORCE] >= 0:
        # The frame of the outputs moves with the last surface, and so does the gap behind it.
        values[:, columns[-1, FORCE:GROOVE]] = 0.0
    return AdjointMatrix(columns, values, from_packets(at_start, forward.n_rays) if start else None)


def _zero_filled(values: np.ndarray, count: int) -> wp.array:
    """Return derivatives [n_output, 3, n] as packets, the last one filled up with zeros."""
    padded = np.zeros((*values.shape[:2], count * LANES))
    padded[:, :, : values.shape[2]] = values
    return warp_array(padded.reshape(*values.shape[:2], count, LANES), lanes)
