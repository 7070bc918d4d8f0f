"""Loops that follow their data, compiled ahead (C++) and called through `jax.ffi` on CPUs."""
