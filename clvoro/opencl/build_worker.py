"""A process that builds kernels into PoCL's cache; `prebuild` starts it.

It runs as a file, without the import of the package. PoCL compiles a kernel at its first launch, for the size of the
work-group. So each kernel is launched once. All its numbers are zero, so that it works on no items.
"""

import contextlib
import os
import pickle
import sys

import numpy as np
import pyopencl as cl

_BUFFER_BYTES = 1 << 20


def work(platform: int, device: int) -> None:
    """Build the programs and launch the kernels of the `prebuild.Work` on the standard input."""
    ctx = cl.Context([cl.get_platforms()[platform].get_devices()[device]])
    queue = cl.CommandQueue(ctx)
    # The first build loads the compiler, while the parent process prepares the run.
    cl.Program(ctx, "kernel void nothing(void) {}").build(["-D_OPENCL_H_"])
    flags = cl.mem_flags.READ_WRITE | cl.mem_flags.COPY_HOST_PTR
    zeros = cl.Buffer(ctx, flags, hostbuf=np.zeros(_BUFFER_BYTES, np.uint8))
    programs, launches, patient = pickle.load(sys.stdin.buffer)
    built: dict[int, cl.Program] = {}
    eager = True
    for index, name, group, sizes in launches:
        if eager and index >= patient and hasattr(os, "nice"):
            os.nice(10)
            eager = False
        if index not in built:
            text, options = programs[index]
            built[index] = cl.Program(ctx, text).build(options=list(options))
        with contextlib.suppress(cl.Error):  # the record may be from another version
            kernel = cl.Kernel(built[index], name)
            kernel.set_args(*(np.zeros(size, np.uint8) if size else zeros for size in sizes))
            cl.enqueue_nd_range_kernel(queue, kernel, (group,), (group,))
            queue.finish()


if __name__ == "__main__":
    work(int(sys.argv[1]), int(sys.argv[2]))
