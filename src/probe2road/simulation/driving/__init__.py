"""Vehicles on a network: routes, lanes, paths, speeds, traffic."""
