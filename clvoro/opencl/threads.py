"""The parts of a domain in the threads of one process: each has a device of its own."""

from __future__ import annotations

import queue
import threading
from collections.abc import Callable, Sequence
from typing import Any, TypeAlias, TypeVar

import numpy as np
from numpy.typing import ArrayLike

from ..arguments import WARNING, warn
from ..errors import RankError
from .peers import Peers, Swap

Made = TypeVar("Made")
_Calls: TypeAlias = "queue.SimpleQueue[Callable[[], object] | None]"


class _Table:
    """Hands over objects among threads, in rounds. In each round a thread gives one object, and waits for all others.

    Each round has a list of its own, since threads of earlier rounds may still read theirs.
    """

    def __init__(self, count: int) -> None:
        self._places, self._changed = [None] * count, threading.Condition()
        self._there = self._rounds = 0
        self._closed = ""
        self._calls: dict[int, Any] = {}

    def hand_over(self, number: int, given: Any, count: int) -> list[Any]:
        """Give an object as thread `number`, and return the objects of the first `count` threads in their order.

        Raises `RankError` if the table has been closed.
        """
        with self._changed:
            turn = self._rounds
            places: list[Any] = self._places
            if not self._closed:
                places[number] = given
                self._there += 1
                if self._there == count:
                    self._there, self._rounds, self._places = 0, turn + 1, [None] * len(places)
                    self._changed.notify_all()
                self._changed.wait_for(lambda: self._rounds > turn or self._closed)
            if self._rounds == turn:
                raise RankError(self._closed)
        return list(places[:count])

    def call(self, number: int, message: Any) -> None:
        """Let thread `number`, which has no work, return from `rest` with `message`."""
        with self._changed:
            self._calls[number] = message
            self._changed.notify_all()

    def rest(self, number: int) -> Any:
        """Wait until thread `number` is called, and return its message. Raises RankError as `hand_over`."""
        with self._changed:
            self._changed.wait_for(lambda: number in self._calls or self._closed)
            if number not in self._calls:
                raise RankError(self._closed)
            return self._calls.pop(number)

    def close(self, why: str) -> None:
        """Let threads that wait, and all that come later, raise an error. The first reason counts."""
        with self._changed:
            self._closed = self._closed or why
            self._changed.notify_all()


class Threads(Peers):
    """The parts of a domain in the threads of a `Team`, as one of them sees them."""

    shared = True

    def __init__(self, team: Team, number: int, count: int) -> None:
        self.team, self.number, self.size = team, number, count
        self.lead(count)

    def begin(self, table: _Table, calls: _Calls) -> None:
        """Begin to work with the others at `table`. The thread that waits for all of them takes the `calls`."""
        self._table, self._calls = table, calls
        self.lead(self.size)

    def end(self) -> None:
        """Let threads that still wait for this one raise an error."""
        self._table.close(f"part {self.number} of {self.size} has ended, and others wait for it")

    def gather(self, values: np.ndarray) -> list[np.ndarray]:
        """Hand over a copy, so that this part may write to `values` again. The arrays are read-only."""
        self.reductions += 1
        own = np.array(values)
        own.setflags(write=False)
        return self._table.hand_over(self.number, own, self.count)

    def exchange(self, sent: Sequence[np.ndarray], sizes: ArrayLike | None = None) -> list[np.ndarray]:
        """Hand over copies of the arrays."""
        self.exchanges += 1
        given = self._table.hand_over(self.number, [np.array(values) for values in sent], self.count)
        return [arrays[self.number] for arrays in given]

    def swap(self, rows: Swap, values: np.ndarray | None = None) -> list[np.ndarray]:
        """Hand over copies of the rows for each part, and of `values`."""
        self.exchanges += 1
        self.reductions += values is not None
        sent = np.split(np.array(rows.sent), np.cumsum(rows.sent_sizes)[:-1])
        given = sent, None if values is None else np.array(values)
        arrays, found = zip(*self._table.hand_over(self.number, given, self.count), strict=True)
        np.concatenate([pieces[self.number] for pieces in arrays], out=rows.received)
        return [] if values is None else list(found)

    def fail(self, error: BaseException) -> None:
        """Let all calls of other threads, and further ones of this thread, raise an error."""
        self._table.close(f"part {self.number} of {self.size} has failed: {type(error).__name__}: {error}")

    def _call(self, parts: range, message: object) -> None:
        for number in parts:
            self._table.call(number, message)

    def _await_call(self) -> Any:
        return self._table.rest(self.number)

    def ask(self, call: Callable[[], object]) -> Any:
        """Return the result of `call` in the thread that waits for the team, or raise its error; None after Ctrl-C."""
        answers: queue.SimpleQueue[tuple[object, BaseException | None]] = queue.SimpleQueue()

        def answer() -> None:
            try:
                answers.put((call(), None))
            except KeyboardInterrupt:
                self.team.interrupt()
                answers.put((None, None))
            except BaseException as error:
                answers.put((None, error))

        self._calls.put(answer)
        made, error = answers.get()
        if error is not None:
            raise error
        return made


class Team:
    """Threads, one for each part, that do their work together.

    - `count`: number of threads.

    Its attributes:
    - `peers`: the parts of the domain as each thread sees them.
    - `interrupted`: whether the user has pressed Ctrl-C since they began to work.
    """

    def __init__(self, count: int) -> None:
        self.peers = tuple(Threads(self, number, count) for number in range(count))
        self.interrupted = False
        self._errors: list[BaseException] = []

    def interrupt(self) -> None:
        """Note that the user has pressed Ctrl-C; if it is for the second time, end the work."""
        if self.interrupted:
            self._errors.insert(0, KeyboardInterrupt())
            self.peers[0].fail(self._errors[0])
        self.interrupted = True

    def run(self, work: Callable[[Threads], Made]) -> list[Made]:
        """Call `work` in all threads, and return the results in their order.

        Warnings of the first part are given in the thread that calls this. The others have the same ones, which are
        left out. After Ctrl-C `interrupted` is True, and `work` should end soon; a second Ctrl-C ends it.

        Raises the first error of a thread after all threads have ended. A `RankError` is raised only
        if there is no other error.
        """
        calls: _Calls = queue.SimpleQueue()
        table, results = _Table(len(self.peers)), [None] * len(self.peers)

        def run(peers: Threads) -> None:
            WARNING.set((lambda *given: peers.ask(lambda: warn(*given))) if peers.number == 0 else lambda *_: None)
            try:
                results[peers.number] = work(peers)  # type: ignore[call-overload]
                peers.end()
            except BaseException as error:
                self._errors.append(error)
                peers.fail(error)
            calls.put(None)

        self.interrupted, self._errors = False, []
        for peers in self.peers:
            peers.begin(table, calls)
        threads = [threading.Thread(target=run, args=(peers,), daemon=True) for peers in self.peers]
        for thread in threads:
            thread.start()
        at_work = len(threads)
        while at_work:
            try:
                call = calls.get()
                if call is None:
                    at_work -= 1
                else:
                    call()
            except KeyboardInterrupt:
                self.interrupt()
        if self._errors:
            raise next((error for error in self._errors if not isinstance(error, RankError)), self._errors[0])
        return results  # type: ignore[return-value]
