"""The camera: CCDs, their heights, and the focal plane that they make."""
