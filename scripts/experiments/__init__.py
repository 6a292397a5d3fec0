"""Experiments on the package: not installed, run by ``./scripts/experiment NAME``."""
