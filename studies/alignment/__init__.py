"""Active optics in a loop: errors of the telescope, donuts, estimates and corrections, visit by visit."""
