"""Parameter sweeps, on one machine or a cluster."""
