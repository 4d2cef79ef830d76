"""Compiled kernels, the only place with numba; each stands beside a plain NumPy reference."""
