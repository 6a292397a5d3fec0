"""The paper, statement by statement, and its errata."""
