"""Foundations without mechanics: arrays, validation, TOML and XML, atomic files, summaries, linear algebra."""
