"""Design studies: metrics, images, derivatives, optimisation and their plots."""
