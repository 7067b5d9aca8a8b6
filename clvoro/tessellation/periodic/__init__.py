"""Diagrams of periodic boxes: ghost images of generators across the seams."""
