"""Stability suite: cases, formulations and methods, each run compared with an independent reference."""
