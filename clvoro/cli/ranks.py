"""Commands under `mpiexec`: the rank of this process, and how all ranks end with one message and one exit code."""

from __future__ import annotations

import os
import sys
from collections.abc import Callable

from ..errors import InputError, MissingLibraryError
from ..opencl.peers import ALONE, Peers, Ranks

_COUNTS, _NUMBERS = ("PMI_SIZE", "OMPI_COMM_WORLD_SIZE"), ("PMI_RANK", "OMPI_COMM_WORLD_RANK", "PMIX_RANK")
"""Variables that MPICH, Open MPI and Slurm set in the processes that they start."""


def _set_in_environment(names: tuple[str, ...], default: int) -> int:
    values = [os.environ.get(name, "") for name in names]
    return next((int(value) for value in values if value.isdecimal()), default)


def may_speak() -> bool:
    """Return whether this process may print: under `mpiexec` only rank 0 does."""
    return _set_in_environment(_NUMBERS, 0) == 0


def this_rank() -> Peers:
    """Return the ranks that share this command; `ALONE` without `mpiexec`.

    MPI is loaded only if `mpiexec`, or ``python -m mpi4py``, has started the process.

    Raises `MissingLibraryError` if `mpiexec` has started several processes, and mpi4py is not installed. Raises
    `InputError` if mpi4py belongs to another MPI than `mpiexec`.
    """
    count = _set_in_environment(_COUNTS, 1)
    if count == 1 and "mpi4py.MPI" not in sys.modules and "PMIX_RANK" not in os.environ:
        return ALONE
    try:
        from mpi4py import MPI
    except ImportError as error:
        raise MissingLibraryError(
            f"mpiexec has started {count} processes, and mpi4py, with which they share a run, is not installed "
            f"({error}); run `pip install 'clvoro[mpi]'`, or call clvoro without mpiexec"
        ) from error
    ranks = Ranks(MPI.COMM_WORLD)
    if ranks.count == 1 and count > 1:
        raise InputError(
            f"mpiexec has started {count} processes, but mpi4py belongs to another MPI and sees 1 of them; use the "
            f"mpiexec of that MPI ({MPI.Get_library_version():.40}), or build mpi4py for this one: "
            "pip install --force-reinstall --no-binary mpi4py mpi4py"
        )
    return ranks if ranks.count > 1 else ALONE


def end_together(peers: Peers, code: int, show: Callable[[], object]) -> int:
    """Return the exit code of all ranks after an error. Alone, this rank would end with `code`.

    Rank 0 calls `show`, which prints the message, and all ranks end with its code. A rank that does not hear from
    rank 0 calls `show` itself and ends all processes.
    """
    if peers.number == 0:
        show()
        peers.close(code)
        return code
    told = peers.await_close()
    if told is None:
        show()
        peers.abort(code)
        return code
    return told
