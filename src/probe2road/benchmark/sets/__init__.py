"""Simulated fleets on disk: data sets with known truth, made from fixed seeds, and their splits."""
