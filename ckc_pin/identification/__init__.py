"""Parameters of a real mechanism from measurements, and motions that make them known."""
