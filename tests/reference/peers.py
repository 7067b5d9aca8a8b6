"""Parts of a domain in the threads of one process: what ranks are on a cluster."""

from __future__ import annotations

import threading

from clvoro.opencl.peers import Peers

WAIT = 60.0
"""Seconds after which a thread that waits for the others gives up."""


class Threads(Peers):
    """The peers of one thread: arrays are handed over between two barriers."""

    shared = True

    def __init__(self, number, count, barrier, table):
        self.number, self.count, self._barrier, self._table = number, count, barrier, table

    def gather(self, values):
        self._table[self.number] = values
        self._barrier.wait(WAIT)
        found = list(self._table)
        self._barrier.wait(WAIT)
        return found

    def exchange(self, sent, sizes=None):
        found = [given[self.number] for given in self.gather(sent)]
        assert sizes is None or [len(rows) for rows in found] == list(sizes)
        return found


def run_parts(count, work):
    """Call ``work(peers)`` in `count` threads, and return the results in their order.

    The first error is raised, or that they wait for each other in vain.
    """
    barrier, table, results, errors = threading.Barrier(count), [None] * count, [None] * count, []

    def run(number):
        try:
            results[number] = work(Threads(number, count, barrier, table))
        except threading.BrokenBarrierError:
            pass
        except BaseException as error:
            errors.append(error)
            barrier.abort()

    threads = [threading.Thread(target=run, args=(number,)) for number in range(count)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    if errors:
        raise errors[0]
    if barrier.broken:
        raise TimeoutError(f"a part waited for others for {WAIT:g} s, expected as many calls of all of them")
    return results
