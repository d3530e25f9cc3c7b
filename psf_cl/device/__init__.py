"""The only package that imports pyopencl: devices, programs, records and parallel primitives."""

import os

# PoCL generates code anew for every local and global size unless told not to: 2 to 3 s each for a
# large kernel, and no gain in speed was measured.  It reads the variable when the driver is loaded.
os.environ.setdefault("POCL_WORK_GROUP_SPECIALIZATION", "0")

# Its default method looks for vectors across work items.  The kernels that matter are written as
# vectors already: it finds none, and takes a fifth of the compile time to do so.
os.environ.setdefault("POCL_WORK_GROUP_METHOD", "loops")

# Drivers keep their own caches; programs from pyopencl's have no argument names on some of them.
os.environ.setdefault("PYOPENCL_NO_CACHE", "1")
