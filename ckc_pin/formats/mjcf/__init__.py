"""MuJoCo's models: read through MuJoCo's own compiler, and written for it."""
