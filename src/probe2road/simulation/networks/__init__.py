"""Road networks in 3-D: from OpenStreetMap, with heights, crossings and classes."""
