"""A telescope as arrays for the trace kernels."""
