"""Arithmetic that knows no camera: guarded operations, sets of bits, linear maps, a thin QR."""
