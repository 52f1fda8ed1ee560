"""Ahead-of-time compilation of element-wise kernels."""
