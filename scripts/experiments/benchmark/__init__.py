"""Benchmark of error against run time: every formulation and method of ckc_pin, and other programs."""
