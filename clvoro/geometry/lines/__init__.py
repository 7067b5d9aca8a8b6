"""Lines inside a domain in 2D, and the generators beside them."""
