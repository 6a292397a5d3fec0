"""From a scene to a `Run`: prepare, simulate, step, record and save."""
