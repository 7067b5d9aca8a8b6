"""The adaptation loop, its methods, and all that moves, inserts or deletes generators."""
