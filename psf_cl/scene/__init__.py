"""Files to Scene: NumPy only, never OpenCL."""
