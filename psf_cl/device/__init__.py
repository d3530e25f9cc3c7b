"""The only package that imports pyopencl: devices, programs, records and parallel primitives."""

import os

# PoCL generates code anew for every local and global size unless told not to: 2 to 3 s each for a
# large kernel, and no gain in speed was measured.  It reads the variable when the driver is loaded.
os.environ.setdefault("POCL_WORK_GROUP_SPECIALIZATION", "0")

# Drivers keep their own caches; programs from pyopencl's have no argument names on some of them.
os.environ.setdefault("PYOPENCL_NO_CACHE", "1")
