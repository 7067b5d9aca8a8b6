"""Power diagrams of given generators, and cells with prescribed volumes."""
