"""Starting designs: telescopes and lenses from third-order formulas, as prescriptions to go on from."""
