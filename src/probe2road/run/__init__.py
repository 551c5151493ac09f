"""Long work: what its stages leave behind, how far it is, and processes that share it."""
