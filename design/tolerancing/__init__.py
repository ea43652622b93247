"""Tolerancing: criteria, merits of deviations with compensators, Monte Carlo, yields."""
