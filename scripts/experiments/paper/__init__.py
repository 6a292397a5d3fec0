"""Experiments on the paper's statements and its errata."""
