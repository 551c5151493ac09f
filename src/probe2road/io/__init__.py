"""Files in and out: readers with a column map, writers that are atomic.

Nothing is imported here, so that reading a CSV does not load what writing OSM needs.
"""
