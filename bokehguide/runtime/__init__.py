"""Devices, worker threads, ranks (processes that render one picture), compiled kernels, and settings of the process."""
