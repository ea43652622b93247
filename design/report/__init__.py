"""Design report: prescription, first-order data, layout and all analyses of a telescope on one page."""
