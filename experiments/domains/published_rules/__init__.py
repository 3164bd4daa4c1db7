"""The published rules of the field's domains as pure functions on columns.

The package has these rules in its kernels alone, which draw their own random numbers. Here a replay gives the numbers,
in any floating-point type. `tests/test_batched_kernels.py` compares the kernels with these functions.
"""
