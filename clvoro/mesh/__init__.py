"""What the caller gets, as NumPy arrays: diagrams and results, connectivity, quality, checks."""
