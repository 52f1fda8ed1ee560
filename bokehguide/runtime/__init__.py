"""The process around a render: devices, worker threads, ranks, compiled kernels."""
