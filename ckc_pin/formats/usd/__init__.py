"""Universal Scene Description (USD) with physics."""
