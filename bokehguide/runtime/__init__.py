"""Devices, worker threads, ranks (processes that render one picture), the native core, and settings of the process."""
