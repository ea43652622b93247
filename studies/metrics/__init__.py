"""Metrics of telescopes, focal planes and PSFs, for baselines and sweeps."""
