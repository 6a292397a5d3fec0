"""A scene: what to run, as a typed value from a file or from Python."""
