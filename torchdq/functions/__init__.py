"""The public functions as computations on numbers, and compiling them ahead of time."""
