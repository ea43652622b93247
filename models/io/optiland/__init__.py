"""Files of optiland (.json), the text of an `Optic`."""
