"""Road graphs: their tables and invariants, and what can be done to them without any drive."""
