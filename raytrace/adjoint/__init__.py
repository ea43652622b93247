"""Exact derivatives by backward passes through the surfaces."""
