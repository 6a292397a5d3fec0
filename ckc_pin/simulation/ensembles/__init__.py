"""Ensembles: a scene run many times with other numbers, and what came of it as labelled arrays."""
