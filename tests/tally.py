"""Count the commands of a queue."""

from collections import Counter

from clvoro.opencl.hooks import MEMORY


class Tally:
    """A watcher of `hooks` that counts commands, and their bytes if known, per stage and kernel."""

    def __init__(self):
        self.calls, self.bytes = Counter(), Counter()

    def __call__(self, event, stage, name, moved, done=False):
        self.calls[stage, name] += 1
        self.bytes[stage, name] += moved or 0

    @property
    def launches(self):
        """Number of commands that work on the device: kernels, copies and fills."""
        return sum(self.calls.values()) - self.reads - self.writes

    @property
    def reads(self):
        return self.calls[MEMORY, "read"]

    @property
    def writes(self):
        return self.calls[MEMORY, "write"]

    @property
    def bytes_read(self):
        return self.bytes[MEMORY, "read"]
