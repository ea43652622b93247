"""Static and flux-dependent effects of a CCD on images of stars: brighter-fatter effect, tree rings, edge roll-off."""
