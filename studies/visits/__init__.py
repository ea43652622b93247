"""Many visits to one patch of sky: rolls and dithers, PSFs of the stack, null test."""
