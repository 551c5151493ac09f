"""Networks drawn from parameters: corridors, curves, interchanges, towns."""
