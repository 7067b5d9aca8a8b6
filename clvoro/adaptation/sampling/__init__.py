"""How many generators a run needs, and where they start."""
