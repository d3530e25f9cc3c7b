"""The command line: one module a command.

At their top these modules import only what ``--help`` needs; what takes time or may be missing
(NumPy, OpenCL) is imported where a command uses it.
"""
