"""The YAML format of prescriptions."""
