"""Domains, their boundaries, shapes, surfaces, boundary layers, and readers of geometry files."""
