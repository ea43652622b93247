"""A telescope as the arrays that the trace kernels read."""
