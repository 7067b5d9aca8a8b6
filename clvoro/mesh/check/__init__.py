"""Verification of meshes on the host, from their arrays alone."""
