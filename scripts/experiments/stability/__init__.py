"""The stability suite: cases x formulations x methods, each cell measured against a reference of its own."""
