"""Lanes of a network and what is painted and built along them."""
