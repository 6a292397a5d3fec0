"""Derivatives of runs with respect to parameters, and Floquet multipliers of periodic motions."""
