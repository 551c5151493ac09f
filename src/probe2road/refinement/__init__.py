"""Traces refine a graph: gaps filled, false junctions split, edges moved and counted."""
