"""Random motions, judged by an integration that shares nothing with the package."""
