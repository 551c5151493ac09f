"""Counts in, centreline probability out: segmenters behind one interface."""
