"""Parameters of a telescope: single ones, degrees of freedom, tolerances, temperature."""
