"""Design studies: what a telescope does to light in figures, pictures, derivatives, and how to make it better."""
