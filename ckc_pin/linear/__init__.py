"""Linear models and the stability of closed loops."""
