"""Products: star fields, shapes, PCA models, correlations, reports and the command line."""
