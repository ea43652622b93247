"""Studies made of many runs: sweeps, baselines, the paper's figures, which model to choose, what each cause does."""
