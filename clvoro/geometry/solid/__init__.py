"""The solid: a domain in space whose boundary is a triangulated surface."""
