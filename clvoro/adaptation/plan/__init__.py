"""The plan of a run: which actions, how many of each effort, in which order."""
