"""The parts of a domain as one of them sees them: alone, or as one of the ranks of MPI."""

from __future__ import annotations

import json
import math
import os
import time
from collections.abc import Callable, Mapping, Sequence
from itertools import zip_longest
from typing import Any, NamedTuple, TypeVar, cast

import numpy as np
from numpy.typing import ArrayLike

from ..errors import InputError, InputTypeError, RankError
from ..version import __version__

Made = TypeVar("Made")
PATIENCE, NAPS = 2, (1e-4, 2e-3)
"""A rank that waits for a message first asks for it `PATIENCE` times without a pause. Then it sleeps before each
question, since there may be more ranks than cores: for as long as it has already waited, within the limits `NAPS` in
seconds. To fall asleep and to wake up takes some 30 microseconds of processor time."""
REST = 0.02
"""Seconds for which a rank without work sleeps before it asks again whether there is some."""
FEW = 32
"""Largest number of ranks that send an array to each other directly. MPI's own algorithm has several rounds, and a rank
that sleeps delays each of them."""
ALARM, CLOSE, CLOSED, CALL = 1, 2, 3, 4
"""Tags of messages: a rank has failed, rank 0 sends the exit code, another rank has received it, rank 0 has work."""
GRACE = 1.0
"""Seconds for which rank 0 waits for answers to the exit code, where each process has a core. The others wait 1.5 times
as long for the code."""


class Swap(NamedTuple):
    """An array with the rows that a part sends, and one for the rows that it receives, both in the order of parts."""

    sent: np.ndarray
    sent_sizes: np.ndarray
    """(p,) int. Number of rows for each part."""
    received: np.ndarray
    sizes: np.ndarray
    """(p,) int. Number of rows from each part."""


class Peers:
    """The parts of a domain as one of them sees them. All of them call the same methods in the same order.

    This class stands for a domain in one part. Subclasses connect several parts: they replace `exchange`, `gather`,
    `_call` and `_await_call`.

    While a mesh has few cells, only the first parts work (`lead`). The others are alone, and rest until part 0 calls
    them.

    - `number`, `count`, `size`: number of this part; number of parts that work together, 1 if this part rests; number
      of all parts.
    - `rests`: whether this part has no work.
    - `shared`: whether the run is one over ranks, be it a single one. The faces of a cell are then in the order of the
      permanent numbers of its neighbors.
    - `gathers`: whether this part gathers the mesh of all parts at the end of each run.
    - `exchanges`, `reductions`, `waits`: how often this part has exchanged arrays, gathered values and waited so far.
      `swap` counts as an exchange, and with `values` as a gather, too.
    """

    number, count, size, shared, gathers, rests = 0, 1, 1, False, False, False
    exchanges = reductions = waits = 0

    def exchange(self, sent: Sequence[np.ndarray], sizes: ArrayLike | None = None) -> list[np.ndarray]:
        """Send array k to part k, and return what each part has sent to this one, in the order of parts.

        Arrays may differ in their number of rows. If all parts know how many rows they receive from each part, they
        give these numbers as `sizes` (p,), which saves a message.
        """
        return list(sent)

    def swap(self, rows: Swap, values: np.ndarray | None = None) -> list[np.ndarray]:
        """Send and receive `rows`. With `values` also return what `gather` returns; parts wait only once for both."""
        found = self.exchange(np.split(rows.sent, np.cumsum(rows.sent_sizes)[:-1]), rows.sizes)
        np.concatenate(found, out=rows.received)
        return [] if values is None else self.gather(values)

    def gather(self, values: np.ndarray) -> list[np.ndarray]:
        """Return the `values` of all parts, arrays of one shape, in their order."""
        return [values]

    def total(self, values: Any) -> np.ndarray:
        """Return the sum of `values` over all parts, in the order of parts."""
        values = np.asarray(values)
        return values if self.count == 1 else np.sum(self.gather(values), axis=0)

    def before(self, values: Any) -> np.ndarray:
        """Return the sum of `values` over the parts before this one."""
        values = np.asarray(values)
        return sum(self.gather(values)[: self.number], np.zeros_like(values))

    def any(self, condition: bool) -> bool:
        """Return whether `condition` holds in any part."""
        return condition if self.count == 1 else bool(self.total(np.array(condition, np.int32)))

    def collect(self, values: np.ndarray) -> list[np.ndarray]:
        """Return the `values` of all parts on part 0, and [] on the others. Numbers of rows may differ."""
        found = self.exchange([values if part == 0 else values[:0] for part in range(self.count)])
        return found if self.number == 0 else []

    def gather_text(self, text: str) -> list[str]:
        """Return the `text` of each part, in their order."""
        found = self.exchange([np.frombuffer(text.encode(), np.uint8)] * self.count)
        return [sent.tobytes().decode() for sent in found]

    def agree(
        self, prepare: Callable[[], Made], describe: Callable[[Made], Mapping[str, object]] = lambda _: {}
    ) -> Made:
        """Call `prepare` in all parts, check that they agree, and return the result of this part.

        `describe` names values of the result. They must be the same in all parts, and so must the version of clvoro.

        Raises `InputError` on part 0, if values differ; the message names the first one. Raises `RankError` on the
        other parts, if values differ; or if `prepare` has raised an error in another part.
        """
        if self.count == 1:
            return prepare()
        error, made, told = None, None, {"version": __version__}
        try:
            made = prepare()
            told |= {name: str(value) for name, value in describe(made).items()}
        except Exception as caught:
            error, told["error"] = caught, f"{type(caught).__name__}: {caught}"
        found = [json.loads(text) for text in self.gather_text(json.dumps(told))]
        if error is not None:
            raise error
        for number, other in enumerate(found):
            if "error" in other:
                raise RankError(f"rank {number} of {self.count} has failed: {other['error']}")
        for number, other in enumerate(found):
            for name in {**found[0], **other}:
                if (expected := found[0].get(name)) == (value := other.get(name)):
                    continue
                lines = zip_longest(str(value).splitlines(), str(expected).splitlines())
                value, expected = next((pair for pair in lines if pair[0] != pair[1]), (value, expected))
                where = f"rank {number} of {self.count} has {name} = {value!s:.200}, expected {expected!s:.200},"
                if self.number:
                    raise RankError(f"{where} as rank 0 has")
                raise InputError(
                    f"{where} as rank 0 has; give all ranks the same arguments and the same version of clvoro"
                )
        return cast("Made", made)

    def lead(self, count: int) -> None:
        """Let only the first `count` parts work together from now on. All parts do this at the same time."""
        self.rests = self.number >= count
        self.count = 1 if self.rests else count

    def call(self, count: int, message: object) -> None:
        """Let the first `count` parts work together from now on. Those that work do this at the same time.

        The others among them return from `rest` with `message` of part 0.
        """
        if self.number == 0:
            self._call(range(self.count, count), (count, message))
        self.lead(count)

    def rest(self) -> Any:
        """Wait for a `call` of this part, and return its message."""
        count, message = self._await_call()
        self.lead(count)
        return message

    def _call(self, parts: range, message: object) -> None:
        """Send `message` to `parts` that rest."""

    def _await_call(self) -> Any:
        """Return the message of part 0 to this part, which rests."""

    def fail(self, error: BaseException) -> None:
        """Tell the others that this part has failed. Those that wait for a message raise a `RankError`."""

    def close(self, code: int) -> None:
        """On part 0: send the exit `code` to the others. If one of them does not answer, end all processes."""

    def await_close(self) -> int | None:
        """On the other parts: return the exit code of part 0, or None if none arrives in time."""
        return None

    def abort(self, code: int) -> None:
        """End the processes of all parts."""


ALONE = Peers()


class Ranks(Peers):
    """The ranks of an MPI communicator. It is duplicated, so all of its ranks create this object together.

    Raises `InputTypeError` if `comm` is no communicator.
    """

    shared = True

    def __init__(self, comm: Any) -> None:
        if not (hasattr(comm, "Dup") and hasattr(comm, "Iallgather")):
            raise InputTypeError(
                f"comm is {comm!r:.60} of type {type(comm).__name__}, expected a communicator of mpi4py; write "
                "comm=MPI.COMM_WORLD after `from mpi4py import MPI`, with `pip install clvoro[mpi]`"
            )
        self._comm, self._alarms = comm.Dup(), comm.Dup()
        self.number, self.size = comm.Get_rank(), comm.Get_size()
        self.count, self._failed = self.size, ""

    def exchange(self, sent: Sequence[np.ndarray], sizes: ArrayLike | None = None) -> list[np.ndarray]:
        """Send the numbers of rows, unless all ranks know theirs, and then the rows."""
        self.exchanges += 1
        own, counts = sent[self.number], np.array([len(values) for values in sent], np.int64)
        others, found = [part for part in range(self.count) if part != self.number], counts.copy()
        told: list[Any] = []
        if sizes is not None:
            found[:] = sizes
        elif self.count == self.size > FEW:
            told = [self._comm.Ialltoall(counts, found)]
        else:
            told = [self._comm.Irecv(found[part : part + 1], part) for part in others]
            told += [self._comm.Isend(counts[part : part + 1], part) for part in others]
        # The rows are on their way while the numbers arrive.
        packed = {part: np.ascontiguousarray(sent[part]) for part in others if len(sent[part])}
        requests = [self._comm.Isend(_bytes(values), part) for part, values in packed.items()]
        if told:
            self._complete(told)
        received = [np.empty((int(size), *own.shape[1:]), own.dtype) for size in found]
        received[self.number] = own
        requests += [self._comm.Irecv(_bytes(received[part]), part) for part in others if found[part]]
        self._complete(requests)
        return received

    def swap(self, rows: Swap, values: np.ndarray | None = None) -> list[np.ndarray]:
        """Send and receive slices of both arrays."""
        self.exchanges += 1
        requests, row = [], rows.sent.dtype.itemsize * math.prod(rows.sent.shape[1:])
        sends = rows.sent, rows.sent_sizes, self._comm.Isend
        for array, counts, begin in ((rows.received, rows.sizes, self._comm.Irecv), sends):
            buffer, ends = _bytes(array), np.cumsum(counts) * row
            requests += [
                begin(buffer[end - row * size : end], part)
                for part, (end, size) in enumerate(zip(ends.tolist(), counts.tolist(), strict=True))
                if size
            ]
        found, more = ([], []) if values is None else self._begin_gather(values)
        self._complete(requests + more)
        return list(found)

    def gather(self, values: np.ndarray) -> list[np.ndarray]:
        """Collect one array of each rank on all of them."""
        found, requests = self._begin_gather(values)
        self._complete(requests)
        return list(found)

    def _begin_gather(self, values: np.ndarray) -> tuple[np.ndarray, list[Any]]:
        """Return the array that gets the `values` of all ranks, and the requests to be completed."""
        self.reductions += 1
        values = np.asarray(values, order="C")
        found = np.empty((self.count, *values.shape), values.dtype)
        own, rows = _bytes(values), _bytes(found).reshape(self.count, values.nbytes)
        if self.count == self.size > FEW:
            return found, [self._comm.Iallgather(own, rows)]
        found[self.number] = values
        others = [part for part in range(self.count) if part != self.number]
        requests = [self._comm.Irecv(rows[part], part) for part in others]
        return found, requests + [self._comm.Isend(own, part) for part in others]

    def _complete(self, requests: list[Any]) -> None:
        """Wait for `requests`, unless a rank fails."""
        if self._failed:
            raise RankError(self._failed)
        self.waits += 1
        turns, began, waited = 0, time.perf_counter(), 0.0
        while requests and not requests[0].Testall(requests):
            turns += 1
            if turns > PATIENCE:
                self._hear_alarm()
                time.sleep(min(max(waited, NAPS[0]), NAPS[1]))
                waited = time.perf_counter() - began

    def _hear_alarm(self) -> None:
        """Raise an error if another rank has failed."""
        if self._alarms.Iprobe(tag=ALARM):
            self._failed = self._alarms.recv(tag=ALARM)
            raise RankError(self._failed)

    def _call(self, parts: range, message: object) -> None:
        self._complete([self._alarms.isend(message, part, CALL) for part in parts])

    def _await_call(self) -> Any:
        """Ask now and then whether rank 0 has sent something."""
        while not self._alarms.Iprobe(0, CALL):
            self._hear_alarm()
            time.sleep(REST)
        return self._alarms.recv(source=0, tag=CALL)

    def fail(self, error: BaseException) -> None:
        """Send the text of `error` to all other ranks."""
        if self._failed:
            return
        self._failed = f"rank {self.number} of {self.size} has failed: {type(error).__name__}: {error}"
        for part in range(self.size):
            if part != self.number:
                self._alarms.isend(self._failed, part, ALARM)

    def close(self, code: int) -> None:
        """Send `code` to the others, and wait for their answers."""
        for part in range(1, self.size):
            self._alarms.isend(code, part, CLOSE)
        for part in range(1, self.size):
            if self._hear(part, CLOSED, GRACE) is None:
                self.abort(code)

    def await_close(self) -> int | None:
        """Wait for the code, and answer."""
        code = self._hear(0, CLOSE, 1.5 * GRACE)
        if code is not None:
            self._alarms.isend(code, 0, CLOSED)
        return code

    def abort(self, code: int) -> None:
        """End all processes that `mpiexec` has started."""
        self._comm.Abort(code)

    def _hear(self, part: int, tag: int, seconds: float) -> int | None:
        """Return the number that `part` sends, or None if it does not send one in time.

        Where more processes work than there are cores, they get more time.
        """
        load = os.getloadavg()[0] if hasattr(os, "getloadavg") else 0.0
        latest = time.monotonic() + seconds * max(load / (os.cpu_count() or 1), 1)
        while not self._alarms.Iprobe(part, tag):
            if time.monotonic() > latest:
                return None
            time.sleep(NAPS[1])
        return int(self._alarms.recv(source=part, tag=tag))


def peers_of(comm: object) -> Peers:
    """Return the ranks of `comm`, a communicator of mpi4py, as `Peers`. `Peers` are returned as they are.

    None stands for a domain in one part. All ranks call this together.

    Raises `InputTypeError` if `comm` is something else.
    """
    return ALONE if comm is None else comm if isinstance(comm, Peers) else Ranks(comm)


def _bytes(values: np.ndarray) -> np.ndarray:
    return values.reshape(-1).view(np.uint8)
