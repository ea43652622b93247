"""Outputs of a trace whose derivatives are compared with differences."""

from dataclasses import replace

import numpy as np

from pachon.raytrace.adjoint.backward_pass import position_gradient


def position_and_path(forward):
    """Return the gradient of four outputs of each ray: its landing point and its path."""
    gradient = position_gradient(forward)
    n_ray = gradient.position.shape[-1]
    return replace(
        gradient,
        position=np.concatenate([gradient.position, np.zeros((1, 3, n_ray))]),
        direction=np.zeros((4, 3, n_ray)),
        path=np.array([0.0, 0.0, 0.0, 1.0]),
    )
