"""Diagrams copied from the device to NumPy arrays."""
