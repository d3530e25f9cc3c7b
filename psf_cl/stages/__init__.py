"""The stages of a render: each declares what it needs.

A stage's module and its ``.cl`` file share a stem.  Arguments of kernels are found by name among
the planned buffers, so a kernel cannot ask for a buffer of something that is off.
"""
