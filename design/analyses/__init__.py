"""Analyses that optical engineers expect: fans, field curvature, colour, Seidel sums, light, images of targets."""
